"""Other solvers on our problem, each set up as its experts would: one iteration at a time.

Every peer sees the robot through a URDF (`peer_model`), contacts as points and normals, and joints
that follow others. What is theirs is theirs: kinematics, tasks and quadratic program. All keep the
limits in every step.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Protocol

import numpy as np
from peer_model import Joints, peer_urdf

import casadi_ik as ik
from casadi_ik.arrays import Array

LENGTH = 0.1
"""Position errors are divided by this [m], so that they weigh like those of the normals."""


class Peer(Protocol):
    """One iteration of a solver; configurations are ours, (n,)."""

    def aim(self, points: Array, normals: Array) -> None:
        """Take a target: (f, 3) points [m] and normals."""
        ...

    def contacts(self, q: Array) -> tuple[Array, Array]:
        """Go to a configuration; points and normals there, by the peer's own kinematics."""
        ...

    def step(self, q: Array) -> Array:
        """The change of q that the peer makes from where it is."""
        ...


class PinContacts:
    """Contacts and their Jacobian by pinocchio, in our motors."""

    def __init__(self, robot: ik.ArmHand) -> None:
        """Load the robot and look the contact frames up."""
        self.pin: Any = import_module("pinocchio")
        self.joints = Joints(robot)
        self.model = model = self.pin.buildModelFromXML(peer_urdf(robot, self.joints))
        self.frames = [model.getFrameId(f"{name}_contact") for name in robot.fingers]
        place = self.joints.order([n for n in model.names if n != "universe"])
        self.rows = np.array([model.joints[int(i) + 1].idx_q for i in place])
        self.axes = normal_axes(robot, self.at(model.createData(), robot.home)[2])

    def theta(self, q: Array) -> Array:
        """Joints in pinocchio's order."""
        theta = np.empty(self.model.nq)
        theta[self.rows] = self.joints.C @ q
        return theta

    def at(self, data: Any, q: Array) -> tuple[Any, Array, Array]:
        """Points and rotations of the contact frames; `data` then holds the Jacobians."""
        self.pin.computeJointJacobians(self.model, data, self.theta(q))
        self.pin.updateFramePlacements(self.model, data)
        placed = [data.oMf[frame] for frame in self.frames]
        return (
            data,
            np.array([m.translation for m in placed]),
            np.array([m.rotation for m in placed]),
        )

    def rows_of(self, data: Any, normals: Array) -> Array:
        """(6 f, joints) derivative of points / LENGTH and normals, in pinocchio's order."""
        world = self.pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        parts = [self.pin.getFrameJacobian(self.model, data, i, world) for i in self.frames]
        turned = [-cross(n) @ J[3:] for n, J in zip(normals, parts, strict=True)]
        return np.concatenate([J[:3] / LENGTH for J in parts] + turned)


class Scipy:
    """`scipy.optimize.least_squares` (trf, analytic Jacobian): a whole descent is one step."""

    def __init__(self, robot: ik.ArmHand, evaluations: int, tight: bool) -> None:
        """Set it up.

        Args:
            robot: The robot.
            evaluations: Budget of a descent.
            tight: Whether to go on to the last digits.
        """
        self._least_squares: Any = import_module("scipy.optimize").least_squares
        self._robot = robot
        self._evaluations, self._tolerance = evaluations, 1e-15 if tight else 1e-6
        self._pin = PinContacts(robot)
        self._data = self._pin.model.createData()

    def aim(self, points: Array, normals: Array) -> None:
        """See `Peer`."""
        self._target = points, normals

    def contacts(self, q: Array) -> tuple[Array, Array]:
        """See `Peer`."""
        _, points, rotations = self._pin.at(self._data, q)
        return points, np.einsum("fij,fj->fi", rotations, self._pin.axes)

    def step(self, q: Array) -> Array:
        """See `Peer`."""
        margin = 1e-12  # the start has to be inside
        found = self._least_squares(
            self._residual,
            np.clip(q, self._robot.lower + margin, self._robot.upper - margin),
            self._jacobian,
            bounds=(self._robot.lower, self._robot.upper),
            max_nfev=self._evaluations,
            ftol=self._tolerance,
            xtol=self._tolerance,
            gtol=self._tolerance,
        )
        return found.x - q

    def _residual(self, q: Array) -> Array:
        return residual(*self.contacts(q), *self._target)

    def _jacobian(self, q: Array) -> Array:
        _, normals = self.contacts(q)
        return self._pin.rows_of(self._data, normals)[:, self._pin.rows] @ self._pin.joints.C


def normal_axes(robot: ik.ArmHand, rotations: Array) -> Array:
    """(f, 3) the normals in the contact frames, from the rotations of these at home."""
    _, normals = robot.contacts(robot.home)
    return np.einsum("fji,fj->fi", rotations, normals)


def residual(points: Array, normals: Array, wanted: Array, facing: Array) -> Array:
    """(6 f,) errors of the points / LENGTH, then of the normals."""
    return np.concatenate([((points - wanted) / LENGTH).ravel(), (normals - facing).ravel()])


def cross(v: Array) -> Array:
    """(3, 3) the matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
