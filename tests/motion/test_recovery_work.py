"""The search for a way back divides its work over cycles."""

from __future__ import annotations

import math

import numpy as np

from casadi_ik.motion.cycle_runner import CycleRunner
from casadi_ik.motion.guard import Guard
from casadi_ik.motion.recovery import CAPACITY, CHECKS, Recovery

PERIOD = 0.01


class CountingGuard(Guard):
    """Guard of a robot of which only the recent postures are free; it counts the checks."""

    def __init__(self) -> None:
        self.checked = 0

    def are_free(self, q: np.ndarray) -> bool:
        self.checked += len(q)
        return bool((q > 5.0).all())

    def posture_with_clearance(self, q: np.ndarray, units: np.ndarray) -> np.ndarray:
        return q


class CountingInputs(CycleRunner):
    """Graph of a cycle that misses its target by the distance from 0; it counts evaluations."""

    def __init__(self) -> None:
        self.evaluated = 0
        self.ratio = math.inf

    @property
    def error_ratio(self) -> float:
        return self.ratio

    @property
    def goal_error_ratio(self) -> float:
        return self.ratio

    def error_ratio_at(self, q: np.ndarray) -> float:
        self.evaluated += 1
        return float(abs(q).max())

    exact_error_ratio = error_ratio_at


def test_work_of_each_cycle_is_bounded():
    """A cycle evaluates its graph at most twice more, and checks at most `CHECKS` postures."""
    guard, inputs, units = CountingGuard(), CountingInputs(), np.ones(2)
    recovery = Recovery(units, 0.05 * units, 0.01 * units, PERIOD, guard)
    recovery.reset(np.zeros(2))
    state, total = np.zeros(6), 0
    inputs.ratio = 0.0
    for _ in range(CAPACITY):
        state[:2] += 0.1
        recovery.update(inputs, state[:2], units, is_stopped=False)
    inputs.ratio = 20.0
    for _ in range(400):
        guard.checked = inputs.evaluated = 0
        step = recovery.step(state)
        is_blocked = step is not None and bool(step.any())
        recovery.update(inputs, state[:2], np.zeros(2), is_stopped=is_blocked)
        assert inputs.evaluated <= 2
        assert guard.checked <= CHECKS
        assert not (inputs.evaluated and guard.checked)
        total += guard.checked
    assert total > 2 * CHECKS
