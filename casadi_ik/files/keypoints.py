"""Checks of hand tracker frames: lost frames are rejected, and orders of keypoints are recognised.

A tracker that has lost the hand sends zeros, -1, or the same numbers for several keypoints; one
that mistakes a joint sends a bone that is too long, or a hand that jumps. Such a frame is not an
error of a stream: it is rejected with a reason, and the robot is held.

Lengths of bones and gaps between knuckles do not depend on the posture. In the right order they are
those of a hand, up to its size: knuckles at a palm's length from the wrist, and bones that become
shorter towards the tips.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputWarning
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
        max_speed: Largest speed of a keypoint [m/s]; hands of people are slower than 10 m/s.
        max_jump: Distance that a keypoint may jump at any speed [m]: noise of fast trackers.
        max_stretch: Largest length of a bone over its median length in previous frames [-].
        max_extra_palm_lengths: Additional length of a bone, in lengths of the palm [-].
        max_wrist_offset: Largest distance of a wrist at exactly zero from the middle of the hand,
            over the median distance of the keypoints from there [-].
        memory: Number of frames in the median.
        min_flatness: Smallest sine of the angle between the directions to the two knuckles [-].
    """

    max_speed: float = 10.0
    max_jump: float = 0.05
    max_stretch: float = 3.0
    max_extra_palm_lengths: float = 1.0
    max_wrist_offset: float = 4.0
    memory: int = 31
    min_flatness: float = 1e-4


FRAME_LIMITS = FrameLimits()


def lost_frame_reason(frame: Array, checked_keys: NDArray[np.intp], wrist: int = 0) -> str:
    """Return why a single frame cannot be a hand; "" if it can.

    Args:
        frame: (21, 3) keypoints [m].
        checked_keys: Keypoints that are checked, each once.
        wrist: Keypoint of the wrist.
    """
    points = frame[checked_keys]
    if not np.isfinite(points).all():
        return "a keypoint is not finite"
    rows = points.tolist()
    for key, (x, y, z) in zip(checked_keys.tolist(), rows, strict=True):
        if not (x == y == z and x in SENTINELS):
            continue
        if key == wrist:  # the wrist may be the origin of the keypoints
            distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
            max_offset = FRAME_LIMITS.max_wrist_offset * float(np.median(distances))
            if distances[checked_keys == wrist][0] <= max_offset:
                continue
        return f"keypoint {key} is exactly {x:g} {y:g} {z:g}"
    if len(set(map(tuple, rows))) < len(rows):
        return "two keypoints coincide"
    index, little = frame[KNUCKLES[0]] - frame[wrist], frame[KNUCKLES[1]] - frame[wrist]
    squares, product = float(index @ index) * float(little @ little), float(index @ little)
    if not squares - product**2 > FRAME_LIMITS.min_flatness**2 * squares:
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

    def __init__(self, checked_keys: Sequence[int], wrist: int = 0) -> None:
        """Create a filter.

        Args:
            checked_keys: Keypoints that are checked.
            wrist: Keypoint of the wrist.
        """
        self._checked_keys, self._wrist = (
            np.unique(np.array([*checked_keys, wrist, *KNUCKLES])),
            wrist,
        )
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
        recording = FrameFilter(self._checked_keys.tolist(), self._wrist)
        usable = [
            frame
            for frame in frames
            if not lost_frame_reason(frame, self._checked_keys, self._wrist)
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
        """Return why a frame is rejected; "" if it is accepted."""
        reason = lost_frame_reason(frame, self._checked_keys, self._wrist)
        if reason:
            return reason
        self._lengths = lengths = bone_lengths(frame)
        if self._reference is not None:
            palm = max(self._reference[4], self._reference[16])
            max_lengths = (
                FRAME_LIMITS.max_stretch * self._reference
                + FRAME_LIMITS.max_extra_palm_lengths * palm
            )
            is_too_long = lengths > max_lengths
            if is_too_long.any():
                bone = int(np.argmax(is_too_long))
                return (
                    f"the bone to keypoint {BONES[bone, 1]} is {lengths[bone]:.3g} m long, "
                    f"{self._reference[bone]:.3g} m in other frames"
                )
        if self._accepted is not None:
            displacements = frame[self._checked_keys] - self._accepted[self._checked_keys]
            max_distance = FRAME_LIMITS.max_speed * self._elapsed + FRAME_LIMITS.max_jump
            squares = np.einsum("ij,ij->i", displacements, displacements)
            if squares.max() > max_distance**2:
                distances = np.sqrt(squares)
                key = self._checked_keys[int(np.argmax(distances))]
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


FINGERS = range(5)
"""Thumb, index, middle, ring and little finger."""


def _order(wrist: int, *fingers: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the indices of the standard keypoints: the wrist, then four of each finger."""
    return np.array([wrist, *(key for finger in fingers for key in finger)], dtype=np.intp)


STANDARD_ORDER = "MediaPipe, OpenPose"
"""Name of the standard order: the wrist, then from the thumb on four keypoints a finger, tips last.
"""

_MANO = ((13, 14, 15, 16), (1, 2, 3, 17), (4, 5, 6, 18), (10, 11, 12, 19), (7, 8, 9, 20))

KEYPOINT_ORDERS: dict[str, NDArray[np.intp]] = {
    STANDARD_ORDER: np.arange(KEYPOINTS),
    "MANO, HO-3D": _order(0, *_MANO),
    "five tips, then MANO": _order(5, *((a + 5, b + 5, c + 5, d - 16) for a, b, c, d in _MANO)),
    "InterHand2.6M": _order(20, *((4 * f + 3, 4 * f + 2, 4 * f + 1, 4 * f) for f in FINGERS)),
    "RHD": _order(0, *((4 * f + 4, 4 * f + 3, 4 * f + 2, 4 * f + 1) for f in FINGERS)),
    "BigHand2.2M, FPHA": _order(0, *((1 + f, 6 + 3 * f, 7 + 3 * f, 8 + 3 * f) for f in FINGERS)),
    "five tips, wrist, then the other joints": _order(
        5, *((6 + 3 * f, 7 + 3 * f, 8 + 3 * f, f) for f in FINGERS)
    ),
    "wrist, five tips, then the other joints": _order(
        0, *((6 + 3 * f, 7 + 3 * f, 8 + 3 * f, 1 + f) for f in FINGERS)
    ),
    "STB": _order(0, *(tuple(range(17 - 4 * f, 21 - 4 * f)) for f in FINGERS)),
    "little finger first, tips first": _order(
        0, *(tuple(range(20 - 4 * f, 16 - 4 * f, -1)) for f in FINGERS)
    ),
    "wrist last": _order(20, *((4 * f, 4 * f + 1, 4 * f + 2, 4 * f + 3) for f in FINGERS)),
    "wrist, five knuckles, ..., five tips": _order(
        0, *((1 + f, 6 + f, 11 + f, 16 + f) for f in FINGERS)
    ),
    "wrist, five tips, ..., five knuckles": _order(
        0, *((16 + f, 11 + f, 6 + f, 1 + f) for f in FINGERS)
    ),
    "five tips, ..., five knuckles, wrist": _order(
        20, *((15 + f, 10 + f, 5 + f, f) for f in FINGERS)
    ),
}
"""Indices (21,) that sort a frame into the standard order: ``frame[KEYPOINT_ORDERS[name]]``."""

PAIRS: NDArray[np.intp] = np.vstack([BONES, [(1, 5), (5, 9), (9, 13), (13, 17)]])
"""Pairs (24, 2) of keypoints whose distance hardly depends on the posture."""

LENGTHS = np.array(
    [
        *(40, 40, 32, 28),
        *(92, 40, 24, 22),
        *(90, 44, 28, 24),
        *(84, 40, 26, 24),
        *(80, 32, 20, 21),
        *(66, 21, 20, 20),
    ]
)
"""Distances (24,) of the pairs in an adult's hand [mm], rounded; only their ratios matter."""


@dataclass(frozen=True)
class OrderLimits:
    """Thresholds of the recognition of keypoint orders.

    Attributes:
        max_misfit: Largest misfit of the right order: root mean square of the logarithms of ratios
            to `LENGTHS` [-].
        min_advantage: Difference by which another order must fit better than the standard one.
        max_frames: Largest number of frames that are compared.
        min_size: Largest distance of two keypoints of a small fist [m].
        max_size: Largest distance of two keypoints of a large open hand [m].
    """

    max_misfit: float = 0.35
    min_advantage: float = 0.15
    max_frames: int = 30
    min_size: float = 0.08
    max_size: float = 0.3


ORDER_LIMITS = OrderLimits()


def misfit(distances: Array, order: NDArray[np.intp]) -> float:
    """Return the misfit of an order: root mean square of logarithms of length ratios, up to scale.

    Args:
        distances: (21, 21) distances between keypoints [m], or their medians over frames.
        order: See `KEYPOINT_ORDERS`.
    """
    first, second = order[PAIRS].T
    lengths = distances[first, second]
    if not (np.isfinite(lengths).all() and (lengths > 0).all()):
        return np.inf
    logs = np.log(lengths / LENGTHS)
    return float(np.std(logs))


def distances_between(frames: Array) -> Array:
    """Return the distances (21, 21) between keypoints of frames (k, 21, 3), medians over frames."""
    return np.median(np.linalg.norm(frames[:, :, None] - frames[:, None], axis=-1), axis=0)


class OrderConverter:
    """Converter of the frames of one hand to the standard order, once their order is recognised.

    Attributes:
        name: Recognised order, see `KEYPOINT_ORDERS`; "" until then.
        is_decided: True if the order is known and used from now on.
    """

    def __init__(self, location: str) -> None:
        """Store the name of the argument, for warnings."""
        self.name, self.is_decided = "", False
        self._location, self._tries = location, 0
        self._newest: Array | None = None

    def assume_standard(self) -> None:
        """Take the coming frames as being in the standard order."""
        self.name, self.is_decided = STANDARD_ORDER, True

    def converted(self, frames: Array) -> Array:
        """Return frames (k, 21, 3) in the standard order; unchanged until an order is recognised.

        A warning names a recognised order other than the standard one, and reports a hand in none
        of them.
        """
        if self.is_decided:
            return frames if self.name == STANDARD_ORDER else frames[:, KEYPOINT_ORDERS[self.name]]
        complete = frames[np.isfinite(frames).all(axis=(1, 2))]
        if not len(complete) or self._tries >= ORDER_LIMITS.max_frames:
            return frames
        if self._newest is not None and np.array_equal(frames, self._newest):
            return frames
        self._newest, self._tries = frames.copy(), self._tries + 1
        complete = complete[:: max(1, len(complete) // ORDER_LIMITS.max_frames)]
        self.name = recognise_order(complete)
        if not self.name:
            size = float(distances_between(complete).max())
            if self._tries == 1 and ORDER_LIMITS.min_size < size < ORDER_LIMITS.max_size:
                self._warn("are in none of the known orders")
            return frames
        self.is_decided = True
        if self.name == STANDARD_ORDER:
            return frames
        self._warn(f"are in the order of {self.name}, and are converted")
        return frames[:, KEYPOINT_ORDERS[self.name]]

    def _warn(self, problem: str) -> None:
        message = (
            f"{self._location}: the keypoints {problem}; expected the order of {STANDARD_ORDER}: 0 "
            "the wrist, then four for each finger from the thumb on, tips 4, 8, 12, 16, 20"
        )
        warnings.warn(message, InputWarning, stacklevel=2)


def recognise_order(frames: Array) -> str:
    """Return the order of keypoints, "" if none fits clearly.

    Args:
        frames: (k, 21, 3) finite keypoints of one person [m].
    """
    distances = distances_between(frames)
    misfits = {name: misfit(distances, order) for name, order in KEYPOINT_ORDERS.items()}
    best = min(misfits, key=lambda name: misfits[name])
    if misfits[best] > ORDER_LIMITS.max_misfit:
        return ""
    if (
        best != STANDARD_ORDER
        and misfits[best] > misfits[STANDARD_ORDER] - ORDER_LIMITS.min_advantage
    ):
        return ""
    return best
