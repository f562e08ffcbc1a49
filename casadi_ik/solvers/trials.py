"""Runs of the hand-first loop with other bounds, weights and starts: what a diagnosis asks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.kernels.layout import Layout
from casadi_ik.solvers.hand_first import UNBOUNDED, HandFirstMethod
from casadi_ik.solvers.problem import Array, Problems
from casadi_ik.solvers.verdict import judge
from casadi_ik.steps.contact_fit import fresh_fit
from casadi_ik.steps.hand_first_state import LENGTH
from casadi_ik.steps.status import Phase

NEVER = 1e-12
"""A tolerance that nothing meets: the loop then goes on to the minimum."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of the actuators, (n,) or (k, n)."""

    lower: Array
    upper: Array

    def clip(self, q: Array) -> Array:
        """Configurations moved into the bounds."""
        return np.clip(q, self.lower, self.upper)

    def tiled(self, count: int) -> Bounds:
        """The same bounds for k configurations."""
        return Bounds(np.tile(self.lower, (count, 1)), np.tile(self.upper, (count, 1)))

    def beyond(self, q: Array) -> Array:
        """Signed distance from the bounds: > 0 above, < 0 below, 0 within."""
        return np.maximum(q - self.upper, 0.0) - np.maximum(self.lower - q, 0.0)


@dataclass(frozen=True, eq=False)
class Trials:
    """The loop of the hand-first method, asked in other ways.

    Attributes:
        robot: The robot.
        method: The method on that robot.
    """

    robot: ArmHand
    method: HandFirstMethod

    @cached_property
    def state(self) -> Layout:
        """Layout of the loop's state."""
        return self.method.step.layouts.state

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the loop's parameters."""
        return self.method.step.layouts.parameters

    def limits(self, problems: Problems) -> Bounds:
        """The bounds (n,) that a solution has to keep."""
        return Bounds(*problems.bounds(self.robot.description, UNBOUNDED))

    def search(self, problems: Problems, start: Array, bounds: Bounds) -> Array:
        """The first round of hand-first for each of k targets.

        Args:
            problems: The targets.
            start: (n,).
            bounds: (k, n).

        Returns:
            (k, n) configurations.
        """
        states, parameters = self.method.rows(problems, bounds.clip(start))
        self.set_bounds(parameters, bounds)
        return self.run(states, parameters)

    def rounds(
        self, problems: Problems, start: Array, bounds: Bounds, numbers: Sequence[int]
    ) -> tuple[Array, Array]:
        """Some rounds of hand-first for one target, each with and without regard to the reach.

        Returns:
            Configurations (m, n) whose hands the hand stage went through, and those (k, n) the
            rounds ended with.
        """
        states, parameters = self.method.rows(problems, bounds.clip(start)[None], numbers)
        states, parameters = np.tile(states, (2, 1)), np.tile(parameters, (2, 1))
        self.set_bounds(parameters, bounds)
        parameters[: len(numbers), self.parameters.slice("reach")] = 0.0
        result = self.method.run_rows(states, parameters, trace=True)
        rows = result.rows
        assert rows is not None
        # A row holds what came before its step: what a fit ended with is in the row after it, or
        # nowhere if that is the next candidate's; then its last two steps are as good.
        fitted = rows["phase"] == Phase.HAND_FIT
        after = fitted[:-1] & ~fitted[1:] & (rows["phase"][1:] != Phase.CANDIDATE)
        fitted[:-2] &= ~(fitted[1:-1] & fitted[2:])
        fitted[1:] |= after
        ends = result.states[:, self.state.slice("q")]
        return np.asarray(rows["q"][fitted], dtype=float), ends

    def solved(self, problems: Problems, q: Array, limits: bool) -> NDArray[np.bool_]:
        """(k,) whether configurations meet their targets, and if asked the robot's limits."""
        verdict = judge(self.robot, problems, q)
        return verdict.all_ok & verdict.limits_ok if limits else verdict.all_ok

    def misses(self, problems: Problems, q: Array) -> Array:
        """(k, f, 2) lengths of the residuals of points [0.1 m] and normals; 0 where free."""
        position, angle = self.robot.errors(q, problems.points, problems.normals)
        return np.nan_to_num(np.stack([position / LENGTH, 2 * np.sin(angle / 2)], axis=2))

    def set_bounds(self, parameters: Array, bounds: Bounds) -> None:
        """Put bounds into rows of parameters."""
        parameters[:, self.parameters.slice("lower")] = bounds.lower
        parameters[:, self.parameters.slice("upper")] = bounds.upper

    def run(self, states: Array, parameters: Array) -> Array:
        """(k, n) configurations that rows lead to."""
        return self.method.run_rows(states, parameters).states[:, self.state.slice("q")]


class Descent:
    """Refinement of the whole arm-hand from given configurations, for k targets."""

    def __init__(self, trials: Trials, problems: Problems) -> None:
        """Lay out the rows once, for any number of runs."""
        self._trials = trials
        self._states, self._parameters = refinement_rows(trials, problems)

    def run(
        self,
        q: Array,
        bounds: Bounds,
        weights: Array | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> Array:
        """Refine.

        Args:
            q: (k, n) starts.
            bounds: (n,) or (k, n).
            weights: (k, f, 2) of points and normals; None counts all alike. With weights the loop
                does not stop at the tolerance.
            rows: (k,) which targets; None is all of them.

        Returns:
            (k, n) configurations.
        """
        trials, chosen = self._trials, slice(None) if rows is None else rows
        states, parameters = self._states[chosen].copy(), self._parameters[chosen].copy()
        start = bounds.clip(q)
        states[:, trials.state.slice("q")] = start
        states[:, trials.state.slice("best_q")] = start
        trials.set_bounds(parameters, bounds)
        if weights is not None:
            layout = trials.parameters
            parameters[:, layout.slice("weights")] *= weights.reshape(len(q), -1)
            parameters[:, layout.slice("position_tolerance")] = NEVER
            parameters[:, layout.slice("angle_tolerance")] = NEVER
        return trials.run(states, parameters)


def refinement_rows(trials: Trials, problems: Problems) -> tuple[Array, Array]:
    """States and parameters of the loop that begin with the refinement of the whole arm-hand."""
    home = np.tile(trials.robot.home, (len(problems), 1))
    states, parameters = trials.method.rows(problems, home, ())
    last = trials.method.options.candidates - 1
    for name, value in ({"phase": Phase.REFINEMENT, "candidate": last} | fresh_fit()).items():
        states[:, trials.state.slice(name)] = value
    return states, parameters


def repeated(problems: Problems, count: int) -> Problems:
    """One target, several times."""
    return problems.rows(np.zeros(count, dtype=np.intp))


def allowed(problems: Problems) -> Array:
    """(f, 2) the residuals that the tolerances allow, as `Trials.misses`; 0 where free."""
    known = [~np.isnan(problems.points[0, :, 0]), ~np.isnan(problems.normals[0, :, 0])]
    tolerated = [problems.position_tolerance / LENGTH, 2 * np.sin(problems.angle_tolerance / 2)]
    return np.stack(known, axis=1) * np.stack(tolerated, axis=1)
