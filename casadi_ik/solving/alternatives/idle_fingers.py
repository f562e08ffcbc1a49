"""Fingers that have nothing to touch, put where they are least in the way."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array, Bools
from casadi_ik.methods.common.even_spread import even_steps
from casadi_ik.problem.clearance import ROUNDING, Surroundings
from casadi_ik.problem.problems import Problems

PLACES = 48
"""Postures of the idle fingers that are looked at, evenly spread over their limits."""


class IdleFingers:
    """The motors of k targets' hands that move no finger with a contact."""

    def __init__(self, robot: ArmHand, problems: Problems) -> None:
        self._description = description = robot.description
        free = np.isnan(problems.points[..., 0]) & np.isnan(problems.normals[..., 0])
        for more in problems.more.values():
            free &= np.isnan(more[..., 0])
        busy = np.zeros((len(description.finger_names), len(robot.lower)), dtype=bool)
        for finger, name in enumerate(description.finger_names):
            busy[finger, list(description.finger_actuators(name))] = True
        hand = np.zeros(len(robot.lower), dtype=bool)
        hand[list(description.hand_actuators)] = True
        self._motors: Bools = hand & ~(~free[:, :, None] & busy).any(axis=1)
        if problems.fixed is not None:
            self._motors &= np.isnan(problems.fixed)
        parts = (0.5 + np.arange(PLACES)[:, None] * even_steps(len(robot.lower))) % 1.0
        self._places = robot.lower + parts * (robot.upper - robot.lower)

    def aside(self, q: Array, owner: NDArray[np.intp], around: Surroundings) -> Array:
        """Hands, those that touch something by themselves with their idle fingers elsewhere.

        Args:
            q: (m, n) configurations.
            owner: (m,) their targets.
            around: What hands by themselves are checked against.

        Returns:
            (m, n) each as it is, or with the idle fingers where they have most room.
        """
        some = np.flatnonzero(self._motors[owner].any(axis=1))
        if not len(some):
            return q
        of_idle, others = around.parted(self._links)
        # What the idle fingers have no part in they do not help.
        some = some[others.rows(owner[some]).free(q[some])]
        before = of_idle.rows(owner[some]).check(q[some]).room
        touching = before < -ROUNDING
        some, before = some[touching], before[touching]
        if not len(some):
            return q
        motors = self._motors[owner[some]]
        tried = np.where(motors[:, None], self._places, q[some][:, None])
        rows = np.repeat(owner[some], PLACES)
        room = of_idle.rows(rows).check(tried.reshape(-1, q.shape[1])).room.reshape(-1, PLACES)
        best = room.argmax(axis=1)
        each = np.arange(len(some))
        better = room[each, best] > before
        moved = q.copy()
        moved[some[better]] = tried[each, best][better]
        return moved

    @cached_property
    def _links(self) -> frozenset[str]:
        """Links that a motor moves which is idle in one of the targets."""
        idle = np.flatnonzero(self._motors.any(axis=0)).tolist()
        return self._description.links_moved(idle)
