"""Outputs: found unwritable before the solve, complete afterwards or not there at all."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import FAST, Command

import casadi_ik as ik
from casadi_ik.cli.outputs import OutputError, check_outputs, write_output

GraspFile = Callable[..., Path]
TargetFile = Callable[..., Path]


@pytest.fixture
def unsolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may be solved in this test."""
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
    grasp, path = grasp_file(), tmp_path / place
    (tmp_path / "folder.png").mkdir()
    error = run("solve", grasp, *FAST, option, path).error
    assert error == f"{path}: {option}: cannot be written: {reason}"
    assert sorted(item.name for item in tmp_path.iterdir()) == ["folder.png", "pinch.yaml"]


@pytest.mark.usefixtures("unsolved")
@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("option", ["--out", "--log", "--picture"])
def test_read_only(option: str, run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    folder, file = tmp_path / "folder", tmp_path / "file.png"
    folder.mkdir(mode=0o500)
    file.touch(mode=0o400)
    for path, reason in ((folder / "new.png", "Permission denied"), (file, "read-only")):
        assert reason in run("solve", grasp_file(), *FAST, option, path).error


@pytest.mark.usefixtures("unsolved")
def test_special_files_are_left_alone(run: Command, grasp_file: GraspFile) -> None:
    error = run("solve", grasp_file(), *FAST, "--out", "/dev/null").error
    assert "not a regular file" in error
    assert not Path("/dev/null").is_file()


@pytest.mark.usefixtures("unsolved")
def test_outputs_do_not_overwrite_each_other_or_the_input(
    run: Command, grasp_file: GraspFile, tmp_path: Path
) -> None:
    grasp, same = grasp_file(), tmp_path / "same"
    (tmp_path / "link").symlink_to("same")
    error = run("solve", grasp, "--out", same, "--log", tmp_path / "link").error
    assert error == f"{same}: --out: found the file of --log, expected another"
    error = run("solve", grasp, "--out", tmp_path / "." / grasp.name).error
    assert "found the file of the input" in error
    assert grasp.read_text().startswith("contacts:")


def _at_most(size: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


@pytest.mark.parametrize("size", [4_000, 16_000])
def test_disk_full_on_the_log(
    size: int, run: Command, run_process: Command, grasp_file: GraspFile, tmp_path: Path
) -> None:
    grasp = grasp_file()
    assert run("solve", grasp, *FAST).exit == 0  # kernels are compiled, nothing else is written
    words = ("solve", grasp, *FAST, "--log", "new.mcap", "--out", "new.json")
    error = run_process(*words, preexec_fn=_at_most(size)).error
    assert error == "new.mcap: cannot write the log: File too large"
    assert [item.name for item in tmp_path.iterdir()] == [grasp.name]


def test_disk_full_on_the_output(
    run: Command, run_process: Command, target_file: TargetFile, tmp_path: Path
) -> None:
    targets = target_file(count=20)
    out = tmp_path / "solved.npz"
    words = ("batch", targets, "--robot", "kuka_lwr_barrett", *FAST, "--out", out)
    assert run(*words).exit == 0
    before = out.read_bytes()
    error = run_process(*words, preexec_fn=_at_most(2_000)).error
    assert error == f"{out}: --out: cannot be written: File too large"
    assert out.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 2


def test_links_are_followed(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    link.symlink_to(target)
    check_outputs({"--out": link})
    write_output(link, "--out", lambda part: part.write_text("new"))
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_what_was_there_stays_if_writing_fails(tmp_path: Path) -> None:
    def fail(part: Path) -> None:
        part.write_text("half")
        raise OSError(28, "No space left on device")

    path = tmp_path / "out"
    path.write_text("old")
    with pytest.raises(OutputError, match="No space left on device"):
        write_output(path, "--out", fail)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
