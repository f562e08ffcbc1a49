"""One motion along known grasps: continued, and where that cannot be, taken up elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.motion.between import between
from casadi_ik.motion.walker import Walker
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import judge
from casadi_ik.solving.engine import Engine

LEAP = 0.05
"""A motor that moves farther than this part of its range from one grasp to the next is looked at
more closely: the contacts are moved there in small steps."""

SUBSTEPS = 16
"""How many."""

SETTLING = 8
"""Cycles that a grasp is given before it counts as missed."""

BLOCK = 512
"""Grasps that are followed at once: behind one that cannot be continued the rest is void."""

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
        problems: The grasps in order, all of the same kinds.
        seed: Of the starts of arms without a closed form.
        walker: Makes the cycles.
        around: What must not be touched; None: nothing is checked.
    """

    engine: Engine
    problems: Problems
    seed: int
    walker: Walker
    around: Surroundings | None
    _reachable: dict[int, bool] = field(default_factory=dict)

    @property
    def unreachable(self) -> int:
        """How many of the grasps that were missed so far cannot be solved at all."""
        return sum(not reachable for reachable in self._reachable.values())

    def follow(self, start: Array) -> tuple[Array, list[Jump]]:
        """Configurations (k, n) that begin with `start`, and the jumps between them."""
        count, n = len(self.problems), self.walker.n
        first = self.walker.at(start)
        states = np.empty((count, len(first)))
        states[0] = first
        jumps: list[Jump] = []
        i = 1
        while i < count:
            block = self.problems.rows(slice(i, min(i + BLOCK, count)))
            states[i : i + len(block)] = self.walker.walk(states[i - 1], block)
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
        leaps = self._parts(np.diff(goals, axis=0)) > LEAP
        missed = ~self._meets(rows, goals[1:])
        suspects = missed & ~leaps
        missed[suspects] = self._reach(rows[suspects])
        broken = np.flatnonzero(leaps | missed)
        return int(broken[0]) if len(broken) else None

    def _reach(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which grasps can be solved, wherever the robot is."""
        new = [row for row in rows.tolist() if row not in self._reachable]
        if new:
            asked = self.problems.rows(np.array(new))
            starts = np.tile(self.engine.robot.home, (len(new), 1))
            q = self.engine.method.run(asked, starts, self.seed, trace=False).q
            self._reachable |= zip(new, self._meets(np.array(new), q).tolist(), strict=True)
        return np.array([self._reachable[row] for row in rows.tolist()], dtype=bool)

    def _taken_up(self, i: int, before: Array, direct: Array) -> tuple[Array, Jump | None]:
        """The state at a grasp that could not simply be continued, and the jump if it takes one."""
        n, row = self.walker.n, self._row(i)
        here, rows = before[2 * n : 3 * n], np.array([i])
        settled = self.walker.walk(before, row.rows(np.zeros(SETTLING, dtype=np.intp)))[-1]
        goal, held = settled[2 * n : 3 * n], None
        if not self._meets(rows, goal[None])[0] or self._parts(goal - here) > LEAP:
            goal, held = self._in_small_steps(i, before)
            if held is not None or not self._meets(rows, goal[None])[0]:
                if not self._reach(rows)[0]:
                    return direct, None
                found = self.engine.finder.find(
                    row, here, self.seed, 1, "q0", around=self._around(rows)
                )
                if not found:
                    return direct, None
                held = goal if held is None else held
                goal = found[0].q
        after = self.walker.at(goal)
        if held is None or self._parts(goal - here) <= LEAP:
            return after, None
        return after, self._jump(i, here, goal, held)

    def _in_small_steps(self, i: int, before: Array) -> tuple[Array, Array | None]:
        """Move the contacts from the last grasp to this one bit by bit.

        Returns:
            The goal reached, and the one before some motor leapt, if one did.
        """
        n = self.walker.n
        way = between(self.problems, i, SUBSTEPS)
        states = self.walker.walk(before, way)
        goals = np.concatenate([before[None, 2 * n : 3 * n], states[:, 2 * n : 3 * n]])
        leaps = np.flatnonzero(self._parts(np.diff(goals, axis=0)) > LEAP)
        return goals[-1], goals[leaps[0]] if len(leaps) else None

    def _meets(self, rows: NDArray[np.intp], q: Array) -> NDArray[np.bool_]:
        problems = self.problems.rows(rows)
        solved = judge(self.engine.robot, problems, q).solved(problems.enforce_limits)
        around = self._around(rows)
        return solved if around is None else solved & around.free(q)

    def _around(self, rows: NDArray[np.intp]) -> Surroundings | None:
        return None if self.around is None else self.around.rows(rows)

    def _row(self, i: int) -> Problems:
        return self.problems.rows(slice(i, i + 1))

    def _parts(self, change: Array) -> Array:
        """(...) the farthest that a motor moves, as a part of its range."""
        robot = self.engine.robot
        return np.max(np.abs(change) / (robot.upper - robot.lower), axis=-1)

    def _jump(self, i: int, before: Array, after: Array, held: Array) -> Jump:
        robot = self.engine.robot
        change = after - before
        largest = int(np.argmax(np.abs(change) / (robot.upper - robot.lower)))
        at = (held - robot.lower <= AT_LIMIT) | (robot.upper - held <= AT_LIMIT)
        names = tuple(name for name, there in zip(robot.actuators, at, strict=True) if there)
        return Jump(i, robot.actuators[largest], float(change[largest]), names)
