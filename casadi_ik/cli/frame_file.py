"""The file that `casadi-ik follow` reads: frames of a stream, with the times when they came."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.files.npz import read_npz
from casadi_ik.motion.retarget import KEYPOINTS

RATE = 30.0
"""Frames in a second where the file has no times."""

FAR = 5.0
"""Contacts farther from the base than this [m], or keypoints from each other, are in mm."""

MOST = 2**28
"""Bytes of all arrays: hours of keypoints."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of a stream.

    Attributes:
        times: (k,) [s], the first 0.
        keypoints: (k, 21, 3) of a person's hand [m]; None: contacts are given.
        points: (k, f, 3) contact points [m], base frame; nothing where keypoints are given.
        normals: (k, f, 3) outward pad normals; NaN where free.
    """

    times: Array
    keypoints: Array | None
    points: Array
    normals: Array

    @property
    def last(self) -> float:
        """When the last frame came [s]."""
        return float(self.times[-1])

    def at(self, times: Array, values: Array) -> Array:
        """Values of frames between the frames, linearly; NaN beside a frame that has NaN."""
        after = np.clip(np.searchsorted(self.times, times), 1, max(len(self.times) - 1, 1))
        if len(self.times) == 1:
            return np.repeat(values, len(times), axis=0)
        start, end = self.times[after - 1], self.times[after]
        share = np.clip((times - start) / (end - start), 0.0, 1.0)[:, None, None]
        before, behind = values[after - 1], values[after]
        with np.errstate(invalid="ignore"):  # a frame that is none gives none
            between = before + share * (behind - before)
        return np.where(share <= 0, before, np.where(share >= 1, behind, between))


def read_frames(path: Path, fingers: int) -> Frames:
    """Read frames.

    Args:
        path: An npz file with `keypoints` (k, 21, 3), or with `points` (k, f, 3) and, if wanted,
            `normals`; and if wanted `times` (k,) [s].
        fingers: How many the robot has.

    Raises:
        DescriptionError: Missing, damaged or too large; the message names the file.
        InputError: Other arrays than expected; the message names file and key.
    """
    arrays = read_npz(path, MOST)
    known = {"keypoints", "points", "normals", "times"}
    if ("keypoints" in arrays) == ("points" in arrays):
        found = ", ".join(arrays) or "nothing"
        raise InputError(
            f"{path}: expected keypoints (k, {KEYPOINTS}, 3) or points (k, {fingers}, 3); "
            f"found {found}"
        )
    for name in sorted(set(arrays) - known):
        raise InputError(f"{path}: {name}: unknown, expected {', '.join(sorted(known))}")
    key = "keypoints" if "keypoints" in arrays else "points"
    shape = (KEYPOINTS if key == "keypoints" else fingers), 3
    frames = arrays[key]
    if frames.ndim != 3 or frames.shape[1:] != shape or not len(frames):
        raise InputError(
            f"{path}: {key}: found shape {frames.shape}, expected (k, {shape[0]}, 3), k >= 1"
        )
    _refuse_other_units(f"{path}: {key}", frames, key)
    normals = arrays.get("normals")
    if normals is not None and (key == "keypoints" or normals.shape != frames.shape):
        expected = "points beside them" if key == "keypoints" else f"{frames.shape}"
        raise InputError(f"{path}: normals: found shape {normals.shape}, expected {expected}")
    times = arrays.get("times", np.arange(len(frames)) / RATE)
    steady = times.shape == (len(frames),) and np.isfinite(times).all()
    if not (steady and (np.diff(times) > 0).all()):
        raise InputError(
            f"{path}: times: expected {len(frames)} growing numbers of seconds, one per frame"
        )
    if key == "keypoints":
        nothing = np.zeros((len(frames), 0, 3))
        return Frames(times - times[0], frames, nothing, nothing)
    free = np.full(frames.shape, np.nan) if normals is None else normals
    return Frames(times - times[0], None, frames, free)


def _refuse_other_units(where: str, frames: Array, key: str) -> None:
    """One bad frame is no error of a stream; most of them too large are in other units."""
    middle = frames.mean(axis=1, keepdims=True) if key == "keypoints" else 0.0
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(frames - middle, axis=2)
    away = away[np.isfinite(away)]
    if len(away) and np.median(away) > FAR:
        raise InputError(
            f"{where}: found {np.median(away):.4g} m from the "
            f"{'middle of the hand' if key == 'keypoints' else 'base'}, expected at most {FAR:g} m "
            "(numbers in mm?)"
        )
