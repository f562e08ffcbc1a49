"""The hand with its palm free to move: how well it fits contacts, and where it takes the wrist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.solvers.contact_verdict import ContactVerdict
from casadi_ik.solvers.diagnosis import ArmReach, HandFit
from casadi_ik.solvers.problem import Array, Problems
from casadi_ik.solvers.verdict import TOLERANCE_SLACK
from casadi_ik.steps.hand_first_state import LENGTH
from casadi_ik.symbolic.srs_arm import SrsArm


@dataclass(frozen=True, eq=False)
class PalmFree:
    """Hand postures, each moved as a whole to where it fits the contacts best.

    Attributes:
        rotation: (m, 3, 3) of the motion from where the arm is at zero.
        shift: (m, 3) [m].
        position_error: (m, f) [m], NaN where free.
        angle_error: (m, f) [rad], NaN where free.
        cost: (m,) squared residual, as in the hand stage.
        ok: (m,) within tolerance.
    """

    rotation: Array
    shift: Array
    position_error: Array
    angle_error: Array
    cost: Array
    ok: NDArray[np.bool_]

    def fit(self, robot: ArmHand, problems: Problems) -> HandFit:
        """The best of them."""
        best = int(np.argmin(np.where(self.ok, -1.0, self.cost)))
        missed = _missed(problems, self.position_error[best], self.angle_error[best])
        contacts = {}
        for i, name in enumerate(robot.fingers):
            position, angle = self.position_error[best, i], self.angle_error[best, i]
            contacts[name] = ContactVerdict(
                float(position), float(angle), not missed[i], problems.tolerances[i]
            )
        return HandFit(bool(self.ok[best]), contacts)

    def reach(self, arm: SrsArm, limits: bool) -> ArmReach:
        """Where those that fit take the wrist: the one nearest to what the arm can span."""
        nearest, farthest = span(arm, limits)
        wrist = arm.shoulder + arm.upper_arm + arm.forearm
        moved = self.rotation[self.ok] @ wrist + self.shift[self.ok]
        distance = np.linalg.norm(moved - arm.shoulder, axis=1)
        outside = np.maximum(distance - farthest, nearest - distance)
        return ArmReach(float(distance[outside.argmin()]), nearest, farthest)


def palm_free(robot: ArmHand, problems: Problems, q: Array) -> PalmFree:
    """Move hand postures to one target.

    Args:
        robot: The robot.
        problems: One target.
        q: (m, n) configurations; of the arm no notice is taken.
    """
    hand = q.copy()
    hand[:, list(robot.description.arm_actuators)] = 0.0
    points, normals = robot.contacts(hand)
    known_point = ~np.isnan(problems.points[0, :, 0])
    known_normal = ~np.isnan(problems.normals[0, :, 0])
    wanted, facing = np.nan_to_num(problems.points[0]), np.nan_to_num(problems.normals[0])
    weight = known_point / known_point.sum()
    centre, hand_centre = weight @ wanted, np.einsum("f,mfi->mi", weight, points)
    a = (points - hand_centre[:, None]) * known_point[:, None] / LENGTH
    b = (wanted - centre) * known_point[:, None] / LENGTH
    B = np.einsum("fi,mfj->mij", b, a)
    B += np.einsum("fi,mfj->mij", facing * known_normal[:, None], normals)
    U, _, Vt = np.linalg.svd(B)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    rotation = U @ Vt
    shift = centre - np.einsum("mij,mj->mi", rotation, hand_centre)
    there = np.einsum("mij,mfj->mfi", rotation, points) + shift[:, None]
    turned = np.einsum("mij,mfj->mfi", rotation, normals)
    position = np.linalg.norm(there - problems.points[0], axis=2)
    chord = np.linalg.norm(turned - problems.normals[0], axis=2)
    angle = 2 * np.arctan2(chord, np.linalg.norm(turned + problems.normals[0], axis=2))
    missed = _missed(problems, position, angle)
    cost = np.nansum((position / LENGTH) ** 2, axis=1) + np.nansum(chord**2, axis=1)
    return PalmFree(rotation, shift, position, angle, cost, np.asarray(~missed.any(axis=1)))


def _missed(problems: Problems, position: Array, angle: Array) -> NDArray[np.bool_]:
    """Which contacts are out of tolerance (..., f); what is free (NaN) is not."""
    slack = 1 + TOLERANCE_SLACK
    far, turned = problems.position_tolerance * slack, problems.angle_tolerance * slack
    return np.asarray((position > far) | (angle > turned))


def span(arm: SrsArm, limits: bool) -> tuple[float, float]:
    """Smallest and largest distance of the wrist from the shoulder [m].

    Args:
        arm: The arm.
        limits: Whether the elbow keeps within its limits.
    """
    upper, lower = float(np.linalg.norm(arm.upper_arm)), float(np.linalg.norm(arm.forearm))
    bent = np.arctan2(
        np.cross(arm.upper_arm, arm.forearm) @ arm.elbow_axis, arm.upper_arm @ arm.forearm
    )
    low, high = arm.elbow_limits + bent if limits else (-np.pi, np.pi)
    extremes = [low, high, *(k * np.pi for k in range(-2, 3) if low <= k * np.pi <= high)]
    squares = upper**2 + lower**2 + 2 * upper * lower * np.cos(extremes)
    distances = np.sqrt(np.maximum(squares, 0.0))
    return float(distances.min()), float(distances.max())
