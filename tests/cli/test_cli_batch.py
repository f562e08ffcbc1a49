"""`casadi-ik batch`: arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from command_line import FAST, Command

import casadi_ik as ik

TargetFile = Callable[..., Path]
ROBOT = ("--robot", "kuka_lwr_barrett")


def test_all_solved(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    out, log = tmp_path / "solved.npz", tmp_path / "solved.mcap"
    done = run("batch", target_file(), *ROBOT, *FAST, "--out", out, "--log", log)
    assert (done.exit, done.err) == (0, "")
    assert done.out.startswith("SOLVED  3 of 3 targets (100.0 %) of targets.npz: enhanced-dls")
    assert "99th percentile" in done.out
    with np.load(out, allow_pickle=False) as data:
        assert {key: data[key].shape for key in data} == {
            "q": (3, 14),
            "success": (3,),
            "status": (3,),
            "position_error": (3, 3),
            "angle_error": (3, 3),
            "iterations": (3,),
            "restarts": (3,),
            "time": (3,),
        }
        assert data["status"].tolist() == ["SOLVED"] * 3
        assert data["success"].dtype == bool
    assert len(ik.logs.open(log).solves()) == 3
    assert len(list(tmp_path.iterdir())) == 3


def test_not_all_solved_names_rows(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    with np.load(target_file(count=20)) as data:
        points = data["points"].copy()
    points[1:16] += 5.0
    out = tmp_path / "solved.npz"
    done = run("batch", target_file(count=20, points=points), *ROBOT, *FAST, "--out", out)
    assert (done.exit, done.err) == (1, "")
    assert done.out.startswith("NOT ALL SOLVED  5 of 20 targets (25.0 %)")
    assert "rows 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12 and 3 more" in " ".join(done.out.split())
    with np.load(out) as data:
        assert data["success"].tolist() == [True] + [False] * 15 + [True] * 4


def test_jobs_and_start_give_what_the_api_gives(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    path, out = target_file(count=6), tmp_path / "solved.npz"
    start = robot.home + 0.05
    done = run("batch", path, *ROBOT, *FAST, "--jobs", 2, "--q0", *start, "--out", out)
    assert done.exit == 0, done.err
    solver = ik.Solver(robot, "enhanced-dls", finger_step="closed-form")
    with np.load(path) as data:
        batch = solver.solve_batch(data["points"], data["normals"], q0=start)
    with np.load(out) as data:
        np.testing.assert_array_equal(data["q"], batch.q)
        np.testing.assert_array_equal(data["iterations"], batch.iterations)


def test_whole_numbers_are_numbers_too(
    run: Command, target_file: TargetFile, tmp_path: Path
) -> None:
    normals = np.tile(np.array([0, 0, 1], dtype=np.int16), (3, 3, 1))
    path = target_file(normals=normals)
    done = run("batch", path, *ROBOT, *FAST, "--out", tmp_path / "solved.npz")
    assert done.exit in (0, 1), done.err
