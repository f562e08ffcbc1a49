"""Collision avoidance of a follower, cycle by cycle.

Two rules keep a follower free of collisions. The goal avoids obstacles as far as the contacts
permit: small clearances are rows of its least-squares problem. And a step is made only if the
robot can brake to rest afterwards without violating a margin in any cycle; otherwise motors brake.
The step before was made under the same condition, so braking is safe: by induction the robot never
violates the margin of a static obstacle.

Cycles between which a pair cannot come near are skipped, and so are pairs that were far apart when
all pairs were last compared. Both bounds are steps of motors times levers
(`collision.distances.levers`). A pair that the motors of one hand can separate stops these motors;
a pair that an arm moves stops its side; a pair that the trunk moves stops all motors.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.collision.clearance import Clearances, CollisionQuery
from casadi_ik.collision.clearance_kernel import OBSTACLES, Guarding
from casadi_ik.collision.distances import levers
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.inputs import FollowerInputs, FollowPlan, clip_step


def stopping_distance(step: Array, change: Array) -> Array:
    """Return the signed distances (n,) that motors travel while they brake to rest.

    Args:
        step: (n,) their last steps.
        change: (n,) maximum change of a step from cycle to cycle.
    """
    cycles = np.floor(np.abs(step) / change)
    return np.sign(step) * (np.abs(step) * cycles - change * cycles * (cycles + 1) / 2)


def braked(step: Array, change: Array) -> Array:
    """Return the steps (n,) of braking motors after their last steps, see `stopping_distance`."""
    return np.sign(step) * np.maximum(np.abs(step) - change, 0.0)


def stopping_path(q: Array, step: Array, change: Array) -> Array:
    """Return the positions of motors that make a step and then brake to rest.

    Args:
        q: (n,) positions before the step.
        step: (n,) step.
        change: (n,) maximum change of a step from cycle to cycle.

    Returns:
        (k, n) positions at the end of each cycle; the first is after the step, the last at rest.
    """
    speed = np.abs(step)
    cycles = np.floor(speed / change)
    braked = np.minimum(np.arange(cycles.max() + 1)[:, None], cycles)
    return q + step + np.sign(step) * (speed * braked - change * braked * (braked + 1) / 2)


class Guard:
    """Collision checks of a follower in its scene.

    Attributes:
        avoidance_distance: Clearance beyond the margin below which the goal avoids a pair [m].
        nudge: Step of the finite differences of clearances [rad or m].
        exact: Accuracy of distances of solids, with a reserve [m].
        fractions: Fractions of the requested step that are attempted before a motor brakes.
    """

    avoidance_distance = 0.01
    nudge = 1e-4
    exact = 1e-6
    fractions = (1.0,)

    def __init__(self, plan: FollowPlan) -> None:
        """Prepare the scene for targets that all fingers touch."""
        assert plan.check is not None
        self._check, self._robot = plan.check, plan.robot.description
        fingers, n = len(plan.robot.fingers), len(plan.robot.actuators)
        self._n, self._change = n, plan.rates.steps(plan.period)[1]
        self._bounds = plan.bounds
        self._hand = np.isin(np.arange(n), self._robot.hand_actuators).astype(float)
        self._side = np.zeros(n)
        self._side[list(self._robot.trunk_actuators)] = -1
        for number, motors in enumerate(self._robot.side_actuators):
            self._side[list(sum(motors, ()))] = number
        anywhere = np.zeros((1, fingers, 3))
        self._query = self._query_of(plan.target_builder.from_arrays(anywhere, anywhere + 1.0))
        self._allocate()

    def set_target(self, problem: TargetBatch) -> None:
        """Adapt the scene to one target: which fingers touch, and the pose of the object."""
        query, previous = self._query_of(problem), self._query
        self._query = query
        if query.table is not previous.table:
            self._allocate()
        elif self._compiled is not None and not np.array_equal(query.poses, previous.poses):
            self._compiled.surround(query.poses)

    def _query_of(self, problem: TargetBatch) -> CollisionQuery:
        return self._check.collision_query(problem).rows(np.zeros(1, dtype=np.intp))

    def _allocate(self) -> None:
        """Allocate the memory of the compiled checks."""
        query = self._query
        self._required = query.margin + self.exact
        self._avoided = query.margin + self.avoidance_distance
        self._levers = levers(self._robot, query.table)
        self._compiled = None
        if query.kernel.entry is not None:
            self._compiled = Guarding(
                query.kernel,
                query.poses,
                query.table,
                self._levers,
                self._hand,
                self._side,
                self._change,
                self.fractions,
                required_distance=self._required,
                avoided_distance=self._avoided,
                nudge=self.nudge,
            )

    def clearance(self, q: Array) -> Clearances:
        """Return the clearance of a configuration (n,)."""
        return self._query.check(q[None])

    def are_free(self, q: Array) -> bool:
        """Return True if configurations (m, n) are free of collisions."""
        query, required = self._query, self._required
        # Distances above the required one are not computed.
        distances, _ = query.kernel.min_distances(q, query.poses, query.table, required, required)
        return bool((distances >= required).all())

    def posture_with_clearance(self, q: Array, units: Array) -> Array:
        """Return the nearest configuration (n,) with the lacking clearances of one, to first order.

        Args:
            q: (n,) configuration.
            units: (n,) unit of each motor [rad or m], in which distances are measured.
        """
        lacking, slopes = self._lacking_clearances(q)
        rows = slopes[lacking > 0] * units
        motion = units * (np.linalg.pinv(rows, rcond=0.1) @ lacking[lacking > 0])
        return np.clip(q + motion, *self._bounds)

    def step(self, inputs: FollowerInputs, step: Array | None = None) -> tuple[Array, bool]:
        """Make a step, or the fraction of it after which the motors can still stop in time.

        Args:
            inputs: Graph of the cycle and its memory.
            step: (n,) step of the motors; None: the step of the graph.

        Returns:
            The new state, and True if motors had to brake.
        """
        n, run = self._n, inputs.run
        state = run.state
        if step is None:
            lacking, slopes = inputs.views["lacking"], inputs.views["slopes"]
            lacking[...], slopes[...] = self._lacking_clearances(state[2 * n : 3 * n])
            new_state = run.step()
        else:
            new_state = inputs.step_by(step)
        q, requested_step = state[:n], new_state[n : 2 * n]
        fraction, step, q_rest = self._free_step(q, state[n : 2 * n], requested_step)
        is_stopped = fraction < 1.0
        if not is_stopped.any():
            return new_state, False
        # Rounding errors of a motor that stops at a limit must not exceed it.
        new_state[:n], new_state[n : 2 * n] = clip_step(q, step, self._bounds), step
        # Without this reset, the goal of a stopped motor could lie behind an obstacle.
        np.copyto(new_state[2 * n : 3 * n], q_rest, where=is_stopped)
        new_state[3 * n] = 0.0
        return new_state, True

    def _free_step(
        self, q: Array, last_step: Array, requested_step: Array
    ) -> tuple[Array, Array, Array]:
        """Return the fraction of a requested step that is collision-free including braking.

        If motors move a pair below its required distance (or below its present distance if that is
        smaller), their fraction is reduced, finally to braking: braking of all motors of a pair was
        checked in the previous cycle.

        Returns:
            (n,) fraction of the requested step by motor, (n,) the step, (n,) positions at rest
            after it.
        """
        if (guarding := self._compiled) is not None:
            guarding.q[...], guarding.last_step[...] = q, last_step
            guarding.wanted_step[...] = requested_step
            guarding.stop_in_time()
            return guarding.share, guarding.step, guarding.q_rest
        braking_step = braked(last_step, self._change)
        fractions, attempts = np.array([*self.fractions, 0.0]), np.zeros(self._n, dtype=int)
        while True:
            step = braking_step + fractions[attempts] * (requested_step - braking_step)
            path = stopping_path(q, step, self._change)
            initial, *distances = self._query.kernel.all_distances(
                np.concatenate([q[None], path]), self._query.poses, self._query.table
            )
            is_touching = ~(distances >= np.minimum(initial, self._required)).all(axis=0)
            is_reduced = self._blocking_motors(self._levers[is_touching] > 0)
            is_reduced &= attempts < len(self.fractions)
            if not is_reduced.any():
                return fractions[attempts], step, path[-1]
            attempts += is_reduced

    def _blocking_motors(self, moves_pair: Bools) -> Bools:
        """Return (n,) True for motors to stop, from the motors (p, n) that move each pair.

        `mark_blocking_motors` in guard.c is the compiled version.
        """
        arms = (moves_pair & (self._hand == 0)).any(axis=0)
        sides = np.isin(self._side, self._side[arms]) | (self._side[arms] < 0).any()
        return moves_pair.any(axis=0) | sides

    def _lacking_clearances(self, goal: Array) -> tuple[Array, Array]:
        """Return the lacking clearances (o,) of the nearest pairs at a goal [m], and slopes (o, n).

        The lacking clearances are continuous functions of the goal, see `keep_away` of guard.c.
        """
        if (guarding := self._compiled) is not None:
            guarding.goal[...] = goal
            guarding.keep_away()
            return guarding.lacking, guarding.slopes
        lacking, slopes = np.zeros(OBSTACLES), np.zeros((OBSTACLES, self._n))
        nudged = goal + np.concatenate([np.zeros((1, self._n)), self.nudge * np.eye(self._n)])
        distances = self._query.kernel.all_distances(nudged, self._query.poses, self._query.table)
        order = np.argsort(distances[0], kind="stable")
        nearest, omitted = order[:OBSTACLES], order[OBSTACLES : OBSTACLES + 1]
        count, threshold = len(nearest), distances[0, omitted].min(initial=self._avoided)
        share = (threshold - distances[0, nearest]) / (self._avoided - self._required)
        lacking[:count] = np.maximum(share * (self._avoided - distances[0, nearest]), 0.0)
        slopes[:count] = ((distances[1:, nearest] - distances[0, nearest]) / self.nudge).T
        return lacking, slopes
