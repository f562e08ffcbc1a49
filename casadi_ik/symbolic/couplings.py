"""From actuators to joints: the map theta = c(q) and its Jacobian, by kind of coupling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca

from casadi_ik.errors import UnsupportedError
from casadi_ik.robots.couplings import Coupling, FourBar, LeadScrew, Linear, Polynomial
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.symbolic import four_bar, lead_screw
from casadi_ik.symbolic.smooth import Expr


class CouplingRow(NamedTuple):
    """The graphs of a kind of coupling.

    All take the coupling's numbers (anything with their names as attributes: the data, or symbols
    where a calibration estimates them), the position of what is followed [rad or m] and the data as
    described, from which branches are taken.

    Attributes:
        follow: Position of the joint [rad or m].
        rate: Its derivative by the position of what it follows.
        toggle: Squared sine of the transmission angle, see `toggle_margins`; None if the kind has
            no singular position.
    """

    follow: Callable[[Any, Expr, Any], Expr]
    rate: Callable[[Any, Expr, Any], Expr]
    toggle: Callable[[Any, Expr, Any], Expr] | None = None


def linkage(numbers: Any, known: FourBar) -> four_bar.Linkage:
    """A four-bar with the branch of the known pose (phi_0, theta_3_0) of its description."""
    described = four_bar.Linkage(known.p, known.q, known.g, known.h)
    branch = four_bar.branch_from_pose(described, known.phi_0, known.theta_3_0)
    return four_bar.Linkage(numbers.p, numbers.q, numbers.g, numbers.h, branch)


def _bent(numbers: Any, source: Expr, known: FourBar) -> Expr:
    # Continuous about the known pose, whatever the estimate of its angle.
    bar, phi = linkage(numbers, known), numbers.phi_0 + source
    return four_bar.theta3(phi, bar, known.theta_3_0) - numbers.theta_3_0


def _horner(coefficients: Sequence[float], source: Expr) -> Expr:
    """A polynomial, its constant first."""
    value: Expr = ca.DM(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * source + coefficient
    return value


def _slopes(coefficients: Sequence[float]) -> list[float]:
    """The coefficients of a polynomial's derivative."""
    return [power * value for power, value in enumerate(coefficients)][1:]


ROWS: dict[type[Any], CouplingRow] = {
    Linear: CouplingRow(
        follow=lambda c, source, _: c.ratio * source + c.offset,
        rate=lambda c, _, __: ca.DM(c.ratio),
    ),
    LeadScrew: CouplingRow(
        follow=lambda c, s, _: lead_screw.angle_from_slider(s, c.b, c.c) - c.theta_0,
        rate=lambda c, s, _: lead_screw.angle_rate(s, c.b, c.c),
        toggle=lambda c, s, _: lead_screw.toggle(s, c.b, c.c),
    ),
    Polynomial: CouplingRow(
        follow=lambda c, x, _: _horner(c.coefficients, x),
        rate=lambda c, x, _: _horner(_slopes(c.coefficients), x),
    ),
    FourBar: CouplingRow(
        follow=_bent,
        rate=lambda c, x, known: four_bar.theta3_rate(c.phi_0 + x, linkage(c, known)),
        toggle=lambda c, x, known: four_bar.toggle(c.phi_0 + x, linkage(c, known)),
    ),
}
"""The kinds of couplings."""


def coupling_row(coupling: Coupling) -> CouplingRow:
    """The row of a coupling's kind.

    Raises:
        UnsupportedError: There is none.
    """
    try:
        return ROWS[type(coupling)]
    except KeyError:
        kind = type(coupling).__name__
        raise UnsupportedError(f"coupling: no graphs for the kind {kind}") from None


def joint_positions(robot: RobotDescription, q: ca.SX) -> ca.SX:
    """Positions of all movable joints.

    Args:
        robot: The description; its couplings form chains that end at actuators.
        q: (n, 1) actuator positions [rad or m].

    Returns:
        theta (m, 1) in the order of `robot.joint_names`.
    """
    values = _positions(robot, q)
    return ca.vertcat(*(values[name] for name in robot.joint_names))


def toggle_margins(robot: RobotDescription, q: ca.SX) -> dict[str, ca.SX]:
    """How far every mechanism that has a singular (toggle) position is from it.

    Args:
        robot: The description.
        q: (n, 1) actuator positions [rad or m].

    Returns:
        By joint that follows such a coupling the squared sine of its transmission angle: 1 at
        best, 0 where the joint's rate over its source blows up, negative where the mechanism
        cannot be assembled. Smooth, never NaN.
    """
    values = _positions(robot, q)
    margins = {}
    for joint in robot.movable:
        coupling = joint.coupling
        if coupling is not None and (toggle := coupling_row(coupling).toggle) is not None:
            margins[joint.name] = toggle(coupling, values[coupling.of], coupling)
    return margins


def has_toggle(joint: Joint) -> bool:
    """Whether a joint follows through a mechanism that has a singular position."""
    return joint.coupling is not None and coupling_row(joint.coupling).toggle is not None


def _positions(robot: RobotDescription, q: ca.SX) -> dict[str, ca.SX]:
    """Positions of all actuators and movable joints by name."""
    values = {name: q[i] for i, name in enumerate(robot.actuator_names)}
    joints = {joint.name: joint for joint in robot.movable}

    def value(name: str) -> ca.SX:
        if name not in values:
            values[name] = follow(joints[name], value(joints[name].coupling.of))  # type: ignore[union-attr]
        return values[name]

    for name in joints:
        value(name)
    return values


def follow(joint: Joint, source: Expr, numbers: Any = None) -> Expr:
    """Position of a joint [rad or m] from the position of what it follows.

    Args:
        joint: The joint; one that follows nothing stands where the source does.
        source: [rad or m].
        numbers: Other numbers of the coupling, as attributes; None: those described.
    """
    coupling = joint.coupling
    if coupling is None:
        return source
    return coupling_row(coupling).follow(numbers or coupling, source, coupling)


def coupling_rate(joint: Joint, source: Expr) -> Expr:
    """Rate d theta / d source of a joint that follows something: eq. (10), for every coupling.

    Args:
        joint: The joint; one that follows nothing has rate 1.
        source: Position of what it follows [rad or m].

    Returns:
        For a four-bar f of eq. (11), for a lead screw the derivative of eq. (8) [rad/m].
    """
    coupling = joint.coupling
    if coupling is None:
        return ca.DM(1)
    return coupling_row(coupling).rate(coupling, source, coupling)
