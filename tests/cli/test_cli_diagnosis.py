"""`casadi-ik solve` says why a grasp cannot be solved."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from command_line import Command


def test_report_says_why(run: Command, far_away: Path) -> None:
    done = run("solve", far_away)
    assert (done.exit, done.err) == (1, "")
    assert done.out.startswith("UNREACHABLE")
    text = " ".join(done.out.split())
    assert "the hand fits the contacts, but the arm does not reach there" in text
    assert "too far for the arm by" in text
    assert "solvable within" in text


def test_json_says_why(run: Command, far_away: Path, tmp_path: Path) -> None:
    out = tmp_path / "far.json"
    assert run("solve", far_away, "--out", out).exit == 1
    found = json.loads(out.read_text())
    diagnosis = found["diagnosis"]
    assert (found["status"], diagnosis["reason"]) == ("UNREACHABLE", "REACH")
    assert diagnosis["established"] is True
    assert diagnosis["reach"]["distance"] > diagnosis["reach"]["farthest"]
    assert set(diagnosis["nearest"]) == {"thumb", "finger_2", "finger_3"}
    assert len(diagnosis["q"]) == len(found["actuators"])


def test_json_of_a_solved_grasp(
    run: Command, grasp_file: Callable[..., Path], tmp_path: Path
) -> None:
    out = tmp_path / "solved.json"
    assert run("solve", grasp_file(), "--out", out).exit == 0
    assert json.loads(out.read_text())["diagnosis"] is None
