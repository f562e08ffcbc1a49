"""Fixtures that call the command line, and files for it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import POSTURE, Command, Run, solvable
from commands import main
from processes import python

import casadi_ik as ik


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Command:
    """Function that calls the command line in this process."""

    def call(*words: object) -> Run:
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        return Run(code, captured.out, captured.err)

    return call


@pytest.fixture
def run_process(tmp_path: Path) -> Command:
    """Function that calls the command line in a process of its own."""

    def call(*words: object, **options: Any) -> Run:
        done = python("-m", "casadi_ik", *words, cwd=tmp_path, **options)
        return Run(done.returncode, done.stdout, done.stderr)

    return call


@pytest.fixture(scope="session")
def contacts(robot: ik.ArmHand) -> dict[str, dict[str, list[float]]]:
    """Contacts of a reachable configuration, in the form of a grasp file."""
    points, normals = robot.contacts(POSTURE)
    return {
        name: {"point": points[i].tolist(), "normal": normals[i].tolist()}
        for i, name in enumerate(robot.fingers)
    }


@pytest.fixture
def grasp_file(tmp_path: Path, contacts: dict[str, Any]) -> Callable[..., Path]:
    """Function that writes a grasp file; keyword arguments replace keys, None deletes one."""

    def write(name: str = "pinch.yaml", **changes: Any) -> Path:
        data = {"robot": "kuka_lwr_barrett", "contacts": contacts} | changes
        path = tmp_path / name
        path.write_text(yaml.safe_dump({k: v for k, v in data.items() if v is not None}))
        return path

    return write


@pytest.fixture
def far_away(grasp_file: Callable[..., Path], contacts: dict[str, Any]) -> Path:
    """Valid grasp file of a grasp out of reach."""
    far_contacts = {
        name: {"point": [x + 5.0 for x in contact["point"]], "normal": contact["normal"]}
        for name, contact in contacts.items()
    }
    return grasp_file("far_away.yaml", contacts=far_contacts)


@pytest.fixture
def target_file(tmp_path: Path, robot: ik.ArmHand) -> Callable[..., Path]:
    """Function that writes three reachable targets; keyword arguments replace arrays."""

    def write(name: str = "targets.npz", count: int = 3, **changes: Any) -> Path:
        points, normals = solvable(robot, count)
        path = tmp_path / name
        np.savez(path, **{"points": points, "normals": normals} | changes)
        return path

    return write


@pytest.fixture(scope="session")
def ranked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ranked grasps of `casadi-ik choose` on a table."""
    folder = tmp_path_factory.mktemp("ranked")
    contacts = {
        name: {"point": contact.point.tolist(), "normal": contact.normal.tolist()}
        for name, contact in ik.load_grasp("cup").contacts.items()
    }
    data = {"candidates": [{"contacts": contacts}]}
    (folder / "candidates.yaml").write_text(yaml.safe_dump(data))
    words = ["choose", folder / "candidates.yaml", "--robot", "kuka_lwr_barrett", "--scene"]
    words += ["table", "--limit", "3", "--per-candidate", "3", "--out", folder / "ranked.json"]
    python("-m", "casadi_ik", *words, check=True)
    return folder / "ranked.json"
