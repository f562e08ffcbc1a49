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
from casadi_ik.motion.cycle import StateFields
from casadi_ik.motion.cycle_runner import CycleRunner, FollowerConfig, clip_step


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
    cycles_to_rest = np.floor(speed / change)
    cycles = np.minimum(np.arange(cycles_to_rest.max() + 1)[:, None], cycles_to_rest)
    return q + step + np.sign(step) * (speed * cycles - change * cycles * (cycles + 1) / 2)


class Guard:
    """Collision checks of a follower in its scene.

    Attributes:
        avoidance_distance: Clearance beyond the margin below which the goal avoids a pair [m].
        nudge: Step of the finite differences of clearances [rad or m].
        distance_accuracy: Accuracy of distances of solids, with a reserve [m].
        fractions: Fractions of the requested step that are attempted before a motor brakes.
    """

    avoidance_distance = 0.01
    nudge = 1e-4
    distance_accuracy = 1e-6
    fractions = (1.0,)

    def __init__(self, config: FollowerConfig) -> None:
        """Prepare the scene for targets with contacts of all fingers."""
        assert config.check is not None
        self._check, self._robot = config.check, config.robot.description
        fingers, n = len(config.robot.fingers), len(config.robot.actuators)
        self._n, self._change = n, config.rates.steps(config.period)[1]
        self._bounds = config.bounds
        self._fields = StateFields.of(n)
        self._is_hand_motor = np.isin(np.arange(n), self._robot.hand_actuators).astype(float)
        # Index of the side that a motor belongs to; -1 for motors of the trunk.
        self._side_index = np.zeros(n)
        self._side_index[list(self._robot.trunk_actuators)] = -1
        for index, (arm_motors, hand_motors) in enumerate(self._robot.side_actuators):
            self._side_index[[*arm_motors, *hand_motors]] = index
        # Which fingers have contacts matters, but not where.
        zeros = np.zeros((1, fingers, 3))
        self._query = self._query_of(config.target_builder.from_arrays(zeros, zeros + 1.0))
        self._allocate()

    def set_target(self, problem: TargetBatch) -> None:
        """Adapt the scene to a batch of one target: its touching fingers and its object pose."""
        query, previous = self._query_of(problem), self._query
        self._query = query
        if query.table is not previous.table:
            self._allocate()
        elif self._compiled is not None and not np.array_equal(query.poses, previous.poses):
            self._compiled.surround(query.poses)

    def _query_of(self, problem: TargetBatch) -> CollisionQuery:
        """Return the collision checks for a batch of one target, at any number of postures."""
        return self._check.collision_query(problem).rows(np.zeros(1, dtype=np.intp))

    def _allocate(self) -> None:
        """Allocate the memory of the compiled checks, after a change of the pairs of shapes."""
        query = self._query
        self._required = query.margin + self.distance_accuracy
        self._avoided = query.margin + self.avoidance_distance
        self._levers = levers(self._robot, query.table)
        self._compiled = None
        if query.kernel.entry is not None:
            self._compiled = Guarding(
                query.kernel,
                query.poses,
                query.table,
                self._levers,
                self._is_hand_motor,
                self._side_index,
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
        """Return the nearest configuration (n,) without lacking clearances, to first order.

        Args:
            q: (n,) configuration.
            units: (n,) unit of each motor [rad or m], in which distances are measured.
        """
        lacking, slopes = self._lacking_clearances(q)
        rows = slopes[lacking > 0] * units
        # Singular directions below a tenth of the largest would require long motions.
        motion = units * (np.linalg.pinv(rows, rcond=0.1) @ lacking[lacking > 0])
        return np.clip(q + motion, *self._bounds)

    def step(self, runner: CycleRunner, step: Array | None = None) -> tuple[Array, bool]:
        """Make a step, or the fraction of it after which the motors can still stop in time.

        Args:
            runner: Graph of the cycle and its memory.
            step: (n,) step of the motors; None: the step of the graph.

        Returns:
            The new state, and True if motors had to brake.
        """
        recurrence, fields = runner.recurrence, self._fields
        state = recurrence.state
        if step is None:
            lacking, slopes = runner.parameters["lacking"], runner.parameters["slopes"]
            lacking[...], slopes[...] = self._lacking_clearances(state[fields.goal])
            new_state = recurrence.step()
        else:
            new_state = runner.step_by(step)
        q, requested_step = state[fields.q], new_state[fields.last_step]
        fraction, step, q_rest = self._free_step(q, state[fields.last_step], requested_step)
        is_stopped = fraction < 1.0
        if not is_stopped.any():
            return new_state, False
        # Rounding errors of a motor that stops at a limit must not exceed it.
        new_state[fields.q] = clip_step(q, step, self._bounds)
        new_state[fields.last_step] = step
        # Without this reset, the goal of a stopped motor could lie behind an obstacle.
        np.copyto(new_state[fields.goal], q_rest, where=is_stopped)
        new_state[fields.locked_on] = 0.0
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
        """Return (n,) True for motors to stop, see the rules of this module.

        `mark_blocking_motors` in guard.c is the compiled version.

        Args:
            moves_pair: (p, n) True if a motor moves a colliding pair.
        """
        is_moving_arm = (moves_pair & (self._is_hand_motor == 0)).any(axis=0)
        stopped_sides = self._side_index[is_moving_arm]
        is_trunk_moving = (stopped_sides < 0).any()
        is_on_stopped_side = np.isin(self._side_index, stopped_sides) | is_trunk_moving
        return moves_pair.any(axis=0) | is_on_stopped_side

    def _lacking_clearances(self, goal: Array) -> tuple[Array, Array]:
        """Return the lacking clearances of the nearest pairs at a goal (n,), and their slopes.

        A pair lacks clearance below the avoidance distance. So that the lacking clearances are
        continuous functions of the goal, they fade out as a pair becomes as distant as the nearest
        omitted pair. `keep_away` of guard.c is the compiled version.

        Returns:
            (o,) lacking clearances [m], 0 or less: none; (o, n) gradients of the clearances [m per
            rad or m].
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
        at_goal = distances[0, nearest]
        fade_factor = (threshold - at_goal) / (self._avoided - self._required)
        lacking[:count] = np.maximum(fade_factor * (self._avoided - at_goal), 0.0)
        slopes[:count] = ((distances[1:, nearest] - at_goal) / self.nudge).T
        return lacking, slopes
