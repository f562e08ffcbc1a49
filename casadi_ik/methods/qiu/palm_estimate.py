"""The palm orientation that the contact points suggest (Qiu & Kermani 2021, eqs. 1 and 2)."""

from __future__ import annotations

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.problem.target import Target
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import forward, number
from casadi_ik.symbolic.smooth import safe_norm


def axes_through(points: list[ca.SX]) -> ca.SX:
    """The frame of eqs. (1) and (2) through three or more points.

    X runs from the last point to the second, Y from the middle of those towards the first (the
    thumb), Z = X x Y, and X = Y x Z makes them orthogonal.

    Args:
        points: Points (3, 1) [m], the thumb's first.

    Returns:
        R (3, 3) with columns X, Y, Z.
    """
    thumb, second, last = points[0], points[1], points[-1]
    x = second - last
    y = thumb - (second + last) / 2
    z = ca.cross(x, y)
    z = z / ca.fmax(safe_norm(z), 1e-12)
    y = y / ca.fmax(safe_norm(y), 1e-12)
    return ca.horzcat(ca.cross(y, z), y, z)


def base_axes(robot: RobotDescription) -> Array:
    """The same frame through the fingers' base points, in the palm frame (3, 3).

    The paper's palm frame has it as the identity; another hand's palm frame may be turned.

    Raises:
        UnsupportedError: The robot has fewer than three fingers.
    """
    if len(robot.fingers) < 3:
        raise UnsupportedError(
            f"robot {robot.name!r} has {len(robot.fingers)} fingers; the palm estimate of "
            "eqs. (1) and (2) needs at least three"
        )
    kinematics = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    child = {joint.name: joint.child for joint in robot.movable}
    origins = [
        kinematics.palm.inverse_apply(kinematics.links[child[robot.finger(name).joints[0]]].origin)
        for name in thumb_first(robot)
    ]
    return number(axes_through(origins)).reshape(3, 3)


def palm_orientation(robot: RobotDescription, goal: dict[str, Target]) -> ca.SX:
    """Estimated palm orientation (3, 3) in the frame of the targets.

    The contact points stand in for the fingers' base points.
    """
    points = [goal[name].point for name in thumb_first(robot)]
    return ca.densify(axes_through(points) @ ca.SX(ca.DM(base_axes(robot).T)))


def thumb_first(robot: RobotDescription) -> tuple[str, ...]:
    """Finger names with the thumb in front."""
    others = tuple(name for name in robot.finger_names if name != robot.thumb)
    return (robot.thumb, *others)
