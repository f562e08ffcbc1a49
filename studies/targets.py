"""Configurations whose contacts are the targets of studies: reachable by construction."""

from __future__ import annotations

from functools import cache

import numpy as np

import casadi_ik as ik
from casadi_ik.arrays import Array


def grasp_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int, grasp: str) -> Array:
    """A grasp's hand posture, held as the grasp file says, on uniformly random arms.

    As in Qiu & Kermani 2021, section III: "for each hand configuration, randomly generate 10,000
    arm configurations that are uniformly distributed within the arm's joint limits".

    Args:
        robot: The robot.
        rng: Source of the arm configurations.
        count: Arm configurations.
        grasp: A shipped grasp.

    Returns:
        (count, n) configurations.
    """
    q = robot.random(rng, count)
    for actuator, value in _posture(grasp):
        q[:, robot.actuators.index(actuator)] = value
    return q


def random_arm_targets(
    robot: ik.ArmHand, names: tuple[str, ...], count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Contacts of `grasp_arms` of several grasps.

    Returns:
        points [m] and normals, (len(names) * count, f, 3), grasp by grasp.
    """
    return robot.contacts(np.concatenate([grasp_arms(robot, rng, count, name) for name in names]))


def any_configuration(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Every actuator uniform within its limits: a random hand on a random arm."""
    return robot.random(rng, count)


def near_limits(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Every actuator by itself: a third within 1 deg of the lower limit, a third of the upper."""
    q = robot.random(rng, count)
    near = rng.uniform(0, np.radians(1), q.shape)
    where = rng.integers(0, 3, q.shape)
    return np.where(where == 0, robot.lower + near, np.where(where == 1, robot.upper - near, q))


def singular(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Elbow straight, shoulder or wrist aligned, or all of them; to 1e-3 ... 1e-9 rad."""
    q = robot.random(rng, count)
    off = rng.normal(0, 1e-3, (count, 3)) * 10.0 ** -rng.integers(0, 6, (count, 1))
    which = rng.integers(0, 4, count)
    for j, column in enumerate((1, 3, 5)):
        rows = (which == j) | (which == 3)
        q[rows, column] = off[rows, j]
    return q


def shipped_hands(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands of the shipped grasps, one after the other, on random arms."""
    names = ik.shipped_grasps(robot.name)
    parts = [grasp_arms(robot, rng, -(-count // len(names)), name) for name in names]
    return np.stack(parts, axis=1).reshape(-1, len(robot.actuators))[:count]


def shipped_hands_on_singular_arms(
    robot: ik.ArmHand, rng: np.random.Generator, count: int
) -> Array:
    """The hands of three parallel fingers leave a freedom, and the arm hardly any."""
    return _on_singular_arms(robot, rng, shipped_hands(robot, rng, count))


def near_limits_on_singular_arms(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands near their limits on arms near a singularity."""
    return _on_singular_arms(robot, rng, near_limits(robot, rng, count))


HARD = (
    any_configuration,
    near_limits,
    singular,
    shipped_hands,
    shipped_hands_on_singular_arms,
    near_limits_on_singular_arms,
)
"""Everything that is hard for an arm-hand."""


def _on_singular_arms(robot: ik.ArmHand, rng: np.random.Generator, q: Array) -> Array:
    arm = list(robot.description.arm_actuators)
    q[:, arm] = singular(robot, rng, len(q))[:, arm]
    return q


@cache
def _posture(grasp: str) -> tuple[tuple[str, float], ...]:
    return tuple(ik.load_grasp(grasp).posture.items())
