"""Pairs of links that may touch, as an SRDF names them."""

from __future__ import annotations

from pathlib import Path

from casadi_ik.errors import DescriptionError
from casadi_ik.robots.robot_files.xml_text import attribute, parse_xml, read_text


def srdf_pairs(path: Path) -> list[tuple[tuple[str, str], str]]:
    """The pairs of ``disable_collisions``, each with the file's reason.

    Raises:
        DescriptionError: The file cannot be read, is no SRDF, or a pair lacks a link.
    """
    element = parse_xml(read_text(path), path)
    if element.tag != "robot":
        raise DescriptionError(f"{path}: found <{element.tag}>, expected <robot> of an SRDF")
    found: list[tuple[tuple[str, str], str]] = []
    for i, pair in enumerate(element.iter("disable_collisions")):
        where = f"{path}: disable_collisions[{i}]"
        links = attribute(pair, "link1", where), attribute(pair, "link2", where)
        found.append((links, f"{path.name}: {pair.get('reason', 'no reason given')}"))
    return found
