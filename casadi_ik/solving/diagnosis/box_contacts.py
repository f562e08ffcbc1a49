"""What a box of hands says of each contact, together with what is asked of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.solving.diagnosis.hand_space import HandSpace
from casadi_ik.symbolic.contact_ranges import ContactRange, contact_ranges
from casadi_ik.symbolic.joint_ranges import Range
from casadi_ik.symbolic.smooth import Expr, safe_norm

SLACK = 1e-9
"""What every ball [m] and every chord of normals is widened by: far more than rounding errors."""

RELATIVE = 1e-12
"""The same as a part of how far away the contacts are."""


@dataclass(frozen=True, eq=False)
class BoxContact:
    """A finger's contact; u are the coordinates from the middle by half the box, in [-1, 1].

    Attributes:
        point: (3, 1) in the middle of the box [m], frame of the palm.
        normal: (3, 1) likewise.
        moves: (3, h) slopes of the point by u [m].
        turns: (3, h) slopes of the normal by u.
        target: (3, 1) the point asked for [m], base frame.
        facing: (3, 1) the normal asked for.
        placed: 1 if a point is asked for, else 0.
        faced: 1 if a normal is asked for.
        radius: How far point and target can be apart once the palm is in place [m].
        chord: How far the normals can be apart.
        near: The same for the point as the slopes have it [m].
        close: The same for the normals.
        moved: What each coordinate adds to the radius [m], h of them.
        turned: What each adds to the chord.
    """

    point: Expr
    normal: Expr
    moves: Expr
    turns: Expr
    target: Expr
    facing: Expr
    placed: Expr
    faced: Expr
    radius: Expr
    chord: Expr
    near: Expr
    close: Expr
    moved: list[Expr]
    turned: list[Expr]

    def alone(self) -> Iterator[Expr]:
        """Whether a finger of a hand that cannot move as a whole misses its contact: > 0."""
        yield self.placed * (safe_norm(self.target - self.point) - self.radius)
        yield self.faced * (safe_norm(self.facing - self.normal) - self.chord)


def box_contacts(
    space: HandSpace, ranges: dict[str, Range], half: Expr, p: dict[str, ca.SX], in_palm: bool
) -> list[BoxContact]:
    """The contacts of all fingers.

    Args:
        space: The hand's coordinates.
        ranges: Of the joints.
        half: (h, 1) half the box.
        p: points, normals, tolerance and asked, see `BoxTest.graph`.
        in_palm: Whether the palm can move.
    """
    found = []
    for i, box in enumerate(contact_ranges(space.robot, ranges, in_palm)):
        joints = space.robot.fingers[i].joints
        found.append(_contact(space, joints, box, ranges, half, p, i))
    return found


def _contact(
    space: HandSpace,
    joints: tuple[str, ...],
    box: ContactRange,
    ranges: dict[str, Range],
    half: Expr,
    p: dict[str, ca.SX],
    i: int,
) -> BoxContact:
    h = len(space.motors)
    moves, turns = ca.SX.zeros(3, h), ca.SX.zeros(3, h)
    moved, turned = [ca.SX(0)] * h, [ca.SX(0)] * h
    loose, slack = box.bend, box.curl
    for j, name in enumerate(joints):
        k, rate = space.followed(name)
        moved[k] += box.reaches[j]
        turned[k] += box.swings[j]
        if rate is None:
            # What follows unevenly counts as if it went its own way.
            loose += safe_norm(box.moves[:, j]) * ranges[name].half
            slack += safe_norm(box.turns[:, j]) * ranges[name].half
        else:
            moves[:, k] += box.moves[:, j] * rate * half[k]
            turns[:, k] += box.turns[:, j] * rate * half[k]
    target = p["points"][i, :].T
    far = SLACK + RELATIVE * (ca.norm_1(target) + ca.norm_1(box.point))
    position = p["tolerance"][i, 0] + far
    angle = 2 * ca.sin(ca.fmin(p["tolerance"][i, 1], np.pi) / 2) + SLACK
    return BoxContact(
        point=box.point,
        normal=box.normal,
        moves=moves,
        turns=turns,
        target=target,
        facing=p["normals"][i, :].T,
        placed=p["asked"][i, 0],
        faced=p["asked"][i, 1],
        radius=box.radius + position,
        chord=ca.fmin(box.chord + angle, 2.0 + SLACK),
        near=loose + position,
        close=slack + angle,
        moved=moved,
        turned=turned,
    )
