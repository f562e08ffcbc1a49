"""Following a moving grasp: every solution continues the one before, and jumps are reported."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import judge
from casadi_ik.solving.alternatives.finder import CLOSE, AlternativeFinder
from casadi_ik.solving.trials import Bounds, Trials, refinement_rows

LEAP = 0.05
"""A motor that moves farther than this part of its range from one grasp to the next is looked at
more closely: the contacts are moved there in small steps."""

SUBSTEPS = 16
"""How many."""

STARTS = 8
"""Solutions of the first grasp that the motion may begin with."""

AT_LIMIT = 1e-6
"""How near to a limit counts as at it [rad or m]."""


@dataclass(frozen=True)
class Jump:
    """A place where no continuous motion goes on.

    Attributes:
        index: The grasp that is not reached continuously from the one before.
        actuator: The motor that has to move farthest, as a part of its range.
        size: By how much [rad or m].
        at_limit: The motors that stand at a limit where the continuous motion ends; none if it
            ends for another reason, such as a singular arm.
    """

    index: int
    actuator: str
    size: float
    at_limit: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Track:
    """A motion along k grasps.

    Attributes:
        q: (k, n) actuator positions [rad or m].
        success: (k,) whether the contacts are met (within limits, unless they are ignored).
        position_error: (k, f) [m], NaN where free.
        angle_error: (k, f) [rad], NaN where free.
        jumps: Where the motion could not be continued.
        time: Seconds spent on the whole motion.
    """

    q: Array
    success: NDArray[np.bool_]
    position_error: Array
    angle_error: Array
    jumps: tuple[Jump, ...]
    time: float

    def __len__(self) -> int:
        return len(self.q)


class Tracker:
    """Follows moving grasps on one robot."""

    def __init__(self, robot: ArmHand, method: HandFirstMethod, finder: AlternativeFinder) -> None:
        """Take hand-first on the robot and the finder of its alternatives."""
        self._robot = robot
        self._trials = Trials(robot, method)
        self._finder = finder

    def track(
        self, problems: Problems, q0: Array, prefer: str, travel: Array | None, seed: int
    ) -> Track:
        """Follow k grasps.

        The motion begins with the best solution of the first grasp from which all others are
        reached without a jump; if there is none, with the one that needs the fewest.

        Args:
            problems: The grasps in order.
            q0: (n,) where the robot is.
            prefer: How the solutions of the first grasp are ranked, see `PREFERENCES`.
            travel: (n,) how far every motor may move from one grasp to the next; None: any.
            seed: Of the starts of arms without a closed form.
        """
        begin = time.perf_counter()
        starts = np.tile(q0, (len(problems), 1))
        outcome = self._trials.method.run(problems, starts, seed, trace=False)
        reachable = self._solved(problems, outcome.q)
        unreachable = int((~reachable).sum())
        best: tuple[Array, list[Jump]] | None = None
        least = (np.inf, np.inf)
        for start in self._starts(problems, q0, prefer, seed):
            walk = _Walk(self._trials, self._finder, problems, travel, seed, reachable)
            q, jumps = walk.follow(start)
            missed = len(q) - self._solved(problems, q).sum()
            if (missed, len(jumps)) < least:
                best, least = (q, jumps), (missed, len(jumps))
            if least[0] <= unreachable and least[1] == 0:
                break
        assert best is not None
        q, jumps = best
        verdict = judge(self._robot, problems, q)
        return Track(
            q=q,
            success=self._solved(problems, q),
            position_error=verdict.position_error,
            angle_error=verdict.angle_error,
            jumps=tuple(jumps),
            time=time.perf_counter() - begin,
        )

    def _starts(self, problems: Problems, q0: Array, prefer: str, seed: int) -> list[Array]:
        first = problems.rows(slice(0, 1))
        found = self._finder.find(first, q0, seed, STARTS, prefer, apart=0)
        if found:
            return [alternative.q for alternative in found]
        # Not to be solved: the nearest there is.
        return [self._trials.method.run(first, q0[None], seed, trace=False).q[0]]

    def _solved(self, problems: Problems, q: Array) -> NDArray[np.bool_]:
        return self._trials.solved(problems, q, problems.enforce_limits)


@dataclass(eq=False)
class _Walk:
    """One motion along the grasps."""

    trials: Trials
    finder: AlternativeFinder
    problems: Problems
    travel: Array | None
    seed: int
    reachable: NDArray[np.bool_]

    @cached_property
    def limits(self) -> Bounds:
        return self.trials.limits(self.problems)

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        return self._prepared(self.problems)

    def follow(self, start: Array) -> tuple[Array, list[Jump]]:
        """Configurations (k, n) that begin with `start`, and the jumps between them.

        Where the motors are too slow, the motion that they cannot keep up with is continued all
        the same, and they run after it.
        """
        path, jumps = [start], []
        wanted = start
        for i in range(1, len(self.problems)):
            q = path[-1]
            direct = self._moved(self.rows, i, q, self._near(q))
            if self._continues(i, q, direct):
                wanted = direct
                path.append(direct)
                continue
            after, jump = self._next(i, wanted)
            jumps += [jump] if jump else []
            wanted = after
            path.append(self._towards(q, wanted))
        return np.stack(path), jumps

    def _next(self, i: int, q: Array) -> tuple[Array, Jump | None]:
        """The next configuration whatever the velocity, and the jump there if it takes one."""
        direct = self._moved(self.rows, i, q, self.limits)
        if self._continues(i, q, direct):
            return direct, None
        stepped, held = self._in_small_steps(i, q)
        if held is None and self._meets(i, stepped):
            return stepped, None
        if not self.reachable[i]:
            return direct, None
        found = self.finder.find(self._row(i), q, self.seed, 1, "q0")
        if not found or self._parts(found[0].q - q) <= LEAP:
            return (found[0].q if found else direct), None
        return found[0].q, self._jump(i, q, found[0].q, stepped if held is None else held)

    def _continues(self, i: int, q: Array, after: Array) -> bool:
        return self._meets(i, after) and self._parts(after - q) <= LEAP

    def _in_small_steps(self, i: int, q: Array) -> tuple[Array, Array | None]:
        """Move the contacts from the last grasp to this one bit by bit.

        Returns:
            The configuration reached, and the one before some motor leapt, if one did.
        """
        rows = self._prepared(_between(self.problems, i))
        held: Array | None = None
        for step in range(SUBSTEPS):
            after = self._moved(rows, step, q, self.limits)
            if held is None and self._parts(after - q) > LEAP:
                held = q
            q = after
        return q, held

    def _towards(self, q: Array, goal: Array) -> Array:
        """As far on the straight way to the goal as the motors come."""
        if self.travel is None:
            return goal
        share = np.max(np.abs(goal - q) / self.travel)
        return goal if share <= 1 else q + (goal - q) / share

    def _moved(self, rows: tuple[Array, Array], i: int, q: Array, bounds: Bounds) -> Array:
        """Refinement of row i from q."""
        trials = self.trials
        state, parameters = rows[0][i : i + 1].copy(), rows[1][i : i + 1].copy()
        for name in ("q", "best_q"):
            state[:, trials.state.slice(name)] = bounds.clip(q)
        trials.set_bounds(parameters, bounds)
        return trials.run(state, parameters)[0]

    def _prepared(self, problems: Problems) -> tuple[Array, Array]:
        states, parameters = refinement_rows(self.trials, problems)
        self.trials.set_tolerance(parameters, CLOSE)
        return states, parameters

    def _near(self, q: Array) -> Bounds:
        limits, travel = self.limits, self.travel
        if travel is None:
            return limits
        return Bounds(np.maximum(limits.lower, q - travel), np.minimum(limits.upper, q + travel))

    def _meets(self, i: int, q: Array) -> bool:
        problem = self._row(i)
        return bool(self.trials.solved(problem, q[None], problem.enforce_limits)[0])

    def _row(self, i: int) -> Problems:
        return self.problems.rows(slice(i, i + 1))

    def _parts(self, change: Array) -> float:
        robot = self.trials.robot
        return float(np.max(np.abs(change) / (robot.upper - robot.lower)))

    def _jump(self, i: int, before: Array, after: Array, held: Array) -> Jump:
        robot = self.trials.robot
        change = after - before
        largest = int(np.argmax(np.abs(change) / (robot.upper - robot.lower)))
        at = (held - robot.lower <= AT_LIMIT) | (robot.upper - held <= AT_LIMIT)
        names = tuple(name for name, there in zip(robot.actuators, at, strict=True) if there)
        return Jump(i, robot.actuators[largest], float(change[largest]), names)


def _between(problems: Problems, i: int) -> Problems:
    """Contacts on the way from grasp i - 1 to grasp i, the last of them grasp i itself."""
    share = np.linspace(0, 1, SUBSTEPS + 1)[1:, None, None]

    def mixed(values: Array) -> Array:
        # What is free in the grasp before comes from where it is in this one.
        before = np.where(np.isnan(values[i - 1]), values[i], values[i - 1])
        return (1 - share) * before + share * values[i]

    def turned(values: Array) -> Array:
        way = mixed(values)
        return way / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-12)

    normals, more = turned(problems.normals), {}
    for name, values in problems.more.items():
        way = turned(values)
        if name == "tangents":
            way -= normals * np.sum(normals * way, axis=2, keepdims=True)
            way /= np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-12)
        more[name] = way
    points = mixed(problems.points)
    return replace(problems, points=points, normals=normals, more=more, object_pose=None)


def travel_limits(robot: ArmHand, period: float | None, velocity: Any) -> Array | None:
    """How far every motor may move from one grasp to the next, (n,), or None: any distance.

    Args:
        robot: The robot.
        period: Time between grasps [s], or None.
        velocity: (n,) or a number [rad/s or m/s]; None takes the robot's own.

    Raises:
        InputError: Not positive numbers, or a velocity without a period.
    """
    if period is None:
        if velocity is not None:
            raise InputError("velocity: given without a period, expected both")
        return None
    own = [actuator.velocity for actuator in robot.description.actuators]
    try:
        limits = np.array(own if velocity is None else velocity, dtype=float)
        travel = np.broadcast_to(limits, (len(own),)) * float(period)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"period and velocity: found {period!r} and {velocity!r}, expected a number and "
            f"{len(own)} numbers (or one)"
        ) from error
    if not (np.all(travel > 0) and np.isfinite(period)):
        raise InputError(
            f"period and velocity: found {period!r} and {velocity!r}, expected numbers > 0"
        )
    return travel
