"""Limbs of a robot file (palms, arms, legs, end links), recognised from the tree of joints."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.model.joints import chain_to, joints_below, leaf_links, moving_below, rigid_links
from casadi_ik.model.multi_arm import MAX_SIDES
from casadi_ik.model.xml_tree import RobotTree, TreeJoint

MIN_ARM_JOINTS = 6
"""Minimum number of consecutive motors of an arm beside other chains."""

MIN_ARM_LENGTH = 0.25
"""Minimum length of an arm beside other chains [m]; fingers are shorter."""

MIN_LONE_ARM_JOINTS = 5
"""Minimum number of motors of an arm that is the only chain of its file."""

MIN_PALM_CHAINS = 3
"""Minimum number of chains of a palm if there are several palms."""

JAW_PATTERN = r"jaw|finger|claw|knuckle|thumb"
"""Names of a jaw at the end of a chain; its joint may also be called gripper."""

LEG_PATTERN = r"leg|foot|ankle|knee|hip|toe"
"""Names of the joints and links of legs."""


def palms(tree: RobotTree) -> list[str]:
    """Return the links that carry two or more moving chains, from the root outwards."""
    return [link for link in tree.links if len(moving_below(tree, link)) >= 2]


def longest_motor_chain(tree: RobotTree, joint: TreeJoint) -> int:
    """Return the largest number of joints without coupling in series, from a joint outwards."""
    counts = (longest_motor_chain(tree, child) for child in moving_below(tree, joint.child))
    return (joint.coupling is None) + max(counts, default=0)


def is_limb(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether the chain that starts with a joint has the motors and length of an arm."""
    return (
        longest_motor_chain(tree, joint) >= MIN_ARM_JOINTS
        and _longest_path(tree, joint.child) >= MIN_ARM_LENGTH
    )


def _longest_path(tree: RobotTree, link: str) -> float:
    """Return the length of the longest path of joints below a link [m]."""
    steps = (
        float(np.linalg.norm(joint.placement[:3, 3])) + _longest_path(tree, joint.child)
        for joint in tree.joints
        if joint.parent == link
    )
    return max(steps, default=0.0)


def carries_arms(tree: RobotTree, palm: str) -> bool:
    """Return whether chains below a link are as long as arms."""
    return bool(arm_ends(tree, palm))


def arm_ends(tree: RobotTree, palm: str) -> list[str]:
    """Return the links that carry the last joints of chains as long as arms, below a link."""
    return [
        joint.parent
        for first in moving_below(tree, palm)
        if is_limb(tree, first)
        for joint in (first, *joints_below(tree, first.child))
        if joint.type != "fixed" and not moving_below(tree, joint.child)
    ]


@dataclass(frozen=True)
class LimbEnd:
    """The end of an arm or a leg, or a hand.

    Attributes:
        link: The palm, or the last link.
        has_fingers: Whether joints move below the link.
    """

    link: str
    has_fingers: bool


def limb_ends(tree: RobotTree) -> list[LimbEnd]:
    """Return the hands of a file, or the ends of its arms if it has no hands."""
    limbs = _ends_below(tree, tree.root, None)
    hands = [end for end in limbs if end.has_fingers]
    arms = [end for end in limbs if not _is_leg(tree, end.link)]
    return hands or arms or limbs


def _ends_below(tree: RobotTree, link: str, parent_joint: TreeJoint | None) -> list[LimbEnd]:
    """Return the ends of the limbs below a link.

    Args:
        tree: The robot file.
        link: The link.
        parent_joint: Joint that moves the link; None for the root.
    """
    chains = moving_below(tree, link)
    chains = [joint for joint in chains if not is_wheel(tree, joint)] or chains
    if not chains:
        if parent_joint is not None and (
            re.search(f"{JAW_PATTERN}|gripper", parent_joint.name.lower())
            or re.search(JAW_PATTERN, parent_joint.child.lower())
        ):
            return [LimbEnd(parent_joint.parent, True)]
        return [LimbEnd(link, False)]
    if len(chains) == 1:
        return _ends_below(tree, chains[0].child, chains[0])
    limbs = [joint for joint in chains if is_limb(tree, joint)]
    if not limbs:  # several complete hands, each on a wrist
        limbs = [joint for joint in chains if _carries_a_palm(tree, joint)]
        limbs = limbs if len(limbs) > 1 else []
    if not limbs:
        return [LimbEnd(link, True)]
    return [end for joint in limbs for end in _ends_below(tree, joint.child, joint)]


def _carries_a_palm(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether a joint moves a link that carries `MIN_PALM_CHAINS` or more chains."""
    links = (joint.child, *(descendant.child for descendant in joints_below(tree, joint.child)))
    return any(len(moving_below(tree, link)) >= MIN_PALM_CHAINS for link in links)


def is_wheel(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether a joint is continuous, is not coupled, and moves no other joint."""
    leads = any(
        candidate.coupling and candidate.coupling.of == joint.name for candidate in tree.joints
    )
    is_independent = joint.type == "continuous" and joint.coupling is None and not leads
    return is_independent and not moving_below(tree, joint.child)


def _is_leg(tree: RobotTree, link: str) -> bool:
    """Return whether the names of a chain are those of a leg."""
    chain = [joint for joint in chain_to(tree, link) if joint.type != "fixed"]
    return any(
        re.search(LEG_PATTERN, f"{joint.name} {joint.child}".lower()) for joint in chain[-3:]
    )


TOOL_FRAME_PATTERNS = (
    r"tool0$",
    r"flange",
    r"eef|ee_link|end_?effector|attachment|link_?8$|tool",
)
"""Patterns of the names of frames on which hands are mounted, in order of preference."""

MAX_LISTED_LINKS = 8
"""Maximum number of links that an error message proposes."""

LinkChoice = tuple[str, str]
"""A link, and the option that names it or the reason of the guess."""


def choose_tip(tree: RobotTree, tip: str | None) -> LinkChoice:
    """Return the link of an arm that carries the hand.

    Args:
        tree: The file of the arm.
        tip: The link that the user names; None to guess it.

    Raises:
        InputError: The link does not exist, or the arm branches and `tip` is None.
    """
    if tip is None:
        return _guess_tip(tree)
    _require_link(tree, tip, "--tip")
    return tip, "--tip"


def _guess_tip(tree: RobotTree) -> LinkChoice:
    """Return the tool frame on the last link of an arm."""
    last_joint = None
    link = tree.root
    while len(movers := moving_below(tree, link)) == 1:
        last_joint = movers[0]
        link = last_joint.child
    if last_joint is None or (len(movers) > 1 and carries_arms(tree, link)):
        leaves = ", ".join(leaf_links(tree, tree.root)[:MAX_LISTED_LINKS])
        raise InputError(
            f"--tip: missing; {tree.path.name} branches at {link!r}; expected the link that "
            f"carries the hand, for example {leaves}"
        )
    frame = tool_frame(tree, last_joint.child)
    if frame != last_joint.child:
        return frame, f"tool frame that is fixed to the last joint ({last_joint.name})"
    return last_joint.child, f"link that the last joint ({last_joint.name}) moves"


def tool_frame(tree: RobotTree, link: str) -> str:
    """Return the frame fixed to a link that has a tool's name; the link if there is none."""
    fixed = rigid_links(tree, link)
    for pattern in TOOL_FRAME_PATTERNS:
        for name in fixed:
            if re.search(pattern, name.lower()):
                return name
    return link


def choose_palms(tree: RobotTree, named_links: Sequence[str]) -> dict[str, LinkChoice]:
    """Return the palm link of each hand by side; the side of a single hand is "".

    Args:
        tree: The file.
        named_links: Palm links that the user names; empty to guess them.

    Raises:
        InputError: A link does not exist, the links are no palms of separate hands, or they cannot
            be guessed.
    """
    for link in named_links:
        _require_link(tree, link, "--palm")
    choices = [(link, "--palm") for link in named_links] or _guess_palms(tree)
    if len(choices) > MAX_SIDES:
        count = f"found {len(choices)} links, expected at most {MAX_SIDES}"
        if not named_links:
            count = f"{tree.path.name} has several arms: {count}"
        examples = ", ".join(link for link, _ in choices[: MAX_LISTED_LINKS - 1])
        raise InputError(
            f"--palm: {count}; name links that carry fingers or end an arm: {examples}"
        )
    if len(choices) == 1:
        return {"": choices[0]}
    for link in named_links:
        if named_links.count(link) > 1:
            raise InputError(f"--palm: {link!r} is given twice; expected one link per hand")
        if any(joint.child in named_links for joint in joints_below(tree, link)):
            raise InputError(
                f"--palm: {link!r} carries another palm; expected hands on separate branches"
            )
    sides = [_side_name(link) for link, _ in choices]
    if "" in sides or len(set(sides)) < len(sides):
        sides = [f"side_{i + 1}" for i in range(len(choices))]
    return dict(zip(sides, choices, strict=True))


def _guess_palms(tree: RobotTree) -> list[LinkChoice]:
    """Return the palms of a file's hands, or the ends of its arms if it has no hands."""
    limbs = limb_ends(tree)
    if len(limbs) == 1:
        (end,) = limbs
        motors = [
            joint
            for joint in tree.chain(tree.root, end.link, str(tree.path))
            if joint.type != "fixed" and joint.coupling is None
        ]
        if not palms(tree) and len(motors) + end.has_fingers < MIN_LONE_ARM_JOINTS:
            return [(tree.root, "base of the only chain of joints")]
        if end.has_fingers and len(moving_below(tree, end.link)) > 1:
            return [(end.link, "first link that carries several chains of joints")]
    choices = []
    for end in limbs:
        if not end.has_fingers:
            choices.append((tool_frame(tree, end.link), "end of an arm without a hand"))
        elif len(moving_below(tree, end.link)) > 1:
            choices.append((end.link, "carries several chains of joints, none as long as an arm"))
        else:
            choices.append((end.link, "parent link of the last joint of an arm with a jaw"))
    return choices


def _side_name(link: str) -> str:
    """Return "left" or "right" if the name of a link contains it or its initial; "" otherwise."""
    match = re.search(r"left|right|(?<![a-z])[lr](?![a-z])", link.lower())
    return {"l": "left", "r": "right"}[match[0][0]] if match else ""


def palm_warning(tree: RobotTree, link: str) -> str:
    """Return a warning if a palm link carries arms instead of fingers; "" otherwise."""
    if link not in palms(tree) or not carries_arms(tree, link):
        return ""
    hands = [palm for palm in palms(tree) if not carries_arms(tree, palm)]
    candidates = list(dict.fromkeys(hands or arm_ends(tree, link)))
    return (
        f"link {link!r} of {tree.path.name} carries chains as long as arms; expected the link that "
        f"carries the fingers, for example {', '.join(candidates[: MAX_LISTED_LINKS - 1])}"
    )


def _require_link(tree: RobotTree, link: str, option: str) -> None:
    if link not in tree.links:
        raise InputError(
            f"{option}: {tree.path.name} has no link {link!r}; expected one of "
            f"{', '.join(tree.links)}"
        )
