"""URDF as a tree of joints, in the file's own order."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import LIMITS
from casadi_ik.robots.couplings import Coupling, Linear
from casadi_ik.robots.linkage import parents_first
from casadi_ik.robots.robot_files.tree import (
    Element,
    RobotTree,
    TreeJoint,
    attribute,
    check_size,
    check_vector,
    number,
    pose_of,
    urdf_shapes,
)

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


def read_urdf(element: Element, path: Path) -> RobotTree:
    """Read a URDF.

    Args:
        element: Its element ``robot``.
        path: The file it is from.

    Raises:
        DescriptionError: It describes no tree, or nonsense; the message names file and joint.
    """
    links = [attribute(link, "name", f"{path}: a link") for link in element.findall("link")]
    elements = element.findall("joint")
    check_size(len(links), sum(one.get("type") != "fixed" for one in elements), path)
    names = [attribute(joint, "name", f"{path}: a joint") for joint in elements]
    _once(links, "link", path)
    _once(names, "joint", path)
    joints = dict(zip(names, elements, strict=True))
    for name, joint in joints.items():
        _check(joint, links, f"{path}: joint {name!r}")
    root = _root(links, joints, path)
    if not joints:
        raise DescriptionError(f"{path}: has no joints ({len(links)} links)")
    found = [_joint(one, name, f"{path}: joint {name!r}") for name, one in joints.items()]
    ordered = parents_first(found, root)
    return RobotTree(path, root, ordered, shapes=urdf_shapes(element), element=element)


def _once(names: list[str], noun: str, path: Path) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise DescriptionError(f"{path}: {noun} {name!r} appears twice")


def _check(joint: Element, links: list[str], where: str) -> None:
    """Everything that pinocchio would refuse without saying where."""
    kind = joint.get("type")
    if kind not in KINDS:
        raise DescriptionError(f"{where}: type: found {kind!r}, expected one of {', '.join(KINDS)}")
    for end in ("parent", "child"):
        link = attribute(joint.find(end), "link", f"{where}: {end}")
        if link not in links:
            raise DescriptionError(f"{where}: {end}: there is no link {link!r}")
    for name in ("xyz", "rpy"):
        check_vector(joint.find("origin"), name, f"{where}: origin")
    axis = joint.find("axis")
    check_vector(axis, "xyz", f"{where}: axis")
    if kind not in ("fixed", "floating") and not np.linalg.norm(_direction(axis)) > 1e-9:
        raise DescriptionError(f"{where}: axis: is zero, expected a direction")
    limit = joint.find("limit")
    ends = _ends(limit, where)
    number(limit, "velocity", f"{where}: limit", math.inf)
    low, high = (end or 0.0 for end in ends)
    if low > high:
        raise DescriptionError(f"{where}: limit: lower {low:.6g} is above upper {high:.6g}")


def _root(links: list[str], joints: dict[str, Element], path: Path) -> str:
    parents: dict[str, str] = {}
    for name, joint in joints.items():
        child = joint.find("child").get("link", "")  # type: ignore[union-attr]
        if child in parents:
            raise DescriptionError(
                f"{path}: joint {name!r}: link {child!r} hangs on two joints, expected a tree; "
                "take one out of the file"
            )
        parents[child] = joint.find("parent").get("link", "")  # type: ignore[union-attr]
    roots = [link for link in links if link not in parents]
    if not roots:
        cycle = f", there is a cycle through link {links[0]!r}" if links else ", it has no link"
        raise DescriptionError(f"{path}: there is no base link{cycle}")
    if len(roots) > 1:
        raise DescriptionError(
            f"{path}: found several base links ({', '.join(roots)}), expected one: join them by a "
            "fixed joint"
        )
    for link in links:
        seen = set()
        while link in parents:
            if link in seen:
                raise DescriptionError(f"{path}: there is a cycle through link {link!r}")
            seen.add(link)
            link = parents[link]
    return roots[0]


def _joint(element: Element, name: str, where: str) -> TreeJoint:
    kind, axis, limit = element.get("type", ""), np.array([0.0, 0.0, 1.0]), element.find("limit")
    if kind in ("revolute", "continuous", "prismatic"):
        axis = np.array(_direction(element.find("axis")))
        axis /= np.linalg.norm(axis)
    velocity = number(limit, "velocity", f"{where}: limit", math.inf) or math.inf
    placement = pose_of(element)
    assert placement is not None  # its vectors are checked
    return TreeJoint(
        name,
        attribute(element.find("parent"), "link", where),
        attribute(element.find("child"), "link", where),
        kind,
        placement,
        axis,
        _limits(limit, where) if kind in ("revolute", "prismatic") else None,
        abs(velocity),
        _mimic(element, where),
    )


def _direction(axis: Element | None) -> list[float]:
    """An axis as stated; x where nothing is, as URDF has it."""
    text = "" if axis is None else axis.get("xyz", "")
    return [float(word) for word in text.split()] or [1.0, 0.0, 0.0]


def _limits(limit: Element | None, where: str) -> tuple[float, float] | None:
    """The range that is stated; an end that is left out is zero in URDF if the other is there."""
    ends = _ends(limit, where)
    if ends == [None, None] or max(abs(end or 0.0) for end in ends) > LIMITS.joint_limit:
        return None
    return ends[0] or 0.0, ends[1] or 0.0


def _ends(limit: Element | None, where: str) -> list[float | None]:
    return [number(limit, name, f"{where}: limit", math.inf) for name in ("lower", "upper")]


def _mimic(element: Element, where: str) -> Coupling | None:
    mimic = element.find("mimic")
    if mimic is None or element.get("type") == "fixed":
        return None
    where = f"{where}: mimic"
    ratio = number(mimic, "multiplier", where)
    offset = number(mimic, "offset", where)
    leader = attribute(mimic, "joint", where)
    return Linear(leader, 1.0 if ratio is None else ratio, offset or 0.0)
