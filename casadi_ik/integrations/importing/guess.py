"""Guesses about an imported hand: fingers, thumb, pads of the fingertips, home posture."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.meshes import IndexedMesh, merge_meshes
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

FINGER_PATTERNS = {
    "thumb": r"thumb|(?<![a-z])th(?=[jb_]|dist|prox|mid|tip|hub|base|$)",
    "index": r"index|fore_?finger|(?<![a-z])ff(?=j|dist|prox|mid|knuck|tip|_|$)",
    "ring": r"(?<![a-z])ring|(?<![a-z])rf(?=j|dist|prox|mid|knuck|tip|_|$)",
    "little": r"little|pinky|(?<![a-z])lf(?=j|dist|prox|mid|knuck|meta|tip|_|$)",
    "middle": r"middle_?finger|(?<![a-z])mf(?=j|dist|prox|mid|knuck|tip|_|$)|middle",
}
"""Patterns of finger names; a middle phalanx must not turn a finger into the middle finger."""


@dataclass(frozen=True)
class GuessParameters:
    """Parameters of the guesses.

    Attributes:
        arm_joints: Minimum number of consecutive motors of an arm beside other chains.
        arm_length: Minimum length of such an arm [m]; fingers are shorter.
        lone_arm_joints: Minimum number of motors of an arm that is the only chain of its file.
        palm_chains: Minimum number of chains of a palm if there are several palms.
        postures: Number of random postures over which opposition is averaged.
        min_opposition_gap: Minimum lead of the thumb's opposition (0 to 2) over the next finger.
        parallel: Cosine above which two joints bend a finger in the same direction.
        min_relative_difference: Minimum relative difference of distances that decides the closing
            direction of a finger.
        home_samples: Number of arm postures that are compared for an arm of `usual_arm_joints`.
        usual_arm_joints: Number of joints up to which all samples are compared.
        difference_step: Step of numerical Jacobians [rad or m].
    """

    arm_joints: int = 6
    arm_length: float = 0.25
    lone_arm_joints: int = 5
    palm_chains: int = 3
    postures: int = 64
    min_opposition_gap: float = 0.15
    parallel: float = 0.7
    min_relative_difference: float = 0.05
    home_samples: int = 300
    usual_arm_joints: int = 12
    difference_step: float = 1e-6


GUESS_PARAMETERS = GuessParameters()


@dataclass(frozen=True)
class Branch:
    """A finger in a tree of links.

    Attributes:
        name: Name of the finger.
        chain: Movable joints from the palm to the tip.
        link: Link that carries the pad.
        links: All links of the finger.
        is_named: True if names in the file identify the finger.
    """

    name: str
    chain: tuple[Joint, ...]
    link: str
    links: tuple[str, ...]
    is_named: bool


JAW = r"jaw|finger|claw|knuckle|thumb"
"""Names of a jaw at the end of a chain, or of its joint; that may also be called a gripper."""

LEG = r"leg|foot|ankle|knee|hip|toe"
"""Names of the joints and links of legs."""


def palms(tree: RobotTree) -> list[str]:
    """Return the links that carry two or more moving chains, from the root down."""
    return [link for link in tree.links if len(moving_below(tree, link)) >= 2]


def motors_in_a_row(tree: RobotTree, joint: TreeJoint) -> int:
    """Return the most joints without coupling in a row, from a joint outwards."""
    counts = (motors_in_a_row(tree, next_) for next_ in moving_below(tree, joint.child))
    return (joint.coupling is None) + max(counts, default=0)


def is_limb(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether what a joint moves has as many motors as an arm, and is as long as one."""
    return (
        motors_in_a_row(tree, joint) >= GUESS_PARAMETERS.arm_joints
        and _longest_path(tree, joint.child) >= GUESS_PARAMETERS.arm_length
    )


def _longest_path(tree: RobotTree, link: str) -> float:
    """Return the length of the longest path of joints below a link [m]."""
    steps = (
        float(np.linalg.norm(joint.placement[:3, 3])) + _longest_path(tree, joint.child)
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
    if not limbs:  # several complete hands, each on a wrist
        limbs = [joint for joint in chains if _carries_a_palm(tree, joint)]
        limbs = limbs if len(limbs) > 1 else []
    if not limbs:
        return [LimbEnd(link, True)]
    return [end for joint in limbs for end in _ends_below(tree, joint.child, joint)]


def _carries_a_palm(tree: RobotTree, joint: TreeJoint) -> bool:
    """Return whether a link from which three or more chains go out is moved by a joint."""
    links = (joint.child, *(further.child for further in joints_below(tree, joint.child)))
    return any(len(moving_below(tree, link)) >= GUESS_PARAMETERS.palm_chains for link in links)


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
    """Return the fingers below a palm, in the order of the file."""
    fingers: list[Branch] = []
    for joint in moving_below(part, palm):
        for start, end in _finger_ends(part, joint):
            links = [
                start.child,
                *(chain_joint.child for chain_joint in joints_below(part, start.child)),
            ]
            names = [
                *links,
                *(chain_joint.name for chain_joint in part.joints if chain_joint.child in links),
            ]
            to_end = chain_to(part, end.child, palm)
            word, chain = (
                _finger_word(names),
                tuple(chain_joint for chain_joint in to_end if chain_joint.type != "fixed"),
            )
            link = _tip(part, end.child)
            fingers.append(Branch(word or "", chain, link, tuple(links), bool(word)))
    return _with_names(fingers)


def _finger_ends(part: RobotPart, joint: Joint) -> list[tuple[Joint, Joint]]:
    """Return the first and last joint of each finger that a joint carries.

    Two chains of two or more joints on one joint are two fingers; of shorter chains (linkages) the
    longest counts.
    """
    next_joints = moving_below(part, joint.child)
    chains = [next_joint for next_joint in next_joints if joint_depth(part, next_joint.child) >= 1]
    if len(chains) >= 2:
        return [pair for next_joint in chains for pair in _finger_ends(part, next_joint)]
    if not next_joints:
        return [(joint, joint)]
    longest = max(next_joints, key=lambda next_joint: joint_depth(part, next_joint.child))
    ends = _finger_ends(part, longest)
    return ends if len(ends) > 1 else [(joint, ends[0][1])]


def _tip(part: RobotPart, link: str) -> str:
    """Return the last link, or the tip frame that is fixed to it."""
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
    best = max(counts, key=lambda word: counts[word])  # the first of equals: middle is the last
    if counts["middle"] and best != "middle" and counts[best] < len(lower) / 2 < counts["middle"]:
        best = "middle"
    return best if counts[best] else None


def _with_names(branches: list[Branch]) -> list[Branch]:
    """Return the branches with unique names: finger names, common prefixes of links, or numbers."""
    stems = [_stem(branch.links) for branch in branches]
    named: list[Branch] = []
    for i, (branch, stem) in enumerate(zip(branches, stems, strict=True)):
        namesakes = [other for other in branches if other.name == branch.name]
        name = branch.name if branch.is_named and len(namesakes) == 1 else ""
        if not name and len(stem) >= 3 and stems.count(stem) == 1:
            name = stem
        if not name or any(other.name == name for other in named):
            name = f"finger_{i + 1}"
        named.append(Branch(name, branch.chain, branch.link, branch.links, branch.is_named))
    return named


def _stem(links: tuple[str, ...]) -> str:
    if len(links) < 2:
        return ""
    first, *other_links = (link.lower() for link in links)
    is_common = [
        all(link[: i + 1] == first[: i + 1] for link in other_links) for i in range(len(first))
    ]
    common = first[: sum(is_common)]
    common = re.sub(r"(link|phalanx|body|joint)_*$", "", common.rstrip("_-. "))
    return re.sub(r"[^a-z0-9_]+", "_", common).strip("_")


def guess_thumb(part: RobotPart, branches: list[Branch], pads: list[Pad]) -> tuple[int, str]:
    """Return the index of the thumb among the fingers, and the reason."""
    is_named = [
        i for i, branch in enumerate(branches) if branch.is_named and branch.name == "thumb"
    ]
    if len(is_named) == 1:
        return is_named[0], "named in the file"
    if len(branches) == 1:
        return 0, "the only finger"
    rng = np.random.default_rng(0)
    opposition = np.zeros(len(branches))
    for _ in range(GUESS_PARAMETERS.postures):
        poses = _poses(part, _random(part, rng))
        normals = np.array([poses[pad.link][:3, :3] @ pad.normal for pad in pads])
        # Bent fingers all face the palm, so only the components across the palm count.
        reaches = [
            _apply(poses[pad.link], pad.point) - poses[branch.chain[0].child][:3, 3]
            for branch, pad in zip(branches, pads, strict=True)
        ]
        z = _unit(np.mean(reaches, axis=0), np.array([0.0, 0.0, 1.0]))
        normals -= np.outer(normals @ z, z)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        cosines = normals @ normals.T
        opposition -= (cosines.sum(axis=1) - 1) / (len(branches) - 1) / GUESS_PARAMETERS.postures
    best, second = np.argsort(-opposition)[:2]
    if opposition[best] - opposition[second] < GUESS_PARAMETERS.min_opposition_gap:
        lengths = [len(branch.chain) for branch in branches]
        if lengths.count(min(lengths)) == 1:  # the finger without a spread joint
            return lengths.index(
                min(lengths)
            ), "no clear opposition: the finger with the fewest joints"
        return 0, "no clear opposition: the first finger"
    return int(best), "its pad opposes the others most"


def guess_palm_frame(
    part: RobotPart, palm: str, branches: list[Branch], pads: list[Pad], thumb: int
) -> Array:
    """Return the palm frame (4, 4) in the palm link: z along the fingers, y towards the thumb."""
    poses = _poses(part, _mid_range(part))
    inverse = np.linalg.inv(poses[palm])
    bases = np.array([(inverse @ poses[branch.chain[0].child])[:3, 3] for branch in branches])
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
    y = _unit(_perpendicular_part(to_thumb, z), _any_perpendicular(z))
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    frame[:3, 3] = bases.mean(axis=0)
    return frame


def _unit(vector: Array, fallback: Array) -> Array:
    length = float(np.linalg.norm(vector))
    direction = vector if length > 1e-9 else fallback
    return direction / np.linalg.norm(direction)


MIN_COS_TILT = np.cos(np.deg2rad(45.0))
"""Cosine of the largest angle between the skin and the closing direction."""


@dataclass(frozen=True, eq=False)
class Pad:
    """A guessed contact frame.

    Attributes:
        link: The link.
        point: (3,) origin in the link frame [m].
        normal: (3,) outward unit normal in the link frame.
        reason: Description of the guess, for a comment.
    """

    link: str
    point: Array
    normal: Array
    reason: str


def guess_pads(
    part: RobotPart, palm: str, branches: list[Branch], surfaces: dict[str, IndexedMesh]
) -> list[Pad]:
    """Return a pad for every finger."""
    middle = _mid_range(part)
    poses = _poses(part, middle)
    bodies = [_last_phalanx(part, branch, surfaces) for branch in branches]
    tips = [
        _apply(poses[branch.chain[index].child], tip)
        for branch, (_, tip, index) in zip(branches, bodies, strict=True)
    ]
    pads: list[Pad] = []
    for i, branch in enumerate(branches):
        other_tips = [tip for j, tip in enumerate(tips) if j != i]
        closing_target = np.mean(other_tips, axis=0) if other_tips else poses[palm][:3, 3]
        if not other_tips and palm in surfaces:  # a jaw closes towards the nearest part of the palm
            points = surfaces[palm].transformed(poses[palm]).points
            closing_target = points[np.argmin(np.linalg.norm(points - tips[i], axis=1))]
        pads.append(_pad(part, branch, bodies[i], closing_target))
    return pads


def guess_fixed_jaw(part: RobotPart, palm: str, pad: Pad, surface: IndexedMesh | None) -> Pad:
    """Return the pad of a jaw that is fixed to the palm's link, opposite the one that moves.

    Args:
        part: The hand.
        palm: The link.
        pad: The pad of the jaw that moves.
        surface: The shape of the palm's link; None if it is not known.
    """
    poses = _poses(part, _mid_range(part))
    pose = np.linalg.inv(poses[palm]) @ poses[pad.link]
    point, normal = _apply(pose, pad.point), pose[:3, :3] @ pad.normal
    hit = None if surface is None else surface.first_hit(point, normal)
    if hit is not None:
        return Pad(palm, hit, -normal, "where a ray from the jaw that moves meets the palm's link")
    positions = []
    for joint in part.joints:
        for value in (joint.lower, joint.upper) if joint.type != "fixed" else ():
            poses_at_limit = _poses(part, _mid_range(part) | {joint.name: value})
            positions.append(
                _apply(np.linalg.inv(poses_at_limit[palm]) @ poses_at_limit[pad.link], pad.point)
            )
    closed = max(positions, key=lambda end: float((end - point) @ normal))
    return Pad(palm, closed, -normal, "where the jaw that moves is when it is closed")


def tool_pad(link: str) -> Pad:
    """Return the pad of an arm without a hand: the origin of its last link, facing along z."""
    return Pad(link, np.zeros(3), np.array([0.0, 0.0, 1.0]), "the arm's last frame faces along z")


Body = tuple[IndexedMesh | None, Array, int]
"""Mesh of the last phalanx in the frame of its moving link, its tip, and the index of the joint
that moves it."""


def _last_phalanx(part: RobotPart, branch: Branch, surfaces: dict[str, IndexedMesh]) -> Body:
    zero_poses = _poses(part, {})
    for index in reversed(range(len(branch.chain))):
        joint = branch.chain[index]
        inverse = np.linalg.inv(zero_poses[joint.child])
        parts = [
            surfaces[link].transformed(inverse @ zero_poses[link])
            for link in rigid_links(part, joint.child)
            if link in surfaces
        ]
        surface = merge_meshes(parts)
        if surface is not None and len(surface.points):
            return surface, _tip_point(surface, joint), index
    joint = branch.chain[-1]
    tip = (np.linalg.inv(zero_poses[joint.child]) @ zero_poses[branch.link])[:3, 3]
    if np.linalg.norm(tip) < 3e-3:  # without a tip frame: 0.8 times the previous phalanx
        previous = zero_poses[branch.chain[-2].child] if len(branch.chain) > 1 else np.eye(4)
        difference_step = zero_poses[joint.child][:3, 3] - previous[:3, 3]
        tip = 0.8 * zero_poses[joint.child][:3, :3].T @ difference_step
    return None, tip, len(branch.chain) - 1


def _tip_point(body: IndexedMesh, joint: Joint) -> Array:
    """Return the tip of the last phalanx: its farthest cross-section's centre."""
    u = _phalanx_direction(body, joint)
    heights = body.points @ u
    outer = body.points[heights > 0.6 * heights.max()] if heights.max() > 0 else body.points
    middle = (outer.min(axis=0) + outer.max(axis=0)) / 2
    return middle + (heights.max() - middle @ u) * u


def _phalanx_direction(body: IndexedMesh, joint: Joint) -> Array:
    """Return the unit direction from joint to phalanx, perpendicular to the joint axis."""
    direction = _perpendicular_part(body.centroid(), joint.axis)
    if np.linalg.norm(direction) < 3e-3:
        flat = body.points - np.outer(body.points @ joint.axis, joint.axis)
        direction = flat[np.argmax(np.linalg.norm(flat, axis=1))]
    return _unit(direction, np.array([0.0, 0.0, 1.0]))


def _pad(part: RobotPart, branch: Branch, body: Body, closing_target: Array) -> Pad:
    shape, end, index = body
    joint = branch.chain[index]
    sign, why = _closing_direction(part, branch, index, end, closing_target)
    if joint.type == "prismatic":
        normal, u = (
            sign * joint.axis,
            _unit(_perpendicular_part(end, joint.axis), _any_perpendicular(joint.axis)),
        )
    else:
        u = (
            _phalanx_direction(shape, joint)
            if shape is not None
            else _perpendicular_part(end, joint.axis)
        )
        u = _unit(u, _any_perpendicular(joint.axis))
        normal = sign * np.cross(joint.axis, u)
    if shape is None:
        point, reason = end, "without shapes: the point is the tip frame or a guess of it"
    else:
        point, reason, radius = _skin(shape, u, normal)
        mean_normal = shape.mean_normal(point, radius, normal)
        if joint.type != "prismatic":
            mean_normal = _unit(_perpendicular_part(mean_normal, joint.axis), normal)
        if mean_normal @ normal > MIN_COS_TILT:
            normal = mean_normal
    zero_poses = _poses(part, {})
    pose = np.linalg.inv(zero_poses[branch.link]) @ zero_poses[joint.child]
    link = branch.link
    if not np.isfinite(pose).all() or _last_moving_link(part, link) != joint.child:
        link, pose = joint.child, np.eye(4)
    return Pad(link, _apply(pose, point), pose[:3, :3] @ normal, f"{reason}; {why}")


def _skin(shape: IndexedMesh, u: Array, normal: Array) -> tuple[Array, str, float]:
    """Return the point of the fingertip's surface in the direction of the normal.

    The second value describes how it was found, the third is the radius of the pad [m].
    """
    side = np.cross(u, normal)
    heights = shape.points @ u
    length = float(heights.max())
    outer = shape.points[heights >= length - 0.4 * max(length, float(np.ptp(heights)))]
    height = float(np.ptp(outer @ normal))
    inset = min(max(height / 2, 0.1 * length), 0.5 * max(length, 1e-3))
    side_range = (outer @ side).min(), (outer @ side).max()
    start = (length - inset) * u + float(np.mean(side_range)) * side
    ray_start = float(np.abs(shape.points).max()) * 4 + 0.1
    hit = shape.first_hit(start + ray_start * normal, -normal)
    if hit is not None:
        reason = f"hit of a ray on the shape {1e3 * inset:.1f} mm before the tip's end"
        return hit, reason, inset / 2
    flat = start - (start @ normal) * normal
    side_range = flat + float((outer @ normal).max()) * normal
    return side_range, "no ray hits the shape: its farthest point", 0.0


def _closing_direction(
    part: RobotPart, branch: Branch, index: int, end: Array, closing_target: Array
) -> tuple[float, str]:
    """Return the direction (1 or -1) in which the last joint closes the finger, and the reason."""
    joint = branch.chain[index]
    middle = _mid_range(part)
    poses = _poses(part, middle)
    axis = poses[joint.child][:3, :3] @ joint.axis
    bending: dict[str, float] = {}
    for chain_joint in branch.chain[: index + 1]:
        if chain_joint.type == joint.type:
            cosine = float(poses[chain_joint.child][:3, :3] @ chain_joint.axis @ axis)
            if abs(cosine) > GUESS_PARAMETERS.parallel:
                bending[chain_joint.name] = np.sign(cosine)
    base = next(chain_joint for chain_joint in branch.chain if chain_joint.name in bending)

    joints = {chain_joint.name: chain_joint for chain_joint in part.joints}

    def tip(sign: float) -> tuple[Array, Array]:
        values = dict(middle)
        for name, direction in bending.items():
            chain_joint = joints[name]
            values[name] = chain_joint.upper if direction * sign > 0 else chain_joint.lower
        closed_poses = _poses(part, values)
        return _apply(closed_poses[joint.child], end), closed_poses[base.child][:3, 3]

    (plus, root), (minus, _) = tip(1.0), tip(-1.0)
    if len(bending) > 1:
        lengths = float(np.linalg.norm(plus - root)), float(np.linalg.norm(minus - root))
        if abs(lengths[0] - lengths[1]) > GUESS_PARAMETERS.min_relative_difference * max(lengths):
            return (1.0 if lengths[0] < lengths[1] else -1.0), "faces the bending direction"
    pose = poses[joint.child]
    tip_position = _apply(pose, end)
    direction = axis if joint.type == "prismatic" else np.cross(axis, tip_position - pose[:3, 3])
    sign = 1.0 if direction @ (closing_target - tip_position) >= 0 else -1.0
    return sign, "faces the other fingers"


def _mid_range(part: RobotPart) -> dict[str, float]:
    """Return the middle of the range of every joint [rad or m]."""
    return {
        joint.name: (joint.lower + joint.upper) / 2
        for joint in part.joints
        if joint.type != "fixed"
    }


def _random(part: RobotPart, rng: np.random.Generator) -> dict[str, float]:
    """Return random positions in the middle half of the range of every joint."""
    return {
        joint.name: joint.lower + (0.25 + 0.5 * rng.random()) * (joint.upper - joint.lower)
        for joint in part.joints
        if joint.type != "fixed"
    }


def _poses(part: RobotPart, values: Mapping[str, float]) -> dict[str, Array]:
    """Return the pose (4, 4) of every link in the root frame."""
    return link_poses(part.root, part.joints, values)


def _last_moving_link(part: RobotPart, link: str) -> str:
    """Return the link, or its nearest ancestor that a joint moves."""
    moving = [joint.child for joint in chain_to(part, link) if joint.type != "fixed"]
    return moving[-1] if moving else part.root


def _apply(pose: Array, point: Array) -> Array:
    return pose[:3, :3] @ point + pose[:3, 3]


def _perpendicular_part(vector: Array, axis: Array) -> Array:
    return vector - (vector @ axis) * axis


def _any_perpendicular(axis: Array) -> Array:
    perpendicular: Array = np.asarray(
        np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]), dtype=float
    )
    return _unit(perpendicular, axis)


MAX_TURN = np.pi / 2
"""Largest distance of a home position from the middle of the joint range [rad]."""


def guess_home(robot: RobotDescription) -> Array:
    """Return a home configuration (n,): the hand half closed, the arm far from singularities.

    The sides of a multi-arm robot are treated separately, with the trunk at zero.
    """
    middle = (robot.lower + robot.upper) / 2
    if robot.sides:
        home = np.clip(0.0, robot.lower, robot.upper)
        for side, (arm, hand) in zip(robot.sides, robot.side_actuators, strict=True):
            home[sorted((*arm, *hand))] = guess_home(robot.side(side.name))
        return home
    arm = list(robot.arm_actuators)
    if not arm:
        return _rounded(middle, robot)
    chain = robot.chain(robot.palm_link)
    rng = np.random.default_rng(0)
    spread = np.minimum((robot.upper - robot.lower)[arm] / 4, MAX_TURN)
    best_value, best_q = -1.0, middle
    # The cost of a posture grows with the square of the number of joints.
    for i in range(
        max(
            1,
            int(
                GUESS_PARAMETERS.home_samples
                * min(1.0, (GUESS_PARAMETERS.usual_arm_joints / len(arm)) ** 2)
            ),
        )
    ):
        q = middle.copy()
        if i:
            q[arm] += spread * rng.uniform(-1, 1, len(arm))
        value = _smallest_singular_value(robot, chain, q, arm)
        if value > best_value:
            best_value, best_q = value, q
    return _rounded(best_q, robot)


def _smallest_singular_value(
    robot: RobotDescription, chain: tuple[Joint, ...], q: Array, arm: list[int]
) -> float:
    """Return the smallest singular value of the palm Jacobian, metres and radians alike."""
    pose = _palm(robot, chain, q)
    columns = []
    for i in arm:
        q_step = q.copy()
        q_step[i] += GUESS_PARAMETERS.difference_step
        change = (
            (_palm(robot, chain, q_step) - pose)
            @ np.linalg.inv(pose)
            / GUESS_PARAMETERS.difference_step
        )
        columns.append([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]])
    values = np.linalg.svd(np.array(columns).T, compute_uv=False)
    return float(values[: min(6, len(arm))].min())


def _palm(robot: RobotDescription, chain: tuple[Joint, ...], q: Array) -> Array:
    values = joint_positions(robot.joints, dict(zip(robot.actuator_names, q, strict=True)))
    positions = {name: float(value[0]) for name, value in values.items()}
    return link_poses(robot.root, chain, positions)[robot.palm_link]


def _rounded(q: Array, robot: RobotDescription) -> Array:
    """Round to two digits (four for small ranges) where that stays within the limits."""
    rounded = np.where(robot.upper - robot.lower > 0.5, np.round(q, 2), np.round(q, 4))
    is_inside = (rounded > robot.lower) & (rounded < robot.upper)
    return np.where(is_inside, rounded, q)
