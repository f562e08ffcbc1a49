"""How hard the compiler optimises changes no bit, so long sources may spare it the work."""

from __future__ import annotations

import numpy as np
import pytest

from casadi_ik.kernels import LoopKernel
from casadi_ik.kernels.compiler import find_compiler

from .graphs import branching_step, needs_compiler, random_step

pytestmark = needs_compiler

COUNT = 40


def iterates() -> bytes:
    """Of steps one after the other and side by side."""
    rng = np.random.default_rng(0)
    found = []
    for step in (random_step(0), branching_step()):
        kernel = LoopKernel(step)
        states, parameters = rng.normal(size=(COUNT, 4)), rng.normal(size=(COUNT, 2))
        one = kernel.run(states[:1], parameters[:1], 300, trace=True)
        _ = kernel.lanes
        result = kernel.run(states, parameters, 300, trace=True)
        assert one.rows is not None
        assert result.rows is not None
        found += [one.rows.tobytes(), result.states.tobytes(), result.rows.tobytes()]
    return b"".join(found)


def test_optimisation_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, flags = iterates(), find_compiler()
    assert len(usual) > 10_000
    monkeypatch.setenv("CASADI_IK_CFLAGS", "-O1")
    assert find_compiler() != flags
    assert iterates() == usual
