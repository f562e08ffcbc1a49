"""Arms whose last axis passes by the point where the two before it meet: Sawyer, xArm 6.

With the last joint at t, the point follows from the palm pose, and the other joints from the point
as those of the arm with a sphere beside it, the ideal arm (Pieper 1968), whose last axis goes
through the point. The ideal arm turns its last joint by some angle g(t); where ``g(t) = t`` the
arm is the real one. So the search is for the roots of one function of one angle, on each of the
eight branches of the ideal arm. It changes slowly: by what the axis passes the point at, to how far
the point is from the first axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.symbolic.closed_arms.form import SIGNS, Bend, ClosedForm
from casadi_ik.symbolic.closed_arms.spherical import SphericalArm
from casadi_ik.symbolic.closed_arms.turns import Turn
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.subexpressions import shared

TURN = 2 * np.pi

STEEP = -0.2
"""The slope of ``g(t) - t`` is taken for no flatter: it is near -1 where a root is alone."""

MOST = 1.0
"""Of a step of t [rad]."""

ROOTS = 4
"""Of a branch, at most: of 200 random poses of an xArm 6 two branches had as many."""

CLOSED = 1e-3
"""The ideal arm is that of t where ``g(t) - t`` is smaller [rad]."""


@dataclass(frozen=True, eq=False)
class PassingArm(ClosedForm):
    """An arm with an ideal one beside it.

    Attributes:
        ideal: Its last axis goes through the sphere's point.
        aside: (3,) from that point to the real last axis [m].
    """

    ideal: SphericalArm
    aside: Array

    @property
    def kind(self) -> str:
        """That of the ideal arm, and which joint passes by its sphere."""
        return f"{self.ideal.kind}, joint {self.last + 1} off it"

    @property
    def parts(self) -> tuple[str, str, str]:
        """Those of the ideal arm."""
        return self.ideal.parts

    @property
    def last(self) -> int:
        """Number of the joint that passes by the sphere."""
        return self.screws.joints[-1]

    @property
    def middle(self) -> float:
        """Of the range of that joint [rad]."""
        return float(self.screws.lower[-1] + self.screws.upper[-1]) / 2

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """By the middle of the circle that the sphere's point is on."""
        motion = self.screws.motion(palm)
        middle = Pose(motion.rotation, motion.origin + motion.rotation @ ca.DM(self.aside))
        beyond = self.ideal.beyond_reach(middle, lower, upper)
        radius = float(np.linalg.norm(self.aside))
        return beyond - ca.fmin(ca.fmax(beyond, -radius), radius)

    def begin(self) -> ca.Function:
        """(rotation, origin, swept) -> the motion of six screws, and the numbers 1 and -1.

        The signs of branches are given as outputs: constants cannot be inputs of the inner
        functions of a step for several solves side by side.
        """
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        swept = ca.SX.sym("swept")
        left = self.left(Pose(rotation, origin), swept)
        outputs = [left.rotation, left.origin, ca.SX(1), ca.SX(-1)]
        return ca.Function("begin", [rotation, origin, swept], outputs)

    def branch(self) -> ca.Function:
        """(rotation, origin, t, two signs of the bend and one of the end) of the ideal arm.

        Returns:
            The six joints (6, 1) [rad] in the order of the screws, the slack, and what is left of
            the condition: ``g(t) - t`` in [-pi, pi] [rad].
        """
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        t, one, two, end = (ca.SX.sym(name) for name in ("t", "one", "two", "end"))
        back = Turn(ca.cos(t), -ca.sin(t)).about(self.screws.axes[-1])
        shift = ca.DM(self.aside) - back @ ca.DM(self.aside)
        moved = Pose(rotation, origin + rotation @ shift)
        (bend,) = self.ideal.bent(moved, (one, two))
        chosen = {
            joint: ca.if_else(end > 0, angle, bend.ends[1][joint])
            for joint, angle in bend.ends[0].items()
        }
        joints = bend.joints | chosen
        arm = ca.vertcat(*(joints[self.screws.joints[place]] for place in self.places))
        left = chosen[self.last] - t
        left -= TURN * ca.floor(left / TURN + 0.5)
        inputs = [rotation, origin, t, one, two, end]
        return ca.Function("branch", inputs, shared(arm, bend.slack, left))

    def turned(self) -> ca.Function:
        """What is left of the condition alone, of the inputs of `branch`."""
        whole = self.branch()
        inputs = whole.sx_in()
        return ca.Function("turned", inputs, shared(whole(*inputs)[2]))

    def whole(self, arm: Expr, swept: Expr) -> Expr:
        """All joints (n, 1), in their order, of the six in the order of their screws."""
        joints = {self.screws.joints[place]: arm[i] for i, place in enumerate(self.places)}
        if self.swept_joint is not None:
            joints[self.swept_joint] = swept
        return ca.vertcat(*(joints[i] for i in range(len(joints))))

    def bends(self, palm: Pose, swept: Expr) -> list[Bend]:
        """Not in one expression: see `branch`."""
        raise NotImplementedError

    def _bends(self, motion: Pose) -> list[Bend]:
        raise NotImplementedError


def next_turn() -> ca.Function:
    """The next t of the secant method.

    Returns:
        (t, what is left, t before, what was left there) -> the next t.
    """
    t, left, before, was = (ca.SX.sym(name) for name in ("t", "left", "before", "was"))
    change = t - before
    moved = ca.fabs(change) > 1e-12
    slope = ca.if_else(moved, (left - was) / ca.if_else(moved, change, 1.0), -1.0)
    slope = ca.fmin(ca.fmax(slope, -5.0), STEEP)
    step = ca.fmin(ca.fmax(-left / slope, -MOST), MOST)
    return ca.Function("next_turn", [t, left, before, was], shared(t + step))


BENDS = tuple(product((1, -1), (1, -1)))
"""First and second sign of the bends; with the end's they are `form.SIGNS`."""

assert tuple((*bend, end) for bend in BENDS for end in (1, -1)) == SIGNS
