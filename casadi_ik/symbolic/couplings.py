"""From actuators to joints: the map theta = c(q) and its Jacobian."""

from __future__ import annotations

import casadi as ca

from casadi_ik.robots.couplings import FourBar, LeadScrew
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.symbolic import four_bar, lead_screw


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
    """How far every lead screw and four-bar is from its singular (toggle) position.

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
        if isinstance(coupling, LeadScrew):
            margins[joint.name] = lead_screw.toggle(values[coupling.of], coupling.b, coupling.c)
        elif isinstance(coupling, FourBar):
            phi = coupling.phi_0 + values[coupling.of]
            margins[joint.name] = four_bar.toggle(phi, linkage(coupling))
    return margins


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


def follow(joint: Joint, source: ca.SX) -> ca.SX:
    """Position of a coupled joint [rad or m] from the position of what it follows."""
    coupling = joint.coupling
    if isinstance(coupling, LeadScrew):
        return lead_screw.angle_from_slider(source, coupling.b, coupling.c) - coupling.theta_0
    if isinstance(coupling, FourBar):
        reference = coupling.theta_3_0
        return four_bar.theta3(coupling.phi_0 + source, linkage(coupling), reference) - reference
    if coupling is None:
        return source
    return coupling.ratio * source + coupling.offset


def linkage(coupling: FourBar) -> four_bar.FourBar:
    """A described four-bar with the branch of its known pose (phi_0, theta_3_0)."""
    bar = four_bar.FourBar(coupling.p, coupling.q, coupling.g, coupling.h)
    return bar._replace(branch=four_bar.branch_from_pose(bar, coupling.phi_0, coupling.theta_3_0))
