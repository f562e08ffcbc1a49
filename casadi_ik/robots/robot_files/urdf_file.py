"""URDF as a tree of joints: pinocchio parses it, elements only say what it does not tell.

Pinocchio gives placements, axes, limits and the order of frames; which limits are stated at all,
which joint mimics which, and the file's own order are read from the elements.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError, MissingExtraError
from casadi_ik.files.limits import LIMITS
from casadi_ik.robots.couplings import Coupling, Linear
from casadi_ik.robots.robot_files.tree import (
    Element,
    RobotTree,
    TreeJoint,
    attribute,
    check_size,
    check_vector,
    number,
    parents_first,
    urdf_shapes,
)

KINEMATIC = ("origin", "parent", "child", "axis", "limit")
"""What of a joint's elements its motion follows from."""

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


def read_urdf(element: Element, path: Path) -> RobotTree:
    """Read a URDF.

    Args:
        element: Its element ``robot``.
        path: The file it is from.

    Raises:
        DescriptionError: It describes no tree, or nonsense; the message names file and joint.
        MissingExtraError: pinocchio is not installed.
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
    model = _model(element, links, joints, path)
    found = {joint.name: joint for joint in _from_model(model, joints, path)}
    ordered = parents_first([found[name] for name in joints], root)
    return RobotTree(path, root, ordered, shapes=urdf_shapes(element), element=element)


def bare(element: Element) -> Element:
    """The links and joints alone: no masses, shapes, transmissions; every joint with its limits."""
    plain = ElementTree.Element("robot", name=element.get("name") or "robot")
    for link in element.findall("link"):
        ElementTree.SubElement(plain, "link", name=link.get("name", ""))
    for joint in element.findall("joint"):
        copy = ElementTree.SubElement(plain, "joint", dict(joint.attrib))
        for kind in KINEMATIC:
            for part in joint.findall(kind)[:1]:
                if kind == "axis" and not part.get("xyz"):  # as if it were not there
                    continue
                if kind == "limit":  # what URDF demands beside the range
                    part = Element("limit", {"effort": "0", "velocity": "0"} | part.attrib)
                copy.append(part)
        if joint.get("type") in ("revolute", "prismatic") and joint.find("limit") is None:
            ElementTree.SubElement(copy, "limit", lower="0", upper="0", effort="0", velocity="0")
    return plain


def pinocchio() -> Any:
    """The module, imported when it is needed.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import pinocchio as module
    except ImportError as error:
        raise MissingExtraError(
            "URDF files are read by pinocchio, which is not installed (there is none for Windows): "
            "pip install pin"
        ) from error
    return module


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
    if axis is not None and kind not in ("fixed", "floating"):
        direction = [float(word) for word in axis.get("xyz", "1 0 0").split()]
        if not np.linalg.norm(direction) > 1e-9:
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


def _model(element: Element, links: list[str], joints: dict[str, Element], path: Path) -> Any:
    module = pinocchio()
    text = ElementTree.tostring(bare(element), encoding="unicode")
    if not joints:
        raise DescriptionError(f"{path}: has no joints ({len(links)} links)")
    with silent() as said:
        try:
            return module.buildModelFromXML(text)
        except (ValueError, RuntimeError) as error:
            reason = said() or str(error)
            raise DescriptionError(f"{path}: pinocchio cannot read it: {reason}") from error


def _from_model(model: Any, elements: dict[str, Element], path: Path) -> Iterator[TreeJoint]:
    """The joints of pinocchio's model, with what the elements add."""
    module = pinocchio()
    frames = model.frames.tolist()
    bodies = {frame.parentFrame: frame for frame in frames if frame.type == module.BODY}
    for index, frame in enumerate(frames):
        if frame.name not in elements or frame.type not in (module.JOINT, module.FIXED_JOINT):
            continue
        element = elements[frame.name]
        parent = frames[frame.parentFrame]
        kind = element.get("type", "")
        axis = np.array([0.0, 0.0, 1.0])
        if frame.type == module.JOINT:
            joint = model.joints[frame.parentJoint]
            placement = parent.placement.inverse() * model.jointPlacements[frame.parentJoint]
            if joint.nv == 1:
                axis = _axis(joint, model)
        else:
            placement = parent.placement.inverse() * frame.placement
        limit = element.find("limit")
        where = f"{path}: joint {frame.name!r}"
        velocity = number(limit, "velocity", f"{where}: limit", math.inf) or math.inf
        yield TreeJoint(
            frame.name,
            parent.name,
            bodies[index].name,
            kind,
            np.array(placement.homogeneous),
            axis,
            _limits(limit, where) if kind in ("revolute", "prismatic") else None,
            abs(velocity),
            _mimic(element, where),
        )


def _axis(joint: Any, model: Any) -> Array:
    data = joint.createData()
    joint.calc(data, np.zeros(model.nq))
    column = np.asarray(data.S, dtype=float).ravel()
    axis = column[3:] if np.linalg.norm(column[3:]) > 0.5 else column[:3]
    return axis / np.linalg.norm(axis)


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


@contextlib.contextmanager
def silent() -> Iterator[Any]:
    """Keep what the parsers print on stderr, whose lines are ours; gives the first error."""
    with tempfile.TemporaryFile() as kept:
        sys.stderr.flush() if sys.stderr is not None else None
        try:
            terminal = os.dup(2)
        except OSError:  # closed by the shell
            yield lambda: ""
            return
        os.dup2(kept.fileno(), 2)

        def said() -> str:
            kept.seek(0)
            lines = kept.read().decode(errors="replace").splitlines()
            errors = [line.partition(":")[2].strip() for line in lines if line.startswith("Error")]
            return errors[0] if errors else ""

        try:
            yield said
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
