"""Targets that leave the reach of a robot and come back."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

import casadi_ik as ik


def excursion(
    robot: ik.ArmHand, q: np.ndarray, kind: str, period: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield contacts that start at a posture, leave it smoothly, come back, and wait for 4 s there.

    Args:
        robot: The robot.
        q: (n,) posture.
        kind: "out" is 1 m away from the base, or forward for a body with two hands; "turn" is
            170 degrees about the middle of each hand's contacts.
        period: Time from target to target [s].
    """
    points, normals = robot.contacts(q)
    sides = robot.description.sides
    hands = [[robot.fingers.index(name) for name in side.fingers] for side in sides]
    hands = hands or [list(range(len(robot.fingers)))]
    u = np.linspace(0, 1, round((4.7 if kind == "out" else 2.0) / period))
    smooth = u**3 * (10 - 15 * u + 6 * u**2)
    axes = np.random.default_rng(0).normal(size=(len(hands), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for share in np.concatenate([smooth, smooth[::-1], np.zeros(round(4 / period))]):
        moved_points, turned_normals = points.copy(), normals.copy()
        for rows, axis in zip(hands, axes, strict=True):
            middle = points[rows].mean(axis=0)
            if kind == "out":
                direction = np.array([1.0, 0.0, 0.0]) if sides else middle / np.linalg.norm(middle)
                moved_points[rows] += share * direction
            else:
                turn = Rotation.from_rotvec(share * np.radians(170) * axis)
                moved_points[rows] = middle + turn.apply(points[rows] - middle)
                turned_normals[rows] = turn.apply(normals[rows])
        yield moved_points, turned_normals
