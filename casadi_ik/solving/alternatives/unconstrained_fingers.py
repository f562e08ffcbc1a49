"""Fingers that no contact constrains, moved out of the way of what the hand touches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array, Bools, even_steps
from casadi_ik.problem.clearance import ROUNDING, CollisionQuery
from casadi_ik.problem.targets import TargetBatch


@dataclass(frozen=True)
class UnconstrainedFingerParameters:
    """Which postures of unconstrained fingers are looked at.

    Attributes:
        postures: Evenly spread over their limits.
        closer: As many about the best of them, where they have too little clearance, ever closer.
        parts: How far about [of the motors' ranges].
        near: Clearance [m] that can be gained about a posture.
    """

    postures: int = 48
    closer: int = 24
    parts: tuple[float, ...] = (0.5, 0.25, 0.12)
    near: float = 0.02


PARAMETERS = UnconstrainedFingerParameters()


class UnconstrainedFingers:
    """The motors of k targets' hands that move no finger with a contact."""

    def __init__(self, robot: ArmHand, targets: TargetBatch) -> None:
        self._description = description = robot.description
        free = np.isnan(targets.points[..., 0]) & np.isnan(targets.normals[..., 0])
        for more in targets.more.values():
            free &= np.isnan(more[..., 0])
        busy = np.zeros((len(description.finger_names), len(robot.lower)), dtype=bool)
        for finger, name in enumerate(description.finger_names):
            busy[finger, list(description.finger_actuators(name))] = True
        hand = np.zeros(len(robot.lower), dtype=bool)
        hand[list(description.hand_actuators)] = True
        self._motors: Bools = hand & ~(~free[:, :, None] & busy).any(axis=1)
        if targets.fixed is not None:
            self._motors &= np.isnan(targets.fixed)
        parts = (0.5 + np.arange(PARAMETERS.postures)[:, None] * even_steps(len(robot.lower))) % 1.0
        ranges = robot.upper - robot.lower
        self._limits = robot.lower, robot.upper
        self._places = robot.lower + parts * ranges
        about = (parts[: PARAMETERS.closer] - 0.5) * ranges
        self._spread = (None, *(part * about for part in PARAMETERS.parts))

    def aside(self, q: Array, owner: NDArray[np.intp], query: CollisionQuery) -> Array:
        """Hands, those that touch something by themselves with their idle fingers elsewhere.

        Args:
            q: (m, n) configurations.
            owner: (m,) their targets.
            query: What hands by themselves are checked against.

        Returns:
            (m, n) each as it is, or with the idle fingers where they have most room.
        """
        some = np.flatnonzero(self._motors[owner].any(axis=1))
        if not len(some):
            return q
        of_idle, others = query.parted(self._links)
        # What the idle fingers have no part in they do not help.
        some = some[others.rows(owner[some]).free(q[some])]
        before = of_idle.rows(owner[some]).check(q[some]).surplus
        touching = before < -ROUNDING
        some, before = some[touching], before[touching]
        if not len(some):
            return q
        moved = q.copy()
        for places in self._spread:
            motors = self._motors[owner[some]]
            about = moved[some][:, None]
            there = self._places if places is None else about + places
            tried = np.where(motors[:, None], np.clip(there, *self._limits), about)
            count = tried.shape[1]
            rows = np.repeat(owner[some], count)
            surplus = (
                of_idle.rows(rows).check(tried.reshape(-1, q.shape[1])).surplus.reshape(-1, count)
            )
            best = surplus.argmax(axis=1)
            each = np.arange(len(some))
            most = surplus[each, best]
            better = most > before
            moved[some[better]] = tried[each, best][better]
            before = np.maximum(before, most)
            near = (before < -ROUNDING) & (before > -PARAMETERS.near)
            some, before = some[near], before[near]
            if not len(some):
                break
        return moved

    @cached_property
    def _links(self) -> frozenset[str]:
        """Links that a motor moves which is idle in one of the targets."""
        idle = np.flatnonzero(self._motors.any(axis=0)).tolist()
        return self._description.links_moved(idle)
