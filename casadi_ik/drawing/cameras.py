"""Where robots are looked at from."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array

View = tuple[float, float]
"""Azimuth about z from x, and elevation above the horizon, of the viewer [rad]."""


def axes_of(view: View) -> Array:
    """(3, 3) unit rows: to the right, up, and towards the viewer."""
    (c, s), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in view)
    return np.array([[-s, c, 0.0], [-se * c, -se * s, ce], [ce * c, ce * s, se]])


def palm_places(robot: ArmHand, q: ArrayLike, *sides: str | None) -> Array:
    """(h, 3) where the palms of some hands are, or of all, base frame [m]."""
    return np.array([robot.palm(q, side)[:3, 3] for side in sides or robot.hands])


def close_view(robot: ArmHand, q: ArrayLike, *sides: str | None) -> View:
    """Where fingertips and palm are furthest apart in the image, and pads are seen from the side.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m].
        sides: The hands that are looked at; none: all.
    """
    fingers = [finger for side in sides or robot.hands for finger in robot.hands[side]]
    points, normals = (values[fingers] for values in robot.contacts(q))
    links, palms = robot.links(q), palm_places(robot, q, *sides)
    palm = palms.mean(axis=0)
    joints = [joint for joint in robot.description.joints if joint.part != "hand"]
    arm = np.mean([links[joint.parent][:3, 3] for joint in joints] or [palm], axis=0)
    spots = np.concatenate([points, palms])

    def score(view: View) -> float:
        axes = axes_of(view)
        flat = spots @ axes[:2].T
        gaps = np.linalg.norm(flat[:, None] - flat[None], axis=2)
        gap = gaps[np.triu_indices(len(spots), 1)].min()
        side = 1 - np.abs(normals @ axes[2]).max()
        hidden = max(0.0, float((arm - palm) @ axes[2]))  # behind the arm
        return float(gap + 0.03 * side - 0.05 * hidden - 0.01 * abs(view[1] - 0.35))

    azimuths = np.deg2rad(np.arange(0, 360, 10)).tolist()
    return max(product(azimuths, np.deg2rad([5, 15, 25, 35]).tolist()), key=score)


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
