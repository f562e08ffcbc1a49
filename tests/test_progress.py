"""Progress output where `sys.stderr` is not the stream of a terminal."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import python

import casadi_ik as ik


class LogStream:
    """Stream of a program with `write` only."""

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> None:
        self.text += text


class ClosedTerminal(LogStream):
    """Closed stream, of which every use is an error."""

    closed = True

    def isatty(self) -> bool:
        raise ValueError("I/O operation on closed file")


@pytest.mark.parametrize("stream", [None, LogStream(), ClosedTerminal()])
def test_a_stream_without_isatty(
    solver: ik.Solver, monkeypatch: pytest.MonkeyPatch, stream: Any
) -> None:
    points, normals = solver.robot.contacts(solver.robot.random(np.random.default_rng(0), 5))
    monkeypatch.setattr(sys, "stderr", stream)
    assert len(solver.solve_batch(points, normals).success) == 5


NOTE = """
import sys
class LogStream:
    def write(self, text):
        sys.stdout.write(text)
sys.stderr = LogStream()
import casadi_ik as ik
robot = ik.load_robot("allegro_right")
contacts = zip(robot.fingers, *robot.contacts(robot.home))
grasp = ik.Grasp({name: ik.Contact(point, normal) for name, point, normal in contacts})
assert ik.Solver(robot).solve(grasp).success
sys.stderr = sys.__stderr__
"""


def test_the_compiler_announces_itself_on_any_stream(tmp_path: Path) -> None:
    environment = {"CASADI_IK_CACHE": str(tmp_path), "CASADI_IK_COMPILE": "background"}
    done = python("-c", NOTE, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert "allegro_right" in done.stdout
