"""Seven-joint arms with a spherical shoulder, an elbow and a spherical wrist, in closed form.

Such an arm (KUKA LWR, iiwa and many others) is recognised from its kinematics: axes 1 to 3 meet
in the shoulder point S, axes 5 to 7 in the wrist point W, axis 4 passes the elbow at right angles
to both links, and neighbouring axes of shoulder and wrist are perpendicular. For a palm pose the
elbow angle follows from the distance S-W; what is left free is the swivel psi about the line S-W,
and the signs of elbow, shoulder and wrist.

With a_i the axes at q = 0 and rotations about them, the arm turns by A B C: shoulder
A = e(a1 t1) e(a2 t2) e(a3 t3), elbow B = e(a4 t4), wrist C = e(a5 t5) e(a6 t6) e(a7 t7).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.directions import rotation_between
from casadi_ik.symbolic.kinematics import Pose, axis_rotation, forward
from casadi_ik.symbolic.smooth import Expr, safe_norm
from casadi_ik.symbolic.so3 import skew

MEETING = 1e-9
"""How far apart axes may pass and still count as meeting [m], or be off perpendicular [rad]."""

STRAIGHTEST = 1e-12
"""How close to one the cosine of the elbow may come."""


@dataclass(frozen=True, eq=False)
class Spherical:
    """Three axes through one point, each perpendicular to the next.

    Attributes:
        frame: (3, 3) columns x, y, z with z along the first axis and y along the second.
        offset: Angle by which the third axis is turned from z about y [rad].
        lower: (3,) joint limits [rad].
        upper: (3,) joint limits [rad].
    """

    frame: Array
    offset: float
    lower: Array
    upper: Array

    def triples(self, matrix: Expr, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
        """Both triples of `euler_angles`, held joints of more than a turn where they are held.

        Args:
            matrix: (3, 3), see `euler_matrix`.
            lower: (3, 1) bounds [rad].
            upper: (3, 1).
        """
        one, other = euler_angles(self, matrix)
        if (self.upper - self.lower < AROUND).all():
            return one, other
        return at_held(one, lower, upper), at_held(other, lower, upper)

    def euler_matrix(self, rotation: Expr) -> Expr:
        """The rotation as Rz(t1) Ry(t2 + offset) Rz(t3), (3, 3)."""
        local = ca.DM(self.frame.T) @ rotation @ ca.DM(self.frame)
        return local @ axis_rotation(np.array([0.0, 1.0, 0.0]), ca.SX(self.offset))


@dataclass(frozen=True, eq=False)
class SrsArm:
    """The constants of the arm, all at q = 0 in the base frame.

    Attributes:
        shoulder: (3,) the point S [m].
        upper_arm: (3,) from S to the elbow [m].
        forearm: (3,) from the elbow to W [m].
        elbow_axis: (3,) axis 4.
        elbow_limits: (2,) [rad].
        shoulder_joints: Joints 1 to 3.
        wrist_joints: Joints 5 to 7.
        palm_rotation: (3, 3) rotation of the palm.
        wrist_in_palm: (3,) the point W in the palm frame [m].
    """

    shoulder: Array
    upper_arm: Array
    forearm: Array
    elbow_axis: Array
    elbow_limits: Array
    shoulder_joints: Spherical
    wrist_joints: Spherical
    palm_rotation: Array
    wrist_in_palm: Array

    @cached_property
    def bent(self) -> float:
        """Angle between upper arm and forearm at q = 0 about the elbow's axis [rad]."""
        across = np.cross(self.upper_arm, self.forearm) @ self.elbow_axis
        return float(np.arctan2(across, self.upper_arm @ self.forearm))


@dataclass(frozen=True, eq=False)
class Swivel:
    """The arm for one palm pose and one elbow sign, as a function of the swivel alone.

    Shoulder and wrist rotations are ``constant + cosine * cos(psi) + sine * sin(psi)``.

    Attributes:
        elbow: Joint 4 [rad].
        reachable: Sine of the elbow's slack: >= 0 where the distance S-W can be spanned.
        shoulder: Three (3, 3) matrices of `Spherical.euler_matrix` (constant, cosine, sine).
        wrist: Likewise.
    """

    elbow: Expr
    reachable: Expr
    shoulder: tuple[Expr, Expr, Expr]
    wrist: tuple[Expr, Expr, Expr]


def srs_arm(robot: RobotDescription) -> SrsArm:
    """Recognise the arm.

    Raises:
        UnsupportedError: The arm is built otherwise; the message says how.
    """
    where = f"robot {robot.name!r}: the arm is not of the S-R-S kind"
    arm = [robot.actuator_names[i] for i in robot.arm_actuators]
    joints = [joint for joint in robot.movable if joint.part == "arm"]
    if len(joints) != 7 or [j.name for j in joints] != arm:
        raise UnsupportedError(f"{where}: it has {len(joints)} joints, expected 7 motors")
    if any(joint.type != "revolute" for joint in joints):
        raise UnsupportedError(f"{where}: expected revolute joints only")
    kinematics = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    axes = [_number(kinematics.axes[joint.name]) for joint in joints]
    origins = [_number(kinematics.links[joint.child].origin) for joint in joints]
    shoulder = _meeting_point(origins[:3], axes[:3], f"{where}: axes 1 to 3")
    wrist = _meeting_point(origins[4:], axes[4:], f"{where}: axes 5 to 7")
    # The elbow point is where axis 4 is closest to the line of axis 3, i.e. on both links.
    elbow = _meeting_point(
        [origins[2], origins[3], origins[4]], [axes[2], axes[3], axes[4]], f"{where}: axes 3 to 5"
    )
    upper_arm, forearm = elbow - shoulder, wrist - elbow
    for name, link in (("upper arm", upper_arm), ("forearm", forearm)):
        if abs(link @ axes[3]) > MEETING or np.linalg.norm(link) < 1e-6:
            raise UnsupportedError(f"{where}: axis 4 is not perpendicular to the {name}")
    limits = np.array([[joint.lower, joint.upper] for joint in joints])
    palm = kinematics.palm
    rotation = np.array(ca.evalf(ca.densify(palm.rotation)))
    return SrsArm(
        shoulder=shoulder,
        upper_arm=upper_arm,
        forearm=forearm,
        elbow_axis=axes[3],
        elbow_limits=limits[3],
        shoulder_joints=_spherical(axes[:3], limits[:3], f"{where}: shoulder"),
        wrist_joints=_spherical(axes[4:], limits[4:], f"{where}: wrist"),
        palm_rotation=rotation,
        wrist_in_palm=rotation.T @ (wrist - _number(palm.origin)),
    )


def swivel(arm: SrsArm, palm: Pose, elbow_sign: Expr) -> Swivel:
    """Everything but the swivel.

    Args:
        arm: The arm's constants.
        palm: Desired pose of the palm, base frame.
        elbow_sign: +1 or -1.
    """
    a, b = float(np.linalg.norm(arm.upper_arm)), float(np.linalg.norm(arm.forearm))
    to_wrist = palm.origin + palm.rotation @ ca.DM(arm.wrist_in_palm) - ca.DM(arm.shoulder)
    cosine = (ca.sumsqr(to_wrist) - a * a - b * b) / (2 * a * b)
    slack = 1 - cosine * cosine
    inner = ca.sqrt(ca.fmax(slack, STRAIGHTEST))
    elbow = elbow_sign * ca.atan2(inner, cosine) - arm.bent
    B = axis_rotation(arm.elbow_axis, elbow)
    stretched = ca.DM(arm.upper_arm) + B @ ca.DM(arm.forearm)
    line = to_wrist / ca.fmax(safe_norm(to_wrist), 1e-12)
    A_0 = rotation_between(stretched / ca.fmax(safe_norm(stretched), 1e-12), line)
    # e(line psi) = line line' + cos (I - line line') + sin [line].
    along = line @ line.T
    parts = (along, ca.DM.eye(3) - along, skew(line))
    turned = palm.rotation @ ca.DM(arm.palm_rotation.T)
    shoulder, wrist = [], []
    for part in parts:
        A = part @ A_0
        shoulder.append(arm.shoulder_joints.euler_matrix(A))
        wrist.append(arm.wrist_joints.euler_matrix(B.T @ (A.T @ turned)))
    return Swivel(
        elbow, slack, (shoulder[0], shoulder[1], shoulder[2]), (wrist[0], wrist[1], wrist[2])
    )


def reach(arm: SrsArm, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
    """Smallest and largest distance S-W [m] that the elbow's bounds [rad] allow."""
    a, b = float(np.linalg.norm(arm.upper_arm)), float(np.linalg.norm(arm.forearm))
    low, high = lower + arm.bent, upper + arm.bent
    most = ca.fmin(ca.fmax(ca.fabs(low), ca.fabs(high)), np.pi)
    least = ca.fmin(ca.fmax(ca.fmax(low, -high), 0.0), np.pi)
    near, far = (
        ca.sqrt(ca.fmax(a * a + b * b + 2 * a * b * ca.cos(bend), 0.0)) for bend in (most, least)
    )
    return near, far


def at_angle(parts: tuple[Expr, Expr, Expr], psi: Expr) -> Expr:
    """``constant + cosine cos(psi) + sine sin(psi)``."""
    return parts[0] + parts[1] * ca.cos(psi) + parts[2] * ca.sin(psi)


def euler_angles(spherical: Spherical, matrix: Expr) -> tuple[Expr, Expr]:
    """Both triples of joint angles (3, 1) [rad] behind Rz(t1) Ry(t2 + offset) Rz(t3).

    Each angle is given in the turn centred on its joint's range.
    """
    sine = ca.sqrt(ca.fmax(matrix[0, 2] ** 2 + matrix[1, 2] ** 2, 1e-24))
    first = ca.atan2(matrix[1, 2], matrix[0, 2])
    second = ca.atan2(sine, matrix[2, 2])
    third = ca.atan2(matrix[2, 1], -matrix[2, 0])
    pi, middle = np.pi, (spherical.lower + spherical.upper) / 2
    triples = (
        (first, second - spherical.offset, third),
        (first + pi, -second - spherical.offset, third + pi),
    )
    centred = [
        ca.vertcat(*(m + _wrapped(angle - m) for angle, m in zip(triple, middle, strict=True)))
        for triple in triples
    ]
    return centred[0], centred[1]


AROUND = 2 * np.pi - 1e-6
"""Range [rad] of a joint from which on it may stand the same way at several angles."""


def at_held(angles: Expr, lower: Expr, upper: Expr) -> Expr:
    """Angles (k, 1) [rad] moved by whole turns to where their joints are held, if they are.

    A closed form gives each angle in the turn centred on its joint's range, but a joint of more
    than a turn may be held in another.

    Args:
        angles: (k, 1) [rad].
        lower: (k, 1) bounds [rad]; a joint whose bounds are equal is held.
        upper: (k, 1).
    """
    turns = ca.floor((lower - angles) / (2 * np.pi) + 0.5)
    return ca.if_else(lower < upper, angles, angles + 2 * np.pi * turns)


def limit_roots(
    spherical: Spherical, parts: tuple[Expr, Expr, Expr], lower: Expr, upper: Expr
) -> Expr:
    """Swivels at which a joint of the sphere may stand at a limit, (12, 1) [rad].

    Every limit reads a cos(psi) + b sin(psi) + c = 0: two roots each, three joints, two limits.
    Where there is none (the limit is never met) the closest approach is given.

    Args:
        spherical: The sphere.
        parts: Its Euler matrix as a function of the swivel.
        lower: (3, 1) limits [rad].
        upper: (3, 1).
    """
    roots = []
    for joint in range(3):
        for limit in (lower[joint], upper[joint]):
            c, a, b = (_limit_form(part, joint, limit) for part in parts)
            if joint == 1:
                c = c - ca.cos(limit + spherical.offset)
            size = ca.fmax(ca.sqrt(a * a + b * b), 1e-12)
            half = ca.acos(ca.fmin(ca.fmax(-c / size, -1.0), 1.0))
            centre = ca.atan2(b, a)
            roots += [centre + half, centre - half]
    return ca.vertcat(*roots)


def _limit_form(matrix: Expr, joint: int, limit: Expr) -> Expr:
    """The form that vanishes when the joint stands at the limit (or half a turn from it)."""
    if joint == 0:
        return matrix[1, 2] * ca.cos(limit) - matrix[0, 2] * ca.sin(limit)
    if joint == 1:
        return matrix[2, 2]
    return matrix[2, 1] * ca.cos(limit) + matrix[2, 0] * ca.sin(limit)


def _wrapped(angle: Expr) -> Expr:
    """Angle in [-3 pi, 3 pi] moved by a full turn into [-pi, pi], without trigonometry."""
    return angle - 2 * np.pi * ca.floor((angle + np.pi) / (2 * np.pi))


def _meeting_point(points: list[Array], axes: list[Array], where: str) -> Array:
    """The point closest to all lines, if they meet."""
    normal = sum((np.eye(3) - np.outer(a, a) for a in axes), np.zeros((3, 3)))
    right = sum(
        ((np.eye(3) - np.outer(a, a)) @ p for p, a in zip(points, axes, strict=True)), np.zeros(3)
    )
    point: Array = np.linalg.lstsq(normal, right, rcond=None)[0].astype(float)
    for p, a in zip(points, axes, strict=True):
        if np.linalg.norm(np.cross(point - p, a)) > MEETING:
            raise UnsupportedError(f"{where} do not meet in one point")
    return point


def _spherical(axes: list[Array], limits: Array, where: str) -> Spherical:
    z, y, third = axes
    if abs(z @ y) > MEETING or abs(y @ third) > MEETING:
        raise UnsupportedError(f"{where}: neighbouring axes are not perpendicular")
    x = np.cross(y, z)
    frame = np.column_stack([x, y, z])
    return Spherical(frame, float(np.arctan2(third @ x, third @ z)), limits[:, 0], limits[:, 1])


def _number(value: ca.SX) -> Array:
    return np.array(ca.evalf(ca.densify(value))).ravel()
