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
    values = {name: q[i] for i, name in enumerate(robot.actuator_names)}
    joints = {joint.name: joint for joint in robot.movable}

    def value(name: str) -> ca.SX:
        if name not in values:
            values[name] = follow(joints[name], value(joints[name].coupling.of))  # type: ignore[union-attr]
        return values[name]

    return ca.vertcat(*(value(joint.name) for joint in robot.movable))


def follow(joint: Joint, source: ca.SX) -> ca.SX:
    """Position of a coupled joint [rad or m] from the position of what it follows."""
    coupling = joint.coupling
    if isinstance(coupling, LeadScrew):
        return lead_screw.angle_from_slider(source, coupling.b, coupling.c) - coupling.theta_0
    if isinstance(coupling, FourBar):
        bar = four_bar.FourBar(coupling.p, coupling.q, coupling.g, coupling.h, coupling.branch)
        reference = coupling.theta_3_0
        return four_bar.theta3(coupling.phi_0 + source, bar, reference) - reference
    if coupling is None:
        return source
    return coupling.ratio * source + coupling.offset
