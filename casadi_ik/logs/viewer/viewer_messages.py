"""What a viewer file says in Foxglove's schemas, in protobuf."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import MissingExtraError
from casadi_ik.symbolic.so3 import quaternion_from_matrix

try:
    from foxglove import Schema
    from foxglove import messages as fox
except ImportError as error:
    raise MissingExtraError(
        "viewer files need foxglove-sdk, which is not installed: pip install casadi-ik[viewer]"
    ) from error

__all__ = [
    "Array",
    "Color",
    "Schema",
    "along",
    "arrow",
    "fox",
    "inverses",
    "quaternion_of",
    "quaternions",
    "sphere",
    "stamp_of",
    "vector_of",
]

Color = tuple[float, float, float]

ARROW = 0.05
"""Length of a contact's normal [m]."""


def inverses(pose: Array) -> Array:
    """Inverse of rigid poses (k, 4, 4)."""
    turned = pose[:, :3, :3].swapaxes(1, 2)
    result = np.zeros_like(pose)
    result[:, :3, :3] = turned
    result[:, :3, 3] = -(turned @ pose[:, :3, 3, None])[..., 0]
    result[:, 3, 3] = 1.0
    return result


def stamp_of(time: int) -> fox.Timestamp:
    """A time [ns since the Unix epoch]."""
    return fox.Timestamp(*divmod(time, 1_000_000_000))


def vector_of(values: Array) -> fox.Vector3:
    """A vector (3,)."""
    x, y, z = values.tolist()
    return fox.Vector3(x=x, y=y, z=z)


def quaternion_of(values: Array) -> fox.Quaternion:
    """A quaternion (4,), scalar first."""
    w, x, y, z = values.tolist()
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def quaternions(rotations: Array) -> Array:
    """Unit quaternions (k, 4), scalar first, of rotations (k, 3, 3)."""
    stacked = _quaternion_function().map(len(rotations))(np.hstack(list(rotations)))
    return np.asarray(stacked, dtype=np.float64).T


def along(normals: Array) -> Array:
    """Rotations (k, 3, 3) whose x axes are unit vectors (k, 3); NaN where those are."""
    other = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    y = np.cross(normals, other)
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    z = np.cross(normals, y)
    return np.stack([normals, y, z], axis=2).astype(np.float64)


@cache
def _quaternion_function() -> ca.Function:
    R = ca.SX.sym("R", 3, 3)
    return ca.Function("quaternion", [R], [quaternion_from_matrix(R)])


def color_of(color: Color) -> fox.Color:
    """An opaque colour."""
    return fox.Color(r=color[0], g=color[1], b=color[2], a=1.0)


def sphere(point: Array, size: float, color: Color) -> fox.SpherePrimitive:
    """A sphere at a point, its diameter [m]."""
    pose = fox.Pose(position=vector_of(point), orientation=fox.Quaternion(w=1.0))
    return fox.SpherePrimitive(
        pose=pose, size=fox.Vector3(x=size, y=size, z=size), color=color_of(color)
    )


def arrow(point: Array, turned: Array, thickness: float, color: Color) -> fox.ArrowPrimitive:
    """An arrow from a point; in its own frame it points along x."""
    return fox.ArrowPrimitive(
        pose=fox.Pose(position=vector_of(point), orientation=quaternion_of(turned)),
        shaft_length=0.7 * ARROW,
        shaft_diameter=thickness,
        head_length=0.3 * ARROW,
        head_diameter=2.2 * thickness,
        color=color_of(color),
    )
