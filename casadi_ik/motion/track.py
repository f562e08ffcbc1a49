"""Tracking of a known path of grasps, without jumps between branches where possible."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.collision.clearance_kernel import OBSTACLES
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.contacts import Kinds
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.cycle_runner import CycleRunner, FollowerConfig, contact_rows, tolerance_rows
from casadi_ik.motion.free_path import check_path
from casadi_ik.motion.guard import Guard
from casadi_ik.solve.engine import Engine
from casadi_ik.solve.verdict import judge


def contacts_between(targets: TargetBatch, i: int, count: int) -> TargetBatch:
    """Return `count` interpolated targets from grasp i - 1 (exclusive) to grasp i (inclusive)."""
    fractions = np.linspace(0, 1, count + 1)[1:, None, None]

    def interpolate(values: Array) -> Array:
        # Contacts that are free in the previous grasp stay at their value in this one.
        previous = np.where(np.isnan(values[i - 1]), values[i], values[i - 1])
        return (1 - fractions) * previous + fractions * values[i]

    def interpolate_directions(values: Array) -> Array:
        vectors = interpolate(values)
        return vectors / np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-12)

    normals, extra_vectors = interpolate_directions(targets.normals), {}
    for name, values in targets.extra_vectors.items():
        vectors = interpolate_directions(values)
        if name == "tangents":  # perpendicular to the interpolated normals
            vectors -= normals * np.sum(normals * vectors, axis=2, keepdims=True)
            vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-12)
        extra_vectors[name] = vectors
    points = interpolate(targets.points)
    vectors = {"points": points, "normals": normals, "extra_vectors": extra_vectors}
    return replace(targets, **vectors, object_pose=None)


@dataclass(frozen=True)
class TrackTuning:
    """Parameters of tracking a known path. Source: ``studies/moving.py``.

    Attributes:
        cycles: Number of cycles per grasp; more than one, because grasps of a path may be farther
            apart than targets of a stream.
        leap: Motion of a motor from one grasp to the next, relative to its range, above which it
            counts as a leap and the contacts are interpolated.
        substeps: Number of interpolation steps from one grasp to the next.
        max_settling_grasps: How often a grasp is repeated, with `cycles` cycles each time, before
            it counts as missed.
        block: Number of grasps that are tracked in one call; results after a failure are
            discarded.
        starts: Maximum number of attempted solutions of the first grasp.
    """

    cycles: int = 2
    leap: float = 0.05
    substeps: int = 16
    max_settling_grasps: int = 8
    block: int = 512
    starts: int = 8


TRACK_TUNING = TrackTuning()


class PathTracker:
    """Graph of a cycle without velocity limits, applied to known targets.

    Attributes:
        n: Number of motors.
        fields: Positions of the fields of a state.
    """

    def __init__(self, config: FollowerConfig, kinds: Kinds) -> None:
        """Compile the graph unless it is cached."""
        self._guard = None if config.check is None else Guard(config)
        self._runner = CycleRunner(config, kinds, 0 if self._guard is None else OBSTACLES)
        self.n = len(config.robot.actuators)
        self.fields = self._runner.fields

    def state_at(self, q: Array) -> Array:
        """Return the state of rest at a posture (n,)."""
        return self._runner.state_at(q)

    def track(self, state: Array, targets: TargetBatch) -> Array:
        """Track targets in their order, `TrackTuning.cycles` cycles each.

        Args:
            state: Initial state.
            targets: k targets.

        Returns:
            (k, s) states after each target (`Cycle.state`).
        """
        runner, guard = self._runner, self._guard
        values = contact_rows(runner.cycle, targets) | tolerance_rows(targets.tolerances)
        rows = runner.rows(len(targets), values)
        if guard is None:
            cycles = TRACK_TUNING.cycles
            all_states, _ = runner.recurrence.run(state, np.repeat(rows, cycles, axis=0))
            return all_states[cycles - 1 :: cycles]
        runner.recurrence.state[:] = state
        states = np.empty((len(rows), len(state)))
        for i, row in enumerate(rows):
            runner.recurrence.parameters[:] = row
            guard.set_target(targets.rows(slice(i, i + 1)))
            for _ in range(TRACK_TUNING.cycles):
                guard.step(runner)
            states[i] = runner.recurrence.state
        return states


@dataclass(frozen=True)
class Jump:
    """Jump of a motion at a grasp that cannot be reached continuously.

    Attributes:
        index: Number of the grasp.
        actuator: Motor with the largest motion relative to its range.
        size: Motion of this motor [rad or m].
        at_limit: Motors at a limit at the end of the continuous motion; empty if it ends for
            another reason, such as a singular arm.

    Example:
        >>> away = np.diag([-1.0, -1.0, 1.0, 1.0])  # rotated to the other side of the robot
        >>> jump = solver.track([grasp, grasp.at(away)]).jumps[0]
        >>> jump.index, jump.actuator in robot.actuators
        (1, True)
    """

    index: int
    actuator: str
    size: float
    at_limit: tuple[str, ...]


@dataclass(eq=False)
class Path:
    """Tracking of a path of grasps.

    Attributes:
        engine: Engine of the hand-first method.
        targets: Grasps in order, with the same kinds of contacts.
        tracker: Graph of the cycles.
        query: Collision checks; None checks nothing.
    """

    engine: Engine
    targets: TargetBatch
    tracker: PathTracker
    query: CollisionQuery | None
    _reachable: dict[int, bool] = field(default_factory=dict)

    @property
    def unreachable(self) -> int:
        """Number of missed grasps without a solution."""
        return sum(not reachable for reachable in self._reachable.values())

    def follow(self, start: Array) -> tuple[Array, list[Jump]]:
        """Return configurations (k, n) that begin with `start`, and the jumps between them."""
        count, fields = len(self.targets), self.tracker.fields
        first = self.tracker.state_at(start)
        states = np.empty((count, len(first)))
        states[0] = first
        jumps: list[Jump] = []
        i = 1
        while i < count:
            block = self.targets.rows(slice(i, min(i + TRACK_TUNING.block, count)))
            states[i : i + len(block)] = self.tracker.track(states[i - 1], block)
            failure = self._first_failure(i, states[i - 1 : i + len(block), fields.goal])
            if failure is None:
                i += len(block)
                continue
            i += failure
            states[i], jump = self._resume(i, states[i - 1], states[i])
            jumps += [jump] if jump else []
            i += 1
        return states[:, fields.q], jumps

    def _first_failure(self, first: int, goals: Array) -> int | None:
        """Return the first grasp of a block whose goal leaps, or misses a grasp with a solution.

        Args:
            first: Number of the block's first grasp.
            goals: (m + 1, n) goal before the block, and the goals of its grasps.

        Returns:
            Number within the block; None without a failure.
        """
        rows = np.arange(first, first + len(goals) - 1)
        leaps = self._relative_motion(np.diff(goals, axis=0)) > TRACK_TUNING.leap
        is_failure = leaps | ~self.meets(rows, goals[1:])
        # A grasp without a solution is no reason to interpolate.
        only_missed = is_failure & ~leaps
        is_failure[only_missed] = self._have_solutions(rows[only_missed])
        failures = np.flatnonzero(is_failure)
        return int(failures[0]) if len(failures) else None

    def _have_solutions(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which grasps have a solution on any branch."""
        new = [row for row in rows.tolist() if row not in self._reachable]
        if new:
            targets = self.targets.rows(np.array(new))
            q = self.engine.method.run(targets.starting_at(self.engine.robot.home)).q
            self._reachable |= zip(new, self.meets(np.array(new), q).tolist(), strict=True)
        return np.array([self._reachable[row] for row in rows.tolist()], dtype=bool)

    def _resume(
        self, i: int, previous_state: Array, direct_state: Array
    ) -> tuple[Array, Jump | None]:
        """Return the state at a grasp that a block could not continue to, and a jump if needed.

        The contacts of the grasp are tracked for more cycles, then approached in small steps, and
        last of all the nearest solution on any branch is taken.

        Args:
            i: Number of the grasp.
            previous_state: State at the grasp before.
            direct_state: State of the block at this grasp, which remains if there is no solution.
        """
        target, leap, goal_field = self._row(i), TRACK_TUNING.leap, self.tracker.fields.goal
        previous_goal, rows = previous_state[goal_field], np.array([i])
        repeated = target.rows(np.zeros(TRACK_TUNING.max_settling_grasps, dtype=np.intp))
        goal = self.tracker.track(previous_state, repeated)[-1][goal_field]
        goal_before_leap = None
        is_met = self.meets(rows, goal[None])[0]
        if not is_met or self._relative_motion(goal - previous_goal) > leap:
            goal, goal_before_leap = self._move_in_small_steps(i, previous_state)
            if goal_before_leap is not None or not self.meets(rows, goal[None])[0]:
                if not self._have_solutions(rows)[0]:
                    return direct_state, None
                alternatives = self.engine.finder.find(
                    target.starting_at(previous_goal), 1, "q0", query=self._query_at(rows)
                )
                if not alternatives:
                    return direct_state, None
                goal_before_leap = goal if goal_before_leap is None else goal_before_leap
                goal = alternatives[0].q
        state = self.tracker.state_at(goal)
        if goal_before_leap is None or self._relative_motion(goal - previous_goal) <= leap:
            return state, None
        return state, self._jump(i, previous_goal, goal, goal_before_leap)

    def _move_in_small_steps(self, i: int, previous_state: Array) -> tuple[Array, Array | None]:
        """Move the contacts from the previous grasp to this one in small steps.

        Returns:
            Final goal, and the goal before the first leap of a motor, None without a leap.
        """
        substeps = contacts_between(self.targets, i, TRACK_TUNING.substeps)
        states = self.tracker.track(previous_state, substeps)
        goals = np.concatenate([previous_state[None], states])[:, self.tracker.fields.goal]
        leaps = np.flatnonzero(self._relative_motion(np.diff(goals, axis=0)) > TRACK_TUNING.leap)
        return goals[-1], goals[leaps[0]] if len(leaps) else None

    def starts(self, prefer: str) -> Iterator[Array]:
        """Yield solutions of the first grasp, beginning with the result of a fast solve."""
        engine, row, first = self.engine, np.zeros(1, dtype=np.intp), self._row(0)
        run = engine.method.run(replace(first, prefer=prefer))
        is_solved = bool(self.meets(row, run.q)[0])
        if is_solved:
            yield run.q[0]
        alternatives = engine.finder.find(
            first, TRACK_TUNING.starts, prefer, separation=0, query=self._query_at(row)
        )
        yield from (alternative.q for alternative in alternatives)
        if not (alternatives or is_solved):
            # The grasp has no solution: start at the nearest configuration.
            yield run.q[0]

    def meets(self, rows: NDArray[np.intp], q: Array) -> Bools:
        """Return which configurations meet their grasps without a collision."""
        targets = self.targets.rows(rows)
        solved = judge(self.engine.robot, targets, q).solved(targets.enforce_limits)
        query = self._query_at(rows)
        return solved if query is None else solved & query.free(q)

    def _query_at(self, rows: NDArray[np.intp]) -> CollisionQuery | None:
        return None if self.query is None else self.query.rows(rows)

    def _row(self, i: int) -> TargetBatch:
        return self.targets.rows(slice(i, i + 1))

    def _relative_motion(self, change: Array) -> Array:
        """Return the largest motion (...) of a motor relative to its range."""
        robot = self.engine.robot
        return np.max(np.abs(change) / (robot.upper - robot.lower), axis=-1)

    def _jump(self, i: int, start: Array, end: Array, goal_before_leap: Array) -> Jump:
        """Return the jump at a grasp, between two goals (n,)."""
        robot = self.engine.robot
        change = end - start
        largest = int(np.argmax(np.abs(change) / (robot.upper - robot.lower)))
        lower, upper = robot.description.motion_limits
        is_at_limit = np.minimum(goal_before_leap - lower, upper - goal_before_leap) <= 1e-6
        names = tuple(np.array(robot.actuators)[is_at_limit].tolist())
        return Jump(i, robot.actuators[largest], float(change[largest]), names)


@dataclass(frozen=True, eq=False)
class Track:
    """Motion along k grasps.

    Attributes:
        q: (k, n) actuator positions [rad or m].
        success: (k,) True if the contacts are met within limits (unless they are ignored), without
            a collision if the solver has a scene.
        position_error: (k, f) [m], NaN where free.
        angle_error: (k, f) [rad], NaN where free.
        jumps: Jumps at grasps that could not be reached continuously.
        clearance: (k,) distance of the pair with the least clearance beyond its margin [m]; None
            without a scene.
        free_between: (k - 1,) True if the straight segment to the next posture is free of
            collisions; False where the motion jumps. None without a scene.
        time: Computation time of the motion [s].

    Example:
        >>> track = solver.track([grasp, grasp])
        >>> track.q.shape, bool(track.success.all())
        ((2, 14), True)
    """

    q: Array
    success: NDArray[np.bool_]
    position_error: Array
    angle_error: Array
    jumps: tuple[Jump, ...]
    clearance: Array | None
    free_between: Bools | None
    time: float

    def __len__(self) -> int:
        return len(self.q)


def track(
    engine: Engine,
    targets: TargetBatch,
    tracker: PathTracker,
    travel: Array | None,
) -> Track:
    """Track k grasps with the same kinds of contacts.

    The motion begins at the best solution of the first grasp from which all grasps are reached
    without a jump, otherwise at the solution with the fewest misses, then the fewest jumps.

    Args:
        engine: Engine of the hand-first method for the kinds of contacts.
        targets: Grasps in order; starts and preference apply to the first one.
        tracker: Graph of the cycles.
        travel: (n,) largest motion of every motor from one grasp to the next; motors that are too
            slow lag behind. None: any distance.

    Raises:
        UnsupportedError: The method is not hand-first.
    """
    start_time, all_rows = time.perf_counter(), np.arange(len(targets))
    query = engine.collision_query(targets)
    path = Path(engine, replace(targets, prefer="limits"), tracker, query)
    best: tuple[Array, list[Jump]] | None = None
    best_counts = (np.inf, np.inf)
    for start in path.starts(targets.prefer):
        q, jumps = path.follow(start)
        missed = int((~path.meets(all_rows, q)).sum())
        if query is not None and not missed:
            # A segment with a collision counts as one missed grasp. Jumps are never free.
            missed += int((~_free_between(query, q, jumps)).sum()) - len(jumps)
        if (missed, len(jumps)) < best_counts:
            best, best_counts = (q, jumps), (missed, len(jumps))
        if best_counts[1] == 0 and best_counts[0] <= path.unreachable:
            break
    assert best is not None
    q, jumps = best
    if travel is not None:
        q = _limit_travel(q, travel)
    verdict = judge(engine.robot, targets, q)
    return Track(
        q=q,
        success=path.meets(all_rows, q),
        position_error=verdict.position_error,
        angle_error=verdict.angle_error,
        jumps=tuple(jumps),
        clearance=None if query is None else query.check(q).distance,
        free_between=None if query is None else _free_between(query, q, jumps),
        time=time.perf_counter() - start_time,
    )


def _free_between(query: CollisionQuery, q: Array, jumps: Sequence[Jump]) -> Bools:
    """Return (k - 1,) True for free segments between postures (k, n), False for jumps.

    The motion is checked from jump to jump.
    """
    jump_rows = np.array([jump.index for jump in jumps], dtype=np.intp)
    free = np.ones(max(len(q) - 1, 0), dtype=bool)
    free[jump_rows - 1] = False
    run_ends = np.flatnonzero(np.append(~free, True)) + 1
    first = 0
    for end in run_ends.tolist():
        rows = np.arange(first, end)
        free[first : end - 1] = check_path(query.rows(rows), q[rows]).free
        first = end
    return free


def _limit_travel(path: Array, travel: Array) -> Array:
    """Return a motion (k, n) that follows a path (k, n) with limited steps."""
    q = path.copy()
    for i in range(1, len(q)):
        step = path[i] - q[i - 1]
        excess = np.max(np.abs(step) / travel)
        if excess > 1:
            q[i] = q[i - 1] + step / excess
    return q
