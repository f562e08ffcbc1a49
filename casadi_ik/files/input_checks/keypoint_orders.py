"""Keypoint orders: the orders of known data sets are recognised by the lengths of bones.

Lengths of bones and gaps between knuckles do not depend on the posture. In the right order they are
those of a hand, up to its size: knuckles at a palm's length from the wrist, and bones that become
shorter towards the tips.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputWarning
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.keypoints import BONES, KEYPOINTS

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
        fits: Largest misfit of the right order: root mean square of the logarithms of ratios to
            `LENGTHS` [-].
        better: Difference by which another order must fit better than the standard one.
        frames: Largest number of frames that are compared.
        smallest: Largest distance of two keypoints of a small fist [m].
        largest: Largest distance of two keypoints of a large open hand [m].
    """

    fits: float = 0.35
    better: float = 0.15
    frames: int = 30
    smallest: float = 0.08
    largest: float = 0.3


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
        if not len(complete) or self._tries >= ORDER_LIMITS.frames:
            return frames
        if self._newest is not None and np.array_equal(frames, self._newest):
            return frames
        self._newest, self._tries = frames.copy(), self._tries + 1
        complete = complete[:: max(1, len(complete) // ORDER_LIMITS.frames)]
        self.name = recognise_order(complete)
        if not self.name:
            size = float(distances_between(complete).max())
            if self._tries == 1 and ORDER_LIMITS.smallest < size < ORDER_LIMITS.largest:
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
    if misfits[best] > ORDER_LIMITS.fits:
        return ""
    if best != STANDARD_ORDER and misfits[best] > misfits[STANDARD_ORDER] - ORDER_LIMITS.better:
        return ""
    return best
