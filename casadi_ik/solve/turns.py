"""Full revolutions of joints: solutions are moved to the revolution nearest to a reference.

A motor without limits may start a search in any revolution; its solution is moved to the revolution
nearest to q0. Hand-first does the same in C (hand_first.c), so that a batch, `fast` and an exported
solver agree.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch

TURN = 2 * np.pi
"""Full revolution [rad]."""


def search_start(robot: RobotDescription, q: Array) -> Array:
    """Return configurations with the motors without limits within half a revolution of zero.

    Args:
        robot: The robot.
        q: (..., n) configurations [rad or m].
    """
    if not robot.continuous.any():
        return q
    return np.where(robot.continuous, q - TURN * np.floor(q / TURN + 0.5), q)


def with_search_starts(robot: RobotDescription, targets: TargetBatch) -> TargetBatch:
    """Return targets with the start configurations of a search, see `search_start`."""
    q0 = robot.home if targets.q0 is None else targets.q0
    return targets.starting_at(search_start(robot, q0))


def nearest_turns(
    robot: RobotDescription,
    q: Array,
    reference: Array,
    bounds: tuple[Array, Array],
    every_motor: bool,
) -> Array:
    """Return solutions moved by full revolutions to be nearest to a reference.

    Args:
        robot: The robot.
        q: (..., n) solutions [rad or m].
        reference: (..., n) reference configurations [rad or m].
        bounds: (n,) or (..., n) lower and upper bounds; a motor with equal bounds is fixed.
        every_motor: True to move motors with limits too, within their bounds.
    """
    columns = list(robot.multi_turn)
    if not columns or not (every_motor or robot.continuous.any()):
        return q
    lower, upper = (np.broadcast_to(bound, q.shape)[..., columns] for bound in bounds)
    free = robot.continuous[columns] & (lower < upper)
    angles = q[..., columns]
    nearest_revolutions = np.floor((reference[..., columns] - angles) / TURN + 0.5)
    first_revolution, last_revolution = (
        np.ceil((lower - angles) / TURN),
        np.floor((upper - angles) / TURN),
    )
    revolutions_within_limits = (
        np.clip(
            nearest_revolutions, np.minimum(first_revolution, 0), np.maximum(last_revolution, 0)
        )
        if every_motor
        else 0.0
    )
    result = q.copy()
    result[..., columns] = angles + TURN * np.where(
        free, nearest_revolutions, revolutions_within_limits
    )
    return result


def in_nearest_turns(robot: RobotDescription, targets: TargetBatch, q: Array) -> Array:
    """Return solutions in the revolutions nearest to the starts, see `nearest_turns`.

    Args:
        robot: The robot.
        targets: k targets; motors with limits are moved if the preference is "q0".
        q: (k, n) solutions [rad or m].
    """
    if not robot.multi_turn:
        return q
    starts, bounds = targets.starts(robot), targets.bounds(robot)
    return nearest_turns(robot, q, starts, bounds, targets.prefers_q0)
