"""Seven joints with a spherical shoulder, an elbow and a spherical wrist (S-R-S).

Of such an arm (KUKA LWR, iiwa and many others) axes 1 to 3 meet in the shoulder point S, axes 5 to
7 in the wrist point W, axis 4 passes the elbow at right angles to both links, and neighbouring axes
of shoulder and wrist are perpendicular. For a palm pose the elbow angle follows from the distance
S-W; the redundancy is the swivel psi about the line S-W (Shimizu et al. 2008).

With a_i the axes at q = 0 and rotations about them, the arm turns by A B C: shoulder
A = e(a1 t1) e(a2 t2) e(a3 t3), elbow B = e(a4 t4), wrist C = e(a5 t5) e(a6 t6) e(a7 t7).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import (
    ClosedForm,
    ElbowBranch,
    JointAngle,
    Redundancy,
    SphericalJoints,
)
from casadi_ik.kinematics.arms.screws import CosSin, Screws, subproblem_4
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.se3 import rotation_between, skew
from casadi_ik.kinematics.smooth import Expr, call_function, safe_norm

MIN_LENGTH = 1e-12
"""Length below which a vector has no direction [m]."""

SwivelForm = tuple[Expr, Expr, Expr]
"""A matrix as ``constant + cosine cos(psi) + sine sin(psi)``."""


@dataclass(frozen=True, eq=False)
class SrsArm(ClosedForm):
    """An S-R-S arm; all constants are at q = 0 in the base frame.

    Attributes:
        screws: The seven screws.
        elbow: (3,) the elbow point [m].
        shoulder_joints: Spherical joint of joints 1 to 3 with the point S.
        wrist_joints: Spherical joint of joints 5 to 7 with the point W.
    """

    screws: Screws
    elbow: Array
    shoulder_joints: SphericalJoints
    wrist_joints: SphericalJoints
    model_error: float = 0.0

    @property
    def kind(self) -> str:
        """Description of the arm."""
        return "spherical shoulder and wrist"

    @property
    def sign_names(self) -> tuple[str, str, str]:
        """The elbow, and the flips of both spherical joints."""
        return ("elbow", "shoulder", "wrist")

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """The swivel angle."""
        return (Redundancy(None),)

    @property
    def shoulder(self) -> Array:
        """The point S, (3,) [m]."""
        return self.shoulder_joints.point

    @cached_property
    def upper_arm(self) -> Array:
        """Vector from S to the elbow, (3,) [m]."""
        return self.elbow - self.shoulder_joints.point

    @cached_property
    def forearm(self) -> Array:
        """Vector from the elbow to W, (3,) [m]."""
        return self.wrist_joints.point - self.elbow

    @cached_property
    def wrist_in_palm(self) -> Array:
        """The point W in the palm frame, (3,) [m]."""
        return self.screws.rotation.T @ (self.wrist_joints.point - self.screws.origin)

    @cached_property
    def elbow_angle_at_zero(self) -> float:
        """Angle from upper arm to forearm at q = 0 about the elbow axis [rad]."""
        sine_part = np.cross(self.upper_arm, self.forearm) @ self.screws.axes[3]
        return float(np.arctan2(sine_part, self.upper_arm @ self.forearm))

    def reach(self, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
        """Return the smallest and largest distance S-W [m] within the elbow's bounds [rad]."""
        a, b = (float(np.linalg.norm(link)) for link in (self.upper_arm, self.forearm))
        low, high = lower + self.elbow_angle_at_zero, upper + self.elbow_angle_at_zero
        max_bend = ca.fmin(ca.fmax(ca.fabs(low), ca.fabs(high)), np.pi)
        min_bend = ca.fmin(ca.fmax(ca.fmax(low, -high), 0.0), np.pi)
        min_distance, max_distance = (
            ca.sqrt(ca.fmax(a * a + b * b + 2 * a * b * ca.cos(bend), 0.0))
            for bend in (max_bend, min_bend)
        )
        return min_distance, max_distance

    def distance_out_of_reach(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """Return the bound from the distance S-W."""
        min_distance, max_distance = self.reach(lower[3], upper[3])
        distance = safe_norm(self._shoulder_to_wrist(palm))
        return distance - ca.fmin(ca.fmax(distance, min_distance), max_distance)

    def bends(
        self, palm: Pose, redundancy: Expr, signs: tuple[Expr, ...] | None = None
    ) -> list[ElbowBranch]:
        """Return the branches elbow up and elbow down, each with flips of shoulder and wrist."""
        cosine, sine = ca.cos(redundancy[0]), ca.sin(redundancy[0])
        branches = []
        for sign in signs or (1.0, -1.0):
            elbow, slack, *spheres = self._without_swivel(palm, sign)
            joints = (self.shoulder_joints, self.wrist_joints)
            flips = tuple(
                sphere.angles_of(self.screws, constant + cosine * cos_term + sine * sin_term)
                for sphere, (constant, cos_term, sin_term) in zip(joints, spheres, strict=True)
            )
            turn, _ = self._elbow_turn(ca.sumsqr(self._shoulder_to_wrist(palm)), sign)
            branches.append(ElbowBranch({3: JointAngle(elbow, turn)}, flips, slack))
        return branches

    def breakpoints(self, palm: Pose, signs: tuple[Expr, ...], lower: Expr, upper: Expr) -> Expr:
        """Return (24, 1) swivel angles at which a joint of shoulder or wrist may reach a bound.

        Every bound is an equation a cos(psi) + b sin(psi) + c = 0 with two roots, for six joints
        and two bounds. Without a root the closest approach is returned.
        """
        _, _, *spheres = self._without_swivel(palm, signs[0])
        roots = []
        for sphere, form in zip((self.shoulder_joints, self.wrist_joints), spheres, strict=True):
            for i, index in enumerate(sphere.indices):
                for bound in (lower[index], upper[index]):
                    c, a, b = (_bound_form(item, i, bound) for item in form)
                    if i == 1:
                        c = c - ca.cos(bound + sphere.offset)
                    size = ca.fmax(ca.sqrt(a * a + b * b), MIN_LENGTH)
                    half_angle = ca.acos(ca.fmin(ca.fmax(-c / size, -1.0), 1.0))
                    centre = ca.atan2(b, a)
                    roots += [centre + half_angle, centre - half_angle]
        return ca.vertcat(*roots)

    def _shoulder_to_wrist(self, palm: Pose) -> Expr:
        """Return the vector from S to the required position of W."""
        return palm.origin + palm.rotation @ ca.DM(self.wrist_in_palm) - ca.DM(self.shoulder)

    def _without_swivel(self, palm: Pose, sign: Expr) -> tuple[Expr, Expr, SwivelForm, SwivelForm]:
        """Return everything that does not depend on the swivel, for a sign of the elbow.

        Returns:
            The elbow [rad], its reach margin, and the `SphericalJoints.euler_matrix` of shoulder
            and wrist.
        """
        line = self._shoulder_to_wrist(palm)
        direction = line / ca.fmax(safe_norm(line), MIN_LENGTH)
        rotation = palm.rotation @ ca.DM(self.screws.rotation.T)
        elbow, slack, *matrices = self._elbow_function(ca.sumsqr(line), direction, rotation, sign)
        return elbow, slack, tuple(matrices[:3]), tuple(matrices[3:])  # type: ignore[return-value]

    def _elbow_turn(self, squared: Expr, sign: Expr) -> tuple[CosSin, Expr]:
        """Return the elbow angle at a squared distance S-W for a sign, and its reach margin."""
        axis, upper, fore = self.screws.axes[3], self.upper_arm, self.forearm
        cos_part, sin_part = 2 * float(upper @ fore), 2 * float(upper @ np.cross(axis, fore))
        height = squared - float(upper @ upper + fore @ fore)
        first, second, slack = subproblem_4(ca.SX(cos_part), ca.SX(sin_part), height)
        return first.select(sign > 0, second), slack

    @cached_property
    def _elbow_function(self) -> ca.Function:
        """Function (squared distance, unit vector S-W, rotation, sign) -> `_without_swivel`."""
        axis, upper, fore = self.screws.axes[3], self.upper_arm, self.forearm
        squared, sign = ca.SX.sym("squared"), ca.SX.sym("sign")
        direction, rotation = ca.SX.sym("along", 3), ca.SX.sym("turned", 3, 3)
        turn, slack = self._elbow_turn(squared, sign)
        B = turn.rotation(axis)
        stretched = ca.DM(upper) + B @ ca.DM(fore)
        A_0 = rotation_between(stretched / ca.fmax(safe_norm(stretched), MIN_LENGTH), direction)
        # e(line psi) = line line' + cos (I - line line') + sin [line].
        outer = direction @ direction.T
        rotations = [matrix @ A_0 for matrix in (outer, ca.DM.eye(3) - outer, skew(direction))]
        matrices = [self.shoulder_joints.euler_matrix(A) for A in rotations]
        matrices += [self.wrist_joints.euler_matrix(B.T @ (A.T @ rotation)) for A in rotations]
        elbow = self.screws.centred(3, turn.angle)
        return call_function(
            "bent_arm",
            [squared, direction, rotation, sign],
            [elbow, slack, *map(ca.densify, matrices)],
        )


def _bound_form(matrix: Expr, joint: int, bound: Expr) -> Expr:
    """Return the form that is zero if the joint is at the bound (or half a turn from it)."""
    if joint == 0:
        return matrix[1, 2] * ca.cos(bound) - matrix[0, 2] * ca.sin(bound)
    if joint == 1:
        return matrix[2, 2]
    return matrix[2, 1] * ca.cos(bound) + matrix[2, 0] * ca.sin(bound)
