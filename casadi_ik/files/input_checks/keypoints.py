"""Checks of hand tracker frames: frames of a lost hand are rejected with a reason.

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
"""Number of keypoints of a hand."""

KNUCKLES = (5, 17)
"""Knuckles of the index and little finger, which with the wrist determine the orientation of a
hand.
"""

BONES: NDArray[np.intp] = np.array(
    [(0 if key % 4 == 1 else key - 1, key) for key in range(1, KEYPOINTS)], dtype=np.intp
)
"""Keypoints (20, 2) at the ends of each bone, in the standard order: wrist, then four a finger."""

SENTINELS = (0.0, -1.0)
"""Numbers that trackers send for all coordinates of a missing keypoint."""


@dataclass(frozen=True)
class FrameLimits:
    """Largest differences between a frame of a hand and other frames of the same person.

    Attributes:
        speed: Largest speed of a keypoint [m/s]; hands of people are slower than 10 m/s.
        slack: Distance that a keypoint may jump at any speed [m]: noise of fast trackers.
        stretch: Largest length of a bone over its median length in previous frames [-].
        palm_lengths: Additional length of a bone, in lengths of the palm [-].
        spread: Largest distance of a wrist at exactly zero from the middle of the hand, over the
            median distance of the keypoints from there [-].
        memory: Number of frames in the median.
        flatness: Smallest sine of the angle between the directions to the two knuckles [-].
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
        used: Keypoints that are checked, each once.
        wrist: Keypoint of the wrist.
    """
    points = frame[used]
    if not np.isfinite(points).all():
        return "a keypoint is not finite"
    rows = points.tolist()
    for key, (x, y, z) in zip(used.tolist(), rows, strict=True):
        if not (x == y == z and x in SENTINELS):
            continue
        if key == wrist:  # the wrist may be the origin of the keypoints
            distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
            if distances[used == wrist][0] <= FRAME_LIMITS.spread * float(np.median(distances)):
                continue
        return f"keypoint {key} is exactly {x:g} {y:g} {z:g}"
    if len(set(map(tuple, rows))) < len(rows):
        return "two keypoints coincide"
    index, little = frame[KNUCKLES[0]] - frame[wrist], frame[KNUCKLES[1]] - frame[wrist]
    squares, product = float(index @ index) * float(little @ little), float(index @ little)
    if not squares - product**2 > FRAME_LIMITS.flatness**2 * squares:
        return "wrist and knuckles are on a line"
    return ""


def bone_lengths(frames: Array) -> Array:
    """Return the lengths (..., 20) of the bones of frames (..., 21, 3) [m]."""
    with np.errstate(invalid="ignore", over="ignore"):
        bones = frames[..., BONES[:, 1], :] - frames[..., BONES[:, 0], :]
        return np.sqrt(np.einsum("...i,...i->...", bones, bones))


class FrameFilter:
    """A filter that rejects frames of one hand that differ implausibly from previous frames.

    Attributes:
        reason: Why the last frame was rejected, "" if it was accepted.
    """

    def __init__(self, used: Sequence[int], wrist: int = 0) -> None:
        """Create a filter.

        Args:
            used: Keypoints that are checked.
            wrist: Keypoint of the wrist.
        """
        self._used, self._wrist = np.unique(np.array([*used, wrist, *KNUCKLES])), wrist
        self._bones: deque[Array] = deque(maxlen=FRAME_LIMITS.memory)
        self._reference: Array | None = None
        self._accepted: Array | None = None
        self._newest: Array | None = None
        self._lengths = np.zeros(len(BONES))
        self._elapsed, self._count = 0.0, 0
        self.reason = ""

    def rejection_reasons(self, frames: Array, times: Array) -> list[str]:
        """Return why each frame of a recording is rejected, "" where it is accepted.

        Bones are compared with their median length in the whole recording.

        Args:
            frames: (k, 21, 3) keypoints [m].
            times: (k,) times [s].
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
        """Return True if a frame (21, 3) is plausible, and store it.

        Args:
            frame: The newest frame, which may equal the previous one.
            elapsed: Time since the previous call [s].
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
        # Sorting every frame would be slow: the median is updated after 1, 2, 4, ... frames, then
        # whenever all frames in memory are new.
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
            max_lengths = FRAME_LIMITS.stretch * self._reference + FRAME_LIMITS.palm_lengths * palm
            is_too_long = lengths > max_lengths
            if is_too_long.any():
                bone = int(np.argmax(is_too_long))
                return (
                    f"the bone to keypoint {BONES[bone, 1]} is {lengths[bone]:.3g} m long, "
                    f"{self._reference[bone]:.3g} m in other frames"
                )
        if self._accepted is not None:
            displacements = frame[self._used] - self._accepted[self._used]
            max_distance = FRAME_LIMITS.speed * self._elapsed + FRAME_LIMITS.slack
            squares = np.einsum("ij,ij->i", displacements, displacements)
            if squares.max() > max_distance**2:
                distances = np.sqrt(squares)
                key = self._used[int(np.argmax(distances))]
                return f"keypoint {key} jumps by {distances.max():.3g} m in {self._elapsed:.3g} s"
        return ""


def _median(lengths: Sequence[Array] | deque[Array]) -> Array | None:
    """Return the median (20,) of finite lengths; infinity where there is none."""
    if not lengths:
        return None
    rows = np.array(lengths)
    finite = np.isfinite(rows)
    ordered = np.sort(np.where(finite, rows, np.inf), axis=0)
    middle = np.maximum(finite.sum(axis=0) - 1, 0) // 2
    return ordered[middle, np.arange(rows.shape[1])]


def lost_contacts_reason(points: Array) -> str:
    """Return why contact points (f, 3) are those of a lost hand; "" if they may be contacts."""
    fixed_points = points[np.isfinite(points).all(axis=1)]
    if not len(fixed_points):
        return ""
    if not fixed_points.any():
        return "every contact point is exactly 0 0 0"
    if len(fixed_points) > 1 and (fixed_points == fixed_points[0]).all():
        return "all contact points coincide"
    return ""
