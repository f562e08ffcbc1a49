"""What there is: robots, methods, grasps, a log's contents, versions and help."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
from command_line import FAST, Command

import casadi_ik as ik
from casadi_ik.cli.parser import build_parser

WORDS = {
    "solve": "--picture",
    "batch": "OUT.npz",
    "import": "--palm",
    "robots": "robots",
    "methods": "methods",
    "grasps": "grasps",
    "log": "info",
    "log info": "FILE",
    "log solves": "--status",
    "log events": "--event",
    "log why": "SOLVE",
    "log plot": "--out",
    "log compare": "--methods",
    "log export": "layout",
    "log finish": "FILE",
    "log merge": "--out",
}


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


def test_version(capsys: pytest.CaptureFixture[str], run: Command) -> None:
    with pytest.raises(SystemExit) as ended:
        run("--version")
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"casadi-ik {version('casadi-ik')}\n"


@pytest.mark.parametrize("command", ["", *WORDS])
def test_help(command: str, capsys: pytest.CaptureFixture[str], run: Command) -> None:
    with pytest.raises(SystemExit) as ended:
        run(*command.split(), "--help")
    assert ended.value.code == 0
    assert WORDS.get(command, "examples:") in capsys.readouterr().out


def test_understanding_a_command_line_imports_no_rich(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "rich"]:
        monkeypatch.setitem(sys.modules, name, None)
    assert build_parser().parse_args(["methods"]).run is not None
