"""Configurations closest to contacts: of the whole robot, and of the hand with a floating palm.

For weights w_i >= 0 the minimum of ``sum w_i e_i^2`` over the errors e_i is a bound: if it exceeds
``sum w_i t_i^2``, the tolerances t_i cannot all be met. Weights that grow where the tolerance is
exceeded most tighten the bound (Lawson's algorithm), and lead to the configuration whose largest
error relative to its tolerance is smallest (minimax).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, Rows
from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.kinematics.arms.srs import SrsArm
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.diagnosis import ArmReach, HandFit
from casadi_ik.solve.row_selection import smallest_per_owner
from casadi_ik.solve.subproblems import (
    UNREACHABLE_TOLERANCE,
    SubproblemSolver,
    fit_hands_again,
    residual_tolerances,
)
from casadi_ik.solve.verdict import contact_verdicts, judge


@dataclass(frozen=True)
class ClosestSettings:
    """Settings of the search for the closest configurations. Source: ``studies/diagnosis.py``.

    Attributes:
        max_weight_updates: Maximum number of updates of the minimax weights.
        convergence: Relative gap between bound and best error, and relative gain of an update,
            below which the weights are final.
        unreachable_factor: Factor of the tolerances that has to be exceeded for a target to count
            as unreachable.
        min_weight: Smallest weight of a contact.
        first_seeds: Number of hand seeds of every target; if none fits, the seeds of two restarts
            are used.
        max_slid_fits: Number of fits per target beyond the arm's reach that are moved towards it.
    """

    max_weight_updates: int = 16
    convergence: float = 0.01
    unreachable_factor: float = 1.02
    min_weight: float = 1e-4
    first_seeds: int = 4
    max_slid_fits: int = 2


CLOSEST_SETTINGS = ClosestSettings()


@dataclass(frozen=True, eq=False)
class ClosestConfigurations:
    """Configurations closest to k targets.

    Attributes:
        q: (k, n) configurations with the smallest squared error [rad or m].
        minimax_q: (k, n) configurations with the smallest largest error [rad or m].
        factor: (k,) lower bound of the factor by which the tolerances have to grow, near any of
            the minima.
    """

    q: Array
    minimax_q: Array
    factor: Array

    def rows(self, rows: Rows) -> ClosestConfigurations:
        """Return the configurations of some targets."""
        return ClosestConfigurations(self.q[rows], self.minimax_q[rows], self.factor[rows])

    def update(self, rows: Rows, closer: ClosestConfigurations) -> None:
        """Replace the configurations of some targets."""
        self.q[rows], self.minimax_q[rows] = closer.q, closer.minimax_q
        self.factor[rows] = closer.factor


class WeightedRefinement(Protocol):
    """Refinement of configurations under changing weights."""

    @property
    def targets(self) -> TargetBatch:
        """The targets."""
        ...

    def run(self, owner: Rows, q: Array, *, weights: Array) -> Array:
        """Return refined configurations (m, n), see `LocalRefinement.run`."""
        ...

    def misses(self, owner: Rows, q: Array) -> Array:
        """Return (m, f, 2) residual norms, see `LocalRefinement.misses`."""
        ...


def find_closest(
    refinement: WeightedRefinement,
    owner: Rows,
    q: Array,
    max_starts: int,
    tolerances: Array | None = None,
) -> ClosestConfigurations:
    """Refine the best of some configurations to their minimax minimum.

    Args:
        refinement: Refinement of k targets.
        owner: (m,) target index of each configuration; every target has at least one.
        q: (m, n) start configurations [rad or m].
        max_starts: Maximum number of configurations per target that are refined.
        tolerances: (k, f, 2) residuals by which errors are divided, 0 where free; None: those at
            tolerance.
    """
    settings = CLOSEST_SETTINGS
    cost = (refinement.misses(owner, q) ** 2).sum(axis=(1, 2))
    selected = smallest_per_owner(owner, cost, max_starts)
    owner, q = owner[selected], q[selected]
    count, first = len(q), np.searchsorted(owner, np.arange(len(refinement.targets)))
    if tolerances is None:
        tolerances = residual_tolerances(refinement.targets)
    tolerance = tolerances[owner]
    is_constrained = tolerance > 0
    total = (tolerance**2).sum(axis=(1, 2))
    weights = is_constrained.astype(float)
    worst, bound = np.full(count, np.inf), np.zeros(count)
    best = np.full(len(first), np.inf)
    is_done = np.zeros(len(first), dtype=bool)
    minimax_q, least_squares_q, cost = q.copy(), q, np.zeros(count)
    rows = np.arange(count)
    for update in range(settings.max_weight_updates):
        target = owner[rows]
        q[rows] = refinement.run(target, q[rows], weights=np.sqrt(weights[rows]))
        misses = refinement.misses(target, q[rows])
        if update == 0:
            least_squares_q, cost = q.copy(), (misses**2).sum(axis=(1, 2))
        relative = np.divide(
            misses, tolerance[rows], where=is_constrained[rows], out=np.zeros_like(misses)
        )
        largest = relative.max(axis=(1, 2))
        improved = rows[largest < worst[rows]]
        minimax_q[improved] = q[improved]
        worst[rows] = np.minimum(worst[rows], largest)
        squares = (weights[rows] * misses**2).sum(axis=(1, 2))
        bound[rows] = np.maximum(bound[rows], np.sqrt(squares / total[rows]))
        previous, best = best, np.minimum.reduceat(worst, first)
        lowest_bound = np.minimum.reduceat(bound, first)
        is_stalled = best > (1 - settings.convergence) * previous
        is_done |= (
            (best <= 1)
            | ((lowest_bound > settings.unreachable_factor) & is_stalled)
            | (lowest_bound > (1 - settings.convergence) * best)
        )
        # Drop minima whose bound exceeds the best error of the target.
        is_active = ~is_done[target] & (bound[rows] < best[target])
        if not is_active.any():
            break
        updated = np.where(
            is_constrained[rows],
            np.maximum(weights[rows] * relative, settings.min_weight),
            0.0,
        )
        scale = total[rows] / (updated * tolerance[rows] ** 2).sum(axis=(1, 2))
        weights[rows] = updated * scale[:, None, None]
        rows = rows[is_active]
    return ClosestConfigurations(
        least_squares_q[smallest_per_owner(owner, cost, 1)],
        minimax_q[smallest_per_owner(owner, worst, 1)],
        np.minimum.reduceat(bound, first),
    )


@dataclass(frozen=True, eq=False)
class HandFits:
    """Fits of the hand alone to targets, each with a palm pose.

    Attributes:
        owner: (m,) target index.
        states: (m, ...) states of the loop, before the arm is placed.
        parameters: (m, ...) parameters of the loop.
        position_error: (m, f) distances [m], NaN where free.
        angle_error: (m, f) angles [rad], NaN where free.
        met: (m, f) True where the errors are within tolerance, or free.
        cost: (m,) squared residual of the hand stage.
        distance: (m,) distance of the wrist from the shoulder [m]; NaN for an arm without a
            closed form.
        outside: (m,) distance of the wrist from the range of the arm [m], 0 within.
    """

    owner: Rows
    states: Array
    parameters: Array
    position_error: Array
    angle_error: Array
    met: NDArray[np.bool_]
    cost: Array
    distance: Array
    outside: Array

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(m,) True where every contact is within tolerance."""
        return np.all(self.met, axis=1)

    def unreached_targets(self) -> Rows:
        """Return the targets without a fit that the arm reaches."""
        return np.setdiff1d(self.owner, self.owner[self.ok & (self.outside == 0)])

    def tolerance_factor(self, targets: TargetBatch) -> Array:
        """Return (k,) lower bounds of the factor by which the tolerances have to grow."""
        cost = self.cost[smallest_per_owner(self.owner, self.cost, 1)]
        return np.sqrt(cost / (residual_tolerances(targets) ** 2).sum(axis=(1, 2)))

    def best_rows(self, count: int) -> Rows:
        """Return up to `count` best fits of each target, by the sum of cost and reach error."""
        return smallest_per_owner(self.owner, self.cost + (self.outside / LENGTH) ** 2, count)

    @classmethod
    def concatenate(cls, groups: Sequence[HandFits]) -> HandFits:
        """Return the concatenation of several groups of fits."""
        names = [item.name for item in fields(cls)]
        return cls(*(np.concatenate([getattr(fit, name) for fit in groups]) for name in names))


class FloatingPalmFit:
    """Fit of the hand alone to targets, with a floating palm."""

    def __init__(self, subproblems: SubproblemSolver) -> None:
        """Store the solver of subproblems."""
        self._subproblems = subproblems
        self._arm = srs_arm(subproblems.robot.description)

    @cached_property
    def _palm(self) -> Array:
        """(4, 4) palm pose with the arm at zero."""
        robot = self._subproblems.robot
        return robot.palm(np.zeros(len(robot.actuators)))

    def evidence(
        self, targets: TargetBatch, hand_fits: HandFits
    ) -> list[tuple[HandFit, ArmReach | None]]:
        """Return the best hand fit of each target, and the arm reach of the nearest fit.

        The reach is None if no hand fits, and for an arm without a closed form.
        """
        best = smallest_per_owner(
            hand_fits.owner, np.where(hand_fits.ok, 0.0, 1.0 + hand_fits.cost), 1
        )
        nearest = smallest_per_owner(
            hand_fits.owner, np.where(hand_fits.ok, hand_fits.outside, np.inf), 1
        )
        fingers = self._subproblems.robot.fingers
        errors = hand_fits.position_error, hand_fits.angle_error, hand_fits.met
        evidence = []
        for row, nearest_row in zip(best.tolist(), nearest.tolist(), strict=True):
            row_errors = (array[row].tolist() for array in errors)
            contacts = contact_verdicts(fingers, targets.tolerances, *row_errors)
            hand, arm = HandFit(bool(hand_fits.ok[row]), contacts), None
            if hand.ok and self._arm is not None:
                arm = ArmReach(
                    float(hand_fits.distance[nearest_row]), *self._wrist_range(targets, self._arm)
                )
            evidence.append((hand, arm))
        return evidence

    def fit(self, targets: TargetBatch) -> HandFits:
        """Fit a few seeds to each of k targets, and more seeds if the arm reaches none of the fits.

        Args:
            targets: The targets; unconstrained motors stay at their start.
        """
        method, all_targets = self._subproblems.method, np.arange(len(targets))
        nearest = method.postures(targets, 0)
        hand_fits = self._fit_seeds(
            targets, all_targets, nearest[:, : CLOSEST_SETTINGS.first_seeds]
        )
        unreached = hand_fits.unreached_targets()
        if len(unreached):
            further = method.postures(targets.rows(unreached), 1)
            seeds = np.concatenate(
                [nearest[unreached, CLOSEST_SETTINGS.first_seeds :], further], axis=1
            )
            hand_fits = HandFits.concatenate(
                [hand_fits, self._fit_seeds(targets, unreached, seeds)]
            )
        rows = np.flatnonzero(
            hand_fits.ok & np.isin(hand_fits.owner, hand_fits.unreached_targets())
        )
        rows = rows[
            smallest_per_owner(
                hand_fits.owner[rows], hand_fits.outside[rows], CLOSEST_SETTINGS.max_slid_fits
            )
        ]
        if len(rows):
            hand_fits = HandFits.concatenate(
                [hand_fits, self._slide_towards_arm(targets, hand_fits, rows)]
            )
        return hand_fits

    def _fit_seeds(self, targets: TargetBatch, target_rows: Rows, postures: Array) -> HandFits:
        """Fit seeds (c, p, hand) to the selected targets (c,)."""
        subproblems = self._subproblems
        owner, states, parameters = subproblems.hand_rows(targets, target_rows, postures)
        parameters[:, subproblems.parameters.slice("hand_only")] = 1.0
        parameters[:, subproblems.parameters.slice("reach_weight")] = 0.0
        return self._run(targets, owner, states, parameters)

    def _slide_towards_arm(self, targets: TargetBatch, hand_fits: HandFits, rows: Rows) -> HandFits:
        """Move fits towards the range of the arm along motions that the contacts leave free.

        The weight of the reach is small, so that a hand without free motions stays within
        tolerance.
        """
        subproblems = self._subproblems
        states, parameters = hand_fits.states[rows], hand_fits.parameters[rows]
        fit_hands_again(subproblems.method, states)
        min_tolerance = parameters[:, subproblems.parameters.slice("position_tolerance")].min(
            axis=1
        )
        weight = np.sqrt(np.minimum(min_tolerance / (3 * hand_fits.outside[rows]), 1.0))
        parameters[:, subproblems.parameters.slice("reach_weight")] = weight[:, None]
        subproblems.set_tolerance(parameters, UNREACHABLE_TOLERANCE)
        slid = self._run(targets, hand_fits.owner[rows], states, parameters)
        return replace(slid, parameters=hand_fits.parameters[rows])

    def _run(self, targets: TargetBatch, owner: Rows, states: Array, parameters: Array) -> HandFits:
        """Run the hand stage of some rows, and measure the resulting fits."""
        subproblems = self._subproblems
        states = subproblems.method.run_rows(states, parameters).states
        # Runs from these states may continue with the arm.
        parameters[:, subproblems.parameters.slice("hand_only")] = 0.0
        rotation = states[:, subproblems.state.slice("palm_rotation")].reshape(-1, 3, 3)
        origin = states[:, subproblems.state.slice("palm_origin")]
        hand = states[:, subproblems.state.slice("q")].copy()
        hand[:, list(subproblems.robot.description.arm_actuators)] = 0.0
        moved_targets = self._in_zero_palm(targets.rows(owner), rotation, origin)
        verdict = judge(subproblems.robot, moved_targets, hand)
        position, angle, met = verdict.position_error, verdict.angle_error, verdict.ok
        squares = (position / LENGTH) ** 2, (2 * np.sin(angle / 2)) ** 2
        distance, outside = self._wrist_distances(targets, rotation, origin)
        return HandFits(
            owner=owner,
            states=states,
            parameters=parameters,
            position_error=position,
            angle_error=angle,
            met=met,
            cost=np.nan_to_num(squares).sum(axis=(0, 2)),
            distance=distance,
            outside=outside,
        )

    def _in_zero_palm(self, targets: TargetBatch, rotation: Array, origin: Array) -> TargetBatch:
        """Return targets moved with their palm poses to the palm pose with the arm at zero."""
        palm = self._palm
        rotation_to_zero = np.einsum("ij,kmj->kim", palm[:3, :3], rotation)
        points = (
            np.einsum("kij,kfj->kfi", rotation_to_zero, targets.points - origin[:, None])
            + palm[:3, 3]
        )
        normals = np.einsum("kij,kfj->kfi", rotation_to_zero, targets.normals)
        extra_vectors = {
            name: np.einsum("kij,kfj->kfi", rotation_to_zero, vectors)
            for name, vectors in targets.extra_vectors.items()
        }
        return replace(targets, points=points, normals=normals, extra_vectors=extra_vectors)

    def _wrist_distances(
        self, targets: TargetBatch, rotation: Array, origin: Array
    ) -> tuple[Array, Array]:
        """Return (m,) distances of the wrist from the shoulder and from the arm range [m]."""
        if self._arm is None:
            return np.full(len(origin), np.nan), np.zeros(len(origin))
        wrist = origin + rotation @ self._arm.wrist_in_palm
        distance = np.linalg.norm(wrist - self._arm.shoulder, axis=1)
        min_distance, max_distance = self._wrist_range(targets, self._arm)
        return distance, np.maximum(
            np.maximum(distance - max_distance, min_distance - distance), 0.0
        )

    def _wrist_range(self, targets: TargetBatch, arm: SrsArm) -> tuple[float, float]:
        """Return the smallest and largest distance between wrist and shoulder [m]."""
        limits = self._subproblems.limits(targets)
        elbow = self._subproblems.robot.description.arm_actuators[3]
        min_distance, max_distance = arm.reach(limits.lower[elbow], limits.upper[elbow])
        return float(min_distance), float(max_distance)
