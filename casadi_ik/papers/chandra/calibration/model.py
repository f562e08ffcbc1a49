"""Parametric hand model: parameters with priors, and fingertip poses as functions of them.

The graphs are those of the robot (Chandra et al. 2019, eq. 8 for triangles, eq. 9 for four-bars,
eq. 3 for chains) with the numbers of the description as inputs. A four-bar stays on the branch of
its known pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.compile import FunctionKernel
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.kinematics.couplings import follow
from casadi_ik.kinematics.se3 import exp_so3, perpendicular
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint

PARAMETER_GROUPS = ("linkage", "axes", "tips")
"""Groups of parameters: couplings, origins and directions of joint axes, contact frames."""

BOUND = 3.0
"""Bound of estimates around the description [prior standard deviations]."""


@dataclass(frozen=True)
class Priors:
    """Standard deviations of the errors of a description.

    Attributes:
        length: Lengths in triangles and four-bars [m].
        angle: Reference angles of the couplings [rad].
        origin: Coordinates of a point on a joint axis [m].
        axis: Tilts of a joint axis [rad].
        tip: Coordinates of a contact point [m].
        tip_angle: Rotations of a contact frame [rad].
    """

    length: float = 0.5e-3
    angle: float = math.radians(2.0)
    origin: float = 1e-3
    axis: float = math.radians(1.0)
    tip: float = 1e-3
    tip_angle: float = math.radians(2.0)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"priors.{name}: found {value!r}, expected a number > 0")


@dataclass(frozen=True)
class Parameter:
    """An estimated parameter.

    Attributes:
        owner: Name of the joint or finger.
        part: "coupling", "origin", "axis", "tip" or "turn".
        key: Field of the coupling, coordinate "x", "y" or "z", or tilt "1" or "2".
        nominal: Value in the description; 0 for tilts and rotations.
        prior: Standard deviation of the prior.
        unit: "m" or "rad".
    """

    owner: str
    part: str
    key: str
    nominal: float
    prior: float
    unit: str

    @property
    def name(self) -> str:
        """Name of the parameter."""
        if self.part == "coupling":
            return f"{self.owner}.{self.key}"
        return f"{self.owner}.{self.part}.{self.key}"

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest value of an estimate."""
        return self.nominal - BOUND * self.prior, self.nominal + BOUND * self.prior


def hand_parameters(
    robot: RobotDescription,
    fingers: Sequence[str],
    groups: Sequence[str] = PARAMETER_GROUPS,
    priors: Priors | None = None,
) -> tuple[Parameter, ...]:
    """Return the parameters of fingers from the palm to the tips, without duplicates.

    Args:
        robot: Description of the robot.
        fingers: Names of the measured fingers.
        groups: Groups of parameters to estimate.
        priors: Standard deviations of the errors of the description.

    Raises:
        UnknownNameError: A finger does not exist.
        InputError: There are no fingers, or a group is unknown.
    """
    unknown = [group for group in groups if group not in PARAMETER_GROUPS]
    if unknown or not groups:
        wrong = repr(unknown[0]) if unknown else "nothing"
        raise InputError(f"groups: found {wrong}, expected some of {', '.join(PARAMETER_GROUPS)}")
    if not fingers:
        raise InputError("fingers: found none, expected at least one")
    deviations = priors or Priors()
    rows: list[tuple[str, str, str, float, float, str]] = []
    for finger in fingers:
        chain = robot.chain(robot.finger(finger).link)
        for joint in (j for j in chain if j.type != "fixed" and j.part == "hand"):
            name, coupling = joint.name, joint.coupling
            if "linkage" in groups and coupling is not None:
                for keys, prior, unit in (
                    (coupling.lengths, deviations.length, "m"),
                    (coupling.angles, deviations.angle, "rad"),
                ):
                    for key in keys:
                        value = float(getattr(coupling, key))
                        rows.append((name, "coupling", key, value, prior, unit))
            if "axes" in groups:
                coordinates = zip("xyz", joint.placement[:3, 3].tolist(), strict=True)
                rows += [
                    (name, "origin", key, value, deviations.origin, "m")
                    for key, value in coordinates
                ]
                rows += [(name, "axis", key, 0.0, deviations.axis, "rad") for key in "12"]
        if "tips" in groups:
            coordinates = zip("xyz", robot.finger(finger).placement[:3, 3].tolist(), strict=True)
            rows += [(finger, "tip", key, value, deviations.tip, "m") for key, value in coordinates]
            rows += [(finger, "turn", key, 0.0, deviations.tip_angle, "rad") for key in "xyz"]
    parameters = (Parameter(*row) for row in rows)
    return tuple({parameter.name: parameter for parameter in parameters}.values())


@dataclass(frozen=True, eq=False)
class HandModel:
    """A description with free parameters.

    Attributes:
        robot: Description of the robot.
        parameters: Free parameters in the order of all vectors of values (k,).
        compiled: False evaluates the graphs with CasADi's virtual machine.
    """

    robot: RobotDescription
    parameters: tuple[Parameter, ...]
    compiled: bool = True

    @cached_property
    def nominal(self) -> Array:
        """Parameter values of the description (k,)."""
        return np.array([parameter.nominal for parameter in self.parameters])

    @cached_property
    def prior(self) -> Array:
        """(k,) standard deviations of the priors."""
        return np.array([parameter.prior for parameter in self.parameters])

    def poses(self, finger: str, q: Array, values: Array) -> Array:
        """Return the fingertip poses.

        Args:
            finger: Name of the finger.
            q: (m, n) actuator positions [rad or m].
            values: (k,) values of the parameters.

        Returns:
            (m, 8) unit dual quaternions in the base frame.
        """
        (poses,) = self._kernel(finger, "pose")(q, values)
        return poses

    def misfit(self, finger: str, q: Array, values: Array, measured: Array) -> tuple[Array, Array]:
        """Return the errors of the model at measured poses, and their Jacobian.

        Args:
            finger: Name of the finger.
            q: (m, n) actuator positions.
            values: (k,) values of the parameters.
            measured: (m, 8) unit dual quaternions in the base frame.

        Returns:
            error (m, 6), point of the model minus measured point [m] and rotation vector from
            measured to model [rad], and its Jacobian with respect to the parameters (m, 6, k).
        """
        error, jacobian = self._kernel(finger, "misfit")(q, values, measured)
        return error, jacobian.reshape(len(error), 6, len(values))

    def _kernel(self, finger: str, kind: str) -> FunctionKernel:
        key = (finger, kind)
        if key not in self._kernels:
            q = ca.SX.sym("q", len(self.robot.actuators))
            p = ca.SX.sym("p", len(self.parameters))
            pose = self._pose(finger, q, p)
            name = ca.Function.fix_name(f"calibrate_{kind}_{self.robot.name}_{finger}")
            if kind == "pose":
                function = ca.Function(name, [q, p], with_cse(ca.densify(pose)))
            else:
                measured = ca.SX.sym("measured", 8)
                rotation, _ = dq.log(dq.error(pose, measured))
                error = ca.vertcat(dq.translation(pose) - dq.translation(measured), rotation)
                outputs = with_cse(error, ca.densify(ca.jacobian(error, p)))
                function = ca.Function(name, [q, p, measured], outputs)
            self._kernels[key] = FunctionKernel(function, self.compiled)
        return self._kernels[key]

    @cached_property
    def _kernels(self) -> dict[tuple[str, str], FunctionKernel]:
        return {}

    def _pose(self, finger: str, q: ca.SX, p: ca.SX) -> Expr:
        """Return the tip pose as the product of the joint screws in their parent frames."""
        symbols = {parameter.name: p[i] for i, parameter in enumerate(self.parameters)}
        positions = {name: q[i] for i, name in enumerate(self.robot.actuator_names)}
        joints = {joint.name: joint for joint in self.robot.movable}

        def position(name: str) -> Expr:
            if name not in positions:
                joint = joints[name]
                source = position(joint.coupling.of)  # type: ignore[union-attr]
                positions[name] = follow(joint, source, _CouplingValues(joint, symbols))
            return positions[name]

        entry = self.robot.finger(finger)
        pose: Expr = dq.identity()
        for joint in self.robot.chain(entry.link):
            origin = _vector(symbols, joint.name, "origin", joint.placement[:3, 3])
            pose = dq.multiply(pose, dq.from_pose(ca.DM(joint.placement[:3, :3]), origin))
            if joint.type == "fixed":
                continue
            axis = tilted(joint.axis, _vector(symbols, joint.name, "axis", np.zeros(2)))
            value = position(joint.name)
            angle, distance = (value, 0.0) if joint.type == "revolute" else (0.0, value)
            motion = dq.exp_screw(angle, distance, axis, ca.DM.zeros(3, 1))
            pose = dq.multiply(pose, motion)
        point = _vector(symbols, finger, "tip", entry.placement[:3, 3])
        placement = dq.from_pose(ca.DM(entry.placement[:3, :3]), point)
        rotation = _vector(symbols, finger, "turn", np.zeros(3))
        return dq.multiply(dq.multiply(pose, placement), dq.exp(rotation, ca.DM.zeros(3, 1)))


def tilted(axis: Array, tilts: Expr) -> Expr:
    """Return a unit axis (3,) rotated by two perpendicular tilts (2, 1) [rad]."""
    first = perpendicular(ca.DM(axis.tolist()))
    tilt_axes = ca.horzcat(first, ca.cross(ca.DM(axis.tolist()), first))
    return exp_so3(tilt_axes @ tilts) @ ca.DM(axis.tolist())


class _CouplingValues:
    """Parameters of the coupling of a joint as attributes; symbols for free parameters."""

    def __init__(self, joint: Joint, symbols: dict[str, Expr]) -> None:
        self._joint, self._symbols = joint, symbols

    def __getattr__(self, key: str) -> Expr:
        return self._symbols.get(f"{self._joint.name}.{key}", getattr(self._joint.coupling, key))


def _vector(symbols: dict[str, Expr], owner: str, part: str, nominal: Array) -> Expr:
    """Return a vector with symbols in place of free entries."""
    keys: Sequence[str] = "12" if part == "axis" else "xyz"
    pairs = zip(keys, nominal, strict=True)
    return ca.vertcat(*(symbols.get(f"{owner}.{part}.{key}", float(value)) for key, value in pairs))
