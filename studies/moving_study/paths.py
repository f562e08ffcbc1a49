"""Paths of a robot that moves smoothly, from rest."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.motion.rates import own_velocities

EASE = 0.5
"""Seconds in which a path comes to its speed."""


def smooth_path(robot: ik.ArmHand, seed: int, count: int, period: float, share: float) -> Array:
    """(count, n) sums of slow sines about a posture, within limits, that begin at rest.

    Args:
        robot: The robot.
        seed: Of the path.
        count: Of its postures.
        period: Time between two of them [s].
        share: Most of any motor's velocity, and of the acceleration that reaches it in 0.25 s.
    """
    rng = np.random.default_rng(seed)
    middle, half = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 2
    centre = middle + 0.4 * half * rng.uniform(-1, 1, len(middle))
    # From rest: the first half second passes slowly.
    share_of_time = np.minimum(period * np.arange(count) / EASE, 1.0)
    time = np.cumsum(period * share_of_time**2 * (3 - 2 * share_of_time))[:, None]
    path = np.zeros((count, len(middle)))
    for _ in range(3):
        rate = rng.uniform(0.2, 1.0, len(middle))
        path += np.sin(2 * np.pi * rate * time + rng.uniform(0, 2 * np.pi, len(middle)))
    room = np.minimum(robot.upper - centre, centre - robot.lower)
    path *= 0.5 * room / np.abs(path).max(axis=0)
    limits = own_velocities(robot)
    speed = (np.abs(np.diff(path, axis=0)) / (period * limits)).max(axis=0)
    change = (np.abs(np.diff(path, 2, axis=0)) / (period**2 * limits / 0.25)).max(axis=0)
    return centre + path * np.minimum(1.0, share / np.maximum(speed, change))
