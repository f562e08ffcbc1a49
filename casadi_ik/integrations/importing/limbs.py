"""Limbs of a robot file: palms, arms, legs and their ends, recognised from the tree of joints."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from casadi_ik.model.joints import chain_to, joints_below, moving_below
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
    chains = [joint for joint in chains if not _is_wheel(tree, joint)] or chains
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


def _is_wheel(tree: RobotTree, joint: TreeJoint) -> bool:
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
