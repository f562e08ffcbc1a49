"""Run of a method that ends at the nearest configurations of targets that it does not solve.

The restarts of a method take longer than the search for the nearest configuration. A target counts
as out of reach if the first restarts do not solve it and its nearest configuration is far outside
the tolerances; its other restarts are omitted.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.files.arrays import Array, Rows
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.best_effort import BestEffort
from casadi_ik.solve.collision_free import DEFAULT_PREFERENCE
from casadi_ik.solve.method import Method, Outcome
from casadi_ik.solve.nearest import NearestSearch
from casadi_ik.solve.status import Status
from casadi_ik.solve.verdict import judge

MIN_MEAN_SQUARE = 1.001
"""Mean square of the errors of the nearest configuration, divided by their tolerances, from which a
target is out of reach. It does not exceed 1 for a solution; the excess covers rounding.

Source: of 220,000 reachable targets, many at limits, of a Panda, a KUKA LWR with a Barrett hand and
a Panda with an Allegro hand, with tolerances of 0.5 mm and 1.5 mm, one restart leaves 1,848
unsolved, and the mean square of 29 of these exceeds 1. Two restarts leave 14, and none exceeds 1.
Of 90,000 reachable targets of an SO-101, one restart leaves 98, and none exceeds 1. Of 139,975
targets at limits that five robots solve at tolerances of 0.25 mm to 1 mm, all have the same
solutions with best effort.
"""

FIRST_RESTARTS, FIRST_RESTARTS_WITHOUT_CLOSED_FORM = 2, 1
"""Numbers of restarts before the search for the nearest configuration. A restart of an arm without
a closed form takes as long as several others."""


@dataclass(frozen=True, eq=False)
class BestEffortRun:
    """A method followed by the search for the nearest configurations.

    Attributes:
        robot: The robot.
        method: The method.
        search: Search for the nearest configurations.
    """

    robot: ArmHand
    method: Method
    search: NearestSearch

    @cached_property
    def first_restarts(self) -> int:
        """Number of restarts before the search for the nearest configuration."""
        hand_search = self.method.hand_search
        is_numeric = hand_search is not None and hand_search.step.arm is None
        has_arm = bool(self.robot.description.arm_actuators)
        return FIRST_RESTARTS_WITHOUT_CLOSED_FORM if is_numeric and has_arm else FIRST_RESTARTS

    def first_targets(self, targets: TargetBatch) -> TargetBatch | None:
        """Return targets for the first restarts; None if restarts may not be omitted.

        A preference only ranks answers; it is not part of the first restarts. Required are all
        restarts of methods without numbered restarts, and of searches without compiled code, which
        may miss the nearest configuration.
        """
        if self.method.hand_search is None or not self.search.is_compiled:
            return None
        return replace(targets, prefer=DEFAULT_PREFERENCE) if targets.prefers_q0 else targets

    def is_out_of_reach(self, targets: TargetBatch) -> NDArray[np.bool_]:
        """Return (k,) True where the nearest configuration is far outside the tolerances.

        Without compiled code no target counts as out of reach. Collisions are not considered.
        """
        if not self.search.is_compiled:
            return np.zeros(len(targets), dtype=bool)
        no_q = np.full((len(targets), len(self.robot.actuators)), np.nan)
        minima = self.search.solve(targets, no_q, None, BestEffort())
        return minima.mean_square >= MIN_MEAN_SQUARE * max_mean_square(targets)

    def run(
        self,
        targets: TargetBatch,
        query: CollisionQuery | None,
        options: BestEffort,
        trace: bool = False,
        outcome: Outcome | None = None,
    ) -> Outcome:
        """Solve a batch; unsolved targets get the status NEAREST and their nearest configuration.

        Args:
            targets: k targets of the kinds of contacts of the method.
            query: Collision query of the targets; None: collisions are not checked. A target for
                which all minima collide keeps the status and the configuration of the method.
            options: Options of the nearest configurations.
            trace: Whether to record every iteration.
            outcome: Outcome of `first_targets` after the first restarts, if they have run.
        """
        first_targets = self.first_targets(targets)
        if first_targets is None:
            outcome = self.method.run(targets, trace)
            unsolved = np.flatnonzero(~self._solved(targets, outcome.q))
            return self._with_nearest(targets, unsolved, outcome, query, options)
        if outcome is None:
            hand_search = self.method.hand_search
            assert hand_search is not None
            outcome = hand_search.run(first_targets, trace, self.first_restarts)
            solved = self._solved(targets, outcome.q)
        else:
            solved = outcome.status == Status.SOLVED
        outcome = self.end_early(targets, outcome, solved, query, options)
        is_open = outcome.status != Status.NEAREST
        rows = np.flatnonzero(is_open & (~solved | targets.prefers_q0))
        if len(rows):
            outcome = outcome.with_rows(rows, self.method.run(targets.rows(rows), trace))
            solved[rows] = self._solved(targets.rows(rows), outcome.q[rows])
        return self._with_nearest(
            targets, np.flatnonzero(is_open & ~solved), outcome, query, options
        )

    def end_early(
        self,
        targets: TargetBatch,
        outcome: Outcome,
        solved: NDArray[np.bool_],
        query: CollisionQuery | None,
        options: BestEffort,
    ) -> Outcome:
        """Return the outcome of the first restarts with the nearest configurations.

        Args:
            targets: k targets.
            outcome: Outcome of the first restarts.
            solved: (k,) True for solved targets.
            query: See `run`.
            options: See `run`.

        Returns:
            The outcome; targets that are out of reach have the status NEAREST.
        """
        rows = np.flatnonzero(~solved)
        bounds = MIN_MEAN_SQUARE * max_mean_square(targets)
        outcome = self._with_nearest(targets, rows, outcome, query, BestEffort(), bounds)
        if options != BestEffort():
            rows = np.flatnonzero(outcome.status == Status.NEAREST)
            outcome = self._with_nearest(targets, rows, outcome, query, options)
        return outcome

    def _solved(self, targets: TargetBatch, q: Array) -> NDArray[np.bool_]:
        return judge(self.robot, targets, q).solved(targets.enforce_limits)

    def _with_nearest(
        self,
        targets: TargetBatch,
        rows: Rows,
        outcome: Outcome,
        query: CollisionQuery | None,
        options: BestEffort,
        min_mean_square: float | Array = 0.0,
    ) -> Outcome:
        """Return an outcome with the nearest configurations of some targets.

        Args:
            targets: k targets.
            rows: Indices of unsolved targets.
            outcome: Outcome of the method.
            query: See `run`.
            options: See `run`.
            min_mean_square: Mean square of the errors of a nearest configuration, divided by their
                tolerances, below which a target remains unchanged; one number, or (k,).
        """
        if not len(rows):
            return outcome
        started = time.perf_counter()
        bounds = np.broadcast_to(min_mean_square, len(targets))[rows]
        q, status, seconds = outcome.q.copy(), outcome.status.copy(), outcome.time.copy()
        group, group_query = targets.rows(rows), None if query is None else query.rows(rows)
        minima = self.search.solve(group, q[rows], group_query, options)
        is_result = minima.is_free & (minima.mean_square >= bounds)
        q[rows[is_result]], status[rows[is_result]] = minima.q[is_result], Status.NEAREST
        seconds[rows] += (time.perf_counter() - started) / len(rows)
        return replace(outcome, q=q, status=status, time=seconds)


def max_mean_square(targets: TargetBatch) -> Array:
    """Return the largest mean square (k,) of the contact errors of any solution.

    The errors are divided by their tolerances, so that it is 1 for targets given by contacts. A
    palm pose within tolerance displaces a contact by the position error of the palm, and by its
    angle error times the distance of the contact from the palm. It turns both axes of a contact.
    """
    if targets.palms is None:
        return np.ones(len(targets))
    tolerance, points = targets.largest_tolerance, targets.points
    distances = np.linalg.norm(points - targets.palms[:, None, :3, 3], axis=2)
    chord = 2 * np.sin(min(tolerance.angle, np.pi) / 2)
    position_ratios = (tolerance.position + chord * distances) / targets.position_tolerance
    angle_ratios = tolerance.angle / targets.angle_tolerance
    return np.fmax(np.nanmax(position_ratios, axis=1) ** 2, 2 * angle_ratios.max() ** 2)
