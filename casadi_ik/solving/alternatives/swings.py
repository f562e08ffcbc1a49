"""All arms that hold hands where they are, for many hands at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.common.arm_branches import SIDES, arm_at, form_at
from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.symbolic.closed_arms.form import SIGNS
from casadi_ik.symbolic.closed_arms.recognise import ArmForm
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

    def rows(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Swung:
        """Some of them."""
        return Swung(self.q[rows], self.owner[rows], self.swivel[rows], self.branch[rows])


class ArmSwings:
    """The branches and swivels of one arm in closed form.

    A swivel is the angle of an S-R-S arm's elbow, or the position of another arm's swept joint; an
    arm of six joints has none.
    """

    def __init__(self, robot: ArmHand, arm: ArmForm, compiled: bool = True) -> None:
        """Compile the function of the arm or load it from the cache."""
        self._robot = robot
        self._columns = list(robot.description.arm_actuators)
        self._elbows, self._sides = ELBOWS, len(SIDES)
        self._range: tuple[float, float] | None = (0.0, 2 * np.pi)
        if isinstance(arm, SrsArm):
            self._at = FunctionKernel(arm_at(arm), compiled)
        else:
            self._at = FunctionKernel(form_at(arm), compiled)
            self._elbows, self._sides = (1.0,), len(SIGNS)
            self._range = None
            if arm.swept_joint is not None:
                column = self._columns[arm.swept_joint]
                low, high = robot.lower[column], robot.upper[column]
                middle, half = (low + high) / 2, min((high - low) / 2, np.pi)
                self._range = (float(middle - half), float(middle + half))
        self._srs = isinstance(arm, SrsArm)

    def all_around(self, q: Array, lower: Array, upper: Array) -> Swung:
        """Every branch at swivels all around, within bounds (n,), for hands as in q (k, n)."""
        angles = self._swivels()
        count, each = len(q), len(self._elbows) * len(angles)
        owner = np.repeat(np.arange(count), each)
        elbows = np.tile(np.repeat(self._elbows, len(angles)), count)
        tried = np.tile(angles, count * len(self._elbows))
        return self._arms(q, owner, elbows, tried, lower, upper)

    def _swivels(self) -> Array:
        if self._range is None:
            return np.zeros(1)
        first, last = self._range
        return first + (last - first) * (np.arange(SWIVELS) + 0.5) / SWIVELS

    def around(self, q: Array, swung: Swung, lower: Array, upper: Array) -> Swung:
        """Of one arm per hand the swivels about it, of its branch; owners are rows of `swung`."""
        if self._range is None:
            return Swung(swung.q, np.arange(len(q)), swung.swivel, swung.branch)
        step = (self._range[1] - self._range[0]) / SWIVELS
        offsets = step * np.linspace(-1, 1, CLOSER + 2)[1:-1]
        owner = np.repeat(np.arange(len(q)), CLOSER)
        angles = (swung.swivel[:, None] + offsets).ravel()
        elbows = np.array(self._elbows)[swung.branch // self._sides][owner]
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
        if not len(angles):
            none = np.zeros(0, dtype=np.intp)
            return Swung(q[:0], none, angles, none)
        columns = self._columns
        palms = self._robot.palm(q)[owner]
        origin = np.ascontiguousarray(palms[:, :3, 3])
        freedom = (elbows, angles) if self._srs else (angles,)
        arms, reach = self._at(palms[:, :3, :3], origin, *freedom)
        low, high = lower[columns], upper[columns]
        margin = np.minimum(arms - low, high - arms).min(axis=2)
        within = reach.reshape(len(angles), -1) >= 0
        rows, sides = np.nonzero((margin >= ALLOWED) & within)
        found = q[owner[rows]]
        found[:, columns] = arms[rows, sides]
        signs = (elbows[rows] < 0).astype(np.intp)
        clipped = np.clip(found, lower, upper)
        return Swung(clipped, owner[rows], angles[rows], signs * self._sides + sides)
