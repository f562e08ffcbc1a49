"""Poses as matrices and as the page has them: position and quaternion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arrays import Array
from casadi_ik.grasps.pose import rotations_of

MOST = 1e6
"""Of a number that a browser sends [m, deg or mm]."""


def quaternions(rotations: Array) -> Array:
    """(k, 4) unit quaternions, scalar first, of rotations (k, 3, 3)."""
    r = rotations
    # Four times the squares of the parts; the largest is taken, so that nothing is divided by zero.
    x, y, z = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    squares = np.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], axis=1)
    a, b, c = (r[:, i, j] - r[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (r[:, i, j] + r[:, j, i] for i, j in ((1, 0), (0, 2), (2, 1)))
    rows = np.stack(
        [
            np.stack([squares[:, 0], a, b, c], axis=1),
            np.stack([a, squares[:, 1], d, e], axis=1),
            np.stack([b, d, squares[:, 2], f], axis=1),
            np.stack([c, e, f, squares[:, 3]], axis=1),
        ],
        axis=1,
    )
    chosen = rows[np.arange(len(r)), squares.argmax(axis=1)]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def quaternion(rotation: Array) -> Array:
    """(4,) of one rotation (3, 3)."""
    # The same in plain numbers: of a single one, arrays would take ten times as long.
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    squares = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    a, b, c, d, e, f = zy - yz, xz - zx, yx - xy, yx + xy, xz + zx, zy + yz
    rows = (
        (squares[0], a, b, c),
        (a, squares[1], d, e),
        (b, d, squares[2], f),
        (c, e, f, squares[3]),
    )
    chosen = np.array(rows[squares.index(max(squares))])
    return chosen / math.sqrt(chosen @ chosen)


def pose_of(position: Array, wxyz: Array) -> Array:
    """(4, 4) of a position (3,) and a quaternion (4,).

    Raises:
        ValueError: They are not of these sizes, or not finite.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotations_of(usable(wxyz, 4)[None])[0]
    pose[:3, 3] = usable(position, 3)
    if not np.isfinite(pose).all():
        raise ValueError("found a quaternion of no length")
    return pose


def usable(numbers: ArrayLike, count: int) -> Array:
    """Numbers (count,) that a browser has sent.

    Raises:
        ValueError: They are none, not so many, not finite, or too large to be drawn.
    """
    try:
        found = np.asarray(numbers, dtype=float)
    except TypeError as error:
        raise ValueError(str(error)) from error
    if found.shape != (count,) or not (np.abs(found) <= MOST).all():
        raise ValueError(f"found {found}, expected {count} numbers up to {MOST:g}")
    return found


def facing(point: Array, normal: Array, like: Array | None = None) -> Array:
    """(4, 4) pose at a point whose x axis is a direction, otherwise turned as little as may be.

    Args:
        point: (3,) [m].
        normal: (3,) any length but zero.
        like: (3, 3) what it is turned from; None: the base frame.
    """
    x = normal / np.linalg.norm(normal)
    axes = (np.eye(3) if like is None else like).T
    y = axes[1] - x * (x @ axes[1])
    if np.linalg.norm(y) < 1e-3:
        y = axes[2] - x * (x @ axes[2])
    if np.linalg.norm(y) < 1e-3:
        y = axes[0] - x * (x @ axes[0])
    y /= np.linalg.norm(y)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, y, np.cross(x, y), point])
    return pose
