"""Arms of six screws with three parallel ones in the middle: Universal Robots and others.

Second to fourth are parallel, fifth and sixth meet. The first sets how far their meeting point is
aside of the plane of the three, the fifth how the last axis leans out of it; what is left is a
chain of three in a plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.symbolic.closed_arms.form import Bend, ClosedForm
from casadi_ik.symbolic.closed_arms.turns import (
    Turn,
    about_axis,
    turn,
    turn_between,
    turns_to_height,
)
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr


@dataclass(frozen=True, eq=False)
class ParallelTriple(ClosedForm):
    """Second to fourth of the six screws are parallel, fifth and sixth meet.

    Attributes:
        wrist: (3,) where fifth and sixth meet [m].
    """

    wrist: Array

    @property
    def kind(self) -> str:
        """What the arm is."""
        return "three parallel axes"

    @property
    def parts(self) -> tuple[str, str, str]:
        """What turns the plane, what leans out of it, what bends in it."""
        return ("shoulder", "wrist", "elbow")

    def _bends(self, motion: Pose) -> list[Bend]:
        first, second, _, fourth, fifth, sixth = self.places
        axes, points = self.screws.axes, self.screws.points
        across = axes[second]
        out = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(points[first])
        still, ahead, aside = (
            ca.dot(ca.DM(across), part) for part in about_axis(-axes[first], out)
        )
        wanted = float(across @ (self.wrist - points[first]))
        *pans, pannable = turns_to_height(ahead, aside, wanted - still)
        leans = [float(across @ part) for part in _parts(axes[fifth], axes[sixth])]
        bends = []
        for pan in pans:
            facing = pan.back.about(axes[first]) @ motion.rotation
            height = ca.dot(ca.DM(across), facing @ ca.DM(axes[sixth])) - leans[0]
            *tilts, leanable = turns_to_height(ca.SX(leans[1]), ca.SX(leans[2]), height)
            for tilt in tilts:
                slack = ca.fmin(pannable, leanable)
                bends.append(self._planar(pan, tilt, facing, motion, slack))
        del fourth
        return bends

    def _planar(self, pan: Turn, tilt: Turn, facing: Expr, motion: Pose, slack: Expr) -> Bend:
        """What is left to the three parallel screws."""
        first, second, third, fourth, fifth, sixth = self.places
        axes, points = self.screws.axes, self.screws.points
        across = axes[second]
        seen = tilt.back.about(axes[fifth]) @ ca.DM(across)
        roll = turn_between(axes[sixth], facing.T @ ca.DM(across), seen)
        # The motion of the three: a turn about `across`, and where it takes the fourth axis.
        turned = facing @ roll.back.about(axes[sixth]) @ tilt.back.about(axes[fifth])
        start = _perpendicular(across)
        whole = turn_between(across, ca.DM(start), turned @ ca.DM(start))
        at = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(points[first])
        wrist = pan.back.about(axes[first]) @ at + ca.DM(points[first])
        hinge = points[second]
        to_fourth = wrist + turned @ ca.DM(points[fourth] - self.wrist) - ca.DM(hinge)
        inside = to_fourth - ca.DM(across) * ca.dot(ca.DM(across), to_fourth)
        upper, fore = (
            link - across * (across @ link)
            for link in (points[third] - hinge, points[fourth] - points[third])
        )
        ahead, aside = 2 * float(upper @ fore), 2 * float(upper @ np.cross(across, fore))
        fixed = float(upper @ upper + fore @ fore)
        *elbows, bendable = turns_to_height(ca.SX(ahead), ca.SX(aside), ca.sumsqr(inside) - fixed)
        ends = []
        for elbow in elbows:
            reached = ca.DM(upper) + elbow.about(across) @ ca.DM(fore)
            lift = turn_between(across, reached, inside)
            last = whole.plus(lift.back).plus(elbow.back)
            last = turn(last.cosine, last.sine)
            ends.append(
                self.angle(second, lift)
                | self.angle(third, self._signed(third, elbow))
                | self.angle(fourth, self._signed(fourth, last))
            )
        joints = self.angle(first, pan) | self.angle(fifth, tilt) | self.angle(sixth, roll)
        return Bend(joints, (ends[0], ends[1]), ca.fmin(slack, bendable))

    def _signed(self, place: int, about_second: Turn) -> Turn:
        """A turn about the second axis as one about another of the three."""
        same = self.screws.axes[place] @ self.screws.axes[self.places[1]] > 0
        return about_second if same else about_second.back

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """By the distance of the wrist from the shoulder's axes, the elbow bent as it likes."""
        del lower, upper
        _, second, third, fourth, *_ = self.places
        points = self.screws.points
        axis = self.screws.axes[second]
        links = np.diff([*points[[second, third, fourth]], self.wrist], axis=0)
        flat = links - np.outer(links @ axis, axis)
        far = float(np.linalg.norm(flat, axis=1).sum())
        motion = self.screws.motion(palm)
        first = self.places[0]
        about, base = self.screws.axes[first], points[first]
        out = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(base)
        aside = float(axis @ (self.wrist - base))
        hinge = points[second] - base
        lift, arm = float(about @ hinge), abs(float(np.cross(axis, about) @ hinge))
        up = ca.dot(ca.DM(about), out) - lift
        wide = ca.sqrt(ca.fmax(ca.sumsqr(out) - ca.dot(ca.DM(about), out) ** 2 - aside**2, 1e-24))
        return ca.fmax(ca.sqrt((wide - arm) ** 2 + up**2 + 1e-24) - far, 0.0)


def _parts(axis: Array, vector: Array) -> tuple[Array, Array, Array]:
    constant = axis * (axis @ vector)
    return constant, vector - constant, np.cross(axis, vector)


def _perpendicular(axis: Array) -> Array:
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    across = np.cross(axis, helper).astype(float)
    return across / np.linalg.norm(across)
