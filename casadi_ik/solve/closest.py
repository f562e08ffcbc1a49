"""How near a hand comes to contacts: with the arm at its fairest, and alone, its palm floating.

With weights w_i >= 0 the smallest ``sum w_i e_i^2`` of the errors e_i bounds what is possible: if
it exceeds ``sum w_i t_i^2`` the tolerances t_i cannot all be kept. Weights that grow where the
tolerance is exceeded most tighten that bound (Lawson's algorithm), and lead to the configuration
whose largest error, as a part of its tolerance, is smallest (minimax).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.kinematics.arms.srs import SrsArm
from casadi_ik.kinematics.contact_fit import initial_lm_state
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.diagnosis import ArmReach, HandFit
from casadi_ik.solve.status import Phase
from casadi_ik.solve.trials import (
    UNREACHABLE_TOLERANCE,
    LocalRefinement,
    Rows,
    Subproblems,
    residual_tolerances,
    smallest_per_target,
)
from casadi_ik.solve.verdict import contact_verdicts, judge


@dataclass(frozen=True)
class ClosestSettings:
    """Numbers of the search for the nearest contacts, chosen with ``studies/diagnosis.py``.

    Attributes:
        rounds: Adaptations of the minimax weights, at most.
        settled: The weights are adapted no further when the bound is this close to what was
            reached, or when it says no and a round gains less than this.
        margin: By which factor the contacts have to be missed for a grasp to count as unreachable.
        lightest: Smallest weight.
        first: Hand postures tried for every target; where none of them fits, two rounds of them.
        slid: Hands that fit but are out of the arm's reach, and are slid towards it.
    """

    rounds: int = 16
    settled: float = 0.01
    margin: float = 1.02
    lightest: float = 1e-4
    first: int = 4
    slid: int = 2


CLOSEST_TUNING = ClosestSettings()


@dataclass(frozen=True, eq=False)
class ClosestConfigurations:
    """What came closest to k targets.

    Attributes:
        q: (k, n) configurations with the smallest squared error.
        fair: (k, n) configurations with the smallest largest error.
        ratio: (k,) by which factor the tolerances would have to grow at least, near any of the
            minima.
    """

    q: Array
    fair: Array
    ratio: Array

    def rows(self, rows: Rows) -> ClosestConfigurations:
        """What came closest to some of the targets."""
        return ClosestConfigurations(self.q[rows], self.fair[rows], self.ratio[rows])

    def put(self, rows: Rows, found: ClosestConfigurations) -> None:
        """Take what came closer to some of the targets."""
        self.q[rows], self.fair[rows], self.ratio[rows] = found.q, found.fair, found.ratio


def find_closest(
    descent: LocalRefinement, owner: Rows, q: Array, followed: int
) -> ClosestConfigurations:
    """Follow the best of some configurations to the end.

    Args:
        descent: Of k targets.
        owner: (m,) which target a configuration is for; every target has one at least.
        q: (m, n).
        followed: How many of a target at most.
    """
    cost = (descent.misses(owner, q) ** 2).sum(axis=(1, 2))
    kept = smallest_per_target(owner, cost, followed)
    owner, q = owner[kept], q[kept]
    count, first = len(q), np.searchsorted(owner, np.arange(len(descent.targets)))
    tolerated = residual_tolerances(descent.targets)[owner]
    counted = tolerated > 0
    total = (tolerated**2).sum(axis=(1, 2))
    weights = counted.astype(float)
    worst, bound = np.full(count, np.inf), np.zeros(count)
    best = np.full(len(first), np.inf)
    done = np.zeros(len(first), dtype=bool)
    fair, plain, cost = q.copy(), q, np.zeros(count)
    rows = np.arange(count)
    for number in range(CLOSEST_TUNING.rounds):
        here = owner[rows]
        q[rows] = descent.run(here, q[rows], weights=np.sqrt(weights[rows]))
        misses = descent.misses(here, q[rows])
        if number == 0:
            plain, cost = q.copy(), (misses**2).sum(axis=(1, 2))
        parts = np.divide(misses, tolerated[rows], where=counted[rows], out=np.zeros_like(misses))
        largest = parts.max(axis=(1, 2))
        better = rows[largest < worst[rows]]
        fair[better] = q[better]
        worst[rows] = np.minimum(worst[rows], largest)
        squares = (weights[rows] * misses**2).sum(axis=(1, 2))
        bound[rows] = np.maximum(bound[rows], np.sqrt(squares / total[rows]))
        before, best = best, np.minimum.reduceat(worst, first)
        least = np.minimum.reduceat(bound, first)
        stuck = best > (1 - CLOSEST_TUNING.settled) * before
        done |= (
            (best <= 1)
            | ((least > CLOSEST_TUNING.margin) & stuck)
            | (least > (1 - CLOSEST_TUNING.settled) * best)
        )
        # A minimum that cannot come closer than another one already has is followed no further.
        going = ~done[here] & (bound[rows] < best[here])
        if not going.any():
            break
        new = np.where(
            counted[rows], np.maximum(weights[rows] * parts, CLOSEST_TUNING.lightest), 0.0
        )
        scale = total[rows] / (new * tolerated[rows] ** 2).sum(axis=(1, 2))
        weights[rows] = new * scale[:, None, None]
        rows = rows[going]
    ratio = np.minimum.reduceat(bound, first)
    return ClosestConfigurations(
        plain[smallest_per_target(owner, cost, 1)],
        fair[smallest_per_target(owner, worst, 1)],
        ratio,
    )


@dataclass(frozen=True, eq=False)
class HandFits:
    """Hand postures that were fitted to targets without the arm, each with a palm pose.

    Attributes:
        owner: (m,) number of the target.
        states: (m, ...) of the loop, where the arm would be placed next.
        parameters: (m, ...) of the loop.
        position_error: (m, f) [m], NaN where free.
        angle_error: (m, f) [rad], NaN where free.
        met: (m, f) within tolerance, or free.
        cost: (m,) squared residual, as in the hand stage.
        distance: (m,) of the wrist from the shoulder [m]; NaN for an arm without a closed form.
        outside: (m,) how far the wrist is from what the arm can span [m], 0 within.
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
        """(m,) every contact within tolerance."""
        return np.all(self.met, axis=1)

    def without(self) -> Rows:
        """Targets without a fit that the arm reaches."""
        return np.setdiff1d(self.owner, self.owner[self.ok & (self.outside == 0)])

    def ratio(self, targets: TargetBatch) -> Array:
        """(k,) by which factor the tolerances would have to grow at least, near any of the fits."""
        cost = self.cost[smallest_per_target(self.owner, self.cost, 1)]
        return np.sqrt(cost / (residual_tolerances(targets) ** 2).sum(axis=(1, 2)))

    def best(self, most: int) -> Rows:
        """Rows of each target that fit best with regard to the arm's reach."""
        return smallest_per_target(self.owner, self.cost + (self.outside / LENGTH) ** 2, most)

    @classmethod
    def joined(cls, parts: Sequence[HandFits]) -> HandFits:
        """One after the other."""
        names = [item.name for item in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class FloatingPalmFit:
    """Fits the hand alone to targets, whatever the arm could do."""

    def __init__(self, trials: Subproblems) -> None:
        """Ask the loop's hand stage."""
        self._trials = trials
        self._arm = srs_arm(trials.robot.description)

    @cached_property
    def _palm(self) -> Array:
        """(4, 4) where the palm is with the arm at zero."""
        robot = self._trials.robot
        return robot.palm(np.zeros(len(robot.actuators)))

    def evidence(
        self, targets: TargetBatch, fits: HandFits
    ) -> list[tuple[HandFit, ArmReach | None]]:
        """What the fits say of each target: the best one, and the one nearest to the arm's range.

        Nothing is said of the reach where no hand fits, or of an arm without a closed form.
        """
        best = smallest_per_target(fits.owner, np.where(fits.ok, 0.0, 1.0 + fits.cost), 1)
        nearest = smallest_per_target(fits.owner, np.where(fits.ok, fits.outside, np.inf), 1)
        errors = (each[best] for each in (fits.position_error, fits.angle_error, fits.met))
        verdicts = contact_verdicts(self._trials.robot.fingers, targets.tolerances, *errors)
        found = []
        for row, near, contacts in zip(best.tolist(), nearest.tolist(), verdicts, strict=True):
            hand, arm = HandFit(bool(fits.ok[row]), contacts), None
            if hand.fits and self._arm is not None:
                arm = ArmReach(float(fits.distance[near]), *self._span(targets, self._arm))
            found.append((hand, arm))
        return found

    def fits(self, targets: TargetBatch, q0: Array) -> HandFits:
        """Fit some postures to each of k targets, more where none of them fits.

        Args:
            targets: The targets.
            q0: (k, n) where what is free stays.
        """
        method, every = self._trials.method, np.arange(len(targets))
        nearest = method.postures(targets, 0)
        fits = self._fitted(targets, q0, every, nearest[:, : CLOSEST_TUNING.first])
        without = fits.without()
        if len(without):
            wide = method.postures(targets.rows(without), 1)
            more = np.concatenate([nearest[without, CLOSEST_TUNING.first :], wide], axis=1)
            fits = HandFits.joined([fits, self._fitted(targets, q0, without, more)])
        rows = np.flatnonzero(fits.ok & np.isin(fits.owner, fits.without()))
        rows = rows[smallest_per_target(fits.owner[rows], fits.outside[rows], CLOSEST_TUNING.slid)]
        if len(rows):
            fits = HandFits.joined([fits, self._slid(targets, fits, rows)])
        return fits

    def _fitted(self, targets: TargetBatch, q0: Array, chosen: Rows, postures: Array) -> HandFits:
        """Fit postures (c, p, hand) to c of the targets."""
        trials = self._trials
        owner, states, parameters = trials.hand_rows(targets, chosen, q0, postures)
        parameters[:, trials.parameters.slice("alone")] = 1.0
        parameters[:, trials.parameters.slice("reach")] = 0.0
        return self._run(targets, owner, states, parameters)

    def _slid(self, targets: TargetBatch, fits: HandFits, rows: Rows) -> HandFits:
        """Spend what freedom the contacts leave on the arm's reach.

        The reach weighs so little that a hand without a freedom stays within the tolerance.
        """
        trials = self._trials
        states, parameters = fits.states[rows], fits.parameters[rows]
        for name, value in ({"phase": Phase.HAND_FIT} | initial_lm_state()).items():
            states[:, trials.state.slice(name)] = value
        loose = parameters[:, trials.parameters.slice("position_tolerance")].min(axis=1)
        weight = np.sqrt(np.minimum(loose / (3 * fits.outside[rows]), 1.0))
        parameters[:, trials.parameters.slice("reach")] = weight[:, None]
        trials.set_tolerance(parameters, UNREACHABLE_TOLERANCE)
        slid = self._run(targets, fits.owner[rows], states, parameters)
        return replace(slid, parameters=fits.parameters[rows])

    def _run(self, targets: TargetBatch, owner: Rows, states: Array, parameters: Array) -> HandFits:
        """Run the hand stage of some rows to its end and judge what it came to."""
        trials = self._trials
        states = trials.method.run_rows(states, parameters).states
        # From here on the rows may go on to the arm.
        parameters[:, trials.parameters.slice("alone")] = 0.0
        rotation = states[:, trials.state.slice("palm_rotation")].reshape(-1, 3, 3)
        origin = states[:, trials.state.slice("palm_origin")]
        hand = states[:, trials.state.slice("q")].copy()
        hand[:, list(trials.robot.description.arm_actuators)] = 0.0
        seen = self._seen(targets.rows(owner), rotation, origin)
        verdict = judge(trials.robot, seen, hand)
        position, angle, met = verdict.position_error, verdict.angle_error, verdict.ok
        squares = (position / LENGTH) ** 2, (2 * np.sin(angle / 2)) ** 2
        distance, outside = self._wrist(targets, rotation, origin)
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

    def _seen(self, asked: TargetBatch, rotation: Array, origin: Array) -> TargetBatch:
        """Targets moved with their palm poses to where the palm is with the arm at zero."""
        palm = self._palm
        turn = np.einsum("ij,kmj->kim", palm[:3, :3], rotation)
        points = np.einsum("kij,kfj->kfi", turn, asked.points - origin[:, None]) + palm[:3, 3]
        normals = np.einsum("kij,kfj->kfi", turn, asked.normals)
        more = {key: np.einsum("kij,kfj->kfi", turn, v) for key, v in asked.more.items()}
        return replace(asked, points=points, normals=normals, more=more)

    def _wrist(self, targets: TargetBatch, rotation: Array, origin: Array) -> tuple[Array, Array]:
        """(m,) distance of the wrist from the shoulder, and from what the arm can span [m]."""
        if self._arm is None:
            return np.full(len(origin), np.nan), np.zeros(len(origin))
        wrist = origin + rotation @ self._arm.wrist_in_palm
        distance = np.linalg.norm(wrist - self._arm.shoulder, axis=1)
        near, far = self._span(targets, self._arm)
        return distance, np.maximum(np.maximum(distance - far, near - distance), 0.0)

    def _span(self, targets: TargetBatch, arm: SrsArm) -> tuple[float, float]:
        """Smallest and largest distance of the wrist from the shoulder [m]."""
        limits = self._trials.limits(targets)
        elbow = self._trials.robot.description.arm_actuators[3]
        near, far = arm.reach(limits.lower[elbow], limits.upper[elbow])
        return float(near), float(far)
