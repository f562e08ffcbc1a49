"""How much nearer the shapes of a pair can come while motors move: steps of motors times levers.

A distance changes by no more than points of one shape move seen from the other. Joints that carry
both shapes move them as one and do not count.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import Table
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.robots.linkage import joint_positions

GRID = 1025
"""Positions of a motor between which the rate of a joint that follows it is taken."""


def levers(robot: RobotDescription, table: Table) -> Array:
    """How far a unit of each motor moves the shapes of each pair against each other at most.

    Args:
        robot: With shapes.
        table: The pairs.

    Returns:
        (p, n) [m per rad or m].
    """
    shapes = robot.shapes
    arms = [_arms(robot, one.link, _ends(one.center, one.half), 0.0) for one in shapes.capsules]
    for one, solid in zip(shapes.solids, table.solids, strict=False):
        arms.append(_arms(robot, one.link, one.pose[None, :3, 3], solid.reach))
    # What stands about the robot is moved by nothing.
    arms += [np.zeros(len(robot.movable))] * (len(table.solids) - table.own)
    one, other = np.array(arms)[table.pairs.T]
    return np.where((one > 0) & (other > 0), 0.0, one + other) @ _rates(robot)


def _ends(center: Array, half: Array) -> Array:
    return np.stack([center - half, center + half])


def _arms(robot: RobotDescription, link: str, points: Array, about: float) -> Array:
    """(m,) how far points of a link can be from the axes of the joints that carry it [m].

    Args:
        robot: The description.
        link: The link.
        points: (k, 3) in its frame.
        about: Radius of the balls about them [m].

    Returns:
        Never zero for a joint that carries the link; 1 for one that slides.
    """
    found, places = (
        np.zeros(len(robot.movable)),
        {id(one): i for i, one in enumerate(robot.movable)},
    )
    for joint in reversed(robot.chain(link)):
        if joint.type != "fixed":
            found[places[id(joint)]] = _arm(joint, points, about)
            # It may turn them any way.
            about += float(np.sqrt((points * points).sum(axis=1).max()))
            if joint.type == "prismatic":
                about += max(abs(joint.lower), abs(joint.upper))
            points = np.zeros((1, 3))
        points = points @ joint.placement[:3, :3].T + joint.placement[:3, 3]
    return found


def _arm(joint: Joint, points: Array, about: float) -> float:
    if joint.type == "prismatic":
        return 1.0
    along = points @ joint.axis
    off = np.sqrt(np.maximum((points * points).sum(axis=1) - along * along, 0.0))
    return max(float(off.max()) + about, np.finfo(float).tiny)


def _rates(robot: RobotDescription) -> Array:
    """(m, n) how fast each joint moves at most for a unit of the motor that it follows."""
    motors = {name: i for i, name in enumerate(robot.actuator_names)}
    swept = np.linspace(robot.lower, robot.upper, GRID)
    positions = joint_positions(robot.joints, dict(zip(motors, swept.T, strict=True)))
    joints = {joint.name: joint for joint in robot.movable}
    rates = np.zeros((len(joints), len(motors)))
    for row, joint in zip(rates, robot.movable, strict=True):
        motor = joint.name
        while motor not in motors and (coupling := joints[motor].coupling) is not None:
            motor = coupling.of
        steps = np.diff(swept[:, motors[motor]])
        row[motors[motor]] = np.abs(np.diff(positions[joint.name]) / steps).max()
    return rates
