"""Fingers of an imported hand: joint chains below the palm, names, link poses and pads."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.meshes import IndexedMesh, merge_meshes
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


MIN_COS_TILT = np.cos(np.deg2rad(45.0))
"""Cosine of the largest angle between the skin and the closing direction."""

MIN_PARALLEL_COSINE = 0.7
"""Cosine above which two joints bend a finger in the same direction."""

MIN_RELATIVE_DIFFERENCE = 0.05
"""Minimum relative difference of distances that decides the closing direction of a finger."""

MIN_PHALANX_LENGTH = 3e-3
"""Distance from a joint axis below which a point does not give the direction of a phalanx [m]."""


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
    part: RobotPart, palm: str, fingers: list[FingerChain], meshes: dict[str, IndexedMesh]
) -> list[Pad]:
    """Return a pad for every finger.

    Args:
        part: The hand.
        palm: The palm link.
        fingers: The fingers.
        meshes: Meshes by link, in the frame of the link.
    """
    poses = part_poses(part, mid_range_positions(part))
    phalanges = [_last_phalanx(part, finger, meshes) for finger in fingers]
    tips = [
        transform_point(poses[finger.joints[phalanx.joint_index].child], phalanx.tip)
        for finger, phalanx in zip(fingers, phalanges, strict=True)
    ]
    pads: list[Pad] = []
    for i, finger in enumerate(fingers):
        other_tips = [tip for j, tip in enumerate(tips) if j != i]
        closing_target = np.mean(other_tips, axis=0) if other_tips else poses[palm][:3, 3]
        if not other_tips and palm in meshes:  # a jaw closes towards the nearest part of the palm
            points = meshes[palm].transformed(poses[palm]).points
            closing_target = points[np.argmin(np.linalg.norm(points - tips[i], axis=1))]
        pads.append(_guess_pad(part, finger, phalanges[i], closing_target))
    return pads


def guess_fixed_jaw(part: RobotPart, palm: str, pad: Pad, mesh: IndexedMesh | None) -> Pad:
    """Return the pad of the jaw that is fixed to the palm link, opposite the moving jaw.

    Args:
        part: The hand.
        palm: The palm link.
        pad: Pad of the moving jaw.
        mesh: Mesh of the palm link; None if it is unknown.
    """
    poses = part_poses(part, mid_range_positions(part))
    pose = np.linalg.inv(poses[palm]) @ poses[pad.link]
    point, normal = transform_point(pose, pad.point), pose[:3, :3] @ pad.normal
    hit = None if mesh is None else mesh.first_hit(point, normal)
    if hit is not None:
        return Pad(palm, hit, -normal, "intersection of a ray from the moving jaw with the palm")
    positions = []
    for joint in part.joints:
        for value in (joint.lower, joint.upper) if joint.type != "fixed" else ():
            poses_at_limit = part_poses(part, mid_range_positions(part) | {joint.name: value})
            palm_from_pad = np.linalg.inv(poses_at_limit[palm]) @ poses_at_limit[pad.link]
            positions.append(transform_point(palm_from_pad, pad.point))
    closed = max(positions, key=lambda position: float((position - point) @ normal))
    return Pad(palm, closed, -normal, "position of the moving jaw when it is closed")


def tool_pad(link: str) -> Pad:
    """Return the pad of an arm without a hand: the origin of its last link, facing along z."""
    return Pad(link, np.zeros(3), np.array([0.0, 0.0, 1.0]), "the arm's last frame faces along z")


@dataclass(frozen=True, eq=False)
class _Phalanx:
    """The last phalanx of a finger that has a mesh.

    Attributes:
        mesh: Mesh in the frame of the moving link; None if no phalanx has one.
        tip: (3,) tip in the frame of the moving link [m].
        joint_index: Index of the joint that moves the phalanx, in the chain of the finger.
    """

    mesh: IndexedMesh | None
    tip: Array
    joint_index: int


def _last_phalanx(part: RobotPart, finger: FingerChain, meshes: dict[str, IndexedMesh]) -> _Phalanx:
    """Return the last phalanx of a finger with a mesh, or an assumed one without a mesh."""
    zero_poses = part_poses(part, {})
    for index in reversed(range(len(finger.joints))):
        joint = finger.joints[index]
        inverse = np.linalg.inv(zero_poses[joint.child])
        mesh = merge_meshes(
            [
                meshes[link].transformed(inverse @ zero_poses[link])
                for link in rigid_links(part, joint.child)
                if link in meshes
            ]
        )
        if mesh is not None and len(mesh.points):
            return _Phalanx(mesh, _mesh_tip(mesh, joint), index)
    joint = finger.joints[-1]
    tip = (np.linalg.inv(zero_poses[joint.child]) @ zero_poses[finger.link])[:3, 3]
    if np.linalg.norm(tip) < MIN_PHALANX_LENGTH:
        # Without a tip frame, the last phalanx is assumed to have 0.8 times the previous length.
        previous = zero_poses[finger.joints[-2].child] if len(finger.joints) > 1 else np.eye(4)
        previous_phalanx = zero_poses[joint.child][:3, 3] - previous[:3, 3]
        tip = 0.8 * zero_poses[joint.child][:3, :3].T @ previous_phalanx
    return _Phalanx(None, tip, len(finger.joints) - 1)


def _mesh_tip(mesh: IndexedMesh, joint: Joint) -> Array:
    """Return the centre (3,) of the outermost cross-section of a phalanx."""
    u = _phalanx_direction(mesh, joint)
    heights = mesh.points @ u
    outer = mesh.points[heights > 0.6 * heights.max()] if heights.max() > 0 else mesh.points
    middle = (outer.min(axis=0) + outer.max(axis=0)) / 2
    return middle + (heights.max() - middle @ u) * u


def _phalanx_direction(mesh: IndexedMesh, joint: Joint) -> Array:
    """Return the unit direction from joint to phalanx, perpendicular to the joint axis."""
    direction = perpendicular_part(mesh.centroid(), joint.axis)
    if np.linalg.norm(direction) < MIN_PHALANX_LENGTH:
        flat = mesh.points - np.outer(mesh.points @ joint.axis, joint.axis)
        direction = flat[np.argmax(np.linalg.norm(flat, axis=1))]
    return unit_vector(direction, np.array([0.0, 0.0, 1.0]))


def _guess_pad(
    part: RobotPart, finger: FingerChain, phalanx: _Phalanx, closing_target: Array
) -> Pad:
    """Return the pad on the side of the phalanx that faces the closing direction."""
    mesh, tip = phalanx.mesh, phalanx.tip
    joint = finger.joints[phalanx.joint_index]
    sign, facing_reason = _closing_direction(part, finger, phalanx, closing_target)
    perpendicular = any_perpendicular(joint.axis)
    if joint.type == "prismatic":
        normal = sign * joint.axis
        u = unit_vector(perpendicular_part(tip, joint.axis), perpendicular)
    else:
        u = perpendicular_part(tip, joint.axis) if mesh is None else _phalanx_direction(mesh, joint)
        u = unit_vector(u, perpendicular)
        normal = sign * np.cross(joint.axis, u)
    if mesh is None:
        point, point_reason = tip, "without shapes: the point is the tip frame or a guess of it"
    else:
        point, point_reason, radius = _skin_point(mesh, u, normal)
        mean_normal = mesh.mean_normal(point, radius, normal)
        if joint.type != "prismatic":
            mean_normal = unit_vector(perpendicular_part(mean_normal, joint.axis), normal)
        if mean_normal @ normal > MIN_COS_TILT:
            normal = mean_normal
    zero_poses = part_poses(part, {})
    pose = np.linalg.inv(zero_poses[finger.link]) @ zero_poses[joint.child]
    link = finger.link
    if not np.isfinite(pose).all() or _last_moving_link(part, link) != joint.child:
        link, pose = joint.child, np.eye(4)
    reason = f"{point_reason}; {facing_reason}"
    return Pad(link, transform_point(pose, point), pose[:3, :3] @ normal, reason)


def _skin_point(mesh: IndexedMesh, u: Array, normal: Array) -> tuple[Array, str, float]:
    """Return the point on the surface of a fingertip in the direction of the pad normal.

    Args:
        mesh: Mesh of the last phalanx.
        u: (3,) unit direction along the phalanx.
        normal: (3,) unit normal of the pad.

    Returns:
        The point (3,) [m], the reason, and the radius of the pad [m].
    """
    side = np.cross(u, normal)
    heights = mesh.points @ u
    length = float(heights.max())
    outer = mesh.points[heights >= length - 0.4 * max(length, float(np.ptp(heights)))]
    thickness = float(np.ptp(outer @ normal))
    inset = min(max(thickness / 2, 0.1 * length), 0.5 * max(length, 1e-3))
    side_range = (outer @ side).min(), (outer @ side).max()
    start = (length - inset) * u + float(np.mean(side_range)) * side
    ray_start = float(np.abs(mesh.points).max()) * 4 + 0.1
    hit = mesh.first_hit(start + ray_start * normal, -normal)
    if hit is not None:
        reason = f"hit of a ray on the shape {1e3 * inset:.1f} mm before the tip's end"
        return hit, reason, inset / 2
    flat = start - (start @ normal) * normal
    farthest = flat + float((outer @ normal).max()) * normal
    return farthest, "no ray hits the shape: its farthest point", 0.0


def _closing_direction(
    part: RobotPart, finger: FingerChain, phalanx: _Phalanx, closing_target: Array
) -> tuple[float, str]:
    """Return the sign (1 or -1) of the last joint's motion that closes the finger, and the reason.

    A finger of several parallel joints closes in the direction in which its tip comes nearer to its
    base; any other finger, towards `closing_target`.
    """
    index, tip = phalanx.joint_index, phalanx.tip
    joint = finger.joints[index]
    middle = mid_range_positions(part)
    poses = part_poses(part, middle)
    axis = poses[joint.child][:3, :3] @ joint.axis
    bending_signs: dict[str, float] = {}
    for chain_joint in finger.joints[: index + 1]:
        if chain_joint.type == joint.type:
            cosine = float(poses[chain_joint.child][:3, :3] @ chain_joint.axis @ axis)
            if abs(cosine) > MIN_PARALLEL_COSINE:
                bending_signs[chain_joint.name] = np.sign(cosine)
    base = next(chain_joint for chain_joint in finger.joints if chain_joint.name in bending_signs)
    joints = {chain_joint.name: chain_joint for chain_joint in part.joints}

    def bent_positions(sign: float) -> tuple[Array, Array]:
        """Return the positions of the tip and of the base at one end of the bending range."""
        positions = dict(middle)
        for name, bending_sign in bending_signs.items():
            chain_joint = joints[name]
            positions[name] = chain_joint.upper if bending_sign * sign > 0 else chain_joint.lower
        bent_poses = part_poses(part, positions)
        return transform_point(bent_poses[joint.child], tip), bent_poses[base.child][:3, 3]

    if len(bending_signs) > 1:
        (upper_tip, root), (lower_tip, _) = bent_positions(1.0), bent_positions(-1.0)
        upper, lower = (float(np.linalg.norm(end - root)) for end in (upper_tip, lower_tip))
        if abs(upper - lower) > MIN_RELATIVE_DIFFERENCE * max(upper, lower):
            return (1.0 if upper < lower else -1.0), "faces the bending direction"
    pose = poses[joint.child]
    tip_position = transform_point(pose, tip)
    motion = axis if joint.type == "prismatic" else np.cross(axis, tip_position - pose[:3, 3])
    sign = 1.0 if motion @ (closing_target - tip_position) >= 0 else -1.0
    return sign, "faces the other fingers"


def _last_moving_link(part: RobotPart, link: str) -> str:
    """Return the link, or its nearest ancestor that a joint moves."""
    moving = [joint.child for joint in chain_to(part, link) if joint.type != "fixed"]
    return moving[-1] if moving else part.root


OPPOSITION_POSTURES = 64
"""Number of random postures over which opposition is averaged."""

MIN_OPPOSITION_GAP = 0.15
"""Minimum lead of the thumb's opposition (0 to 2) over the next finger."""

MIN_THUMB_OFFSET = 5e-3
"""Distance of the thumb's base from the z axis above which it determines the y axis [m]."""


def guess_thumb(part: RobotPart, fingers: list[FingerChain], pads: list[Pad]) -> tuple[int, str]:
    """Return the index of the thumb among the fingers, and the reason."""
    named_thumbs = [
        i for i, finger in enumerate(fingers) if finger.is_named and finger.name == "thumb"
    ]
    if len(named_thumbs) == 1:
        return named_thumbs[0], "named in the file"
    if len(fingers) == 1:
        return 0, "the only finger"
    opposition = _mean_opposition(part, fingers, pads)
    best, second = np.argsort(-opposition)[:2]
    if opposition[best] - opposition[second] >= MIN_OPPOSITION_GAP:
        return int(best), "its pad opposes the others most"
    lengths = [len(finger.joints) for finger in fingers]
    if lengths.count(min(lengths)) == 1:  # the finger without a spread joint
        return lengths.index(min(lengths)), "no clear opposition: the finger with the fewest joints"
    return 0, "no clear opposition: the first finger"


def _mean_opposition(part: RobotPart, fingers: list[FingerChain], pads: list[Pad]) -> Array:
    """Return the negative mean cosine (f,) of each pad normal with the normals of other pads."""
    rng = np.random.default_rng(0)
    opposition = np.zeros(len(fingers))
    for _ in range(OPPOSITION_POSTURES):
        poses = part_poses(part, random_positions(part, rng))
        normals = np.array([poses[pad.link][:3, :3] @ pad.normal for pad in pads])
        # Bent fingers all face the palm, so only the components across the palm count.
        extensions = [
            transform_point(poses[pad.link], pad.point) - poses[finger.joints[0].child][:3, 3]
            for finger, pad in zip(fingers, pads, strict=True)
        ]
        z = unit_vector(np.mean(extensions, axis=0), np.array([0.0, 0.0, 1.0]))
        normals -= np.outer(normals @ z, z)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        cosines = normals @ normals.T
        opposition -= (cosines.sum(axis=1) - 1) / (len(fingers) - 1) / OPPOSITION_POSTURES
    return opposition


def guess_palm_frame(
    part: RobotPart, palm: str, fingers: list[FingerChain], pads: list[Pad], thumb: int
) -> Array:
    """Return the palm frame (4, 4) in the palm link: z along the fingers, y towards the thumb.

    Args:
        part: The hand.
        palm: The palm link.
        fingers: The fingers.
        pads: Their pads, in the same order.
        thumb: Index of the thumb among the fingers.
    """
    poses = part_poses(part, mid_range_positions(part))
    inverse = np.linalg.inv(poses[palm])
    bases = np.array([(inverse @ poses[finger.joints[0].child])[:3, 3] for finger in fingers])
    tips = (
        np.array([transform_point(poses[pad.link], pad.point) for pad in pads]) @ inverse[:3, :3].T
        + inverse[:3, 3]
    )
    other_bases, other_tips = np.delete(bases, thumb, axis=0), np.delete(tips, thumb, axis=0)
    has_others = len(other_bases) > 0
    extensions = np.delete(tips - bases, thumb, axis=0) if has_others else tips - bases
    z = unit_vector(extensions.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    to_thumb = bases[thumb] - (other_bases.mean(axis=0) if has_others else 0 * bases[thumb])
    if np.linalg.norm(to_thumb - (to_thumb @ z) * z) < MIN_THUMB_OFFSET:
        to_thumb = tips[thumb] - (other_tips.mean(axis=0) if has_others else 0)
    y = unit_vector(perpendicular_part(to_thumb, z), any_perpendicular(z))
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    frame[:3, 3] = bases.mean(axis=0)
    return frame
