"""The closed chain in numbers: constraint, palm poses with the thumb held, arms that follow."""

from __future__ import annotations

from typing import Any, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import casadi_ik as ik
from casadi_ik.compile import FunctionKernel
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.kinematics.arms.search import ARM_SEARCH, ArmTrials, Farthest
from casadi_ik.kinematics.closed_chain import closed_chain, split
from casadi_ik.kinematics.forward import Pose, actuated

LENGTH = 0.1
"""Unit of the constraint's linear rows [m]: about the size of a hand."""


def constraints(robot: ik.ArmHand, q: Array) -> Array:
    """C of eq. (6), (k, 6, c), over `split(robot).columns`, at (k, n) configurations."""
    description = robot.description
    x = ca.SX.sym("q", len(robot.actuators))
    chain = closed_chain(actuated(description, x), split(description), LENGTH)
    kernel = FunctionKernel(ca.Function("chain_constraint", [x], [ca.densify(chain.constraint)]))
    (value,) = kernel(q)
    return value


class HeldThumb:
    """Palm poses with the thumb's contact held, and whether the arm can follow."""

    def __init__(self, robot: ik.ArmHand) -> None:
        """Build the arm's closed form.

        Args:
            robot: With an S-R-S arm.
        """
        self.robot = robot
        self.arm = list(robot.description.arm_actuators)
        self.thumb = robot.fingers.index(robot.thumb)
        rotation, origin, trial = ca.MX.sym("R", 3, 3), ca.MX.sym("p", 3), ca.MX.sym("trial")
        palm: Any = Pose(cast(Any, rotation), cast(Any, origin))
        lower, upper = (ca.MX(ca.DM(x[self.arm].tolist())) for x in (robot.lower, robot.upper))
        arm, elbow = srs_arm(robot.description), self.arm[3]
        assert arm is not None
        self._srs, self._search = arm, ArmTrials(arm, Farthest())
        self._reach = [float(x) for x in arm.reach(robot.lower[elbow], robot.upper[elbow])]
        best = lower, trial
        _, margin, _ = self._search.trial(palm, (lower, upper), trial, best, trial)
        self._margin = FunctionKernel(ca.Function("margin", [rotation, origin, trial], [margin]))

    def palms(self, q: Array, contact: tuple[Array, Array], turn: Array) -> tuple[Array, Array]:
        """Palms that put the thumb of each hand on a contact.

        Args:
            q: (k, n) configurations; only the hand's part matters, and where the palm of the
                first stands: it is the zero of the turn.
            contact: Point (3,) [m] and unit normal (3,), or (k, 3) each.
            turn: (k,) virtual joint [rad].

        Returns:
            Rotations (k, 3, 3) and origins (k, 3) [m].
        """
        points, normals = (part[:, self.thumb] for part in self.robot.contacts(q))
        palm = self.robot.palm(q)
        point, normal = contact
        rotations = between(normals, np.broadcast_to(normal, normals.shape)) @ palm[:, :3, :3]
        rotation = rotation_about(np.broadcast_to(normal, normals.shape), turn) @ rotations
        lever = np.einsum("kji,kj->ki", palm[:, :3, :3], points - palm[:, :3, 3])
        return rotation, point - np.einsum("kij,kj->ki", rotation, lever)

    def is_followed(self, rotation: Array, origin: Array) -> NDArray[np.bool_]:
        """Return whether an arm configuration within limits reaches each palm pose (k,)."""
        value = np.zeros(len(origin), dtype=bool)
        for trial in range(self._search.trials):
            remaining = np.flatnonzero(~value)
            if len(remaining):
                (margin,) = self._margin(rotation[remaining], origin[remaining], float(trial))
                value[remaining] = margin >= ARM_SEARCH.tolerance
        return value

    def in_reach(self, rotation: Array, origin: Array) -> NDArray[np.bool_]:
        """Return whether the elbow can extend to each wrist position (k,)."""
        wrist = origin + rotation @ self._srs.wrist_in_palm
        distance = np.linalg.norm(wrist - self._srs.shoulder, axis=1)
        inner, outer = self._reach
        return (distance >= inner) & (distance <= outer)


def rotation_about(axis: Array, angle: Array) -> Array:
    """Rotations (k, 3, 3) about unit axes (k, 3) by angles (k,)."""
    x, y, z = axis.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + s * cross + (1 - c) * cross @ cross


def between(a: Array, b: Array) -> Array:
    """Shortest rotations (k, 3, 3) that turn unit vectors a into b, (k, 3) each, not opposite."""
    u = a + b
    scaled = 2 / np.sum(u * u, axis=1)[:, None, None]
    return np.eye(3) - scaled * u[:, :, None] * u[:, None, :] + 2 * b[:, :, None] * a[:, None, :]


def cylinder(origin: Array) -> tuple[Array, Array]:
    """Distance from the base's axis and height [m] of points (k, 3)."""
    return np.hypot(origin[:, 0], origin[:, 1]), origin[:, 2]
