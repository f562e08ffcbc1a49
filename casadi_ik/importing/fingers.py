"""Which branches below the palm are fingers, where each ends, and what to call it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from casadi_ik.importing.posture import Postures
from casadi_ik.robots.description import Joint
from casadi_ik.robots.robot_files.tree import RobotTree, TreeJoint

WORDS = {
    "thumb": r"thumb|(?<![a-z])th(?=[jb_]|dist|prox|mid|tip|hub|base|$)",
    "index": r"index|fore_?finger|(?<![a-z])ff(?=j|dist|prox|mid|knuck|tip|_|$)",
    "ring": r"(?<![a-z])ring|(?<![a-z])rf(?=j|dist|prox|mid|knuck|tip|_|$)",
    "little": r"little|pinky|(?<![a-z])lf(?=j|dist|prox|mid|knuck|meta|tip|_|$)",
    "middle": r"middle_?finger|(?<![a-z])mf(?=j|dist|prox|mid|knuck|tip|_|$)|middle",
}
"""What the fingers' names look like; a middle phalanx must not make a finger the middle one."""

LONG_CHAIN = 6
"""So many joints in a row are an arm, not a finger."""


@dataclass(frozen=True)
class Branch:
    """A finger as found in a tree.

    Attributes:
        name: What it is called.
        chain: Its joints that move, from the palm to the tip.
        link: The link that carries the pad.
        links: All links of the branch.
        named: Whether the file's names say which finger it is.
    """

    name: str
    chain: tuple[Joint, ...]
    link: str
    links: tuple[str, ...]
    named: bool


def palms(tree: RobotTree) -> list[str]:
    """Links from which two or more chains that move go out, from the root down."""
    return [link for link in tree.links if len(moving_below(tree, link)) >= 2]


def holds_arms(tree: RobotTree, palm: str) -> bool:
    """Whether what hangs on a link is rather arms than fingers."""
    return any(_depth(tree, joint.child) + 1 >= LONG_CHAIN for joint in moving_below(tree, palm))


def moving_below(tree: RobotTree, link: str) -> list[TreeJoint]:
    """The first moving joints below a link, those behind fixed ones included."""
    found: list[TreeJoint] = []
    for joint in tree.joints:
        if joint.parent == link:
            found += [joint] if joint.type != "fixed" else moving_below(tree, joint.child)
    return found


def _depth(tree: RobotTree, link: str) -> int:
    """The most moving joints in a row below a link."""
    below = [joint for joint in tree.joints if joint.parent == link]
    return max((_depth(tree, one.child) + (one.type != "fixed") for one in below), default=0)


def find_fingers(postures: Postures, palm: str) -> list[Branch]:
    """The fingers below a palm, in the file's order."""
    first = [
        joint
        for joint in postures.part.joints
        if joint.type != "fixed"
        and postures.moving_link(joint.parent) == postures.moving_link(palm)
        and _below(postures, joint.child, palm)
    ]
    found: list[Branch] = []
    for joint in first:
        for start, end in _ends(postures, joint):
            links = [start.child]
            for other in postures.part.joints:
                if other.parent in links:
                    links.append(other.child)
            names = [*links, *(one.name for one in postures.part.joints if one.child in links)]
            word, chain = _word(names), tuple(postures.chain(end.child, palm))
            link = _tip(postures, end.child)
            found.append(Branch(word or "", chain, link, tuple(links), bool(word)))
    return _called(found)


def _ends(postures: Postures, joint: Joint) -> list[tuple[Joint, Joint]]:
    """The fingers that a joint carries: the first joint that is one's own, and its last.

    Two chains of two joints or more that hang on one joint are two fingers; of shorter ones
    (linkages) the longest counts.
    """
    next_ = _next(postures, joint)
    long = [one for one in next_ if _length(postures, one) >= 2]
    if len(long) >= 2:
        return [pair for one in long for pair in _ends(postures, one)]
    if not next_:
        return [(joint, joint)]
    longest = max(next_, key=lambda one: _length(postures, one))
    further = _ends(postures, longest)
    return further if len(further) > 1 else [(joint, further[0][1])]


def _next(postures: Postures, joint: Joint) -> list[Joint]:
    """The next joints that move, those behind fixed ones included."""
    carried = postures.rigid(joint.child)
    joints = postures.part.joints
    return [one for one in joints if one.type != "fixed" and one.parent in carried]


def _length(postures: Postures, joint: Joint) -> int:
    """The most moving joints in a row, this one included."""
    return 1 + max((_length(postures, one) for one in _next(postures, joint)), default=0)


def _below(postures: Postures, link: str, palm: str) -> bool:
    while link in postures.by_child and link != palm:
        link = postures.by_child[link].parent
    return link == palm


def _tip(postures: Postures, link: str) -> str:
    """The last link, or the frame of a tip that is fixed to it."""
    ends = [one for one in postures.rigid(link)[1:] if "tip" in one.lower()]
    return ends[0] if len(ends) == 1 else link


def _word(names: list[str]) -> str | None:
    """The finger that most of some names speak of."""
    lower = [name.lower() for name in names]
    counts = {
        word: sum(bool(re.search(pattern, name)) for name in lower)
        for word, pattern in WORDS.items()
    }
    best = max(counts, key=lambda word: counts[word])  # the first of equals: middle is the last
    if counts["middle"] and best != "middle" and counts[best] < len(lower) / 2 < counts["middle"]:
        best = "middle"
    return best if counts[best] else None


def _called(branches: list[Branch]) -> list[Branch]:
    """Names for all: those of fingers, what a branch's links begin with, or numbers."""
    stems = [_stem(branch.links) for branch in branches]
    called: list[Branch] = []
    for i, (branch, stem) in enumerate(zip(branches, stems, strict=True)):
        same = [one for one in branches if one.name == branch.name]
        name = branch.name if branch.named and len(same) == 1 else ""
        if not name and len(stem) >= 3 and stems.count(stem) == 1:
            name = stem
        if not name or any(one.name == name for one in called):
            name = f"finger_{i + 1}"
        called.append(Branch(name, branch.chain, branch.link, branch.links, branch.named))
    return called


def _stem(links: tuple[str, ...]) -> str:
    if len(links) < 2:
        return ""
    first, *others = (link.lower() for link in links)
    same = [all(one[: i + 1] == first[: i + 1] for one in others) for i in range(len(first))]
    common = first[: sum(same)]
    common = re.sub(r"(link|phalanx|body|joint)_*$", "", common.rstrip("_-. "))
    return re.sub(r"[^a-z0-9_]+", "_", common).strip("_")
