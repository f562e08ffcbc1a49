"""Files: unwritable outputs are detected before solving; oversized inputs are refused."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from command_line import FAST, Command
from processes import NO_BYTECODE, NOT_ROOT, POSIX, at_most
from torch_zip import write_torch

import casadi_ik as ik

GraspFile = Callable[..., Path]
TargetFile = Callable[..., Path]


@pytest.fixture
def unsolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every call of the solver fail."""
    monkeypatch.setattr(ik.Solver, "solve_batch", None)


@pytest.mark.usefixtures("unsolved")
@pytest.mark.parametrize("option", ["--out", "--log", "--picture"])
@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("nowhere/new.png", "No such file or directory"),
        ("folder.png", "the path is a directory"),
        ("pinch.yaml/new.png", "Not a directory"),
        ("/proc/new.png", "No such file or directory"),
        ("x" * 260 + ".png", "File name too long"),
    ],
)
def test_unwritable(
    place: str,
    reason: str,
    option: str,
    run: Command,
    grasp_file: GraspFile,
    tmp_path: Path,
) -> None:
    place = place if option == "--picture" else place.replace(".png", ".json")
    grasp, path = grasp_file(), tmp_path / place
    folder = tmp_path / ("folder" + path.suffix)
    folder.mkdir()
    error = run("solve", grasp, *FAST, option, path).error
    assert error == f"{path}: {option}: cannot be written: {reason}"
    assert sorted(item.name for item in tmp_path.iterdir()) == [folder.name, "pinch.yaml"]


@pytest.mark.usefixtures("unsolved")
@NOT_ROOT
@pytest.mark.parametrize("option", ["--out", "--log", "--picture"])
def test_read_only(option: str, run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    suffix = ".png" if option == "--picture" else ".json"
    folder, file = tmp_path / "folder", tmp_path / f"file{suffix}"
    folder.mkdir(mode=0o500)
    file.touch(mode=0o400)
    for path, reason in ((folder / f"new{suffix}", "Permission denied"), (file, "read-only")):
        assert reason in run("solve", grasp_file(), *FAST, option, path).error


@POSIX
@pytest.mark.usefixtures("unsolved")
def test_special_files_are_left_alone(run: Command, grasp_file: GraspFile) -> None:
    error = run("solve", grasp_file(), *FAST, "--out", "/dev/null").error
    assert error.startswith("/dev/null: ")
    assert not Path("/dev/null").is_file()


@pytest.mark.usefixtures("unsolved")
def test_outputs_do_not_overwrite_each_other_or_the_input(
    run: Command, grasp_file: GraspFile, tmp_path: Path
) -> None:
    grasp, same_path = grasp_file(), tmp_path / "same"
    (tmp_path / "link").symlink_to("same")
    error = run("solve", grasp, "--out", same_path, "--log", tmp_path / "link").error
    assert error.startswith(f"{same_path}: --out: ")
    assert "--log" in error
    (tmp_path / "input.json").hardlink_to(grasp)
    error = run("solve", grasp, "--out", tmp_path / "input.json").error
    assert "--out" in error
    assert grasp.read_text().startswith("contacts:")


@POSIX
@pytest.mark.parametrize("size", [4_000, 16_000])
def test_disk_full_on_the_log(
    size: int, run: Command, run_process: Command, grasp_file: GraspFile, tmp_path: Path
) -> None:
    grasp = grasp_file()
    assert run("solve", grasp, *FAST).exit == 0  # kernels are compiled, nothing else is written
    words = ("solve", grasp, *FAST, "--log", "new.mcap", "--out", "new.json")
    error = run_process(*words, preexec_fn=at_most(size), env=NO_BYTECODE).error
    assert error == "new.mcap: cannot write the log: File too large"
    assert [item.name for item in tmp_path.iterdir()] == [grasp.name]


@POSIX
def test_disk_full_on_the_output(
    run: Command, run_process: Command, target_file: TargetFile, tmp_path: Path
) -> None:
    targets = target_file(count=20)
    out = tmp_path / "solved.npz"
    words = ("batch", targets, "--robot", "kuka_lwr_barrett", *FAST, "--out", out)
    assert run(*words).exit == 0
    data_before = out.read_bytes()
    error = run_process(*words, preexec_fn=at_most(2_000), env=NO_BYTECODE).error
    assert error == f"{out}: --out: cannot be written: File too large"
    assert out.read_bytes() == data_before
    assert len(list(tmp_path.iterdir())) == 2


def test_links_are_followed(run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    link.symlink_to(target)
    assert run("solve", grasp_file(), *FAST, "--out", link).exit == 0
    assert link.is_symlink()
    assert target.read_text().startswith("{")


def _columns(robot: ik.ArmHand, count: int) -> dict[str, np.ndarray]:
    names = ("x", "y", "z", "roll", "pitch", "yaw", *robot.actuators[7:])
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
        ("choose", "set.parquet", _parquet, 1e-3, "67108"),
        ("choose", "set.npz", _table, 1e-3, "67108"),
        ("choose", "set.csv", _csv, 1e-3, "67108"),
        ("choose", "targets.npz", _targets, 1e-3, "found 2000 grasps, expected at most 200"),
        ("choose", "set.npy", _data_set, 1e-4, "53687"),
        ("choose", "set.pt", _torch, 1e-4, "53687"),
        ("batch", "targets.parquet", _target_table, 1e-3, "times its size"),
        ("follow", "frames.npz", _frames, 1e-3, "268435"),
        ("follow", "frames.npz", _long, 1e-3, "30 s"),
    ],
)
def test_oversized_files_are_refused(
    command: str,
    name: str,
    write: Callable[[Path, ik.ArmHand], None],
    factor: float,
    says: str,
    run: Command,
    robot: ik.ArmHand,
    tmp_path: Path,
) -> None:
    """Size limits reduced by a factor of 1000 stand for files that are 1000 times larger."""
    path = tmp_path / name
    write(path, robot)
    out = tmp_path / {"batch": "out.npz", "choose": "out.json", "follow": "out.csv"}[command]
    words = (command, path, "--robot", robot.name, "--out", out)
    error = run(*words, "--size-limits", factor).error
    assert says in error
    assert "(--size-limits 4, or CASADI_IK_LIMITS=4 in the environment, allows four" in error
    assert list(tmp_path.iterdir()) == [path]


def test_limit_option_admits_large_files(
    run: Command, robot: ik.ArmHand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CASADI_IK_LIMITS", "1e-3")
    path, out = tmp_path / "frames.npz", tmp_path / "out.csv"
    _long(path, robot)
    words = ("follow", path, "--robot", robot.name, "--out", out, "--period", "0.1")
    assert run(*words, "--size-limits", "1e-5").exit == 2
    assert run(*words, "--size-limits", "1").exit in (0, 1)
    assert "expected a number > 0" in run(*words, "--size-limits", "0").error


def test_arrays_that_are_larger_than_their_files(
    run: Command, robot: ik.ArmHand, tmp_path: Path
) -> None:
    """Headers that claim too many numbers, and members without arrays, are refused."""
    path = tmp_path / "frames.npz"
    np.save(tmp_path / "a.npy", np.zeros((3, 3, 3)))
    data = (tmp_path / "a.npy").read_bytes()
    lying = data.replace(b"(3, 3, 3), }         ", b"(300000000000, 3, 3),}")
    assert lying != data
    for content, says in ((lying, "damaged"), (b"no array", "found values of type bytes")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("points.npy" if content is lying else "points", content)
        words = ("follow", path, "--robot", robot.name, "--out", tmp_path / "out.csv")
        assert says in run(*words).error
