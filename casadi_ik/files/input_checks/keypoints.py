"""The rules for frames of a hand tracker: lost hands are recognised, known orders converted.

A tracker that has lost the hand sends zeros, -1, or the same numbers for several keypoints; one
that mistakes a joint sends a bone that is too long, or a hand that jumps. Such a frame is not an
error of a stream: it is rejected with a reason, and the robot is held.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array

KEYPOINTS = 21
"""Keypoints of a hand."""

KNUCKLES = (5, 17)
"""Knuckles of index and little finger: with the wrist they tell how a hand is turned."""

BONES: NDArray[np.intp] = np.array(
    [(0 if key % 4 == 1 else key - 1, key) for key in range(1, KEYPOINTS)], dtype=np.intp
)
"""(20, 2) keypoints at the ends of each bone, in the usual order: wrist, then four a finger."""

SENTINELS = (0.0, -1.0)
"""Numbers that trackers send for all three coordinates of a keypoint they have not found."""


@dataclass(frozen=True)
class FrameLimits:
    """Largest differences between a frame of a hand and the person's other frames.

    Attributes:
        speed: Largest speed of a keypoint [m/s]; hands of people are slower than 10 m/s.
        slack: Distance that a keypoint may jump at any speed [m]: noise of fast trackers.
        stretch: Largest length of a bone over its median length in the frames before [-].
        palm_lengths: Length that a bone may have beyond that, in lengths of the palm [-].
        spread: Largest distance of a wrist at exactly zero from the middle of the hand, over the
            median distance of the keypoints from there [-].
        memory: Number of frames whose median is compared with.
        flatness: Least sine of the angle between the directions to the two knuckles [-].
    """

    speed: float = 10.0
    slack: float = 0.05
    stretch: float = 3.0
    palm_lengths: float = 1.0
    spread: float = 4.0
    memory: int = 31
    flatness: float = 1e-4


FRAME_LIMITS = FrameLimits()


def lost_frame_reason(frame: Array, used: NDArray[np.intp], wrist: int = 0) -> str:
    """Return why a single frame cannot be a hand; "" if it can.

    Args:
        frame: (21, 3) keypoints [m].
        used: Keypoints that count, each once; the others may be anything.
        wrist: Keypoint of the wrist.
    """
    points = frame[used]
    if not np.isfinite(points).all():
        return "a keypoint is not finite"
    rows = points.tolist()
    for key, (x, y, z) in zip(used.tolist(), rows, strict=True):
        if not (x == y == z and x in SENTINELS):
            continue
        if key == wrist:  # the origin may be there
            away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
            if away[used == wrist][0] <= FRAME_LIMITS.spread * float(np.median(away)):
                continue
        return f"keypoint {key} is exactly {x:g} {y:g} {z:g}"
    if len(set(map(tuple, rows))) < len(rows):
        return "two keypoints coincide"
    index, little = frame[KNUCKLES[0]] - frame[wrist], frame[KNUCKLES[1]] - frame[wrist]
    squares, along = float(index @ index) * float(little @ little), float(index @ little)
    if not squares - along**2 > FRAME_LIMITS.flatness**2 * squares:
        return "wrist and knuckles are on a line"
    return ""


def bone_lengths(frames: Array) -> Array:
    """Return the lengths (..., 20) of the bones of frames (..., 21, 3) [m]."""
    with np.errstate(invalid="ignore", over="ignore"):
        along = frames[..., BONES[:, 1], :] - frames[..., BONES[:, 0], :]
        return np.sqrt(np.einsum("...i,...i->...", along, along))


class FrameFilter:
    """Rejects frames of one hand that differ implausibly from the frames before.

    Attributes:
        reason: Why the last frame was rejected, "" if it was accepted.
    """

    def __init__(self, used: Sequence[int], wrist: int = 0) -> None:
        """Take the keypoints that count, and that of the wrist."""
        self._used, self._wrist = np.unique(np.array([*used, wrist, *KNUCKLES])), wrist
        self._bones: deque[Array] = deque(maxlen=FRAME_LIMITS.memory)
        self._reference: Array | None = None
        self._accepted: Array | None = None
        self._newest: Array | None = None
        self._lengths = np.zeros(len(BONES))
        self._elapsed, self._count = 0.0, 0
        self.reason = ""

    def of_recording(self, frames: Array, times: Array) -> list[str]:
        """Return why each frame of a recording is rejected, "" where it is not.

        Bones are compared with their median length in the whole recording.

        Args:
            frames: (k, 21, 3) [m].
            times: (k,) [s].
        """
        recording = FrameFilter(self._used.tolist(), self._wrist)
        usable = [
            frame for frame in frames if not lost_frame_reason(frame, self._used, self._wrist)
        ]
        for frame in usable[:: max(1, -(-len(usable) // FRAME_LIMITS.memory))]:
            recording._bones.append(bone_lengths(frame))
        recording._reference = self._reference = _median(recording._bones)
        self._bones = recording._bones.copy()
        reasons = list[str]()
        for frame, elapsed in zip(frames, np.diff(times, prepend=times[0]), strict=True):
            recording.accepts(frame, float(elapsed))
            reasons.append(recording.reason)
        return reasons

    def accepts(self, frame: Array, elapsed: float) -> bool:
        """Decide whether a frame (21, 3) is plausible.

        Args:
            frame: The newest frame, which may be the same as before.
            elapsed: Time since the call before [s].
        """
        self._elapsed += elapsed
        if self._newest is not None and np.array_equal(frame, self._newest):
            return not self.reason
        self._newest = frame.copy()
        self.reason = self._problem(frame)
        if self.reason:
            return False
        self._bones.append(self._lengths)
        self._count += 1
        # The median is of 1, 2, 4, ... frames at first, then taken when all frames are new.
        if self._count % FRAME_LIMITS.memory == 0 or self._count & (self._count - 1) == 0:
            self._reference = _median(self._bones)
        self._accepted, self._elapsed = self._newest, 0.0
        return True

    def _problem(self, frame: Array) -> str:
        reason = lost_frame_reason(frame, self._used, self._wrist)
        if reason:
            return reason
        self._lengths = lengths = bone_lengths(frame)
        if self._reference is not None:
            palm = max(self._reference[4], self._reference[16])
            most = FRAME_LIMITS.stretch * self._reference + FRAME_LIMITS.palm_lengths * palm
            long = lengths > most
            if long.any():
                bone = int(np.argmax(long))
                return (
                    f"the bone to keypoint {BONES[bone, 1]} is {lengths[bone]:.3g} m long, "
                    f"{self._reference[bone]:.3g} m in other frames"
                )
        if self._accepted is not None:
            away = frame[self._used] - self._accepted[self._used]
            most = FRAME_LIMITS.speed * self._elapsed + FRAME_LIMITS.slack
            squares = np.einsum("ij,ij->i", away, away)
            if squares.max() > most**2:
                moved = np.sqrt(squares)
                key = self._used[int(np.argmax(moved))]
                return f"keypoint {key} jumps by {moved.max():.3g} m in {self._elapsed:.3g} s"
        return ""


def _median(lengths: Sequence[Array] | deque[Array]) -> Array | None:
    """Return the median (20,) of lengths that are not NaN; infinite where all are."""
    if not lengths:
        return None
    rows = np.array(lengths)
    seen = np.isfinite(rows)
    ordered = np.sort(np.where(seen, rows, np.inf), axis=0)
    middle = np.maximum(seen.sum(axis=0) - 1, 0) // 2
    return ordered[middle, np.arange(rows.shape[1])]


def lost_contacts_reason(points: Array) -> str:
    """Return why contact points (f, 3) are those of a lost hand; "" if they may be contacts."""
    known = points[np.isfinite(points).all(axis=1)]
    if not len(known):
        return ""
    if not known.any():
        return "every contact point is exactly 0 0 0"
    if len(known) > 1 and (known == known[0]).all():
        return "all contact points coincide"
    return ""
