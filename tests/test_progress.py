"""Progress output where `sys.stderr` is not the stream of a terminal."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.compile.compiler import print_note


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
@pytest.mark.parametrize("policy", ["wait", "background"])
def test_a_stream_without_isatty(
    solver: ik.Solver, monkeypatch: pytest.MonkeyPatch, stream: Any, policy: str
) -> None:
    points, normals = solver.robot.contacts(solver.robot.random(np.random.default_rng(0), 5))
    monkeypatch.setattr(sys, "stderr", stream)
    assert len(solver.solve_batch(points, normals).success) == 5
    monkeypatch.setenv("CASADI_IK_COMPILE", policy)
    print_note("compiling")
    if isinstance(stream, LogStream) and policy == "background":
        assert stream.text.endswith("compiling\n")
