"""A robot's file, of whatever format, as a tree of joints."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Any

from casadi_ik.errors import DescriptionError, MissingExtraError
from casadi_ik.robots.robot_files.mjcf_file import read_mjcf
from casadi_ik.robots.robot_files.tree import RobotTree
from casadi_ik.robots.robot_files.urdf_file import read_urdf
from casadi_ik.robots.robot_files.xml_text import Element, parse_xml, read_text

MACROS = ("{http://www.ros.org/wiki/xacro}", "{http://ros.org/wiki/xacro}")
"""How the tags of macros begin."""

SUFFIXES = (".urdf", ".xacro", ".xml", ".mjcf")
"""Of the files that are read."""


def read_tree(path: Path) -> RobotTree:
    """Read a robot's file.

    Args:
        path: URDF, xacro or MJCF.

    Raises:
        DescriptionError: It is missing or malformed; the message names file and joint.
        MissingExtraError: What reads this format is not installed.
    """
    try:
        stamp = path.stat().st_mtime_ns
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror}") from error
    return _read(path, stamp)


@lru_cache(maxsize=8)
def _read(path: Path, _: int) -> RobotTree:
    element = robot_element(path)
    if element.tag == "mujoco":
        return read_mjcf(path)
    return read_urdf(element, path)


def robot_element(path: Path) -> Element:
    """The outermost element of a robot's file, macros expanded.

    Raises:
        DescriptionError: See `read_tree`.
        MissingExtraError: It has macros and xacro is not installed.
    """
    text = read_text(path)
    element = parse_xml(text, path)
    if path.suffix == ".xacro" or any(one.tag.startswith(MACROS) for one in element.iter()):
        element = parse_xml(_expanded(path), path)
    if element.tag not in ("robot", "mujoco"):
        raise DescriptionError(
            f"{path}: found <{element.tag}>, expected a URDF (<robot>) or an MJCF (<mujoco>)"
        )
    return element


def _expanded(path: Path) -> str:
    try:
        import xacro
    except ImportError as error:
        raise MissingExtraError(
            f"{path}: has xacro macros; to read them: pip install casadi-ik[xacro]"
        ) from error
    try:
        document: Any = xacro.process_file(os.fspath(path))
        return str(document.toxml())
    except Exception as error:  # whatever its macros evaluate to
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DescriptionError(f"{path}: xacro cannot expand it: {reason}") from error
