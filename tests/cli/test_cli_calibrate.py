"""`casadi-ik calibrate`: an estimate that loads as a robot, and one line for a bad file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Command

import casadi_ik as ik
from casadi_ik.calibration import (
    HandModel,
    hand_parameters,
    simulate,
    true_values,
    write_measurements,
)

HEADER = "finger,index_proximal_slider,index_middle_slider,x,y,z,qw,qx,qy,qz\n"
ROW = "index,0.0485,0.0512,-0.0466,0.0921,0.1607,0.0831,0.7023,-0.0829,0.7021\n"


@pytest.fixture
def refused(run: Command, tmp_path: Path) -> Callable[..., str]:
    """Calls `calibrate` and gives the refusal; nothing may be written."""

    def call(path: Path, *words: Any, out: str = "out.yaml", robot: str = "ar10") -> str:
        before = sorted(tmp_path.rglob("*"))
        error = run("calibrate", path, "--robot", robot, "--out", tmp_path / out, *words).error
        assert sorted(tmp_path.rglob("*")) == before
        return error

    return call


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    robot = ik.load_robot("ar10").description
    model = HandModel(robot, hand_parameters(robot, ["index"]))
    rng = np.random.default_rng(1)
    data = simulate(model, true_values(model, rng), "index", 40, rng, outliers=0.05)
    path = tmp_path / "poses.csv"
    write_measurements(data, robot, path)
    return path


def test_calibrate_in_a_process(run_process: Command, poses: Path, tmp_path: Path) -> None:
    out = tmp_path / "my_ar10.yaml"
    done = run_process("calibrate", poses, "--robot", "ar10", "--out", out)
    assert done.exit == 0, done.err
    assert done.out.startswith("ESTIMATED  33 numbers from 40 poses")
    assert "index_proximal.b" in done.out
    robot = ik.load_robot(out)
    assert robot.actuators == ik.load_robot("ar10").actuators
    assert not list(tmp_path.glob(".*"))


def test_a_group_of_numbers(run: Command, poses: Path, tmp_path: Path) -> None:
    out = tmp_path / "tips.yaml"
    done = run("calibrate", poses, "--robot", "ar10", "--estimate", "tips", "--out", out)
    assert done.exit == 0, done.err
    assert "6 numbers" in done.out
    assert "index_proximal.b" not in done.out


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("", "holds no measurements"),
        (HEADER, "holds no measurements"),
        (HEADER.replace(",x,", ",X,") + ROW, ":1: unknown column 'X'; known: finger, x"),
        (HEADER.replace("finger,", "") + ROW, ":1: column 'finger' is missing"),
        (HEADER.replace(",y,", ",x,") + ROW, ":1: column 'x' appears twice"),
        (HEADER.replace(",qz", "") + ROW, ":1: found qw, qx, qy, expected all or none"),
        ("finger,index_proximal_slider,x,y,z\nindex,0.05,0,0,0\n", ":1: column 'index_middle_s"),
        (HEADER + ROW + ROW.replace("index", "toe", 1), ":3: finger: found 'toe', expected one of"),
        (HEADER + ROW + ROW.replace("0.0485", "0.5"), ":3: index_proximal_slider: found 0.5, exp"),
        (HEADER + ROW + "\n" + ROW.replace("0.0921", "a"), ":4: y: found 'a', expected a finite"),
        (HEADER + ROW.replace("0.0921", "nan"), ":2: y: found 'nan', expected a finite number"),
        (HEADER + ROW.replace("0.0921", ""), ":2: y: found '', expected a finite number"),
        (HEADER + ROW.replace("0.0921,", ""), ":2: found 9 columns, the header has 10"),
        (HEADER + ROW.replace("0.7021", "0.9"), ":2: qw..qz: found length 1.148, expected 1"),
        (HEADER + ROW.replace("0.7021", ""), ":2: qz: found '', expected a finite number"),
    ],
)
def test_bad_csv(text: str, fragment: str, refused: Callable[..., str], tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    error = refused(path)
    assert error.startswith(f"{path}:")
    assert fragment in error


def test_bad_options(refused: Callable[..., str], poses: Path, tmp_path: Path) -> None:
    assert "No such file" in refused(tmp_path / "x.csv")
    assert "no shipped" in refused(poses, robot="hand")
    assert "found 'median'" in refused(poses, "--loss", "median")
    assert "found 'screws'" in refused(poses, "--estimate", "screws")
    assert "cannot be written" in refused(poses, out="no/out.yaml")
    assert "expected a name ending in .yaml" in refused(poses, out="out.json")
