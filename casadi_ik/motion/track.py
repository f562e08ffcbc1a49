"""Following a path of grasps that is known beforehand: without a jump where that can be."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.contacts import Kinds
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.clear import OBSTACLES, Guard, between
from casadi_ik.motion.inputs import FollowerInputs, FollowPlan, contact_rows, tolerance_rows
from casadi_ik.solve.engine import Engine
from casadi_ik.solve.verdict import judge


def contacts_between(targets: TargetBatch, i: int, count: int) -> TargetBatch:
    """Contacts on the way from grasp i - 1 to grasp i, the last of them grasp i itself."""
    share = np.linspace(0, 1, count + 1)[1:, None, None]

    def mixed(values: Array) -> Array:
        # What is free in the grasp before comes from where it is in this one.
        before = np.where(np.isnan(values[i - 1]), values[i], values[i - 1])
        return (1 - share) * before + share * values[i]

    def turned(values: Array) -> Array:
        way = mixed(values)
        return way / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-12)

    normals, more = turned(targets.normals), {}
    for name, values in targets.extra_vectors.items():
        way = turned(values)
        if name == "tangents":
            way -= normals * np.sum(normals * way, axis=2, keepdims=True)
            way /= np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-12)
        more[name] = way
    points = mixed(targets.points)
    return replace(targets, points=points, normals=normals, extra_vectors=more, object_pose=None)


@dataclass(frozen=True)
class TrackTuning:
    """Numbers of tracking a known path, chosen with ``studies/moving.py``.

    Attributes:
        cycles: Cycles that a target is given: those of a path may be farther apart than those of a
            stream.
        leap: A motor that moves farther than this part of its range from one grasp to the next is
            looked at more closely: the contacts are moved there in small steps.
        substeps: How many.
        settling: Cycles that a grasp is given before it counts as missed.
        block: Grasps that are followed at once: behind one that cannot be continued the rest is
            void.
        starts: Solutions of the first grasp that the motion may begin with.
    """

    cycles: int = 2
    leap: float = 0.05
    substeps: int = 16
    settling: int = 8
    block: int = 512
    starts: int = 8


TUNING = TrackTuning()


class PathTracker:
    """Makes cycles of one graph, without limits of velocity.

    Attributes:
        n: How many motors there are.
    """

    def __init__(self, plan: FollowPlan, kinds: Kinds) -> None:
        """Compile what is not compiled yet."""
        self._guard = None if plan.check is None else Guard(plan)
        self._asked = FollowerInputs(plan, kinds, 0 if self._guard is None else OBSTACLES)
        self.n = len(plan.robot.actuators)

    def at(self, q: Array) -> Array:
        """The state of rest at a posture (n,)."""
        return self._asked.state_at(q)

    def walk(self, state: Array, targets: TargetBatch) -> Array:
        """Follow targets, TUNING.cycles` each.

        Args:
            state: Where it begins.
            targets: k targets.

        Returns:
            (k, ...) the states after them (`Cycle.state`): where the motors are comes first, their
            last step second, the goal third.
        """
        asked, guard = self._asked, self._guard
        asked_for = contact_rows(asked.cycle, targets) | tolerance_rows(targets.tolerances)
        rows = asked.rows(len(targets), asked_for)
        if guard is None:
            return asked.run.run(state, np.repeat(rows, TUNING.cycles, axis=0))[0][
                TUNING.cycles - 1 :: TUNING.cycles
            ]
        asked.run.state[:] = state
        found = np.empty((len(rows), len(state)))
        for i, row in enumerate(rows):
            asked.run.parameters[:] = row
            guard.surround(targets.rows(slice(i, i + 1)))
            for _ in range(TUNING.cycles):
                guard.step(asked)
            found[i] = asked.run.state
        return found


@dataclass(frozen=True)
class Jump:
    """A place in a path where no continuous motion exists.

    Attributes:
        index: The grasp that is not reached continuously from the one before.
        actuator: The motor that has to move farthest, as a part of its range.
        size: By how much [rad or m].
        at_limit: The motors that stand at a limit where the continuous motion ends; none if it
            ends for another reason, such as a singular arm.

    Example:
        >>> away = np.diag([-1.0, -1.0, 1.0, 1.0])  # the other side of the robot, at once
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
    """Grasps to be followed.

    Attributes:
        engine: Hand-first on the robot.
        targets: The grasps in order, all of the same kinds.
        seed: Of the starts of arms without a closed form.
        tracker: Makes the cycles.
        query: What must not be touched; None: nothing is checked.
    """

    engine: Engine
    targets: TargetBatch
    seed: int
    tracker: PathTracker
    query: CollisionQuery | None
    _reachable: dict[int, bool] = field(default_factory=dict)

    @property
    def unreachable(self) -> int:
        """How many of the grasps that were missed so far cannot be solved at all."""
        return sum(not reachable for reachable in self._reachable.values())

    def follow(self, start: Array) -> tuple[Array, list[Jump]]:
        """Configurations (k, n) that begin with `start`, and the jumps between them."""
        count, n = len(self.targets), self.tracker.n
        first = self.tracker.at(start)
        states = np.empty((count, len(first)))
        states[0] = first
        jumps: list[Jump] = []
        i = 1
        while i < count:
            block = self.targets.rows(slice(i, min(i + TUNING.block, count)))
            states[i : i + len(block)] = self.tracker.walk(states[i - 1], block)
            broken = self._broken(i, states[i - 1 : i + len(block), 2 * n : 3 * n])
            if broken is None:
                i += len(block)
                continue
            i += broken
            states[i], jump = self._taken_up(i, states[i - 1], states[i])
            jumps += [jump] if jump else []
            i += 1
        return states[:, :n], jumps

    def _broken(self, first: int, goals: Array) -> int | None:
        """The first grasp of a block whose goal leaps or misses what can be reached.

        Args:
            first: Number of the block's first grasp.
            goals: (m + 1, n) the goal before the block, and its own.
        """
        rows = np.arange(first, first + len(goals) - 1)
        leaps = self._parts(np.diff(goals, axis=0)) > TUNING.leap
        missed = ~self.meets(rows, goals[1:])
        suspects = missed & ~leaps
        missed[suspects] = self._reach(rows[suspects])
        broken = np.flatnonzero(leaps | missed)
        return int(broken[0]) if len(broken) else None

    def _reach(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which grasps can be solved, wherever the robot is."""
        new = [row for row in rows.tolist() if row not in self._reachable]
        if new:
            asked = self.targets.rows(np.array(new))
            starts = np.tile(self.engine.robot.home, (len(new), 1))
            q = self.engine.method.run(asked, starts, self.seed, trace=False).q
            self._reachable |= zip(new, self.meets(np.array(new), q).tolist(), strict=True)
        return np.array([self._reachable[row] for row in rows.tolist()], dtype=bool)

    def _taken_up(self, i: int, before: Array, direct: Array) -> tuple[Array, Jump | None]:
        """The state at a grasp that could not simply be continued, and the jump if it takes one."""
        n, row = self.tracker.n, self._row(i)
        here, rows = before[2 * n : 3 * n], np.array([i])
        settled = self.tracker.walk(before, row.rows(np.zeros(TUNING.settling, dtype=np.intp)))[-1]
        goal, held = settled[2 * n : 3 * n], None
        if not self.meets(rows, goal[None])[0] or self._parts(goal - here) > TUNING.leap:
            goal, held = self._in_small_steps(i, before)
            if held is not None or not self.meets(rows, goal[None])[0]:
                if not self._reach(rows)[0]:
                    return direct, None
                found = self.engine.finder.find(
                    row, here, self.seed, 1, "q0", query=self._query_at(rows)
                )
                if not found:
                    return direct, None
                held = goal if held is None else held
                goal = found[0].q
        after = self.tracker.at(goal)
        if held is None or self._parts(goal - here) <= TUNING.leap:
            return after, None
        return after, self._jump(i, here, goal, held)

    def _in_small_steps(self, i: int, before: Array) -> tuple[Array, Array | None]:
        """Move the contacts from the last grasp to this one bit by bit.

        Returns:
            The goal reached, and the one before some motor leapt, if one did.
        """
        n = self.tracker.n
        way = contacts_between(self.targets, i, TUNING.substeps)
        states = self.tracker.walk(before, way)
        goals = np.concatenate([before[None, 2 * n : 3 * n], states[:, 2 * n : 3 * n]])
        leaps = np.flatnonzero(self._parts(np.diff(goals, axis=0)) > TUNING.leap)
        return goals[-1], goals[leaps[0]] if len(leaps) else None

    def starts(self, q0: Array, prefer: str) -> Iterator[Array]:
        """Postures the motion may begin with, the one that a solve gives first: it is quick."""
        engine, row, first = self.engine, np.zeros(1, dtype=np.intp), self._row(0)
        run = engine.method.run(replace(first, prefer=prefer), q0[None], self.seed, trace=False)
        solved = bool(self.meets(row, run.q)[0])
        if solved:
            yield run.q[0]
        found = engine.finder.find(
            first, q0, self.seed, TUNING.starts, prefer, apart=0, query=self._query_at(row)
        )
        yield from (alternative.q for alternative in found)
        if not (found or solved):
            # Not to be solved: the nearest there is.
            yield run.q[0]

    def meets(self, rows: NDArray[np.intp], q: Array) -> Bools:
        """Whether configurations meet grasps, and touch nothing."""
        targets = self.targets.rows(rows)
        solved = judge(self.engine.robot, targets, q).solved(targets.enforce_limits)
        query = self._query_at(rows)
        return solved if query is None else solved & query.free(q)

    def _query_at(self, rows: NDArray[np.intp]) -> CollisionQuery | None:
        return None if self.query is None else self.query.rows(rows)

    def _row(self, i: int) -> TargetBatch:
        return self.targets.rows(slice(i, i + 1))

    def _parts(self, change: Array) -> Array:
        """(...) the farthest that a motor moves, as a part of its range."""
        robot = self.engine.robot
        return np.max(np.abs(change) / (robot.upper - robot.lower), axis=-1)

    def _jump(self, i: int, before: Array, after: Array, held: Array) -> Jump:
        robot = self.engine.robot
        change = after - before
        largest = int(np.argmax(np.abs(change) / (robot.upper - robot.lower)))
        lower, upper = robot.description.motion_limits
        at = (held - lower <= 1e-6) | (upper - held <= 1e-6)
        names = tuple(name for name, there in zip(robot.actuators, at, strict=True) if there)
        return Jump(i, robot.actuators[largest], float(change[largest]), names)


@dataclass(frozen=True, eq=False)
class Track:
    """A motion along k grasps.

    Attributes:
        q: (k, n) actuator positions [rad or m].
        success: (k,) whether the contacts are met (within limits, unless they are ignored), and
            nothing is too near where the solver has a scene.
        position_error: (k, f) [m], NaN where free.
        angle_error: (k, f) [rad], NaN where free.
        jumps: Where the motion could not be continued.
        clearance: (k,) distance of the pair nearest to being too near [m]; None without a scene.
        free_between: (k - 1,) whether nothing is too near all along the straight way from each
            posture to the next; not where the motion jumps. None without a scene.
        time: Seconds spent on the whole motion.

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
    q0: Array,
    prefer: str,
    tracker: PathTracker,
    travel: Array | None,
    seed: int,
) -> Track:
    """Follow k grasps of the same kinds.

    The motion begins with the best solution of the first grasp from which all others are reached
    without a jump; if there is none, with the one that misses the fewest and then jumps least.

    Args:
        engine: Hand-first on the robot, for the kinds of the grasps.
        targets: The grasps in order.
        q0: (n,) where the robot is.
        prefer: How the solutions of the first grasp are ranked, see `PREFERENCES`.
        tracker: Goes along them.
        travel: (n,) how far every motor may move from one grasp to the next; None: any distance.
            Where motors are too slow they run after the motion that they cannot keep up with.
        seed: Of the starts of arms without a closed form.

    Raises:
        UnsupportedError: The method is not hand-first.
    """
    begin, every = time.perf_counter(), np.arange(len(targets))
    query = engine.collision_query(targets)
    path = Path(engine, targets, seed, tracker, query)
    best: tuple[Array, list[Jump]] | None = None
    least = (np.inf, np.inf)
    for start in path.starts(q0, prefer):
        q, jumps = path.follow(start)
        missed = int((~path.meets(every, q)).sum())
        if query is not None and not missed:
            # A way between two postures that touches something counts as one missed.
            missed += int((~_free_between(query, q, jumps)).sum()) - len(jumps)
        if (missed, len(jumps)) < least:
            best, least = (q, jumps), (missed, len(jumps))
        if least[1] == 0 and (least[0] == 0 or least[0] <= path.unreachable):
            break
    assert best is not None
    q, jumps = best
    if travel is not None:
        q = _run_after(q, travel)
    verdict = judge(engine.robot, targets, q)
    return Track(
        q=q,
        success=path.meets(every, q),
        position_error=verdict.position_error,
        angle_error=verdict.angle_error,
        jumps=tuple(jumps),
        clearance=None if query is None else query.check(q).distance,
        free_between=None if query is None else _free_between(query, q, jumps),
        time=time.perf_counter() - begin,
    )


def _free_between(query: CollisionQuery, q: Array, jumps: Sequence[Jump]) -> Bools:
    """(k - 1,) of postures (k, n) whether the ways between them are free; jumps are no ways."""
    reached = np.array([jump.index for jump in jumps], dtype=np.intp)
    free = np.ones(max(len(q) - 1, 0), dtype=bool)
    free[reached - 1] = False
    ends = np.flatnonzero(np.append(~free, True)) + 1
    first = 0
    for end in ends.tolist():
        rows = np.arange(first, end)
        free[first : end - 1] = between(query.rows(rows), q[rows]).free
        first = end
    return free


def _run_after(path: Array, travel: Array) -> Array:
    """Motors (k, n) that go straight to where the path (k, n) is, as far as they come."""
    q = path.copy()
    for i in range(1, len(q)):
        way = path[i] - q[i - 1]
        share = np.max(np.abs(way) / travel)
        if share > 1:
            q[i] = q[i - 1] + way / share
    return q
