"""Configurations that are hard for any robot; their contacts are reachable by construction."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik
from casadi_ik.arrays import Array

DRAWS = 32
"""Arms of which the one nearest to a singularity is taken."""

AMID = 0.6
"""Where the one arm of random hands stands within its limits."""

NUDGE = 1e-6
"""Difference [rad or m] from which slopes are taken."""

LENGTH = 0.1
"""This many metres weigh like a radian."""


def random_hands(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Every actuator uniform within its limits."""
    return robot.random(rng, count)


def hands_on_one_arm(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Random hands on an arm amid its limits: what a hand can do is what is tried."""
    q = robot.random(rng, count)
    arm = list(robot.description.arm_actuators)
    q[:, arm] = (robot.lower + AMID * (robot.upper - robot.lower))[arm]
    return q


def corners(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Every actuator by itself at its lower limit, at its upper one or anywhere."""
    q, where = robot.random(rng, count), rng.integers(0, 3, (count, len(robot.lower)))
    return np.where(where == 0, robot.lower, np.where(where == 1, robot.upper, q))


def close_to_limits(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Likewise, within 1 deg of the limit; a slider within a fiftieth of its stroke."""
    q = robot.random(rng, count)
    turning = [actuator.unit == "rad" for actuator in robot.description.actuators]
    widest = np.where(turning, np.radians(1), (robot.upper - robot.lower) / 50)
    near = rng.uniform(0, np.minimum(widest, robot.upper - robot.lower), q.shape)
    where = rng.integers(0, 3, q.shape)
    return np.where(where == 0, robot.lower + near, np.where(where == 1, robot.upper - near, q))


def singular_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands at corners on arms that are the nearest to singular of several."""
    q, arm = corners(robot, rng, count), list(robot.description.arm_actuators)
    if not arm:
        return q
    draws = robot.random(rng, count * DRAWS)
    smallest = palm_slopes(robot, draws).reshape(count, DRAWS)
    chosen = draws.reshape(count, DRAWS, -1)[np.arange(count), smallest.argmin(axis=1)]
    q[:, arm] = chosen[:, arm]
    return q


def palm_slopes(robot: ik.ArmHand, q: Array) -> Array:
    """(k,) smallest singular value of how the palm moves with the arm, metres by `LENGTH`."""
    arm = list(robot.description.arm_actuators)
    here = robot.palm(q)
    rows = []
    for column in arm:
        moved = q.copy()
        moved[:, column] += NUDGE
        change = (robot.palm(moved) - here) / NUDGE
        turned = change[:, :3, :3] @ here[:, :3, :3].transpose(0, 2, 1)
        turn = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1)
        rows.append(np.concatenate([change[:, :3, 3] / LENGTH, turn], axis=1))
    return np.linalg.svd(np.stack(rows, axis=2), compute_uv=False)[:, -1]


def contact_slopes(robot: ik.ArmHand, q: Array) -> Array:
    """(k,) smallest singular value of how all contacts move with all motors, elbow aside.

    Where it is small the contacts hardly tell where the motors are. An arm of more than six joints
    moves without moving the palm; that motion is not counted.
    """
    points, normals = robot.contacts(q)
    columns = []
    ranges = robot.upper - robot.lower
    for column in range(q.shape[1]):
        moved = q.copy()
        step = NUDGE * min(1.0, float(ranges[column]))
        moved[:, column] += step
        there = robot.contacts(moved)
        scale = min(1.0, float(ranges[column])) / step
        change = [(there[0] - points) / LENGTH * scale, (there[1] - normals) * scale]
        columns.append(np.concatenate([part.reshape(len(q), -1) for part in change], axis=1))
    values = np.linalg.svd(np.stack(columns, axis=2), compute_uv=False)
    spare = max(len(robot.description.arm_actuators) - 6, 0)
    # A point and a direction are five numbers.
    return values[:, min(q.shape[1] - spare, 5 * len(robot.fingers)) - 1]


SETS = {
    "random hands": random_hands,
    "hands on one arm": hands_on_one_arm,
    "corners": corners,
    "near limits": close_to_limits,
    "corners on near-singular arms": singular_arms,
}
"""What is tried, by name."""
