"""All arms that hold hands where they are, for many hands at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.common.arm_branches import SIDES, arm_at
from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.symbolic.srs_arm import SrsArm

SWIVELS = 24
"""Swivels looked at all around, for every branch."""

CLOSER = 15
"""Swivels looked at around the one that was taken."""

ELBOWS = (1.0, -1.0)


@dataclass(frozen=True, eq=False)
class Swung:
    """Arms of hands.

    Attributes:
        q: (m, n) configurations within the bounds.
        owner: (m,) number of the hand.
        swivel: (m,) [rad].
        branch: (m,) number of elbow and side.
    """

    q: Array
    owner: NDArray[np.intp]
    swivel: Array
    branch: NDArray[np.intp]


class ArmSwings:
    """The branches and swivels of one S-R-S arm."""

    def __init__(self, robot: ArmHand, arm: SrsArm, compiled: bool = True) -> None:
        """Compile the function of the arm or load it from the cache."""
        self._robot = robot
        self._columns = list(robot.description.arm_actuators)
        self._at = FunctionKernel(arm_at(arm), compiled)

    def all_around(self, q: Array, lower: Array, upper: Array) -> Swung:
        """Every branch at swivels all around, within bounds (n,), for hands as in q (k, n)."""
        angles = 2 * np.pi * (np.arange(SWIVELS) + 0.5) / SWIVELS
        count = len(q)
        owner = np.repeat(np.arange(count), len(ELBOWS) * SWIVELS)
        elbows = np.tile(np.repeat(ELBOWS, SWIVELS), count)
        return self._arms(q, owner, elbows, np.tile(angles, count * len(ELBOWS)), lower, upper)

    def around(self, q: Array, swung: Swung, lower: Array, upper: Array) -> Swung:
        """Of one arm per hand the swivels about it, of its branch; owners are rows of `swung`."""
        step = 2 * np.pi / SWIVELS
        offsets = step * np.linspace(-1, 1, CLOSER + 2)[1:-1]
        owner = np.repeat(np.arange(len(q)), CLOSER)
        angles = (swung.swivel[:, None] + offsets).ravel()
        elbows = np.array(ELBOWS)[swung.branch // len(SIDES)][owner]
        found = self._arms(q, owner, elbows, angles, lower, upper)
        same = found.branch == swung.branch[found.owner]
        return Swung(found.q[same], found.owner[same], found.swivel[same], found.branch[same])

    def _arms(
        self,
        q: Array,
        owner: NDArray[np.intp],
        elbows: Array,
        angles: Array,
        lower: Array,
        upper: Array,
    ) -> Swung:
        columns = self._columns
        palms = self._robot.palm(q)[owner]
        origin = np.ascontiguousarray(palms[:, :3, 3])
        arms, reach = self._at(palms[:, :3, :3], origin, elbows, angles)
        low, high = lower[columns], upper[columns]
        margin = np.minimum(arms - low, high - arms).min(axis=2)
        rows, sides = np.nonzero((margin >= ALLOWED) & (reach >= 0)[:, None])
        found = q[owner[rows]]
        found[:, columns] = arms[rows, sides]
        signs = (elbows[rows] < 0).astype(np.intp)
        clipped = np.clip(found, lower, upper)
        return Swung(clipped, owner[rows], angles[rows], signs * len(SIDES) + sides)
