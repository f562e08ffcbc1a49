"""Arms of more joints than a closed form has: those at their ends are held, the rest is solved.

A hand with a wrist makes an arm of seven joints one of nine. With the wrist held at any angles the
other joints have the closed form they have without it, for a palm pose that is moved by the wrist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.closed_arms.form import ClosedForm
from casadi_ik.symbolic.closed_arms.passing import PassingArm
from casadi_ik.symbolic.closed_arms.recognise import passing, recognised
from casadi_ik.symbolic.closed_arms.screws import Screws, arm_screws
from casadi_ik.symbolic.kinematics import Pose, axis_rotation
from casadi_ik.symbolic.se3 import Transform, compose, inverse
from casadi_ik.symbolic.smooth import Expr


@dataclass(frozen=True, eq=False)
class HeldArm:
    """An arm that has a closed form when some of its joints are held.

    Attributes:
        form: Of the joints that are solved for, numbered from 0.
        screws: Of the whole arm.
        solved: Numbers of these joints, one after the other.
        held: Numbers of the others.
    """

    form: ClosedForm
    screws: Screws
    solved: tuple[int, ...]
    held: tuple[int, ...]

    @property
    def exact(self) -> bool:
        """Whether the closed form is that of the real arm."""
        return self.form.exact

    @property
    def passes(self) -> bool:
        """Whether the form is one whose last axis passes by its sphere."""
        return isinstance(self.form, PassingArm)

    @property
    def off(self) -> float:
        """How far the ideal arm is from the real one [m and rad]."""
        return self.form.off

    def seen(self, palm: Pose, angles: Expr) -> Pose:
        """The palm pose that the solved joints have to reach alone.

        Args:
            palm: Desired pose, base frame.
            angles: (h, 1) of the held joints [rad].
        """
        before = [place for place, joint in enumerate(self.held) if joint < self.solved[0]]
        after = [place for place, joint in enumerate(self.held) if joint > self.solved[-1]]
        start: Transform = ca.DM(self.screws.rotation), ca.DM(self.screws.origin)
        moved = compose(self._undone(before, angles), (palm.rotation, palm.origin))
        moved = compose(compose(moved, inverse(start)), self._undone(after, angles))
        return Pose(*compose(moved, start))

    def joined(self, arm: Expr, angles: Expr) -> Expr:
        """The whole arm (n, 1) of its solved and its held joints."""
        values = dict(zip(self.solved, ca.vertsplit(arm), strict=True))
        values |= dict(zip(self.held, ca.vertsplit(angles), strict=True))
        return ca.vertcat(*(values[joint] for joint in sorted(values)))

    def _undone(self, places: Sequence[int], angles: Expr) -> Transform:
        """The inverse of what some of the held joints move by."""
        moved: Transform = (ca.SX.eye(3), ca.SX.zeros(3, 1))
        for place in reversed(places):
            joint = self.held[place]
            point = ca.DM(self.screws.points[joint])
            turn = axis_rotation(self.screws.axes[joint], -angles[place])
            moved = compose(moved, (turn, point - turn @ point))
        return moved


def held_arm(robot: RobotDescription) -> HeldArm | None:
    """How an arm that has no closed form has one with joints held, or None.

    As few joints as possible are held, rather the last ones than the first, and rather so that the
    form needs no search of its own.
    """
    try:
        screws = arm_screws(robot)
    except UnsupportedError:
        return None
    count = len(screws)
    for length, known in product((7, 6), (recognised, passing)):
        for first in range(count - length + 1 if count > length else 0):
            solved = tuple(range(first, first + length))
            form = known(_part(screws, solved))
            if form is not None:
                held = tuple(joint for joint in range(count) if joint not in solved)
                return HeldArm(form, screws, solved, held)
    return None


def _part(screws: Screws, places: Sequence[int]) -> Screws:
    """Some joints of an arm, one after the other, as an arm of their own."""
    rows = list(places)
    limits: tuple[Array, Array] = screws.lower[rows], screws.upper[rows]
    return replace(
        screws,
        joints=tuple(range(len(rows))),
        axes=np.array(screws.axes[rows]),
        points=np.array(screws.points[rows]),
        lower=limits[0],
        upper=limits[1],
    )
