"""Where a robot starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.robots.description import Actuator, Joint, frozen
from casadi_ik.robots.motor_ranges import motor_ranges


def the_home(
    home: dict[str, float],
    units: dict[str, str],
    actuators: Sequence[Actuator],
    joints: Sequence[Joint],
    where: str,
) -> Array:
    """The home position (n,); where nothing is said, the position nearest to zero.

    Args:
        home: Positions by actuator [rad or m].
        units: Unit of those that were given with one, by key ("home.NAME").
        actuators: The motors.
        joints: All joints.
        where: The robot's file, for messages.

    Raises:
        DescriptionError: An unknown actuator, a wrong unit, or a position beyond limits.
    """
    names = [actuator.name for actuator in actuators]
    for name in home:
        if name not in names:
            raise DescriptionError(
                f"{where}: home.{name}: no such actuator; known: {', '.join(names)}"
            )
    for actuator in actuators:
        unit = units.get(f"home.{actuator.name}", actuator.unit)
        if unit != actuator.unit:
            raise DescriptionError(
                f"{where}: home.{actuator.name}: found a number in {unit}, expected {actuator.unit}"
            )
    asked = np.array([home.get(name, 0.0) for name in names])
    movable = [joint for joint in joints if joint.type != "fixed"]
    lower, upper = motor_ranges(movable, actuators, asked, where)
    values = np.clip(asked, lower, upper)
    for name, value, low, high in zip(names, asked, lower, upper, strict=True):
        if name in home and not low <= value <= high:
            raise DescriptionError(
                f"{where}: home.{name}: {value:.6g} is outside the limits [{low:.6g}, {high:.6g}] "
                "of the actuator and its joints"
            )
    return frozen(values)
