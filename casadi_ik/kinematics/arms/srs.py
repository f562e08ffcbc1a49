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
from casadi_ik.kinematics.arms.family import Bend, ClosedForm, Redundancy, Sphere
from casadi_ik.kinematics.arms.screws import Screws, subproblem_4
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.se3 import rotation_between, skew
from casadi_ik.kinematics.smooth import Expr, part, safe_norm

SHORTEST = 1e-12
"""Length [m] below which a vector has no direction."""

Parts = tuple[Expr, Expr, Expr]
"""A matrix as ``constant + cosine cos(psi) + sine sin(psi)``."""


@dataclass(frozen=True, eq=False)
class SrsArm(ClosedForm):
    """The constants of the arm, all at q = 0 in the base frame.

    Attributes:
        screws: The seven.
        elbow: (3,) the elbow point [m].
        shoulder_joints: Joints 1 to 3, and the point S.
        wrist_joints: Joints 5 to 7, and the point W.
    """

    screws: Screws
    elbow: Array
    shoulder_joints: Sphere
    wrist_joints: Sphere
    model_error: float = 0.0

    @property
    def kind(self) -> str:
        """Both spheres."""
        return "spherical shoulder and wrist"

    @property
    def parts(self) -> tuple[str, str, str]:
        """The elbow bends the arm; both spheres turn in two ways."""
        return ("elbow", "shoulder", "wrist")

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """The swivel."""
        return (Redundancy(None),)

    @property
    def shoulder(self) -> Array:
        """(3,) the point S [m]."""
        return self.shoulder_joints.point

    @cached_property
    def upper_arm(self) -> Array:
        """(3,) from S to the elbow [m]."""
        return self.elbow - self.shoulder_joints.point

    @cached_property
    def forearm(self) -> Array:
        """(3,) from the elbow to W [m]."""
        return self.wrist_joints.point - self.elbow

    @cached_property
    def wrist_in_palm(self) -> Array:
        """(3,) the point W in the palm frame [m]."""
        return self.screws.rotation.T @ (self.wrist_joints.point - self.screws.origin)

    @cached_property
    def bent(self) -> float:
        """Angle between upper arm and forearm at q = 0 about the elbow's axis [rad]."""
        across = np.cross(self.upper_arm, self.forearm) @ self.screws.axes[3]
        return float(np.arctan2(across, self.upper_arm @ self.forearm))

    def reach(self, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
        """Smallest and largest distance S-W [m] that the elbow's bounds [rad] allow."""
        a, b = (float(np.linalg.norm(link)) for link in (self.upper_arm, self.forearm))
        low, high = lower + self.bent, upper + self.bent
        most = ca.fmin(ca.fmax(ca.fabs(low), ca.fabs(high)), np.pi)
        least = ca.fmin(ca.fmax(ca.fmax(low, -high), 0.0), np.pi)
        near, far = (
            ca.sqrt(ca.fmax(a * a + b * b + 2 * a * b * ca.cos(bend), 0.0))
            for bend in (most, least)
        )
        return near, far

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """By the distance S-W."""
        near, far = self.reach(lower[3], upper[3])
        distance = safe_norm(self._line(palm))
        return distance - ca.fmin(ca.fmax(distance, near), far)

    def bends(
        self, palm: Pose, redundancy: Expr, signs: tuple[Expr, ...] | None = None
    ) -> list[Bend]:
        """Elbow up and down, each with both ways to turn shoulder and wrist."""
        cosine, sine = ca.cos(redundancy[0]), ca.sin(redundancy[0])
        found = []
        for sign in signs or (1.0, -1.0):
            elbow, slack, *spheres = self._chain(palm, sign)
            joints = (self.shoulder_joints, self.wrist_joints)
            ends = tuple(
                sphere.read(self.screws, constant + cosine * along + sine * across)
                for sphere, (constant, along, across) in zip(joints, spheres, strict=True)
            )
            found.append(Bend({3: elbow}, ends, slack))
        return found

    def breakpoints(self, palm: Pose, signs: tuple[Expr, ...], lower: Expr, upper: Expr) -> Expr:
        """(24, 1) swivels at which a joint of shoulder or wrist may stand at a bound.

        Every bound reads a cos(psi) + b sin(psi) + c = 0: two roots each, six joints, two bounds.
        Where there is none (the bound is never met) the closest approach is given.
        """
        _, _, *spheres = self._chain(palm, signs[0])
        roots = []
        for sphere, parts in zip((self.shoulder_joints, self.wrist_joints), spheres, strict=True):
            for i, place in enumerate(sphere.places):
                for bound in (lower[place], upper[place]):
                    c, a, b = (_bound_form(part, i, bound) for part in parts)
                    if i == 1:
                        c = c - ca.cos(bound + sphere.offset)
                    size = ca.fmax(ca.sqrt(a * a + b * b), SHORTEST)
                    half = ca.acos(ca.fmin(ca.fmax(-c / size, -1.0), 1.0))
                    centre = ca.atan2(b, a)
                    roots += [centre + half, centre - half]
        return ca.vertcat(*roots)

    def _line(self, palm: Pose) -> Expr:
        """From S to where W has to be."""
        return palm.origin + palm.rotation @ ca.DM(self.wrist_in_palm) - ca.DM(self.shoulder)

    def _chain(self, palm: Pose, sign: Expr) -> tuple[Expr, Expr, Parts, Parts]:
        """Everything but the swivel, for a sign of the elbow.

        Returns:
            The elbow [rad], its slack, and the `Sphere.euler_matrix` of shoulder and wrist.
        """
        line = self._line(palm)
        along = line / ca.fmax(safe_norm(line), SHORTEST)
        turned = palm.rotation @ ca.DM(self.screws.rotation.T)
        elbow, slack, *matrices = self._bent(ca.sumsqr(line), along, turned, sign)
        return elbow, slack, tuple(matrices[:3]), tuple(matrices[3:])  # type: ignore[return-value]

    @cached_property
    def _bent(self) -> ca.Function:
        """(squared distance S-W, unit vector from S to W, rotation from zero, sign) -> `_chain`."""
        axis, upper, fore = self.screws.axes[3], self.upper_arm, self.forearm
        squared, sign = ca.SX.sym("squared"), ca.SX.sym("sign")
        along, turned = ca.SX.sym("along", 3), ca.SX.sym("turned", 3, 3)
        ahead, aside = 2 * float(upper @ fore), 2 * float(upper @ np.cross(axis, fore))
        height = squared - float(upper @ upper + fore @ fore)
        one, other, slack = subproblem_4(ca.SX(ahead), ca.SX(aside), height)
        turn = one.or_other(sign > 0, other)
        B = turn.about(axis)
        stretched = ca.DM(upper) + B @ ca.DM(fore)
        A_0 = rotation_between(stretched / ca.fmax(safe_norm(stretched), SHORTEST), along)
        # e(line psi) = line line' + cos (I - line line') + sin [line].
        outer = along @ along.T
        parts = [part @ A_0 for part in (outer, ca.DM.eye(3) - outer, skew(along))]
        matrices = [self.shoulder_joints.euler_matrix(A) for A in parts]
        matrices += [self.wrist_joints.euler_matrix(B.T @ (A.T @ turned)) for A in parts]
        elbow = self.screws.centred(3, turn.angle)
        return part(
            "bent_arm", [squared, along, turned, sign], [elbow, slack, *map(ca.densify, matrices)]
        )


def _bound_form(matrix: Expr, joint: int, bound: Expr) -> Expr:
    """The form that vanishes when the joint stands at the bound (or half a turn from it)."""
    if joint == 0:
        return matrix[1, 2] * ca.cos(bound) - matrix[0, 2] * ca.sin(bound)
    if joint == 1:
        return matrix[2, 2]
    return matrix[2, 1] * ca.cos(bound) + matrix[2, 0] * ca.sin(bound)
