"""What is guessed of a hand: its fingers, the thumb, the pads of the fingertips, a home posture."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.surfaces import Surface, together
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint
from casadi_ik.model.linkage import (
    chain_to,
    joint_depth,
    joint_positions,
    joints_below,
    link_poses,
    moving_below,
    rigid_links,
)
from casadi_ik.model.parts import RobotPart
from casadi_ik.model.xml_tree import RobotTree, TreeJoint

WORDS = {
    "thumb": r"thumb|(?<![a-z])th(?=[jb_]|dist|prox|mid|tip|hub|base|$)",
    "index": r"index|fore_?finger|(?<![a-z])ff(?=j|dist|prox|mid|knuck|tip|_|$)",
    "ring": r"(?<![a-z])ring|(?<![a-z])rf(?=j|dist|prox|mid|knuck|tip|_|$)",
    "little": r"little|pinky|(?<![a-z])lf(?=j|dist|prox|mid|knuck|meta|tip|_|$)",
    "middle": r"middle_?finger|(?<![a-z])mf(?=j|dist|prox|mid|knuck|tip|_|$)|middle",
}
"""What the fingers' names look like; a middle phalanx must not make a finger the middle one."""


@dataclass(frozen=True)
class GuessParameters:
    """How fingers, thumb, pads and home are guessed.

    Attributes:
        arm_joints: Least number of motors in a row of an arm beside other chains.
        arm_length: Least length of the path along such an arm [m]; fingers are shorter.
        lone_arm_joints: Least number of motors of an arm that is the only chain of its file.
        palm_chains: Least number of chains of a palm that another palm is beside.
        postures: At random, over which opposition is averaged.
        clear: By how much the thumb has to be more opposed than the next finger, of 2, to be called
            clear.
        parallel: Cosine above which two joints of a finger bend it the same way.
        sure: Relative difference of distances above which they say which way a finger closes.
        home_samples: Postures of the arm that are compared, if it has at most `usual_joints`.
        usual_joints: Joints of an arm.
        step: Of the differences that a Jacobian is made of [rad or m].
    """

    arm_joints: int = 6
    arm_length: float = 0.25
    lone_arm_joints: int = 5
    palm_chains: int = 3
    postures: int = 64
    clear: float = 0.15
    parallel: float = 0.7
    sure: float = 0.05
    home_samples: int = 300
    usual_joints: int = 12
    step: float = 1e-6


GUESS = GuessParameters()


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


JAW = r"jaw|finger|claw|knuckle|thumb"
"""Names of a jaw at the end of a chain, or of its joint; that may also be called a gripper."""

LEG = r"leg|foot|ankle|knee|hip|toe"
"""Names of the joints and links of legs."""


def palms(tree: RobotTree) -> list[str]:
    """Return the links that carry two or more moving chains, from the root down."""
    return [link for link in tree.links if len(moving_below(tree, link)) >= 2]


def motors_in_a_row(tree: RobotTree, joint: TreeJoint) -> int:
    """Return the most joints without coupling in a row, from a joint outwards."""
    further = (motors_in_a_row(tree, next_) for next_ in moving_below(tree, joint.child))
    return (joint.coupling is None) + max(further, default=0)


def is_limb(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether what a joint moves has as many motors as an arm, and is as long as one."""
    return (
        motors_in_a_row(tree, joint) >= GUESS.arm_joints
        and _length(tree, joint.child) >= GUESS.arm_length
    )


def _length(tree: RobotTree, link: str) -> float:
    """Return the length of the longest path of joints below a link [m]."""
    steps = (
        float(np.linalg.norm(joint.placement[:3, 3])) + _length(tree, joint.child)
        for joint in tree.joints
        if joint.parent == link
    )
    return max(steps, default=0.0)


def holds_arms(tree: RobotTree, palm: str) -> bool:
    """Return whether chains below a link are as long as arms."""
    return bool(ends_of_arms(tree, palm))


def ends_of_arms(tree: RobotTree, palm: str) -> list[str]:
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
    ends = _ends_below(tree, tree.root, None)
    hands = [end for end in ends if end.has_fingers]
    arms = [end for end in ends if not _is_leg(tree, end.link)]
    return hands or arms or ends


def _ends_below(tree: RobotTree, link: str, last: TreeJoint | None) -> list[LimbEnd]:
    """Return the ends of the limbs below a link, which a joint moves (None: the root)."""
    chains = moving_below(tree, link)
    chains = [joint for joint in chains if not _is_wheel(tree, joint)] or chains
    if not chains:
        if last is not None and re.search(f"{JAW}|gripper", last.name.lower()):
            return [LimbEnd(last.parent, True)]
        if last is not None and re.search(JAW, last.child.lower()):
            return [LimbEnd(last.parent, True)]
        return [LimbEnd(link, False)]
    if len(chains) == 1:
        return _ends_below(tree, chains[0].child, chains[0])
    limbs = [joint for joint in chains if is_limb(tree, joint)]
    if not limbs:  # several whole hands, each on a wrist
        limbs = [joint for joint in chains if _carries_a_palm(tree, joint)]
        limbs = limbs if len(limbs) > 1 else []
    if not limbs:
        return [LimbEnd(link, True)]
    return [end for joint in limbs for end in _ends_below(tree, joint.child, joint)]


def _carries_a_palm(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether a link from which three or more chains go out is moved by a joint."""
    links = (joint.child, *(further.child for further in joints_below(tree, joint.child)))
    return any(len(moving_below(tree, link)) >= GUESS.palm_chains for link in links)


def _is_wheel(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether a joint turns without limits and moves nothing else."""
    leads = any(other.coupling and other.coupling.of == joint.name for other in tree.joints)
    is_free = joint.type == "continuous" and joint.coupling is None and not leads
    return is_free and not moving_below(tree, joint.child)


def _is_leg(tree: RobotTree, link: str) -> bool:
    """Return whether the names of a chain are those of a leg."""
    chain = [joint for joint in chain_to(tree, link) if joint.type != "fixed"]
    return any(re.search(LEG, f"{joint.name} {joint.child}".lower()) for joint in chain[-3:])


def find_fingers(part: RobotPart, palm: str) -> list[Branch]:
    """The fingers below a palm, in the file's order."""
    found: list[Branch] = []
    for joint in moving_below(part, palm):
        for start, end in _ends(part, joint):
            links = [start.child, *(one.child for one in joints_below(part, start.child))]
            names = [*links, *(one.name for one in part.joints if one.child in links)]
            to_end = chain_to(part, end.child, palm)
            word, chain = _word(names), tuple(one for one in to_end if one.type != "fixed")
            link = _tip(part, end.child)
            found.append(Branch(word or "", chain, link, tuple(links), bool(word)))
    return _called(found)


def _ends(part: RobotPart, joint: Joint) -> list[tuple[Joint, Joint]]:
    """The fingers that a joint carries: the first joint that is one's own, and its last.

    Two chains of two joints or more that hang on one joint are two fingers; of shorter ones
    (linkages) the longest counts.
    """
    next_ = moving_below(part, joint.child)
    long = [one for one in next_ if joint_depth(part, one.child) >= 1]
    if len(long) >= 2:
        return [pair for one in long for pair in _ends(part, one)]
    if not next_:
        return [(joint, joint)]
    longest = max(next_, key=lambda one: joint_depth(part, one.child))
    further = _ends(part, longest)
    return further if len(further) > 1 else [(joint, further[0][1])]


def _tip(part: RobotPart, link: str) -> str:
    """The last link, or the frame of a tip that is fixed to it."""
    ends = [one for one in rigid_links(part, link)[1:] if "tip" in one.lower()]
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


def guess_thumb(part: RobotPart, branches: list[Branch], pads: list[Pad]) -> tuple[int, str]:
    """The thumb's place among the fingers, and how it was found."""
    named = [i for i, branch in enumerate(branches) if branch.named and branch.name == "thumb"]
    if len(named) == 1:
        return named[0], "the file calls it so"
    if len(branches) == 1:
        return 0, "the only finger"
    rng = np.random.default_rng(0)
    opposed = np.zeros(len(branches))
    for _ in range(GUESS.postures):
        poses = _poses(part, _random(part, rng))
        normals = np.array([poses[pad.link][:3, :3] @ pad.normal for pad in pads])
        # Bent fingers all face the palm: what counts is how they face each other across it.
        reaches = [
            _apply(poses[pad.link], pad.point) - poses[branch.chain[0].child][:3, 3]
            for branch, pad in zip(branches, pads, strict=True)
        ]
        z = _unit(np.mean(reaches, axis=0), np.array([0.0, 0.0, 1.0]))
        normals -= np.outer(normals @ z, z)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        cosines = normals @ normals.T
        opposed -= (cosines.sum(axis=1) - 1) / (len(branches) - 1) / GUESS.postures
    best, second = np.argsort(-opposed)[:2]
    if opposed[best] - opposed[second] < GUESS.clear:
        lengths = [len(branch.chain) for branch in branches]
        if lengths.count(min(lengths)) == 1:  # the one that does not spread
            return lengths.index(min(lengths)), "none opposes the others most: the simplest finger"
        return 0, "none opposes the others most: the first finger"
    return int(best), "its pad is the one most opposed to the others"


def guess_palm_frame(
    part: RobotPart, palm: str, branches: list[Branch], pads: list[Pad], thumb: int
) -> Array:
    """(4, 4) in the palm's link: origin amid the fingers' bases, z outwards, y to the thumb."""
    poses = _poses(part, _middle(part))
    inverse = np.linalg.inv(poses[palm])
    bases = np.array([(inverse @ poses[one.chain[0].child])[:3, 3] for one in branches])
    tips = (
        np.array([_apply(poses[pad.link], pad.point) for pad in pads]) @ inverse[:3, :3].T
        + inverse[:3, 3]
    )
    others = np.delete(bases, thumb, axis=0)
    reaches = np.delete(tips - bases, thumb, axis=0) if len(others) else tips - bases
    z = _unit(reaches.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    to_thumb = bases[thumb] - (others.mean(axis=0) if len(others) else 0 * bases[thumb])
    if np.linalg.norm(to_thumb - (to_thumb @ z) * z) < 5e-3:
        to_thumb = tips[thumb] - (np.delete(tips, thumb, axis=0).mean(axis=0) if len(others) else 0)
    y = _unit(_across(to_thumb, z), _any_across(z))
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    frame[:3, 3] = bases.mean(axis=0)
    return frame


def _unit(vector: Array, otherwise: Array) -> Array:
    length = float(np.linalg.norm(vector))
    chosen = vector if length > 1e-9 else otherwise
    return chosen / np.linalg.norm(chosen)


TILT = np.cos(np.deg2rad(45.0))
"""The skin may be tilted so far from where the finger bends to."""


@dataclass(frozen=True, eq=False)
class Pad:
    """A guessed contact frame.

    Attributes:
        link: The link.
        point: (3,) in the link's frame [m].
        normal: (3,) outward, unit, in the link's frame.
        how: How it was found, for a comment.
    """

    link: str
    point: Array
    normal: Array
    how: str


def guess_pads(
    part: RobotPart, palm: str, branches: list[Branch], surfaces: dict[str, Surface]
) -> list[Pad]:
    """A pad for every finger."""
    middle = _middle(part)
    poses = _poses(part, middle)
    bodies = [_body(part, branch, surfaces) for branch in branches]
    tips = [
        _apply(poses[branch.chain[index].child], tip)
        for branch, (_, tip, index) in zip(branches, bodies, strict=True)
    ]
    pads: list[Pad] = []
    for i, branch in enumerate(branches):
        others = [tip for j, tip in enumerate(tips) if j != i]
        meeting = np.mean(others, axis=0) if others else poses[palm][:3, 3]
        if not others and palm in surfaces:  # a jaw closes towards the nearest part of the palm
            points = surfaces[palm].moved(poses[palm]).points
            meeting = points[np.argmin(np.linalg.norm(points - tips[i], axis=1))]
        pads.append(_pad(part, branch, bodies[i], meeting))
    return pads


def guess_fixed_jaw(part: RobotPart, palm: str, pad: Pad, surface: Surface | None) -> Pad:
    """Return the pad of a jaw that is fixed to the palm's link, opposite the one that moves.

    Args:
        part: The hand.
        palm: The link.
        pad: The pad of the jaw that moves.
        surface: The shape of the palm's link; None if it is not known.
    """
    poses = _poses(part, _middle(part))
    pose = np.linalg.inv(poses[palm]) @ poses[pad.link]
    point, normal = _apply(pose, pad.point), pose[:3, :3] @ pad.normal
    hit = None if surface is None else surface.hit(point, normal)
    if hit is not None:
        return Pad(palm, hit, -normal, "where a ray from the jaw that moves meets the palm's link")
    ends = []
    for joint in part.joints:
        for value in (joint.lower, joint.upper) if joint.type != "fixed" else ():
            moved = _poses(part, _middle(part) | {joint.name: value})
            ends.append(_apply(np.linalg.inv(moved[palm]) @ moved[pad.link], pad.point))
    closed = max(ends, key=lambda end: float((end - point) @ normal))
    return Pad(palm, closed, -normal, "where the jaw that moves is when it is closed")


def tool_pad(link: str) -> Pad:
    """Return the pad of an arm without a hand: the origin of its last link, facing along z."""
    return Pad(link, np.zeros(3), np.array([0.0, 0.0, 1.0]), "the arm's last frame faces along z")


Body = tuple[Surface | None, Array, int]
"""The shape of the last phalanx in its moving link's frame, a point at its end, and which of the
chain's joints moves it."""


def _body(part: RobotPart, branch: Branch, surfaces: dict[str, Surface]) -> Body:
    rest = _poses(part, {})
    for index in reversed(range(len(branch.chain))):
        joint = branch.chain[index]
        inverse = np.linalg.inv(rest[joint.child])
        parts = [
            surfaces[link].moved(inverse @ rest[link])
            for link in rigid_links(part, joint.child)
            if link in surfaces
        ]
        whole = together(parts)
        if whole is not None and len(whole.points):
            return whole, _end(whole, joint), index
    joint = branch.chain[-1]
    place = (np.linalg.inv(rest[joint.child]) @ rest[branch.link])[:3, 3]
    if np.linalg.norm(place) < 3e-3:  # no frame of a tip: as long as most of the phalanx before
        before = rest[branch.chain[-2].child] if len(branch.chain) > 1 else np.eye(4)
        step = rest[joint.child][:3, 3] - before[:3, 3]
        place = 0.8 * rest[joint.child][:3, :3].T @ step
    return None, place, len(branch.chain) - 1


def _end(body: Surface, joint: Joint) -> Array:
    """The end of the last phalanx: as far from its joint as the shape goes, in its middle."""
    u = _long_way(body, joint)
    along = body.points @ u
    far = body.points[along > 0.6 * along.max()] if along.max() > 0 else body.points
    middle = (far.min(axis=0) + far.max(axis=0)) / 2
    return middle + (along.max() - middle @ u) * u


def _long_way(body: Surface, joint: Joint) -> Array:
    """Unit direction from the joint to the middle of the phalanx, across the joint's axis."""
    way = _across(body.centroid(), joint.axis)
    if np.linalg.norm(way) < 3e-3:
        flat = body.points - np.outer(body.points @ joint.axis, joint.axis)
        way = flat[np.argmax(np.linalg.norm(flat, axis=1))]
    return _unit(way, np.array([0.0, 0.0, 1.0]))


def _pad(part: RobotPart, branch: Branch, body: Body, meeting: Array) -> Pad:
    shape, end, index = body
    joint = branch.chain[index]
    sign, why = _closing(part, branch, index, end, meeting)
    if joint.type == "prismatic":
        normal, u = sign * joint.axis, _unit(_across(end, joint.axis), _any_across(joint.axis))
    else:
        u = _long_way(shape, joint) if shape is not None else _across(end, joint.axis)
        u = _unit(u, _any_across(joint.axis))
        normal = sign * np.cross(joint.axis, u)
    if shape is None:
        point, how = end, "the file has no shapes: the point is the tip's frame or a guess of it"
    else:
        point, how, radius = _skin(shape, u, normal)
        faced = shape.facing(point, radius, normal)
        if joint.type != "prismatic":
            faced = _unit(_across(faced, joint.axis), normal)
        if faced @ normal > TILT:
            normal = faced
    rest = _poses(part, {})
    pose = np.linalg.inv(rest[branch.link]) @ rest[joint.child]
    link = branch.link
    if not np.isfinite(pose).all() or _moving_link(part, link) != joint.child:
        link, pose = joint.child, np.eye(4)
    return Pad(link, _apply(pose, point), pose[:3, :3] @ normal, f"{how}; {why}")


def _skin(shape: Surface, u: Array, normal: Array) -> tuple[Array, str, float]:
    """The point of the shape over the middle of the fingertip, on the side the normal shows.

    Also how it was found, and within what distance the skin counts as the pad.
    """
    side = np.cross(u, normal)
    along = shape.points @ u
    length = float(along.max())
    far = shape.points[along >= length - 0.4 * max(length, float(np.ptp(along)))]
    height = float(np.ptp(far @ normal))
    back = min(max(height / 2, 0.1 * length), 0.5 * max(length, 1e-3))
    there = (far @ side).min(), (far @ side).max()
    start = (length - back) * u + float(np.mean(there)) * side
    reach = float(np.abs(shape.points).max()) * 4 + 0.1
    hit = shape.hit(start + reach * normal, -normal)
    if hit is not None:
        how = f"where a ray meets the shape {1e3 * back:.1f} mm before the tip's end"
        return hit, how, back / 2
    flat = start - (start @ normal) * normal
    there = flat + float((far @ normal).max()) * normal
    return there, "no ray meets the shape: its farthest point", 0.0


def _closing(
    part: RobotPart, branch: Branch, index: int, end: Array, meeting: Array
) -> tuple[float, str]:
    """Which way the last joint turns when the finger closes, and how that was decided."""
    joint = branch.chain[index]
    middle = _middle(part)
    poses = _poses(part, middle)
    axis = poses[joint.child][:3, :3] @ joint.axis
    bending: dict[str, float] = {}
    for one in branch.chain[: index + 1]:
        if one.type == joint.type:
            cosine = float(poses[one.child][:3, :3] @ one.axis @ axis)
            if abs(cosine) > GUESS.parallel:
                bending[one.name] = np.sign(cosine)
    base = next(one for one in branch.chain if one.name in bending)

    joints = {one.name: one for one in part.joints}

    def tip(sign: float) -> tuple[Array, Array]:
        values = dict(middle)
        for name, way in bending.items():
            one = joints[name]
            values[name] = one.upper if way * sign > 0 else one.lower
        found = _poses(part, values)
        return _apply(found[joint.child], end), found[base.child][:3, 3]

    (plus, root), (minus, _) = tip(1.0), tip(-1.0)
    if len(bending) > 1:
        lengths = float(np.linalg.norm(plus - root)), float(np.linalg.norm(minus - root))
        if abs(lengths[0] - lengths[1]) > GUESS.sure * max(lengths):
            return (1.0 if lengths[0] < lengths[1] else -1.0), "faces the way the finger bends"
    here = poses[joint.child]
    place = _apply(here, end)
    way = axis if joint.type == "prismatic" else np.cross(axis, place - here[:3, 3])
    sign = 1.0 if way @ (meeting - place) >= 0 else -1.0
    return sign, "faces the other fingers"


def _middle(part: RobotPart) -> dict[str, float]:
    """Every joint in the middle of its range [rad or m]."""
    return {one.name: (one.lower + one.upper) / 2 for one in part.joints if one.type != "fixed"}


def _random(part: RobotPart, rng: np.random.Generator) -> dict[str, float]:
    """Every joint anywhere in the middle half of its range, couplings left out."""
    return {
        one.name: one.lower + (0.25 + 0.5 * rng.random()) * (one.upper - one.lower)
        for one in part.joints
        if one.type != "fixed"
    }


def _poses(part: RobotPart, values: Mapping[str, float]) -> dict[str, Array]:
    """(4, 4) pose of every link in the root's frame."""
    return link_poses(part.root, part.joints, values)


def _moving_link(part: RobotPart, link: str) -> str:
    """The link itself, or the next one above that a joint moves."""
    moving = [one.child for one in chain_to(part, link) if one.type != "fixed"]
    return moving[-1] if moving else part.root


def _apply(pose: Array, point: Array) -> Array:
    return pose[:3, :3] @ point + pose[:3, 3]


def _across(vector: Array, axis: Array) -> Array:
    return vector - (vector @ axis) * axis


def _any_across(axis: Array) -> Array:
    across: Array = np.asarray(np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]), dtype=float)
    return _unit(across, axis)


TURN = np.pi / 2
"""A joint is not turned further than this from the middle of its range, however wide it is."""


def guess_home(robot: RobotDescription) -> Array:
    """(n,) the hand half closed, the arm well within its limits and able to move every way.

    Of a body side by side, with its trunk at zero.
    """
    middle = (robot.lower + robot.upper) / 2
    if robot.sides:
        home = np.clip(0.0, robot.lower, robot.upper)
        for side, (arm, hand) in zip(robot.sides, robot.side_actuators, strict=True):
            home[sorted((*arm, *hand))] = guess_home(robot.side(side.name))
        return home
    arm = list(robot.arm_actuators)
    if not arm:
        return _round(middle, robot)
    chain = robot.chain(robot.palm_link)
    rng = np.random.default_rng(0)
    half = np.minimum((robot.upper - robot.lower)[arm] / 4, TURN)
    best, found = -1.0, middle
    # What a posture takes grows with the square of the joints.
    for i in range(
        max(1, int(GUESS.home_samples * min(1.0, (GUESS.usual_joints / len(arm)) ** 2)))
    ):
        q = middle.copy()
        if i:
            q[arm] += half * rng.uniform(-1, 1, len(arm))
        value = _freedom(robot, chain, q, arm)
        if value > best:
            best, found = value, q
    return _round(found, robot)


def _freedom(robot: RobotDescription, chain: tuple[Joint, ...], q: Array, arm: list[int]) -> float:
    """The least that the palm moves for a motion of the arm's motors, a metre as a radian."""
    pose = _palm(robot, chain, q)
    columns = []
    for i in arm:
        other = q.copy()
        other[i] += GUESS.step
        change = (_palm(robot, chain, other) - pose) @ np.linalg.inv(pose) / GUESS.step
        columns.append([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]])
    values = np.linalg.svd(np.array(columns).T, compute_uv=False)
    return float(values[: min(6, len(arm))].min())


def _palm(robot: RobotDescription, chain: tuple[Joint, ...], q: Array) -> Array:
    values = joint_positions(robot.joints, dict(zip(robot.actuator_names, q, strict=True)))
    positions = {name: float(value[0]) for name, value in values.items()}
    return link_poses(robot.root, chain, positions)[robot.palm_link]


def _round(q: Array, robot: RobotDescription) -> Array:
    """Two digits where they are within the limits."""
    short = np.where(robot.upper - robot.lower > 0.5, np.round(q, 2), np.round(q, 4))
    inside = (short > robot.lower) & (short < robot.upper)
    return np.where(inside, short, q)
