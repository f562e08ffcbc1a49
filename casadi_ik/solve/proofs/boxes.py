"""Boxes of hand postures, and guaranteed bounds of the contacts within a box, as graphs.

The bounds move the joints from the centres of their intervals successively, the distal joint of a
finger first. A rotation by delta about an axis at the distance rho moves a point by
2 rho sin(delta / 2), and a unit normal at the angle alpha to the axis by
2 sin(alpha) sin(delta / 2); the motion of distal joints adds at most its size to rho
and to sin(alpha). The same distances bound the remainder of a linearisation at the centre: the
norm of the second derivative of a point by two joints is at most its distance from the axis of the
distal joint.
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
from casadi_ik.solve.proofs.premises import LIMIT_MARGIN, motor_box

BOUND_MARGIN = 1e-9
"""Margin of balls [m] and of chords of normals, far larger than rounding errors."""


@dataclass(frozen=True, eq=False)
class HandSpace:
    """Coordinates of a hand, on which every finger joint depends.

    A coordinate is the joint that a motor drives if it drives only one, otherwise the motor. The
    contacts are nearly linear in the angle of a joint, but not in the length of a slider.

    Attributes:
        robot: Description of the robot.
    """

    robot: RobotDescription

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, one per motor of `robot.finger_motors`."""
        names = []
        for motor in self.robot.finger_motors:
            driven_joints = [
                joint.name
                for joint in self.robot.movable
                if joint.name == motor or (joint.coupling and joint.coupling.of == motor)
            ]
            names.append(driven_joints[0] if len(driven_joints) == 1 else motor)
        return tuple(names)

    def driving_coordinate(self, joint: str) -> tuple[int, float | None]:
        """Return the driving coordinate of a joint, and its rate (None if variable)."""
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
        """Return the intervals of all finger joints, by name.

        Args:
            lower: (h, 1) lower bounds of the coordinates.
            upper: (h, 1) upper bounds of the coordinates.
        """
        coordinates = {
            name: Interval(lower[i], upper[i]) for i, name in enumerate(self.coordinates)
        }
        intervals = joint_intervals(self.robot, coordinates)
        return {name: intervals[name] for name in self.robot.finger_joints}

    def from_positions(self, positions: Mapping[str, Array], targets: TargetBatch) -> Array:
        """Return coordinates (k, h), shifted by whole periods into the box of the targets.

        Args:
            positions: (k,) positions by name of the joint or motor [rad or m].
            targets: Targets whose limits define the box.
        """
        lower, upper = self.box(targets)
        values = np.stack([positions[name] for name in self.coordinates], axis=1)
        revolutions = np.floor((values - lower) / (upper - lower))
        revolutions[(values >= lower) & (values <= upper)] = 0
        return values - revolutions * (upper - lower)

    def box(self, targets: TargetBatch) -> tuple[Array, Array]:
        """Return lower and upper bounds (h,) of the coordinates that the targets allow."""
        motor_bounds = motor_box(self.robot, targets)
        low, high = (
            np.array(part).ravel()
            for part in self._coordinates_of_motors(motor_bounds[0], motor_bounds[1])
        )
        if targets.enforce_limits:
            # A coupled joint may have narrower limits than its motor.
            for joint in self.robot.movable:
                if joint.name in self.coordinates:
                    i = self.coordinates.index(joint.name)
                    low[i] = max(low[i], joint.lower - LIMIT_MARGIN)
                    high[i] = min(high[i], joint.upper + LIMIT_MARGIN)
        return low, high

    @cached_property
    def _coordinates_of_motors(self) -> ca.Function:
        motors = self.robot.finger_motors
        lower, upper = (ca.SX.sym(name, len(motors)) for name in ("lower", "upper"))
        motor_intervals = {name: Interval(lower[i], upper[i]) for i, name in enumerate(motors)}
        all_intervals = joint_intervals(self.robot, motor_intervals) | motor_intervals
        intervals = [all_intervals[name] for name in self.coordinates]
        bounds = (
            [interval.lower for interval in intervals],
            [interval.upper for interval in intervals],
        )
        return ca.Function("coordinates", [lower, upper], [ca.vertcat(*side) for side in bounds])


@dataclass(frozen=True, eq=False)
class BoxContact:
    """Bounds of the contact of a finger within a box, with the target of the finger.

    u are the coordinates relative to the centre of the box, scaled by its half widths to [-1, 1].

    Attributes:
        point: (3, 1) point that must reach the target point, at the centre of the box [m]; palm
            frame, or base frame if the palm is fixed.
        normal: (3, 1) unit normal, in the same frame.
        point_slopes: (3, h) derivatives of the point by u [m].
        normal_slopes: (3, h) derivatives of the normal by u.
        target_point: (3, 1) point to reach (`premises.required_points`) [m], base frame.
        target_normal: (3, 1) target unit normal, base frame.
        has_point: 1 if the point is constrained, else 0.
        has_normal: 1 if the normal is constrained, else 0.
        radius: Largest distance between contact and target at the best palm pose [m].
        chord: Largest distance between the unit normals at the best palm pose.
        point_remainder: Tolerance of the point plus the remainder of its linearisation [m].
        normal_remainder: Tolerance of the normal plus the remainder of its linearisation.
        radius_shares: Contribution of each coordinate to the radius [m], h of them.
        chord_shares: Contribution of each coordinate to the chord, h of them.
    """

    point: Expr
    normal: Expr
    point_slopes: Expr
    normal_slopes: Expr
    target_point: Expr
    target_normal: Expr
    has_point: Expr
    has_normal: Expr
    radius: Expr
    chord: Expr
    point_remainder: Expr
    normal_remainder: Expr
    radius_shares: list[Expr]
    chord_shares: list[Expr]

    def fixed_hand_tests(self) -> Iterator[Expr]:
        """Yield tests that are > 0 if the finger misses its contact while the palm is fixed."""
        yield self.has_point * (safe_norm(self.target_point - self.point) - self.radius)
        yield self.has_normal * (safe_norm(self.target_normal - self.normal) - self.chord)


def box_contacts(
    space: HandSpace,
    intervals: dict[str, Interval],
    half_widths: Expr,
    p: dict[str, ca.SX],
    in_palm: bool,
) -> list[BoxContact]:
    """Return the contacts of all fingers within a box.

    Args:
        space: Coordinates of the hand.
        intervals: Intervals of the finger joints, by name.
        half_widths: (h, 1) half widths of the box.
        p: points, depths, normals, tolerance and constrained, see `BoxTest.graph`.
        in_palm: True for contacts in the palm frame, False for a fixed palm.
    """
    robot = space.robot
    theta = ca.SX.zeros(len(robot.movable), 1)
    for i, name in enumerate(robot.joint_names):
        if name in intervals:
            theta[i] = intervals[name].middle
    body = forward(robot, theta)
    contacts = []
    for i, finger in enumerate(robot.fingers):
        names = "points", "depths", "normals", "tolerance", "constrained"
        target_point = {name: p[name][i, :].T for name in names}
        contacts.append(
            _contact(space, body, finger, intervals, half_widths, target_point, in_palm)
        )
    return contacts


def _contact(
    space: HandSpace,
    body: Kinematics,
    finger: Finger,
    intervals: dict[str, Interval],
    half_widths: Expr,
    p: dict[str, Expr],
    in_palm: bool,
) -> BoxContact:
    joints_by_name = {joint.name: joint for joint in space.robot.movable}
    point, normal = body.contact(finger.name)
    point = point - p["depths"] * normal
    h = len(space.coordinates)
    point_slopes, normal_slopes = ca.SX.zeros(3, h), ca.SX.zeros(3, h)
    radius_shares, chord_shares = [ca.SX(0)] * h, [ca.SX(0)] * h
    radius, chord, point_curvature, total_rotation = ca.SX(0), ca.SX(0), ca.SX(0), ca.SX(0)
    uneven_point, uneven_normal = ca.SX(0), ca.SX(0)
    widths = [intervals[name].half_width for name in finger.joints]
    for j, name in reversed(list(enumerate(finger.joints))):
        axis, width = body.axes[name], widths[j]
        if joints_by_name[name].type == "prismatic":
            point_slope, normal_slope, lever = axis, ca.SX.zeros(3, 1), ca.SX(1)
            point_share, normal_share = width, ca.SX(0)
        else:
            point_slope = ca.cross(axis, point - body.links[joints_by_name[name].child].origin)
            normal_slope = ca.cross(axis, normal)
            sine, lever = ca.sin(ca.fmin(width, np.pi) / 2), safe_norm(point_slope) + radius
            point_share = 2 * sine * lever
            normal_share = 2 * sine * ca.fmin(safe_norm(normal_slope) + chord, 1.0)
            total_rotation += width
        radius, chord = radius + point_share, chord + normal_share
        point_curvature += lever * width * (width / 2 + sum(widths[:j], ca.SX(0)))
        k, rate = space.driving_coordinate(name)
        radius_shares[k], chord_shares[k] = (
            radius_shares[k] + point_share,
            chord_shares[k] + normal_share,
        )
        if rate is None:
            # A joint with a varying rate counts as independent of its coordinate.
            uneven_point += safe_norm(point_slope) * width
            uneven_normal += safe_norm(normal_slope) * width
        else:
            point_slopes[:, k] += point_slope * rate * half_widths[k]
            normal_slopes[:, k] += normal_slope * rate * half_widths[k]
    if in_palm:
        palm = body.palm
        point, normal = palm.inverse_apply(point), palm.rotation.T @ normal
        point_slopes, normal_slopes = (
            palm.rotation.T @ point_slopes,
            palm.rotation.T @ normal_slopes,
        )
    target_point = p["points"]
    rounding = BOUND_MARGIN + 1e-12 * (ca.norm_1(target_point) + ca.norm_1(point))
    position_tolerance = p["tolerance"][0] + rounding
    angle_tolerance = 2 * ca.sin(ca.fmin(p["tolerance"][1], np.pi) / 2) + BOUND_MARGIN
    return BoxContact(
        point=point,
        normal=normal,
        point_slopes=point_slopes,
        normal_slopes=normal_slopes,
        target_point=target_point,
        target_normal=p["normals"],
        has_point=p["constrained"][0],
        has_normal=p["constrained"][1],
        radius=radius + position_tolerance,
        chord=ca.fmin(ca.fmin(chord, 2.0) + angle_tolerance, 2.0 + BOUND_MARGIN),
        point_remainder=point_curvature + uneven_point + position_tolerance,
        normal_remainder=total_rotation * total_rotation / 2 + uneven_normal + angle_tolerance,
        radius_shares=radius_shares,
        chord_shares=chord_shares,
    )
