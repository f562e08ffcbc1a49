"""Files that unpack to more than they should end in one line, and a flag lets them in."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from torch_zip import write_torch

import casadi_ik as ik
from casadi_ik.cli.main import main

ROBOT = "kuka_lwr_barrett"


def _columns(robot: ik.ArmHand, count: int) -> dict[str, np.ndarray]:
    names = ("x", "y", "z", "roll", "pitch", "yaw", *robot.description.finger_motors)
    return {name: np.full(count, 0.1) for name in names}


def _parquet(path: Path, robot: ik.ArmHand) -> None:
    pl.DataFrame(_columns(robot, 2000)).write_parquet(path)


def _table(path: Path, robot: ik.ArmHand) -> None:
    arrays: dict[str, np.ndarray] = _columns(robot, 2000)
    np.savez_compressed(path, **arrays)  # pyright: ignore[reportArgumentType]


def _csv(path: Path, robot: ik.ArmHand) -> None:
    pl.DataFrame(_columns(robot, 2000)).write_csv(path)


def _targets(path: Path, robot: ik.ArmHand) -> None:
    points, normals = robot.contacts(np.tile(robot.home, (2000, 1)))
    np.savez_compressed(path, points=points, normals=normals)


def _target_table(path: Path, robot: ik.ArmHand) -> None:
    points, normals = robot.contacts(np.tile(robot.home, (30_000, 1)))
    columns = {}
    for i, finger in enumerate(robot.fingers):
        for array, endings in ((points, ("x", "y", "z")), (normals, ("nx", "ny", "nz"))):
            columns |= {f"{finger}_{end}": array[:, i, j] for j, end in enumerate(endings)}
    pl.DataFrame(columns).write_parquet(path)


def _data_set(path: Path, robot: ik.ArmHand) -> None:
    content = {"grasp_qpos": np.zeros((1000, 23))}
    np.save(path, np.array(content, dtype=object))


def _torch(path: Path, robot: ik.ArmHand) -> None:
    write_torch(path, {"metadata": [(np.zeros((100_000,)), "a")]})


def _frames(path: Path, robot: ik.ArmHand) -> None:
    points = np.tile(robot.contacts(robot.home)[0], (5000, 1, 1))
    np.savez_compressed(path, points=points)


def _long(path: Path, robot: ik.ArmHand) -> None:
    points = np.tile(robot.contacts(robot.home)[0], (2, 1, 1))
    np.savez(path, points=points, times=[0.0, 30.0])


@pytest.mark.parametrize(
    ("command", "name", "write", "factor", "says"),
    [
        (
            "choose",
            "set.parquet",
            _parquet,
            1e-3,
            "unpacks to 208000 bytes, expected at most 67108",
        ),
        ("choose", "set.npz", _table, 1e-3, "bytes, expected at most 67108"),
        ("choose", "set.csv", _csv, 1e-3, "bytes, expected at most 67108"),
        ("choose", "targets.npz", _targets, 1e-3, "found 2000 grasps, expected at most 200"),
        ("choose", "set.npy", _data_set, 1e-4, "bytes, expected at most 53687"),
        ("choose", "set.pt", _torch, 1e-4, "bytes, expected at most 53687"),
        ("batch", "targets.parquet", _target_table, 1e-3, "times its size"),
        ("follow", "frames.npz", _frames, 1e-3, "bytes, expected at most 268435"),
        ("follow", "frames.npz", _long, 1e-3, "found 30 s, expected at most 20 s"),
    ],
)
def test_what_is_too_large(
    command: str,
    name: str,
    write: Callable[[Path, ik.ArmHand], None],
    factor: float,
    says: str,
    robot: ik.ArmHand,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Limits a thousand times as small as usual stand for files a thousand times as large."""
    path = tmp_path / name
    write(path, robot)
    out = tmp_path / ("out.npz" if command == "batch" else "out.csv")
    words = [command, str(path), "--robot", ROBOT, "--out", str(out)]
    assert main([*words, "--size-limits", str(factor)]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert "(--size-limits 4, or CASADI_IK_LIMITS=4 in the environment, allows four" in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == [path]


def test_the_flag_lets_in(
    robot: ik.ArmHand,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("CASADI_IK_LIMITS", "1e-3")
    path, out = tmp_path / "frames.npz", tmp_path / "out.csv"
    _long(path, robot)
    words = ["follow", str(path), "--robot", ROBOT, "--out", str(out), "--period", "0.1"]
    assert main([*words, "--size-limits", "1e-5"]) == 2
    assert main([*words, "--size-limits", "1"]) in (0, 1)
    capsys.readouterr()
    assert main([*words, "--size-limits", "0"]) == 2
    assert "expected a number > 0" in capsys.readouterr().err


def test_arrays_that_are_larger_than_their_files(
    robot: ik.ArmHand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A head that says more numbers than there are, and members that are no arrays."""
    path = tmp_path / "frames.npz"
    words = ["follow", str(path), "--robot", ROBOT, "--out", str(tmp_path / "out.csv")]
    np.save(tmp_path / "a.npy", np.zeros((3, 3, 3)))
    data = (tmp_path / "a.npy").read_bytes()
    lying = data.replace(b"(3, 3, 3), }         ", b"(300000000000, 3, 3),}")
    assert lying != data
    for content, says in ((lying, "damaged"), (b"no array", "found values of type bytes")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("points.npy" if content is lying else "points", content)
        assert main(words) == 2
        said = capsys.readouterr().err
        assert says in said
        assert said.count("\n") == 1
