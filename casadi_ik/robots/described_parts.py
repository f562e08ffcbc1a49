"""Arms and hands as our own files describe them, joint by joint."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.robots.checks import check_couplings, known_link, known_source, positive, unique
from casadi_ik.robots.collision import Shapes, link_shapes
from casadi_ik.robots.description import Actuator, Joint, frozen
from casadi_ik.robots.part import HandPart, Part
from casadi_ik.robots.schema import ActuatorEntry, ArmFile, HandFile, JointEntry

JOINT_TYPES = ("revolute", "prismatic", "fixed")


def arm_part(arm: ArmFile, path: Path) -> Part:
    """An arm, checked.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    joints = _joints(arm.joints, arm.root, arm.sources, "arm", path)
    actuators = _actuators(None, joints, arm.sources, "arm", path)
    tip = known_link(arm.tip.link, arm.root, joints, f"{path}: tip.link")
    known_source(arm.tip.source, arm.sources, f"{path}: tip.source")
    pose = frame_matrix(Frame(arm.tip.xyz, arm.tip.rpy))
    return Part(
        arm.name,
        str(path),
        arm.root,
        joints,
        actuators,
        arm.sources,
        tip,
        pose,
        arm.home,
        _shapes(arm, joints, path),
    )


def hand_part(hand: HandFile, path: Path) -> HandPart:
    """A hand, checked.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    joints = _joints(hand.joints, hand.root, hand.sources, "hand", path)
    actuators = _actuators(hand.actuators, joints, hand.sources, "hand", path)
    palm = known_link(hand.palm.link, hand.root, joints, f"{path}: palm.link")
    known_source(hand.palm.source, hand.sources, f"{path}: palm.source")
    for name, finger in hand.fingers.items():
        known_source(finger.source, hand.sources, f"{path}: fingers.{name}.source")
    return HandPart(
        hand.name,
        str(path),
        hand.root,
        joints,
        actuators,
        hand.sources,
        palm,
        frame_matrix(Frame(hand.palm.xyz, hand.palm.rpy)),
        hand.home,
        _shapes(hand, joints, path),
        dict(hand.fingers),
        hand.thumb,
        frame_matrix(hand.mount),
    )


def _shapes(part: ArmFile | HandFile, joints: list[Joint], path: Path) -> Shapes:
    if part.collision is not None and part.collision.links:
        known_source(part.collision.source, part.sources, f"{path}: collision.source")
    links = (part.root, *(joint.child for joint in joints))
    return link_shapes(part.collision, links, path)


def _joints(
    entries: list[JointEntry], root: str, sources: dict[str, str], part: str, path: Path
) -> list[Joint]:
    """Checked joints, parents before children."""
    names = [entry.name for entry in entries]
    unique(names, f"{path}: joints")
    unique([root, *(entry.child for entry in entries)], f"{path}: joints: child links")
    for entry in entries:
        where = f"{path}: joint {entry.name!r}"
        if entry.type not in JOINT_TYPES:
            raise DescriptionError(
                f"{where}: type: found {entry.type!r}, expected one of {', '.join(JOINT_TYPES)}"
            )
        low, high = entry.limits
        if not low <= high:
            raise DescriptionError(f"{where}: limits: lower {low:.6g} is above upper {high:.6g}")
        if not np.linalg.norm(entry.axis) > 1e-9:
            raise DescriptionError(f"{where}: axis: is zero, expected a direction")
        if entry.velocity is not None:
            positive(entry.velocity, f"{where}: velocity")
        known_source(entry.source, sources, f"{where}: source")
        if entry.coupling is not None:
            entry.coupling.check(f"{where}: coupling")
    by_parent: dict[str, list[JointEntry]] = {}
    for entry in entries:
        by_parent.setdefault(entry.parent, []).append(entry)
    ordered: list[JointEntry] = []
    frontier = [root]
    while frontier:
        children = by_parent.pop(frontier.pop(0), [])
        ordered += children
        frontier += [entry.child for entry in children]
    if by_parent:
        stray = next(iter(by_parent.values()))[0]
        links = {entry.child for entry in entries}
        problem = "is part of a frame cycle" if stray.parent in links else "is no link"
        raise DescriptionError(
            f"{path}: joint {stray.name!r}: parent: {stray.parent!r} {problem}; "
            f"expected a chain of joints down to the root {root!r}"
        )
    ordered.sort(key=lambda entry: names.index(entry.name))
    return [_joint(entry, part) for entry in _parents_first(ordered, root)]


def _parents_first(entries: list[JointEntry], root: str) -> list[JointEntry]:
    """The file's own order, moved only where a child stands before its parent."""
    placed, known = [], {root}
    waiting = list(entries)
    while waiting:
        entry = next(item for item in waiting if item.parent in known)
        waiting.remove(entry)
        placed.append(entry)
        known.add(entry.child)
    return placed


def _joint(entry: JointEntry, part: str) -> Joint:
    axis = np.asarray(entry.axis, dtype=float)
    return Joint(
        name=entry.name,
        parent=entry.parent,
        child=entry.child,
        type=entry.type,
        placement=frozen(frame_matrix(entry.origin)),
        axis=frozen(axis / np.linalg.norm(axis)),
        lower=entry.limits[0],
        upper=entry.limits[1],
        velocity=math.inf if entry.velocity is None else entry.velocity,
        coupling=entry.coupling,
        part=part,
    )


def _actuators(
    entries: dict[str, ActuatorEntry] | None,
    joints: list[Joint],
    sources: dict[str, str],
    part: str,
    path: Path,
) -> list[Actuator]:
    """The part's actuators, after checking that every coupling ends at one of them."""
    by_name = {joint.name: joint for joint in joints if joint.type != "fixed"}
    if entries is None:
        entries = {name: ActuatorEntry() for name, j in by_name.items() if j.coupling is None}
    actuators = []
    for name, entry in entries.items():
        where = f"{path}: actuators.{name}"
        joint = by_name.get(name)
        if joint is not None and joint.coupling is not None:
            raise DescriptionError(f"{where}: joint {name!r} follows {joint.coupling.of!r} already")
        if entry.limits is None and joint is None:
            raise DescriptionError(f"{where}: limits: missing (no joint has this name)")
        if entry.unit not in ("rad", "m"):
            raise DescriptionError(f"{where}: unit: found {entry.unit!r}, expected 'rad' or 'm'")
        low, high = entry.limits or ((joint.lower, joint.upper) if joint else (0.0, 0.0))
        if not low < high:
            raise DescriptionError(
                f"{where}: limits: lower {low:.6g} is not below upper {high:.6g}"
            )
        velocity = joint.velocity if joint else math.inf
        if entry.velocity is not None:
            velocity = positive(entry.velocity, f"{where}: velocity")
        if entry.source or joint is None:
            known_source(entry.source, sources, f"{where}: source")
        unit = ("m" if joint.type == "prismatic" else "rad") if joint else entry.unit
        actuators.append(Actuator(name, unit, low, high, velocity, part))
    check_couplings(by_name, actuators, path)
    return actuators
