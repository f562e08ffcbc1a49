"""The program as the shell sees it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
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
    assert "COMMAND" in run_process().error


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


def test_interrupted(tmp_path: Path) -> None:
    """In the middle of a long batch: one line, the exit code of an interrupt, no half file."""
    robot = ik.load_robot("kuka_lwr_barrett")
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), 3000))
    targets, out = tmp_path / "targets.npz", tmp_path / "out.npz"
    np.savez(targets, points=points, normals=normals)
    process = subprocess.Popen(
        [*PROGRAM, "batch", targets, "--robot", robot.name, "--method", "ipopt", "--out", out],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    # On a busy machine the first use may compile for minutes.
    started = time.monotonic()
    while not list(tmp_path.glob(".batch-*")) and time.monotonic() < started + 300:
        time.sleep(0.05)
    time.sleep(0.5)
    deadline = time.monotonic() + 60
    # One that arrives before the handler stands may be lost: press again.
    while process.poll() is None and time.monotonic() < deadline:
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5)
    process.kill()
    said, error = process.communicate()
    assert process.returncode == 130
    assert (said, error.splitlines()[-1]) == ("", "casadi-ik: error: interrupted")
    assert list(tmp_path.iterdir()) == [targets]


def test_bugs_are_not_hidden(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("casadi_ik.cli.lists.methods", broken)
    with pytest.raises(ZeroDivisionError):
        run("methods")


def test_warnings_are_one_line(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    import warnings

    real = entry.build_parser

    def warn() -> object:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("no C compiler:\n slower", UserWarning, stacklevel=1)
        return real()

    monkeypatch.setattr(entry, "build_parser", warn)
    done = run("methods")
    assert (done.exit, done.err) == (0, "casadi-ik: warning: no C compiler: slower\n")
