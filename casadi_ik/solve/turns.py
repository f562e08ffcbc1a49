"""Full turns of joints: the answer nearest to a reference counts them.

A motor without limits has no border: a search may begin in any of its turns, and its answer is
moved to the turn nearest to where the robot is. Hand-first does the same in C (hand_first.c), so
that a batch, `fast` and an exported solver agree.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch

TURN = 2 * np.pi


def search_start(robot: RobotDescription, q: Array) -> Array:
    """Return configurations (..., n) with motors without limits within half a turn of zero.

    Args:
        robot: The robot.
        q: (..., n) where the robot is [rad or m].
    """
    if not robot.continuous.any():
        return q
    return np.where(robot.continuous, q - TURN * np.floor(q / TURN + 0.5), q)


def nearest_turns(
    robot: RobotDescription,
    q: Array,
    reference: Array,
    bounds: tuple[Array, Array],
    every_motor: bool,
) -> Array:
    """Return answers with motors moved by full turns to be nearest to a reference.

    Args:
        robot: The robot.
        q: (..., n) answers [rad or m].
        reference: (..., n) configurations to be near [rad or m].
        bounds: (n,) or (..., n) lower and upper; a motor whose bounds are equal is held.
        every_motor: True: motors with limits too, within their bounds; False: only motors
            without limits.
    """
    columns = list(robot.turning)
    if not columns or not (every_motor or robot.continuous.any()):
        return q
    lower, upper = (np.broadcast_to(end, q.shape)[..., columns] for end in bounds)
    free = robot.continuous[columns] & (lower < upper)
    angles = q[..., columns]
    turns = np.floor((reference[..., columns] - angles) / TURN + 0.5)
    least, most = np.ceil((lower - angles) / TURN), np.floor((upper - angles) / TURN)
    limited = np.clip(turns, np.minimum(least, 0), np.maximum(most, 0)) if every_motor else 0.0
    moved = q.copy()
    moved[..., columns] = angles + TURN * np.where(free, turns, limited)
    return moved


def in_nearest_turns(robot: RobotDescription, targets: TargetBatch, q: Array, q0: Array) -> Array:
    """Return the answers to targets in the turns nearest to q0, see `nearest_turns`.

    Args:
        robot: The robot.
        targets: k targets; motors with limits are moved if they prefer "q0".
        q: (k, n) or (n,) answers [rad or m].
        q0: (k, n) or (n,) where the robot is [rad or m].
    """
    return nearest_turns(robot, q, q0, targets.bounds(robot), targets.prefer == "q0")
