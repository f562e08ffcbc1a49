"""Fingers that spread about one axis and flex in a plane: geometry, recognised from kinematics.

Such a finger has, from the palm outwards, at most one spread joint and then two parallel flexion
joints whose axes are perpendicular to the spread axis, and its pad normal lies in the flexion
plane. Its normal is then the one of Qiu & Kermani 2021, eq. (4): it depends on the spread and on
the sum of the flexions only. Angles and vectors here are in the *finger frame*, fixed in the palm:
z along the spread axis, y along the flexion axis at zero spread, origin on the spread axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.symbolic.kinematics import forward, number

ALIGNED = 1e-9


@dataclass(frozen=True, eq=False)
class PlanarFinger:
    """The constants of a planar finger.

    Attributes:
        name: The finger.
        spread: Position in q of the spread actuator, or None.
        ratio: Spread joint angle per unit of its actuator.
        offset: Spread joint angle at actuator zero [rad].
        spread_limits: (2,) limits of the spread joint [rad]; zeros without spread.
        flexion: Positions in q of the two flexion actuators, proximal first.
        flexion_limits: (2, 2) their [lower, upper] [rad].
        frame: (4, 4) pose of the finger frame in the palm frame.
        normal_angle: Angle a_0 of the pad normal from z towards x at zero flexion [rad].
        proximal: (3,) a point of the first flexion axis, finger frame [m].
        middle: (3,) from there to the second flexion axis at zero flexion [m].
        tip: (3,) from there to the contact at zero flexion [m].
        facing: +1 if the pad faces +x of the finger frame over the flexion range, else -1.
    """

    name: str
    spread: int | None
    ratio: float
    offset: float
    spread_limits: Array
    flexion: tuple[int, int]
    flexion_limits: Array
    frame: Array
    normal_angle: float
    proximal: Array
    middle: Array
    tip: Array
    facing: float


def planar_finger(robot: RobotDescription, name: str) -> PlanarFinger:
    """Recognise a planar finger.

    Args:
        robot: The description.
        name: The finger.

    Raises:
        UnsupportedError: The finger is built otherwise; the message says how.
    """
    joints = {joint.name: joint for joint in robot.movable}
    chain = [joints[joint] for joint in robot.finger(name).joints]
    where = f"robot {robot.name!r}: finger {name!r} is not a planar finger"
    if len(chain) not in (2, 3) or any(joint.type != "revolute" for joint in chain):
        raise UnsupportedError(
            f"{where}: it has joints {[joint.name for joint in chain]}; expected an optional "
            "spread joint and two flexion joints, all revolute"
        )
    flexion = chain[-2:]
    for joint in flexion:
        if joint.coupling is not None:
            raise UnsupportedError(
                f"{where}: {joint.name} follows {joint.coupling.of!r}; expected its own motor"
            )
    origins, axes, contact, normal = _reference(robot, name, chain)
    y = axes[-2]
    spread_joint = chain[0] if len(chain) == 3 else None
    z = axes[0] if spread_joint else _across(normal, y)
    if abs(y @ axes[-1] - 1) > ALIGNED or abs(y @ z) > ALIGNED or abs(y @ normal) > ALIGNED:
        raise UnsupportedError(f"{where}: its flexion axes are not parallel or not in plane")
    x = np.cross(y, z)
    to_finger = np.stack([x, y, z])
    frame = np.eye(4)
    frame[:3, :3] = to_finger.T
    frame[:3, 3] = origins[0] if spread_joint else origins[-2]
    a_0 = float(np.arctan2(normal @ x, normal @ z))
    limits = np.array([[joint.lower, joint.upper] for joint in flexion])
    index, ratio, offset = _spread(robot, spread_joint, where)
    return PlanarFinger(
        name=name,
        spread=index,
        ratio=ratio,
        offset=offset,
        spread_limits=np.array(
            [spread_joint.lower, spread_joint.upper] if spread_joint else [0.0, 0.0]
        ),
        flexion=(
            robot.actuator_index(flexion[0].name),
            robot.actuator_index(flexion[1].name),
        ),
        flexion_limits=limits,
        frame=frame,
        normal_angle=a_0,
        proximal=to_finger @ (origins[-2] - frame[:3, 3]),
        middle=to_finger @ (origins[-1] - origins[-2]),
        tip=to_finger @ (contact - origins[-1]),
        facing=1.0 if np.sin(a_0 + limits.sum() / 2) >= 0 else -1.0,
    )


def _spread(
    robot: RobotDescription, joint: Joint | None, where: str
) -> tuple[int | None, float, float]:
    if joint is None:
        return None, 1.0, 0.0
    if joint.coupling is None:
        return robot.actuator_index(joint.name), 1.0, 0.0
    coupling = joint.coupling
    if coupling.slope is None or coupling.of not in robot.actuator_names:
        raise UnsupportedError(f"{where}: {joint.name} does not follow a motor linearly")
    return robot.actuator_index(coupling.of), *coupling.slope


def _reference(
    robot: RobotDescription, name: str, chain: list[Joint]
) -> tuple[list[Array], list[Array], Array, Array]:
    """Origins and axes of the chain, contact and normal at theta = 0, in the palm frame."""
    kinematics = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    palm = kinematics.palm
    point, normal = kinematics.contact(name)
    points = [kinematics.links[joint.child].origin for joint in chain] + [point]
    directions = [kinematics.axes[joint.name] for joint in chain] + [normal]
    turned = [number(palm.rotation.T @ direction) for direction in directions]
    moved = [number(palm.inverse_apply(p)) for p in points]
    return moved[:-1], turned[:-1], moved[-1], turned[-1]


def _across(normal: Array, y: Array) -> Array:
    """A direction perpendicular to the flexion axis, for a finger without spread."""
    z = normal - (normal @ y) * y
    return z / np.linalg.norm(z)
