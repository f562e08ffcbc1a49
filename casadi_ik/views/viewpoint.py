"""From where a grasp is seen best."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.views.camera import camera_at

Array = NDArray[np.float64]

View = tuple[float, float]
"""Azimuth about z from x, and elevation above the horizon [rad]."""

AZIMUTHS = np.deg2rad(np.arange(0, 360, 10))
ELEVATIONS = np.deg2rad([5, 15, 25, 35])


def close_view(robot: ArmHand, q: ArrayLike) -> View:
    """Where fingertips and palm are furthest apart in the image, and pads are seen from the side.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m].
    """
    points, normals = robot.contacts(q)
    links = robot.links(q)
    palm = robot.palm(q)[:3, 3]
    # What may hide the hand: the arm.
    arm = np.array(
        [links[joint.parent][:3, 3] for joint in robot.description.joints if joint.part != "hand"]
        or [palm]
    )
    spots = np.concatenate([points, palm[None]])
    best, chosen = -np.inf, (0.0, 0.0)
    for azimuth in AZIMUTHS.tolist():
        for elevation in ELEVATIONS.tolist():
            camera = camera_at(azimuth, elevation, spots, (100, 100))
            flat = spots @ np.stack([camera.right, camera.up], axis=1)
            gaps = np.linalg.norm(flat[:, None] - flat[None], axis=2)
            gap = gaps[np.triu_indices(len(spots), 1)].min()
            side = 1 - np.abs(normals @ camera.towards).max()
            hidden = max(0.0, float((arm.mean(axis=0) - palm) @ camera.towards))
            score = gap + 0.03 * side - 0.05 * hidden - 0.01 * abs(elevation - 0.35)
            if score > best:
                best, chosen = float(score), (azimuth, elevation)
    return chosen


def whole_view(target: Array, close: View) -> View:
    """From the side of an arm that reaches for a target, on the side of the close-up.

    Args:
        target: (3,) what is to be grasped, in the base frame [m].
        close: How the close-up is seen.
    """
    elevation = float(np.deg2rad(18.0))
    if np.hypot(target[0], target[1]) < 0.05:
        return close[0], elevation
    along = float(np.arctan2(target[1], target[0]))
    sides = (along + np.deg2rad(65.0), along - np.deg2rad(65.0))
    return max(sides, key=lambda side: float(np.cos(side - close[0]))), elevation
