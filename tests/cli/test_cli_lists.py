"""What there is: robots, methods, grasps, a log's contents, versions and help."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
from command_line import FAST, Command

import casadi_ik as ik
from casadi_ik.cli.table import COMMANDS


def test_robots(run: Command, robot: ik.ArmHand) -> None:
    done = run("robots")
    assert (done.exit, done.err) == (0, "")
    words = done.out.replace(",", " ").split()
    for name in (robot.name, *robot.fingers, *robot.actuators, "Kermani"):
        assert name in words
    # How an arm is solved: an S-R-S arm, a swept one, one of three parallel axes, one nearly of a
    # form, and one whose last axis passes by its wrist.
    for word in ("shoulder", "swept", "parallel", "nearly", "off"):
        assert word in words


def test_methods(run: Command) -> None:
    done = run("methods")
    assert (done.exit, done.err) == (0, "")
    for name in ik.METHODS:
        assert name in done.out
    assert done.out.count("(default)") == 1


def test_grasps(run: Command) -> None:
    done = run("grasps")
    assert (done.exit, done.err) == (0, "")
    words = done.out.split()
    for name in (*ik.shipped_names("grasps"), "kuka_lwr_barrett", "baxter_ar10"):
        assert name in words


def test_log_info(run: Command, grasp_file: Callable[..., Path], tmp_path: Path) -> None:
    log = tmp_path / "pinch.mcap"
    run("solve", grasp_file(), *FAST, "--log", log, "--seed", 42)
    done = run("log", "info", log, log)
    assert (done.exit, done.err) == (0, "")
    iterations = ik.logs.open(log).info().counts["enhanced-dls"]["iteration"]
    words = done.out.split()
    for word in ("enhanced-dls", "kuka_lwr_barrett", str(iterations), "SOLVED", "PHASE_CHANGE"):
        assert word in words
    for text in ("bytes/iteration", "seed         42", "numpy", "closed-form", "robot.urdf"):
        assert text in done.out
    assert done.out.count(str(log)) == 2
    assert max(map(len, (x for x in done.out.splitlines() if str(log) not in x))) <= 80


def test_version(run: Command) -> None:
    assert run("--version").out == f"casadi-ik {version('casadi-ik')}\n"


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(command: str, run: Command) -> None:
    """It fits a terminal of 80 columns, and names every option there is."""
    done = run(*command.split(), "--help")
    assert (done.exit, done.err) == (0, "")
    assert done.out.startswith(f"usage: casadi-ik {command}".rstrip())
    assert max(map(len, done.out.splitlines())) <= 80
    groups = ("", "log")
    listed = [name for name in COMMANDS if name.rpartition(" ")[0] == command in groups]
    assert all(name.split()[-1] in done.out.split() for name in listed)
    if command in groups:
        assert run(*command.split()) == done


def test_help_loads_neither_casadi_nor_rich() -> None:
    code = "import sys; from casadi_ik.cli.main import main; main(['--help']); print(*sys.modules)"
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert not {"casadi", "numpy", "rich"}.intersection(done.stdout.split())
