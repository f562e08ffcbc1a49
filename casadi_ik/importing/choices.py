"""What of a file becomes an arm or a hand, where the user does not say."""

from __future__ import annotations

import math
import re
from pathlib import Path

from casadi_ik.errors import InputError
from casadi_ik.importing.fingers import holds_arms, moving_below, palms
from casadi_ik.robots.robot_files.tree import RobotTree, TreeJoint

FLANGES = (
    r"tool0$",
    r"flange",
    r"eef|ee_link|end_?effector|attachment|link_?8$|tool",
)
"""Names of the frames on an arm that hands are screwed to, the best first."""

NO_LIMITS = {"revolute": (-math.pi, math.pi), "prismatic": (-0.5, 0.5)}
"""Assumed where a file states none [rad or m]."""


def the_tip(tree: RobotTree) -> tuple[str, str]:
    """The link of an arm that carries the hand, and how it was found.

    Raises:
        InputError: The arm branches, so that there are several.
    """
    last = None
    link = tree.root
    while len(movers := moving_below(tree, link)) == 1:
        last = movers[0]
        link = last.child
    if last is None or (len(movers) > 1 and holds_arms(tree, link)):
        ends = _ends(tree)
        raise InputError(
            f"--tip: missing; {tree.path.name} branches at {link!r}: write the link that carries "
            f"the hand, such as {', '.join(ends[:8])}"
        )
    fixed = _rigid(tree, last.child)
    for pattern in FLANGES:
        named = [one for one in fixed if re.search(pattern, one.lower())]
        if named:
            return named[0], f"it is fixed to the last joint ({last.name}) and called so"
    return last.child, f"the last joint ({last.name}) moves it"


def the_palm(tree: RobotTree, palm: str | None) -> tuple[str, str]:
    """The link that the fingers hang on, and how it was found.

    Raises:
        InputError: There is no such link, or nothing says which it is.
    """
    if palm is not None:
        if palm not in tree.links:
            raise InputError(
                f"--palm: {tree.path.name} has no link {palm!r}; it has {', '.join(tree.links)}"
            )
        return palm, "--palm"
    found = palms(tree)
    if not found:
        return tree.root, "there is a single chain of joints: the base"
    if holds_arms(tree, found[0]):
        raise InputError(
            f"--palm: missing; from {found[0]!r} of {tree.path.name} go chains as long as arms: "
            f"write the link that the fingers hang on, such as {', '.join(found[1:8] or found)}"
        )
    return found[0], "the first link from which several chains of joints go out"


def kept_joints(tree: RobotTree, end: str, below: bool) -> list[TreeJoint]:
    """The joints from the root to a link, and those below it if asked."""
    chain = list(tree.chain(tree.root, end, str(tree.path)))
    return chain + (list(tree.below(end)) if below else [])


def assumed_limits(joints: list[TreeJoint]) -> dict[str, tuple[float, float]]:
    """Limits of the joints whose file states none."""
    return {
        joint.name: NO_LIMITS[joint.type]
        for joint in joints
        if joint.type in NO_LIMITS and joint.limits is None and joint.coupling is None
    }


def assumed_locks(joints: list[TreeJoint]) -> dict[str, float]:
    """Joints that have no single axis stand still."""
    single = ("fixed", "revolute", "continuous", "prismatic")
    return {joint.name: 0.0 for joint in joints if joint.type not in single}


def spinners(tree: RobotTree, palm: str) -> dict[str, float]:
    """Joints below a palm that turn without end by themselves: propellers, no fingers.

    They stand still, at zero, if there are other chains that may be fingers.
    """
    first = moving_below(tree, palm)
    found = [
        joint
        for joint in first
        if joint.type == "continuous" and not joint.coupling and not moving_below(tree, joint.child)
    ]
    leaders = {joint.coupling.of for joint in tree.joints if joint.coupling is not None}
    alone = [joint for joint in found if joint.name not in leaders]
    return {joint.name: 0.0 for joint in alone} if len(alone) < len(first) else {}


def file_text(path: Path, out: Path) -> str:
    """A file as a description names it: relative to that, if it is not far from it."""
    here, there = out.resolve().parent, path.resolve()
    try:
        return there.relative_to(here).as_posix()
    except ValueError:
        return there.as_posix()


def _rigid(tree: RobotTree, link: str) -> list[str]:
    found = [link]
    for joint in tree.joints:
        if joint.type == "fixed" and joint.parent in found:
            found.append(joint.child)
    return found


def _ends(tree: RobotTree) -> list[str]:
    parents = {joint.parent for joint in tree.joints}
    return [link for link in tree.links if link not in parents]
