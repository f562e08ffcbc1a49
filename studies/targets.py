"""Configurations whose contacts are the targets of studies: reachable by construction."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

import casadi_ik as ik

Array = NDArray[np.float64]


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


@cache
def _posture(grasp: str) -> tuple[tuple[str, float], ...]:
    return tuple(ik.load_grasp(grasp).posture.items())
