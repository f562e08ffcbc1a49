"""Which finger is the thumb, and the frame of the palm that follows from it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.importing.fingers import Branch
from casadi_ik.importing.pads import Pad
from casadi_ik.importing.posture import Postures

POSTURES = 64
"""At random, over which opposition is averaged."""

CLEAR = 0.15
"""By how much the thumb has to be more opposed than the next finger, of 2, to be called clear."""


def guess_thumb(postures: Postures, branches: list[Branch], pads: list[Pad]) -> tuple[int, str]:
    """The thumb's place among the fingers, and how it was found."""
    named = [i for i, branch in enumerate(branches) if branch.named and branch.name == "thumb"]
    if len(named) == 1:
        return named[0], "the file calls it so"
    if len(branches) == 1:
        return 0, "the only finger"
    rng = np.random.default_rng(0)
    opposed = np.zeros(len(branches))
    for _ in range(POSTURES):
        poses = postures.poses(postures.random(rng))
        normals = np.array([poses[pad.link][:3, :3] @ pad.normal for pad in pads])
        # Bent fingers all face the palm: what counts is how they face each other across it.
        reaches = [
            _point(poses, pad) - poses[branch.chain[0].child][:3, 3]
            for branch, pad in zip(branches, pads, strict=True)
        ]
        z = _unit(np.mean(reaches, axis=0), np.array([0.0, 0.0, 1.0]))
        normals -= np.outer(normals @ z, z)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        cosines = normals @ normals.T
        opposed -= (cosines.sum(axis=1) - 1) / (len(branches) - 1) / POSTURES
    best, second = np.argsort(-opposed)[:2]
    if opposed[best] - opposed[second] < CLEAR:
        lengths = [len(branch.chain) for branch in branches]
        if lengths.count(min(lengths)) == 1:  # the one that does not spread
            return lengths.index(min(lengths)), "none opposes the others most: the simplest finger"
        return 0, "none opposes the others most: the first finger"
    return int(best), "its pad is the one most opposed to the others"


def guess_palm_frame(
    postures: Postures, palm: str, branches: list[Branch], pads: list[Pad], thumb: int
) -> Array:
    """(4, 4) in the palm's link: origin amid the fingers' bases, z outwards, y to the thumb."""
    poses = postures.poses(postures.middle())
    inverse = np.linalg.inv(poses[palm])
    bases = np.array([(inverse @ poses[one.chain[0].child])[:3, 3] for one in branches])
    tips = np.array([_point(poses, pad) for pad in pads]) @ inverse[:3, :3].T + inverse[:3, 3]
    others = np.delete(bases, thumb, axis=0)
    reaches = np.delete(tips - bases, thumb, axis=0) if len(others) else tips - bases
    z = _unit(reaches.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    to_thumb = bases[thumb] - (others.mean(axis=0) if len(others) else 0 * bases[thumb])
    if np.linalg.norm(to_thumb - (to_thumb @ z) * z) < 5e-3:
        to_thumb = tips[thumb] - (np.delete(tips, thumb, axis=0).mean(axis=0) if len(others) else 0)
    across: Array = np.asarray(np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))]), dtype=float)
    y = _unit(to_thumb - (to_thumb @ z) * z, across)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    frame[:3, 3] = bases.mean(axis=0)
    return frame


def _point(poses: Mapping[str, Array], pad: Pad) -> Array:
    pose = poses[pad.link]
    return pose[:3, :3] @ pad.point + pose[:3, 3]


def _unit(vector: Array, otherwise: Array) -> Array:
    length = float(np.linalg.norm(vector))
    chosen = vector if length > 1e-9 else otherwise
    return chosen / np.linalg.norm(chosen)
