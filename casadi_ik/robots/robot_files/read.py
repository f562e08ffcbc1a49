"""A robot's file, of whatever format, as a tree of joints."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from casadi_ik.errors import DescriptionError, os_errors
from casadi_ik.robots.robot_files.confined import MACROS, confined
from casadi_ik.robots.robot_files.mjcf_file import read_mjcf
from casadi_ik.robots.robot_files.tree import RobotTree, parse_xml, read_robot_file
from casadi_ik.robots.robot_files.urdf_file import read_urdf

MACRO_TAGS = ("{http://www.ros.org/wiki/xacro}", "{http://ros.org/wiki/xacro}")
"""How the tags of macros begin."""


def read_tree(path: Path, xacro: bool = False) -> RobotTree:
    """Read a robot's file.

    Args:
        path: URDF, xacro or MJCF.
        xacro: Whether its macros are expanded although it is not called ``.xacro``.

    Raises:
        DescriptionError: It is missing or malformed; the message names file and joint.
        MissingExtraError: What reads this format is not installed.
    """
    with os_errors(f"{path}: cannot be read", DescriptionError):
        stamp = path.stat().st_mtime_ns
    return _read(path, stamp, xacro or path.suffix == ".xacro")


@lru_cache(maxsize=8)
def _read(path: Path, _: int, xacro: bool) -> RobotTree:
    text = read_robot_file(path)
    element = parse_xml(text, path)
    if xacro and element.tag == "robot":
        element = parse_xml(confined(MACROS, path).decode(), path)
    if element.tag not in ("robot", "mujoco"):
        raise DescriptionError(
            f"{path}: found <{element.tag}>, expected a URDF (<robot>) or an MJCF (<mujoco>)"
        )
    if element.tag == "mujoco":
        return read_mjcf(path)
    for one in element.iter():
        if one.tag.startswith(MACRO_TAGS):
            raise DescriptionError(
                f"{path}: found macros (<xacro:{one.tag.rpartition('}')[2]}>), expected plain "
                "URDF; to have them expanded, call the file .xacro, or import it with --xacro"
            )
    return read_urdf(element, path)
