"""Many cycles along targets that are known: in one call of compiled code, or guarded one by one."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.asked import Asked, contact_rows, tolerance_rows
from casadi_ik.motion.guard import OBSTACLES, Guard
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.problem.contacts import Kinds
from casadi_ik.problem.problems import Problems

CYCLES = 2
"""Cycles that a target is given: those of a path may be farther apart than those of a stream."""


class Walker:
    """Makes cycles of one graph, without limits of velocity.

    Attributes:
        n: How many motors there are.
    """

    def __init__(self, plan: FollowPlan, kinds: Kinds) -> None:
        """Compile what is not compiled yet."""
        self._guard = None if plan.check is None else Guard(plan)
        self._asked = Asked(plan, kinds, 0 if self._guard is None else OBSTACLES)
        self.n = len(plan.robot.actuators)

    def at(self, q: Array) -> Array:
        """The state of rest at a posture (n,)."""
        return self._asked.state_at(q)

    def walk(self, state: Array, problems: Problems) -> Array:
        """Follow targets, `CYCLES` each.

        Args:
            state: Where it begins.
            problems: k targets.

        Returns:
            (k, ...) the states after them (`Cycle.state`): where the motors are comes first, their
            last step second, the goal third.
        """
        asked, guard = self._asked, self._guard
        rows = self._rows(problems)
        if guard is None:
            return asked.run.run(state, np.repeat(rows, CYCLES, axis=0))[0][CYCLES - 1 :: CYCLES]
        asked.run.state[:] = state
        found = np.empty((len(rows), len(state)))
        for i, row in enumerate(rows):
            asked.run.parameters[:] = row
            guard.surround(problems.rows(slice(i, i + 1)))
            for _ in range(CYCLES):
                guard.step(asked)
            found[i] = asked.run.state
        return found

    def _rows(self, problems: Problems) -> Array:
        """(k, ...) parameters of the cycles."""
        asked = self._asked
        # What does not belong to a target stands in the memory already.
        every = np.repeat(asked.run.parameters[None], len(problems), axis=0)
        layout = asked.cycle.parameters
        for name, values in contact_rows(asked.cycle, problems).items():
            every[:, layout.slice(name)] = values.reshape(len(problems), -1)
        for name, each in tolerance_rows(problems.tolerances).items():
            every[:, layout.slice(name)] = each
        return every
