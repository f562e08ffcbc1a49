"""Subproblems of a target, solved by the loop of the hand-first method.

A subproblem is a target with modified bounds, weights, tolerances or start configurations.
Diagnoses, alternatives and the collision-free search fit single hand postures, refine
configurations, or carry palms to given poses: functions named `..._rows` return the states and
parameters of these runs of the loop for `HandSearch.run_rows`, and the bounds, tolerances and
weights in the parameters may be changed before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.compile.layout import Layout
from casadi_ik.files.arrays import Array, Rows, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.search import ARM_SEARCH
from casadi_ik.kinematics.contact_fit import initial_lm_state
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.hand_first.state import Stage
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.verdict import deviations, judge

UNREACHABLE_TOLERANCE = 1e-12
"""Tolerance [m, rad] that no configuration meets, so that the loop continues to the minimum."""

TRUNK_STRETCH = 2.0
"""Factor by which every second trunk sample is scaled about the middle of the range and clipped."""

PALM_SCALES = np.array([0.1, 0.1, 0.1, 2.0])
"""Scales of rotations [1/rad] and translations [1/m] of a free palm, relative to motor ranges."""


def hand_rows(
    method: HandSearch,
    targets: TargetBatch,
    postures: Array,
    palm_numbers: ArrayLike = 0.0,
) -> tuple[Array, Array]:
    """Return states and parameters of solves that try a single hand posture each.

    Args:
        method: The method.
        targets: k targets.
        postures: (k, hand) hand postures [rad or m].
        palm_numbers: (k,) numbers that select the palm pose where contacts leave the palm free.
    """
    states, parameters = method.rows(targets, postures[:, None], skip_q0=True)
    last = method.options.candidates - 1
    fields: dict[str, ArrayLike] = {"candidate": last, "palm_number": palm_numbers}
    if method.robot.sides:
        # Each side has a single seed, its part of the posture.
        fields["first_candidate"] = last
    _assign(method.step.layouts.state, states, fields)
    return states, parameters


def fit_hands_again(method: HandSearch, states: Array) -> None:
    """Let states of solves that ended with a hand fit continue it."""
    _assign(method.step.layouts.state, states, {"phase": Stage.HAND_FIT} | initial_lm_state())


def refinement_rows(method: HandSearch, targets: TargetBatch, q: Array) -> tuple[Array, Array]:
    """Return states and parameters of solves that refine all motors from q (k, n)."""
    hand = np.zeros((len(targets), len(method.robot.hand_actuators)))
    states, parameters = hand_rows(method, targets.starting_at(q), hand)
    start_refinement(method, states, q)
    return states, parameters


def start_refinement(method: HandSearch, states: Array, q: Array) -> None:
    """Let states refine all motors from q (k, n)."""
    fields = {"phase": Stage.REFINEMENT, "q": q, "best_q": q} | initial_lm_state()
    _assign(method.step.layouts.state, states, fields)


def palm_rows(
    method: HandSearch, targets: TargetBatch, q: Array, palms: Array, places_arms: ArrayLike
) -> tuple[Array, Array]:
    """Return states and parameters of solves that only carry the palms of a multi-arm robot.

    Trunk and arms move from q until the palms have the given poses. If the poses are not reached,
    all motors are refined from there, because the contacts may still be within tolerance.

    Args:
        method: The method.
        targets: k targets.
        q: (k, n) start configurations with the hand postures [rad or m].
        palms: (k, s, 4, 4) palm poses that meet the contacts with these postures.
        places_arms: (k,) whether the arms are placed in closed form instead, with the trunk of q;
            a solve ends at q if some arm does not reach its palm pose.
    """
    hands = q[:, list(method.robot.hand_actuators)]
    states, parameters = hand_rows(method, targets.starting_at(q), hands)
    first_stages = np.where(places_arms, float(Stage.ARM_PLACEMENT), float(Stage.TRUNK))
    fields: dict[str, ArrayLike] = {
        "q": q,
        "best_q": q,
        "phase": first_stages,
        "meets_contacts": 1.0,
        "arm_margin": ARM_SEARCH.no_margin,
    }
    for side in range(len(method.robot.sides)):
        fields[f"palm_rotation_{side}"] = palms[:, side, :3, :3].reshape(-1, 9)
        fields[f"palm_origin_{side}"] = palms[:, side, :3, 3]
    _assign(method.step.layouts.state, states, fields)
    _assign(method.step.layouts.parameters, parameters, {"palms_only": 1.0})
    return states, parameters


def _assign(layout: Layout, rows: Array, fields: Mapping[str, ArrayLike]) -> None:
    """Set fields of rows (k, size), each to a number, to (k,) numbers or to (k, m) rows."""
    for name, value in fields.items():
        values = np.asarray(value, dtype=float)
        rows[:, layout.slice(name)] = values[:, None] if values.ndim == 1 else values


@dataclass(frozen=True, eq=False)
class MotorBounds:
    """Bounds of the actuators, (n,) or (k, n)."""

    lower: Array
    upper: Array

    def clip(self, q: Array) -> Array:
        """Return configurations clipped to the bounds."""
        return np.clip(q, self.lower, self.upper)

    def select_rows(self, rows: Rows) -> MotorBounds:
        """Return the bounds of the targets with these indices."""
        return self if self.lower.ndim == 1 else MotorBounds(self.lower[rows], self.upper[rows])

    @property
    def first(self) -> MotorBounds:
        """(n,) bounds of the first target; the bounds of the arm are the same for all targets."""
        return self if self.lower.ndim == 1 else MotorBounds(self.lower[0], self.upper[0])

    def tiled(self, count: int) -> MotorBounds:
        """Return shared bounds as (k, n)."""
        return MotorBounds(np.tile(self.lower, (count, 1)), np.tile(self.upper, (count, 1)))

    def violation(self, q: Array) -> Array:
        """Return signed violations of the bounds: > 0 above, < 0 below, 0 within."""
        return np.maximum(q - self.upper, 0.0) - np.maximum(self.lower - q, 0.0)


@dataclass(frozen=True, eq=False)
class SubproblemSolver:
    """Solver of subproblems that uses the loop of the hand-first method.

    Attributes:
        robot: The robot.
        method: Hand-first, built for this robot.
    """

    robot: ArmHand
    method: HandSearch

    @cached_property
    def state(self) -> Layout:
        """Layout of the state of the loop."""
        return self.method.step.layouts.state

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the parameters of the loop."""
        return self.method.step.layouts.parameters

    def limits(self, targets: TargetBatch) -> MotorBounds:
        """Return the bounds of solutions, (n,) or (k, n), see `TargetBatch.bounds`."""
        return MotorBounds(*targets.bounds(self.robot.description))

    def search(self, targets: TargetBatch, bounds: MotorBounds) -> Array:
        """Run the first restart of hand-first for each of k targets.

        Args:
            targets: The targets.
            bounds: (k, n) bounds [rad or m].

        Returns:
            (k, n) configurations [rad or m].
        """
        targets = targets.starting_at(bounds.clip(targets.starts(self.robot.description)))
        postures = self.method.postures(targets, 0)
        states, parameters = self.method.rows(targets, postures)
        self.set_bounds(parameters, bounds)
        return self.run(states, parameters)

    def hand_rows(
        self,
        targets: TargetBatch,
        rows: Rows,
        postures: Array,
        first_palm_number: int = 0,
    ) -> tuple[Rows, Array, Array]:
        """Return states and parameters for several seeds of each selected target.

        Args:
            targets: k targets.
            rows: (c,) indices of the selected targets.
            postures: (c, p, hand) seeds of the selected targets [rad or m].
            first_palm_number: Palm number of the first seed, see `hand_rows`.

        Returns:
            Target index of each row, (c p,), states and parameters.
        """
        count = postures.shape[1]
        owner, palm_numbers = (
            np.repeat(rows, count),
            first_palm_number + np.tile(np.arange(count), len(rows)),
        )
        flat = postures.reshape(len(owner), postures.shape[2])
        return owner, *hand_rows(self.method, targets.rows(owner), flat, palm_numbers)

    def solved(self, targets: TargetBatch, q: Array, limits: bool) -> NDArray[np.bool_]:
        """Return (k,) True where q solves its target; within limits if `limits`."""
        return judge(self.robot, targets, q).solved(limits)

    def set_bounds(self, parameters: Array, bounds: MotorBounds) -> None:
        """Set the bounds in rows of parameters."""
        parameters[:, self.parameters.slice("lower")] = bounds.lower
        parameters[:, self.parameters.slice("upper")] = bounds.upper

    def set_tolerance(self, parameters: Array, tolerance: float) -> None:
        """Set one tolerance [m, rad] of all contacts in rows of parameters."""
        parameters[:, self.parameters.slice("position_tolerance")] = tolerance
        parameters[:, self.parameters.slice("angle_tolerance")] = tolerance

    def run(self, states: Array, parameters: Array) -> Array:
        """Return the final configurations (k, n) of rows."""
        return self.method.run_rows(states, parameters).states[:, self.state.slice("q")]


class LocalRefinement:
    """Refinement of all motors of the robot from start configurations.

    Attributes:
        subproblems: Solver of subproblems.
        targets: k targets.
    """

    def __init__(self, subproblems: SubproblemSolver, targets: TargetBatch) -> None:
        """Prepare states and parameters of every target, for any number of runs."""
        self.subproblems = subproblems
        self.targets = targets
        home = np.tile(subproblems.robot.home, (len(targets), 1))
        self._states, self._parameters = refinement_rows(subproblems.method, targets, home)

    def run(
        self, owner: Rows, q: Array, bounds: MotorBounds | None = None, weights: Array | None = None
    ) -> Array:
        """Refine configurations.

        Args:
            owner: (m,) target index of each row.
            q: (m, n) start configurations [rad or m].
            bounds: (n,) or (m, n) bounds [rad or m]; None: the limits.
            weights: (m, f, 2) weights of points and normals; None: all 1. With weights the loop
                continues beyond the tolerance to the minimum.

        Returns:
            (m, n) configurations [rad or m].
        """
        subproblems = self.subproblems
        states, parameters = self._states[owner], self._parameters[owner]
        bounds = bounds or subproblems.limits(self.targets).select_rows(owner)
        start_refinement(subproblems.method, states, bounds.clip(q))
        subproblems.set_bounds(parameters, bounds)
        if weights is not None:
            parameters[:, subproblems.parameters.slice("weights")] *= weights.reshape(len(q), -1)
            subproblems.set_tolerance(parameters, UNREACHABLE_TOLERANCE)
        return subproblems.run(states, parameters)

    def misses(self, owner: Rows, q: Array) -> Array:
        """Return (m, f, 2) residual norms of points [0.1 m] and normals; 0 where free."""
        return residual_norms(self.subproblems.robot, self.targets.rows(owner), q)


def sample_trunks(
    subproblems: SubproblemSolver,
    targets: TargetBatch,
    q: Array,
    palms: Array,
    owner: NDArray[np.intp],
    first: int,
    count: int,
) -> tuple[Array, NDArray[np.intp]]:
    """Return configurations with these hand postures and palm poses, for several trunk postures.

    Three of four samples place the arms in closed form at the sampled trunk; the fourth moves trunk
    and arms numerically from a sampled posture.

    Args:
        subproblems: Solver of subproblems.
        targets: k targets.
        q: (m, n) configurations that contain the hand postures [rad or m].
        palms: (m, s, 4, 4) palm poses.
        owner: (m,) target index of each configuration.
        first: Index of the first sample of the low-discrepancy sequence.
        count: Number of samples.

    Returns:
        (m count, n) final configurations [rad or m], and the row of q of each.
    """
    description = subproblems.robot.description
    source_rows = np.repeat(np.arange(len(q)), count)
    moving = [
        *description.trunk_actuators,
        *(column for arm, _ in description.side_actuators for column in arm),
    ]
    samples = spread_points(first + count, len(moving))[first:]
    samples[1::2] = np.clip((samples[1::2] - 0.5) * TRUNK_STRETCH + 0.5, 0.0, 1.0)
    limits = subproblems.limits(targets).select_rows(owner[source_rows])
    starts = q[source_rows]
    lower, upper = (np.broadcast_to(bound, starts.shape) for bound in (limits.lower, limits.upper))
    fractions = np.tile(samples, (len(q), 1))
    starts[:, moving] = lower[:, moving] + fractions * (upper - lower)[:, moving]
    places_arms = np.tile(np.arange(first, first + count) % 4 != 3, len(q))
    return carry_palms(
        subproblems, targets, starts, palms[source_rows], owner[source_rows], places_arms
    ), source_rows


def carry_palms(
    subproblems: SubproblemSolver,
    targets: TargetBatch,
    q: Array,
    palms: Array,
    owner: NDArray[np.intp],
    places_arms: bool | NDArray[np.bool_],
) -> Array:
    """Return configurations (m, n) whose trunk and arms move from q to palm poses (m, s, 4, 4).

    See `palm_rows`.
    """
    rows = palm_rows(subproblems.method, targets.rows(owner), q, palms, places_arms)
    return subproblems.run(*rows)


def side_palms(robot: ArmHand, q: Array) -> Array:
    """Return the palm poses (k, s, 4, 4) of a multi-arm robot."""
    return np.stack([robot.palm(q, side.name) for side in robot.description.sides], axis=1)


def repeat_target(targets: TargetBatch, count: int) -> TargetBatch:
    """Return `count` copies of one target."""
    return targets.rows(np.zeros(count, dtype=np.intp))


def residual_norms(robot: ArmHand, targets: TargetBatch, q: Array) -> Array:
    """Return (k, f, 2) residual norms of points [0.1 m] and normals at q (k, n); 0 where free."""
    position, angle, _ = deviations(robot, targets, q)
    return np.nan_to_num(np.stack([position / LENGTH, 2 * np.sin(angle / 2)], axis=2))


def residual_tolerances(targets: TargetBatch) -> Array:
    """Return (k, f, 2) residuals at tolerance, see `LocalRefinement.misses`; 0 where free."""
    is_constrained = [~np.isnan(targets.points[..., 0]), ~np.isnan(targets.normals[..., 0])]
    tolerances = [targets.position_tolerance / LENGTH, 2 * np.sin(targets.angle_tolerance / 2)]
    return np.stack(is_constrained, axis=2) * np.stack(tolerances, axis=1)


def palm_coordinates(palms: Array) -> Array:
    """Return (k, 12) scaled coordinates of palm poses (k, 4, 4), comparable to motor ranges."""
    return (palms[:, :3] * PALM_SCALES).reshape(-1, 12)
