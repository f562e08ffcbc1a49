"""Configurations that make hard targets for the arm-hand, seeded."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik

ARM = 7
EXACT = ik.Tolerance(1e-6, 1e-6)


def near_limits(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> np.ndarray:
    """Every actuator by itself: a third within 1 deg of the lower limit, a third of the upper."""
    q = robot.random(rng, count)
    near = rng.uniform(0, np.radians(1), q.shape)
    where = rng.integers(0, 3, q.shape)
    return np.where(where == 0, robot.lower + near, np.where(where == 1, robot.upper - near, q))


def singular(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> np.ndarray:
    """Elbow straight, shoulder or wrist aligned, or all of them; to 1e-3 ... 1e-9 rad."""
    q = robot.random(rng, count)
    off = rng.normal(0, 1e-3, (count, 3)) * 10.0 ** -rng.integers(0, 6, (count, 1))
    which = rng.integers(0, 4, count)
    for j, column in enumerate((1, 3, 5)):
        rows = (which == j) | (which == 3)
        q[rows, column] = off[rows, j]
    return q


def shipped_hands(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> np.ndarray:
    """Hands of the shipped grasps on random arms."""
    arrays = [ik.load_grasp(name).arrays(robot.fingers) for name in ik.shipped_grasps(robot.name)]
    points, normals = (np.array(part) for part in zip(*arrays, strict=True))
    hands = ik.Solver(robot, tolerance=EXACT).solve_batch(points, normals).q[:, ARM:]
    q = robot.random(rng, count)
    q[:, ARM:] = hands[np.arange(count) % len(hands)]
    return q


def shipped_hands_on_singular_arms(robot, rng, count):
    """The hands of three parallel fingers leave a freedom, and the arm hardly any."""
    q = shipped_hands(robot, rng, count)
    q[:, :ARM] = singular(robot, rng, count)[:, :ARM]
    return q


def near_limits_on_singular_arms(robot, rng, count):
    q = near_limits(robot, rng, count)
    q[:, :ARM] = singular(robot, rng, count)[:, :ARM]
    return q


def any_configuration(robot, rng, count):
    return robot.random(rng, count)


HARD = (
    any_configuration,
    near_limits,
    singular,
    shipped_hands,
    shipped_hands_on_singular_arms,
    near_limits_on_singular_arms,
)
