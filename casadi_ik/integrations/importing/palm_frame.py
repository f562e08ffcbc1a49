"""The thumb of an imported hand, and the palm frame that follows from it."""

from __future__ import annotations

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.fingers import FingerChain
from casadi_ik.integrations.importing.pads import Pad
from casadi_ik.integrations.importing.part_geometry import (
    any_perpendicular,
    mid_range_positions,
    part_poses,
    perpendicular_part,
    random_positions,
    transform_point,
    unit_vector,
)
from casadi_ik.model.parts import RobotPart

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
