"""Fingers of an imported hand: chains of joints below the palm, their names and link poses."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.joints import (
    Joint,
    chain_to,
    joint_depth,
    joints_below,
    link_poses,
    moving_below,
    rigid_links,
)
from casadi_ik.model.parts import RobotPart

FINGER_PATTERNS = {
    "thumb": r"thumb|(?<![a-z])th(?=[jb_]|dist|prox|mid|tip|hub|base|$)",
    "index": r"index|fore_?finger|(?<![a-z])ff(?=j|dist|prox|mid|knuck|tip|_|$)",
    "ring": r"(?<![a-z])ring|(?<![a-z])rf(?=j|dist|prox|mid|knuck|tip|_|$)",
    "little": r"little|pinky|(?<![a-z])lf(?=j|dist|prox|mid|knuck|meta|tip|_|$)",
    "middle": r"middle_?finger|(?<![a-z])mf(?=j|dist|prox|mid|knuck|tip|_|$)|middle",
}
"""Patterns of finger names; a middle phalanx must not turn a finger into the middle finger.

The abbreviations are those of Shadow hands: th, ff, mf, rf and lf are thumb, first (index), middle,
ring and little finger.
"""


@dataclass(frozen=True)
class FingerChain:
    """A finger in a tree of links.

    Attributes:
        name: Name of the finger.
        joints: Movable joints from the palm to the tip.
        link: Link that carries the pad.
        links: All links of the finger.
        is_named: True if names in the file identify the finger.
    """

    name: str
    joints: tuple[Joint, ...]
    link: str
    links: tuple[str, ...]
    is_named: bool


def find_fingers(part: RobotPart, palm: str) -> list[FingerChain]:
    """Return the fingers below a palm, in the order of the file."""
    fingers: list[FingerChain] = []
    for joint in moving_below(part, palm):
        for start, end in _finger_ends(part, joint):
            links = [
                start.child,
                *(joint_below.child for joint_below in joints_below(part, start.child)),
            ]
            joint_names = [
                link_joint.name for link_joint in part.joints if link_joint.child in links
            ]
            word = _finger_word([*links, *joint_names])
            chain = [item for item in chain_to(part, end.child, palm) if item.type != "fixed"]
            tip = _tip_link(part, end.child)
            fingers.append(FingerChain(word or "", tuple(chain), tip, tuple(links), bool(word)))
    return _with_unique_names(fingers)


def _finger_ends(part: RobotPart, joint: Joint) -> list[tuple[Joint, Joint]]:
    """Return the first and last joint of each finger that a joint carries.

    If a joint carries at least two chains of two or more joints, each chain is a finger. Otherwise
    only the longest chain is followed; the others belong to linkages.
    """
    next_joints = moving_below(part, joint.child)
    chains = [next_joint for next_joint in next_joints if joint_depth(part, next_joint.child) >= 1]
    if len(chains) >= 2:
        return [pair for next_joint in chains for pair in _finger_ends(part, next_joint)]
    if not next_joints:
        return [(joint, joint)]
    longest = max(next_joints, key=lambda next_joint: joint_depth(part, next_joint.child))
    fingers = _finger_ends(part, longest)
    return fingers if len(fingers) > 1 else [(joint, fingers[0][1])]


def _tip_link(part: RobotPart, link: str) -> str:
    """Return the tip frame that is fixed to a link; the link if there is not exactly one."""
    candidates = [
        candidate for candidate in rigid_links(part, link)[1:] if "tip" in candidate.lower()
    ]
    return candidates[0] if len(candidates) == 1 else link


def _finger_word(names: list[str]) -> str | None:
    """Return the finger that most names mention; None if there is none."""
    lower = [name.lower() for name in names]
    counts = {
        word: sum(bool(re.search(pattern, name)) for name in lower)
        for word, pattern in FINGER_PATTERNS.items()
    }
    # "middle" also names phalanges: it wins only if it is in most names and the best word is not.
    best = max(counts, key=lambda word: counts[word])  # the first of equals
    if counts["middle"] and best != "middle" and counts[best] < len(lower) / 2 < counts["middle"]:
        best = "middle"
    return best if counts[best] else None


def _with_unique_names(fingers: list[FingerChain]) -> list[FingerChain]:
    """Return the fingers with unique names: finger words, common prefixes of links, or numbers."""
    prefixes = [_common_prefix(finger.links) for finger in fingers]
    named: list[FingerChain] = []
    for i, (finger, prefix) in enumerate(zip(fingers, prefixes, strict=True)):
        namesakes = [candidate for candidate in fingers if candidate.name == finger.name]
        name = finger.name if finger.is_named and len(namesakes) == 1 else ""
        if not name and len(prefix) >= 3 and prefixes.count(prefix) == 1:
            name = prefix
        if not name or any(predecessor.name == name for predecessor in named):
            name = f"finger_{i + 1}"
        named.append(replace(finger, name=name))
    return named


def _common_prefix(links: tuple[str, ...]) -> str:
    """Return the common beginning of link names without words such as "link"."""
    if len(links) < 2:
        return ""
    first, *further = (link.lower() for link in links)
    is_common = [
        all(link[: i + 1] == first[: i + 1] for link in further) for i in range(len(first))
    ]
    common = first[: sum(is_common)]
    common = re.sub(r"(link|phalanx|body|joint)_*$", "", common.rstrip("_-. "))
    return re.sub(r"[^a-z0-9_]+", "_", common).strip("_")


def mid_range_positions(part: RobotPart) -> dict[str, float]:
    """Return the middle of the range of every joint [rad or m]."""
    return {
        joint.name: (joint.lower + joint.upper) / 2
        for joint in part.joints
        if joint.type != "fixed"
    }


def random_positions(part: RobotPart, rng: np.random.Generator) -> dict[str, float]:
    """Return random positions in the middle half of the range of every joint."""
    return {
        joint.name: joint.lower + (0.25 + 0.5 * rng.random()) * (joint.upper - joint.lower)
        for joint in part.joints
        if joint.type != "fixed"
    }


def part_poses(part: RobotPart, positions: Mapping[str, float]) -> dict[str, Array]:
    """Return the pose (4, 4) of every link in the root frame."""
    return link_poses(part.root, part.joints, positions)


def transform_point(pose: Array, point: Array) -> Array:
    """Return a point (3,) in the frame in which its frame has a (4, 4) pose."""
    return pose[:3, :3] @ point + pose[:3, 3]


def unit_vector(vector: Array, fallback: Array) -> Array:
    """Return the direction of a vector; that of `fallback` if the vector is nearly zero."""
    length = float(np.linalg.norm(vector))
    direction = vector if length > 1e-9 else fallback
    return direction / np.linalg.norm(direction)


def perpendicular_part(vector: Array, axis: Array) -> Array:
    """Return the component of a vector that is perpendicular to a unit axis."""
    return vector - (vector @ axis) * axis


def any_perpendicular(axis: Array) -> Array:
    """Return a unit vector that is perpendicular to an axis."""
    perpendicular: Array = np.asarray(
        np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]), dtype=float
    )
    return unit_vector(perpendicular, axis)
