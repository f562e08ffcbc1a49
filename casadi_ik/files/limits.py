"""Limits on the size of input files, and the factor that raises all of them."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from casadi_ik.errors import InputError

LIMITS_VARIABLE = "CASADI_IK_LIMITS"
"""Environment variable with a factor for all limits."""

RAISE_HINT = (
    f"(--size-limits 4, or {LIMITS_VARIABLE}=4 in the environment, allows four times as much)"
)
"""Hint at the end of messages about a limit."""


@dataclass(frozen=True)
class FileLimits:
    """Limits on untrusted input files; SECURITY.md states these numbers.

    `scaled_limit` multiplies sizes, counts, time and memory by `CASADI_IK_LIMITS`.

    Attributes:
        yaml_bytes: Size of a YAML file [bytes].
        yaml_text: Characters of one text or number.
        yaml_depth: Depth of nested lists and mappings.
        yaml_values: Values in a file; a value that an alias repeats counts again.
        quantity_text: Characters of a number with a unit.
        name_text: Characters of a name in a description.
        mesh_bytes: Size of a mesh file [bytes].
        mesh_faces: Triangles of a mesh.
        mesh_coordinate: Largest coordinate of a vertex [m, or the unit of the file].
        link_triangles: Triangles of one link; of a finer mesh only the points are used.
        object_pieces: Connected pieces of a grasped object.
        cloud_bytes: Size of a point file [bytes].
        cloud_points: Points of a file.
        cloud_head: Header lines of a PLY or PCD file.
        cloud_balls: Balls of a point cloud in a scene.
        robot_bytes: Size of a URDF, xacro or MJCF file [bytes].
        robot_number: Largest length or angle of a robot [m or rad].
        joint_limit: Largest limit of a joint [rad or m]. A joint with a larger limit has none,
            because some programs write 1e16 for a joint without limits.
        xml_depth: Depth of nested XML elements.
        links: Links of a robot file.
        moving_joints: Movable joints of a robot file.
        reader_seconds: CPU time of the process that expands macros and reads MJCF [s].
        reader_patience: Wall time of that process, as a multiple of `reader_seconds`.
        reader_memory: Memory of that process [bytes].
        reader_output: Output of that process [bytes].
        grasp_numbers: Numbers of a grasp of a data set.
        dataset_bytes: Size of a data set file, uncompressed [bytes].
        table_bytes: Size of a table of grasps, uncompressed [bytes].
        candidates: Grasps of a file.
        ranked_bytes: Size of a file of ranked results [bytes]; ten thousand results fill a third.
        stream_bytes: Size of a stream of frames, uncompressed [bytes]: hours of keypoints.
        stream_cycles: Cycles in which a stream is followed: an hour at 1 kHz.
        stream_reach: Largest distance of a contact from the base, or of a keypoint from the middle
            of the hand, in a stream [m]; larger numbers are in another unit.
    """

    yaml_bytes: int = 4 * 2**20
    yaml_text: int = 10_000
    yaml_depth: int = 50
    yaml_values: int = 200_000
    quantity_text: int = 64
    name_text: int = 100
    mesh_bytes: int = 64 * 2**20
    mesh_faces: int = 2_000_000
    mesh_coordinate: float = 1e6
    link_triangles: int = 200_000
    object_pieces: int = 256
    cloud_bytes: int = 2**30
    cloud_points: int = 10_000_000
    cloud_head: int = 200
    cloud_balls: int = 100_000
    robot_bytes: int = 16 * 2**20
    robot_number: float = 1e6
    joint_limit: float = 1e3
    xml_depth: int = 200
    links: int = 1000
    moving_joints: int = 200
    reader_seconds: int = 20
    reader_patience: int = 10
    reader_memory: int = 3 * 2**30
    reader_output: int = 256 * 2**20
    grasp_numbers: int = 200
    dataset_bytes: int = 2**29
    table_bytes: int = 2**26
    candidates: int = 200_000
    ranked_bytes: int = 2**26
    stream_bytes: int = 2**28
    stream_cycles: int = 4_000_000
    stream_reach: float = 5.0


LIMITS = FileLimits()
"""Default limits."""


def scaled_limit(value: float) -> int:
    """Return a limit of size, time or memory times the factor of the environment.

    Raises:
        InputError: The factor is not a positive number.
    """
    text = os.environ.get(LIMITS_VARIABLE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not 0 < factor < 1e9:
        raise InputError(
            f"{LIMITS_VARIABLE}: found {text!r} in the environment, expected a factor above 0"
        )
    return max(1, int(value * factor))


def raise_hint(needed: float, value: float) -> str:
    """Return a hint how to raise a limit.

    Args:
        needed: Required value.
        value: Default value of the limit.

    Example:
        >>> from casadi_ik.files.limits import raise_hint
        >>> raise_hint(3000, 256)
        '(--size-limits 12, or CASADI_IK_LIMITS=12 in the environment, allows as many)'
    """
    factor = math.ceil(needed / value)
    setting = f"{LIMITS_VARIABLE}={factor}"
    return f"(--size-limits {factor}, or {setting} in the environment, allows as many)"
