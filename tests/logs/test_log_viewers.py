"""The log read by the npm packages that Foxglove and Lichtblick are made of."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_solves import make_block

import casadi_ik as ik
from casadi_ik.logs import one_solve
from casadi_ik.logs.viewers import write_view

PACKAGES = (
    "@mcap/core@2.2.2",
    "@foxglove/rosmsg@5.0.5",
    "@foxglove/rosmsg2-serialization@3.1.0",
    "fzstd@0.1.1",
    "protobufjs@7.4.0",
)


@pytest.fixture(scope="module")
def packages() -> Path:
    """A folder with the packages, made once per machine; without node or registry, no test."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("needs node and npm")
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    folder = cache / "casadi_ik_tests" / "-".join(name.rpartition("@")[2] for name in PACKAGES)
    if not (folder / "complete").exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [npm, "install", "--no-audit", "--no-fund", "--prefix", folder, *PACKAGES]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=120)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            pytest.skip(f"npm cannot install: {error}")
        (folder / "complete").touch()
    return folder


def read(packages: Path, path: Path) -> list[dict[str, Any]]:
    """Topic, time and values of every message, by time."""
    script = Path(__file__).parent / "read_log.mjs"
    done = subprocess.run(
        ["node", script, packages, path], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def numbers(value: Any) -> np.ndarray:
    """Numbers as the script prints them."""
    names = {"NaN": np.nan, "Infinity": np.inf, "-Infinity": -np.inf}
    items = value if isinstance(value, list) else [value]
    return np.array([names[x] if isinstance(x, str) else x for x in items], dtype=float)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_mcap_core_and_rosmsg2_serialization(
    packages: Path, tmp_path: Path, write: Callable[..., Path], compression: str
) -> None:
    path = write(make_block(40, 7), urdf="<robot/>", compression=compression)
    messages = read(packages, path)
    log = ik.logs.open(path)
    for kind, table in (
        ("iteration", log.iterations()),
        ("solve", log.solves()),
        ("event", log.events()),
    ):
        found = [m for m in messages if m["topic"] == f"/ik/enhanced-dls/{kind}"]
        assert len(found) == len(table) > 0
        for message, row in zip(found, table.rows, strict=True):
            for name in table.names:
                np.testing.assert_array_equal(numbers(message["values"][name]), row[name].ravel())
    times = [int(message["time"]) for message in messages]
    assert times == sorted(times)


def test_the_viewer_file(packages: Path, tmp_path: Path, robot: ik.ArmHand) -> None:
    """Every topic is deserialised, and tells what the solver did."""
    log, view = tmp_path / "cup.mcap", tmp_path / "view.mcap"
    grasp = ik.load_grasp("cup")
    ik.Solver(robot).solve(grasp, log=log)
    solve = one_solve(ik.logs.open(log))
    write_view(view, solve, robot)
    messages = read(packages, view)
    topics: dict[str, list[dict[str, Any]]] = {}
    for message in messages:
        topics.setdefault(message["topic"], []).append(message["values"])
    assert {topic: len(found) for topic, found in topics.items() if topic != "/ik/messages"} == {
        **dict.fromkeys(("/robot_description", "/ik/targets"), 1),
        **dict.fromkeys(("/tf", "/joint_states", "/ik/contacts", "/ik/iteration"), len(solve.rows)),
    }
    assert topics["/robot_description"][0]["data"] == robot.urdf()
    targets = {entity["id"]: entity for entity in topics["/ik/targets"][0]["entities"]}
    for finger, contact in grasp.contacts.items():
        position = targets[f"{finger} target"]["spheres"][0]["pose"]["position"]
        np.testing.assert_allclose([position[axis] for axis in "xyz"], contact.point)
    for row in (0, -1):
        joints = topics["/joint_states"][row]
        found = dict(zip(joints["name"], joints["position"], strict=True))
        assert found == pytest.approx(robot.joints(solve.rows["q"][row]))
        children = {frame["child_frame_id"] for frame in topics["/tf"][row]["transforms"]}
        assert children >= {f"{finger}_contact" for finger in robot.fingers}
        np.testing.assert_array_equal(
            numbers(topics["/ik/iteration"][row]["q"]), solve.rows["q"][row]
        )
    lines = [values["message"] for values in topics["/ik/messages"]]
    assert any(line.startswith("SOLVED after") for line in lines)
