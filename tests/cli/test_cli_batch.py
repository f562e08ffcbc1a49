"""`casadi-ik batch`: arrays as input and output."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from command_line import FAST, Command

import casadi_ik as ik

TargetFile = Callable[..., Path]
ROBOT = ("--robot", "kuka_lwr_barrett")


def test_solved_batch_is_written(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    out, log = tmp_path / "solved.npz", tmp_path / "solved.mcap"
    done = run("batch", target_file(), *ROBOT, *FAST, "--out", out, "--log", log).fine()
    assert done.out.startswith("SOLVED  3 of 3 targets (100.0 %) of targets.npz: enhanced-dls")
    assert "99th percentile" in done.out
    assert "collision   not checked" in done.out
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


def test_unsolved_rows_are_listed(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    with np.load(target_file(count=20)) as data:
        points = data["points"].copy()
    points[1:16] += 5.0
    out = tmp_path / "solved.npz"
    done = run("batch", target_file(count=20, points=points), *ROBOT, *FAST, "--out", out)
    assert (done.exit, done.err) == (1, "")
    assert done.out.startswith("NOT ALL SOLVED  5 of 20 targets (25.0 %)")
    assert "rows 1, 2, 3, 4, 5, 6, 7, 8, 9, 10 and 5 more" in " ".join(done.out.split())
    with np.load(out) as data:
        assert data["success"].tolist() == [True] + [False] * 15 + [True] * 4


def test_jobs_and_start_match_the_api(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    """Integers are accepted as numbers."""
    path, out = target_file(count=6), tmp_path / "solved.npz"
    up = target_file("up.npz", normals=np.tile(np.array([0, 0, 1], dtype=np.int16), (3, 3, 1)))
    assert run("batch", up, *ROBOT, *FAST, "--out", out).exit in (0, 1)
    start = robot.home + 0.05
    done = run("batch", path, *ROBOT, *FAST, "--jobs", 2, "--q0", *start, "--out", out)
    assert done.exit == 0, done.err
    solver = ik.Solver(robot, "enhanced-dls", finger_step="closed-form")
    with np.load(path) as data:
        batch = solver.solve_batch(data["points"], data["normals"], q0=start)
    with np.load(out) as data:
        np.testing.assert_array_equal(data["q"], batch.q)
        np.testing.assert_array_equal(data["iterations"], batch.iterations)


@pytest.fixture
def hands(robot: ik.ArmHand, tmp_path: Path) -> Callable[[int], Path]:
    """Function that writes random targets, every seventh out of reach and one malformed."""

    def write(count: int) -> Path:
        points, normals = robot.contacts(robot.random(np.random.default_rng(5), count))
        points[::7] += 0.4
        points[count // 2, 0, 0] = np.inf
        path = tmp_path / "hands.npz"
        np.savez_compressed(path, points=np.asfortranarray(points), normals=normals.astype("f4"))
        return path

    return write


@pytest.mark.parametrize(("method", "count"), [("hand-first", 60), ("ipopt", 6)])
def test_results_are_independent_of_blocks_and_jobs(
    run: Command,
    hands: Callable[[int], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    count: int,
) -> None:
    """The layout of the arrays in the file does not matter; a log numbers the rows of the file."""
    answers = []
    for block, jobs in ((4096, 1), (5, 2), (1, 1)):
        monkeypatch.setattr("casadi_ik.app.cli.batch.MAX_BLOCK", block)
        out, log = tmp_path / f"{block}.npz", tmp_path / f"{block}.mcap"
        words = ("--method", method, "--jobs", jobs, "--seed", 3, "--out", out, "--log", log)
        assert run("batch", hands(count), *ROBOT, *words).exit == 1
        with np.load(out, allow_pickle=False) as data:
            answers.append({key: data[key] for key in data if key != "time"})
        solves = list(ik.logs.open(log).solves().records())
        rows = np.delete(np.arange(count), count // 2)
        assert [solve["solve_id"] for solve in solves] == rows.tolist()
        assert [solve["status"] for solve in solves] == answers[0]["status"][rows].tolist()
    for answer in answers[1:]:
        for key, value in answers[0].items():
            np.testing.assert_array_equal(answer[key], value, err_msg=key)


def test_diagnoses_are_written_on_request(
    run: Command, hands: Callable[[int], Path], tmp_path: Path
) -> None:
    out = tmp_path / "o.npz"
    done = run("batch", hands(30), *ROBOT, "--diagnose", "--out", out)
    with np.load(out, allow_pickle=False) as data:
        unreachable = np.isin(data["status"], ["UNREACHABLE", "NOT_FOUND"])
        assert unreachable.sum() >= 2
        assert set(data["reason"][unreachable]) <= {"HAND", "REACH", "LIMITS", "NOT_FOUND"}
        assert not np.isnan(data["nearest_q"][unreachable]).any()
        assert (data["reason"][data["success"]] == "").all()
        assert np.isnan(data["enough_position"][data["success"]]).all()
    assert "reasons" in done.out


def test_a_table_of_answers(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    path, words = target_file(), (*ROBOT, "--diagnose", "--scene", "table")
    for out in ("o.npz", "o.parquet"):
        assert "scene table" in run("batch", path, *words, "--out", tmp_path / out).out
    rows = pl.read_parquet(tmp_path / "o.parquet")
    with np.load(tmp_path / "o.npz") as data:
        motors = [f"q_{name}" for name in robot.actuators]
        np.testing.assert_array_equal(rows.select(motors).to_numpy(), data["q"])
        errors = [f"{name}_angle_error" for name in robot.fingers]
        np.testing.assert_array_equal(rows.select(errors).to_numpy(), data["angle_error"])
        assert rows["status"].to_list() == data["status"].tolist()
        assert data["clearance"].shape == (3,)
        assert set(data.files) - {"q", "nearest_q", "position_error", "angle_error"} < set(
            rows.columns
        )


def test_a_table_needs_polars(
    run: Command, target_file: TargetFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "polars", None)
    error = run("batch", target_file(), *ROBOT, "--out", tmp_path / "o.parquet").error
    assert error == "--out: Parquet files need polars: pip install polars"


def test_process(run_process: Command, target_file: TargetFile, tmp_path: Path) -> None:
    """A damaged end of the file is detected before solving, and nothing is left behind."""
    path, out = target_file(count=50), tmp_path / "o.npz"
    done = run_process("batch", path, *ROBOT, "--out", out).fine()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["o.npz", "targets.npz"]
    out.unlink()
    data = bytearray(path.read_bytes())
    data[data.index(b"normals.npy") + 3000] ^= 1
    path.write_bytes(data)
    done = run_process("batch", path, *ROBOT, "--out", out)
    assert "normals: cannot be read: Bad CRC-32" in done.error
    assert [file.name for file in tmp_path.iterdir()] == ["targets.npz"]


def test_targets_in_the_frame_of_an_object(
    run: Command, target_file: TargetFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    out = tmp_path / "solved.npz"
    pose = ["0.01", "0", "-0.02", "0", "0", "0.1"]
    done = run("batch", target_file(), *ROBOT, "--out", out, "--object-pose", *pose)
    assert done.exit == 0
    with np.load(target_file()) as data, np.load(out) as answers:
        c, s = np.cos(0.1), np.sin(0.1)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        points, normals = robot.contacts(answers["q"])
        offsets = points - (data["points"] @ turn + [0.01, 0, -0.02])
        assert np.linalg.norm(offsets, axis=-1).max() < ik.Tolerance().position
        assert (normals * (data["normals"] @ turn)).sum(axis=-1).min() > np.cos(
            ik.Tolerance().angle
        )
