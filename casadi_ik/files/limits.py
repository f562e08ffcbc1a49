"""How large a file of somebody else may be: each reader has its limits, one factor raises all."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from casadi_ik.errors import InputError

LIMITS_VARIABLE = "CASADI_IK_LIMITS"
"""Factor in the environment by which all limits are multiplied."""

RAISE_HINT = (
    f"(--size-limits 4, or {LIMITS_VARIABLE}=4 in the environment, allows four times as much)"
)
"""Said where a limit is met."""


@dataclass(frozen=True)
class FileLimits:
    """How much of somebody else's file is read; SECURITY.md promises these numbers.

    `scaled_limit` multiplies sizes, counts, time and memory by `CASADI_IK_LIMITS`.

    Attributes:
        yaml_bytes: Bytes of a YAML file.
        yaml_text: Characters of one text or number.
        yaml_depth: Lists and mappings inside one another.
        yaml_values: Values in a file, those counted again that an alias repeats.
        quantity_text: Characters of a number with a unit.
        name_text: Characters of a name in a description.
        mesh_bytes: Bytes of a mesh file.
        mesh_faces: Triangles of a mesh.
        mesh_coordinate: Largest coordinate of a corner [m, or what the file counts in].
        link_triangles: Triangles of one link; of a finer mesh only the points are kept.
        object_pieces: Pieces of a grasped object.
        cloud_bytes: Bytes of a file of points.
        cloud_points: Points of a file.
        cloud_head: Lines of the head of a PLY or PCD file.
        cloud_balls: Balls of a point cloud in a scene.
        robot_bytes: Bytes of a URDF, xacro or MJCF file.
        robot_number: Largest length or angle of a robot [m or rad].
        joint_limit: Largest limit of a joint [rad or m]; beyond it there is none, since some
            programs write 1e16 for a joint without limits.
        xml_depth: Elements inside one another.
        links: Links of a robot's file.
        moving_joints: Joints of a robot's file that move.
        reader_seconds: Computing time of the process that reads macros and MJCF [s].
        reader_patience: Times as long by the clock, since the machine may be busy.
        reader_memory: Memory of that process [bytes].
        reader_output: What it may hand back [bytes].
        grasp_numbers: Numbers of a grasp of a data set.
        dataset_bytes: Bytes of a file of a data set, unpacked.
        table_bytes: Bytes of a table of grasps, unpacked.
        candidates: Grasps of a file.
        ranked_bytes: Bytes of a file of ranked answers, of which ten thousand take a third.
        stream_bytes: Bytes of a stream of frames to be followed, unpacked: hours of keypoints.
        stream_cycles: Cycles in which a stream is followed: an hour at a kilohertz.
        stream_reach: Farthest contact from the base, or keypoint from the middle of the hand, in a
            stream [m]; beyond it the numbers are in other units.
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


def scaled_limit(value: float) -> int:
    """A limit of size, time or memory, times the factor of the environment.

    Raises:
        InputError: The factor is no positive number.
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
    """Return how to raise a limit, whose default is `value`, to what is needed.

    Example:
        >>> from casadi_ik.files.limits import raise_hint
        >>> raise_hint(3000, 256)
        '(--size-limits 12, or CASADI_IK_LIMITS=12 in the environment, allows as many)'
    """
    factor = math.ceil(needed / value)
    setting = f"{LIMITS_VARIABLE}={factor}"
    return f"(--size-limits {factor}, or {setting} in the environment, allows as many)"
