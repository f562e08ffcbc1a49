"""Boxes of hand postures, and where each box lets the contacts be: guaranteed, as graphs.

From the middle of their intervals the joints are moved one after the other, the last of the finger
first. A turn by delta about an axis at the distance rho moves a point by 2 rho sin(delta / 2), and
a unit normal at the angle alpha to the axis by 2 sin(alpha) sin(delta / 2); what the joints beyond
have moved before adds to rho and to sin(alpha) at most. The same numbers bound what the slopes at
the middle leave out: the second derivative of a point by two joints is no longer than its distance
from the axis of the joint nearer to the tip.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.couplings import Interval, joint_intervals
from casadi_ik.kinematics.forward import Kinematics, forward
from casadi_ik.kinematics.smooth import Expr, safe_norm
from casadi_ik.model.description import Finger, RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.premises import OUTWARDS, motor_box

SLACK = 1e-9
"""What every ball [m] and every chord of normals is widened by: far more than rounding errors."""


@dataclass(frozen=True, eq=False)
class HandSpace:
    """The coordinates of a hand, whose box is divided; every finger joint follows one of them.

    A coordinate is the joint that a motor turns, where it turns one only: a slider's length bends
    the slopes, the angle it makes does not. Otherwise it is the motor itself.

    Attributes:
        robot: The description.
    """

    robot: RobotDescription

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, one for each of `robot.finger_motors`."""
        found = []
        for motor in self.robot.finger_motors:
            moved = [
                joint.name
                for joint in self.robot.movable
                if joint.name == motor or (joint.coupling and joint.coupling.of == motor)
            ]
            found.append(moved[0] if len(moved) == 1 else motor)
        return tuple(found)

    def followed(self, joint: str) -> tuple[int, float | None]:
        """Which coordinate a joint follows, and its rate; None if that is not constant."""
        by_name = {item.name: item for item in self.robot.movable}
        rate: float | None = 1.0
        while joint not in self.coordinates:
            coupling = by_name[joint].coupling
            assert coupling is not None, f"joint {joint!r} follows no motor of the hand"
            slope = coupling.slope
            rate = None if slope is None or rate is None else rate * slope[0]
            joint = coupling.of
        return self.coordinates.index(joint), rate

    def intervals(self, lower: ca.SX, upper: ca.SX) -> dict[str, Interval]:
        """Intervals of all joints of the fingers, by name.

        Args:
            lower: (h, 1) ends of the coordinates.
            upper: (h, 1).
        """
        given = {name: Interval(lower[i], upper[i]) for i, name in enumerate(self.coordinates)}
        found = joint_intervals(self.robot, given)
        return {name: found[name] for name in self.robot.finger_joints}

    def of(self, places: Mapping[str, Array], targets: TargetBatch) -> Array:
        """(k, h) coordinates of joint and motor positions, turned by whole periods into the box.

        Args:
            places: (k,) by name of the joint or motor [rad or m].
            targets: Whose limits count.
        """
        lower, upper = self.box(targets)
        found = np.stack([places[name] for name in self.coordinates], axis=1)
        turns = np.floor((found - lower) / (upper - lower))
        turns[(found >= lower) & (found <= upper)] = 0
        return found - turns * (upper - lower)

    def box(self, targets: TargetBatch) -> tuple[Array, Array]:
        """(h,) ends of the coordinates within all that the problems let the hand do."""
        ends = motor_box(self.robot, targets)
        low, high = (np.array(part).ravel() for part in self._of_motors(ends[0], ends[1]))
        if targets.enforce_limits:
            # The limits of a coupled joint may be narrower than those of its motor.
            for joint in self.robot.movable:
                if joint.name in self.coordinates:
                    i = self.coordinates.index(joint.name)
                    low[i] = max(low[i], joint.lower - OUTWARDS)
                    high[i] = min(high[i], joint.upper + OUTWARDS)
        return low, high

    @cached_property
    def _of_motors(self) -> ca.Function:
        motors = self.robot.finger_motors
        lower, upper = (ca.SX.sym(name, len(motors)) for name in ("lower", "upper"))
        given = {name: Interval(lower[i], upper[i]) for i, name in enumerate(motors)}
        found = joint_intervals(self.robot, given) | given
        intervals = [found[name] for name in self.coordinates]
        ends = [one.lower for one in intervals], [one.upper for one in intervals]
        return ca.Function("coordinates", [lower, upper], [ca.vertcat(*side) for side in ends])


@dataclass(frozen=True, eq=False)
class BoxContact:
    """Every contact that a finger can make within a box, and what is asked of it.

    u are the coordinates from the middle of the box by half the box, in [-1, 1].

    Attributes:
        point: (3, 1) in the middle of the box [m], frame of the palm; of a hand that cannot move as
            a whole base frame.
        normal: (3, 1) likewise, unit.
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
    space: HandSpace, intervals: dict[str, Interval], half: Expr, p: dict[str, ca.SX], in_palm: bool
) -> list[BoxContact]:
    """The contacts of all fingers.

    Args:
        space: The hand's coordinates.
        intervals: Of the joints of the fingers.
        half: (h, 1) half the box.
        p: points, normals, tolerance and asked, see `BoxTest.graph`.
        in_palm: Whether the palm can move.
    """
    robot = space.robot
    theta = ca.SX.zeros(len(robot.movable), 1)
    for i, name in enumerate(robot.joint_names):
        if name in intervals:
            theta[i] = intervals[name].middle
    body = forward(robot, theta)
    found = []
    for i, finger in enumerate(robot.fingers):
        names = "points", "normals", "tolerance", "asked"
        asked = {name: p[name][i, :].T for name in names}
        found.append(_contact(space, body, finger, intervals, half, asked, in_palm))
    return found


def _contact(
    space: HandSpace,
    body: Kinematics,
    finger: Finger,
    intervals: dict[str, Interval],
    half: Expr,
    asked: dict[str, Expr],
    in_palm: bool,
) -> BoxContact:
    kinds = {joint.name: joint for joint in space.robot.movable}
    point, normal = body.contact(finger.name)
    h = len(space.coordinates)
    moves, turns = ca.SX.zeros(3, h), ca.SX.zeros(3, h)
    moved, turned = [ca.SX(0)] * h, [ca.SX(0)] * h
    radius, chord, bend, total = ca.SX(0), ca.SX(0), ca.SX(0), ca.SX(0)
    uneven_move, uneven_turn = ca.SX(0), ca.SX(0)
    widths = [intervals[name].half for name in finger.joints]
    for j, name in reversed(list(enumerate(finger.joints))):
        axis, width = body.axes[name], widths[j]
        if kinds[name].type == "prismatic":
            move, turn, lever = axis, ca.SX.zeros(3, 1), ca.SX(1)
            reach, swing = width, ca.SX(0)
        else:
            move = ca.cross(axis, point - body.links[kinds[name].child].origin)
            turn = ca.cross(axis, normal)
            sine, lever = ca.sin(ca.fmin(width, np.pi) / 2), safe_norm(move) + radius
            reach = 2 * sine * lever
            swing = 2 * sine * ca.fmin(safe_norm(turn) + chord, 1.0)
            total += width
        radius, chord = radius + reach, chord + swing
        bend += lever * width * (width / 2 + sum(widths[:j], ca.SX(0)))
        k, rate = space.followed(name)
        moved[k], turned[k] = moved[k] + reach, turned[k] + swing
        if rate is None:
            # What follows unevenly counts as if it went its own way.
            uneven_move += safe_norm(move) * width
            uneven_turn += safe_norm(turn) * width
        else:
            moves[:, k] += move * rate * half[k]
            turns[:, k] += turn * rate * half[k]
    if in_palm:
        palm = body.palm
        point, normal = palm.inverse_apply(point), palm.rotation.T @ normal
        moves, turns = palm.rotation.T @ moves, palm.rotation.T @ turns
    target = asked["points"]
    far = SLACK + 1e-12 * (ca.norm_1(target) + ca.norm_1(point))
    position = asked["tolerance"][0] + far
    angle = 2 * ca.sin(ca.fmin(asked["tolerance"][1], np.pi) / 2) + SLACK
    return BoxContact(
        point=point,
        normal=normal,
        moves=moves,
        turns=turns,
        target=target,
        facing=asked["normals"],
        placed=asked["asked"][0],
        faced=asked["asked"][1],
        radius=radius + position,
        chord=ca.fmin(ca.fmin(chord, 2.0) + angle, 2.0 + SLACK),
        near=bend + uneven_move + position,
        close=total * total / 2 + uneven_turn + angle,
        moved=moved,
        turned=turned,
    )
