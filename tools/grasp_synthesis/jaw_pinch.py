"""A pinch between two parallel pads: it opens by the object's width and stands about its middle."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.optimize import root_scalar

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.grasps import GraspObject
from grasp_synthesis.fingertip_pinch import TipPinch

EDGE = 0.01  # [m] smallest distance of a pad's middle from the ends of the object's axis
EXACT = 1e-12  # [m] from the surface


def jaw_pinches(
    robot: ik.ArmHand,
    item: GraspObject,
    fingers: tuple[str, str],
    axes: Array,
    jaw: int,
    idle: Array,
    rng: np.random.Generator,
    count: int,
) -> Iterator[TipPinch]:
    """Pinches along an axis of the object through its upright one; the first stands as it is.

    Args:
        robot: The arm-hand.
        item: The object; the same on both sides.
        fingers: The two.
        axes: (3, 3) object axes x, y, z, rows, in the hand's root frame.
        jaw: Number of the axis that is pinched.
        idle: (n,) where all motors stand but the one that opens the hand.
        rng: Source of how the others are held.
        count: How many.
    """
    description = robot.description
    (motor,) = description.finger_actuators(fingers[0])
    rows = [robot.fingers.index(name) for name in fingers]
    out = np.eye(3)[jaw]

    def pads(value: float) -> tuple[Array, Array]:
        q = idle.copy()
        q[motor] = value
        root = robot.links(q)[description.palm_link]
        return q, (robot.contacts(q)[0][rows] - root[:3, 3]) @ root[:3, :3]

    def root(function: Callable[[float], float], ends: tuple[float, float]) -> float:
        return float(root_scalar(function, bracket=ends, method="brentq", xtol=1e-15).root)

    half = root(lambda x: float(item.signed_distance(x * out[None])[0]), (0.0, 1.0))

    def gap(value: float) -> float:
        return float(np.linalg.norm(np.subtract(*pads(value)[1]))) - 2 * half

    ends = float(robot.lower[motor]), float(robot.upper[motor])
    if gap(ends[0]) * gap(ends[1]) > 0:
        return
    q, points = pads(root(gap, ends))
    heights = item.mesh(8)[0][:, 2]
    for number in range(count):
        angle = rng.uniform(-np.pi, np.pi) * (number > 0)
        height = rng.uniform(heights.min() + EDGE, heights.max() - EDGE) * (number > 0)
        if abs(item.signed_distance(np.array([half * out + [0, 0, height]]))[0]) > EXACT:
            height = 0.0  # it is as wide as this in its middle only
        pose = np.eye(4)
        pose[:3, :3] = axes.T @ about(out, angle)
        pose[:3, 3] = points.mean(axis=0) - pose[:3, 2] * height
        yield TipPinch(q, pose, 0.0, 0.0, 0.0)


def about(axis: Array, angle: float) -> Array:
    """(3, 3) turn about a coordinate axis."""
    across = np.cross(axis, np.eye(3)).T
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across
