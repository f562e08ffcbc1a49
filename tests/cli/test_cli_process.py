"""The program as the shell sees it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import FAST, Command, Run

import casadi_ik as ik
from casadi_ik.cli import main as entry

PROGRAM = [sys.executable, "-m", "casadi_ik"]


def test_exit_codes(
    run_process: Command, grasp_file: Callable[..., Path], far_away: Path, tmp_path: Path
) -> None:
    assert run_process("solve", grasp_file(), *FAST).exit == 0
    assert run_process("solve", far_away, *FAST).exit == 1
    assert run_process("solve", tmp_path / "nothing.yaml").error.endswith("no such file")


def test_console_script() -> None:
    script = Path(sys.executable).with_name("casadi-ik")
    done = subprocess.run([script, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("casadi-ik ")


def test_reader_goes_away() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [*PROGRAM, "grasps"], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_stdout_is_full() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*PROGRAM, "grasps"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    error = Run(done.returncode, "", done.stderr).error
    assert error == "<stdout>: cannot be written: No space left on device"


def test_poor_terminal(run_process: Command) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "40"}
    done = run_process("grasps", env=environment)
    assert (done.exit, done.err) == (0, "")
    assert done.out.isascii()


@pytest.mark.parametrize(
    ("jobs", "finished", "signal_sent"),
    [
        (1, False, signal.SIGINT),
        (1, True, signal.SIGINT),
        (2, False, signal.SIGTERM),
        (2, True, signal.SIGINT),
        (1, True, signal.SIGTERM),
    ],
)
def test_interrupted(
    tmp_path: Path, jobs: int, finished: bool, signal_sent: signal.Signals
) -> None:
    """In the middle of a long batch: the exit code of the signal, and what is finished stays."""
    robot = ik.load_robot("kuka_lwr_barrett")
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), 3000))
    targets, out = tmp_path / "targets.npz", tmp_path / "out.npz"
    np.savez(targets, points=points, normals=normals)
    process = start_batch(targets, out, "--method", "ipopt", "--jobs", str(jobs))
    assert wait_for(tmp_path, finished)
    process.send_signal(signal_sent)
    said, error = process.communicate(timeout=120)  # the batch would take longer
    interrupted = signal_sent == signal.SIGINT
    assert process.returncode == (130 if interrupted else 143)
    lines = error.splitlines()
    ended = "interrupted" if interrupted else "terminated"
    assert (said, lines[-1]) == ("", f"casadi-ik: error: {ended}")
    if not finished and not out.exists():
        assert list(tmp_path.iterdir()) == [targets]
        return
    with np.load(out) as kept:
        count = len(kept["q"])
        assert 0 < count < 3000
        assert {len(kept[name]) for name in kept.files} == {count}
        assert kept["success"].all()
        reached, _ = robot.contacts(kept["q"])
    np.testing.assert_allclose(reached, points[:count], atol=5e-3)
    assert lines[-2] == f"casadi-ik: interrupted: {out} keeps the first {count} of 3000 rows"
    assert sorted(tmp_path.iterdir()) == [out, targets]


def start_batch(targets: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    """A batch that takes minutes."""
    return subprocess.Popen(
        [*PROGRAM, "batch", targets, "--robot", "kuka_lwr_barrett", "--out", out, *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def wait_for(folder: Path, finished: bool) -> bool:
    """Whether a batch has begun its output, or even finished a block, within five minutes."""
    # On a busy machine the first use may compile for minutes.
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        if list(folder.glob(".batch-*/q" if finished else ".batch-*")):
            if not finished:
                time.sleep(0.5)
            return True
        time.sleep(0.05)
    return False


def test_a_killed_batch(tmp_path: Path) -> None:
    """It leaves no result; what it leaves is removed by a later one that finds it old."""
    robot = ik.load_robot("kuka_lwr_barrett")
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), 300))
    targets, out = tmp_path / "targets.npz", tmp_path / "out.npz"
    np.savez(targets, points=points, normals=normals)
    process = start_batch(targets, out, "--method", "ipopt")
    assert wait_for(tmp_path, finished=False)
    process.kill()
    process.communicate()
    assert not out.exists()
    (left,) = tmp_path.glob(".batch-*")
    young = tmp_path / f".batch-{os.getpid()}-running"
    young.mkdir()
    np.savez(targets, points=points[:2], normals=normals[:2])
    again = ["batch", str(targets), "--robot", robot.name, "--out", str(out)]
    assert entry.main(again) == 0
    assert left.exists()  # a process elsewhere could be at it
    then = time.time() - 3700
    for path in (*left.iterdir(), left, young):
        os.utime(path, (then, then))
    assert entry.main(again) == 0
    assert sorted(tmp_path.iterdir()) == sorted([young, out, targets])


def test_bugs_are_not_hidden(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("casadi_ik.cli.lists.method_summary", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run("methods")


def test_warnings_are_one_line(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def warn(name: str) -> str:
        with warnings.catch_warnings():
            warnings.simplefilter("once")
            warnings.warn("no C compiler:\n slower", UserWarning, stacklevel=1)
        return name

    monkeypatch.setattr("casadi_ik.cli.lists.method_summary", warn)
    done = run("methods")
    assert done.exit == 0
    assert set(done.err.splitlines()) == {"casadi-ik: warning: no C compiler: slower"}
