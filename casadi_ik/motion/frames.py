"""Recorded frames of keypoints or contacts, and the motion of a robot that follows them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import (
    MAX_FRAME_INTERVAL,
    MAX_WAYPOINT_INTERVAL,
    check_time_unit,
    cycle_count,
)
from casadi_ik.files.keypoints import KEYPOINTS, lost_contacts_reason
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import read_npz
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.motion.cycle import side_name
from casadi_ik.motion.follower import Follower, FollowStatus
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.retarget import RATE, Retargeter, as_keypoints

CYCLES_PER_BLOCK = 1024
"""Number of cycles whose targets are in memory at once."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of a recorded stream, either of keypoints or of contacts.

    Attributes:
        path: File of the stream.
        times: (k,) times from the first frame [s].
        keypoints: (k, 21, 3) keypoints of a person's hands by side [m], with side None for a single
            hand; empty for a stream of contacts.
        points: (k, f, 3) contact points [m], base frame; f = 0 for a stream of keypoints.
        normals: (k, f, 3) outward pad normals; NaN where free.
        rejection_reasons: Reason of each rejected frame, in which the tracker has lost the hand.
    """

    path: Path
    times: Array
    keypoints: dict[str | None, Array]
    points: Array
    normals: Array
    rejection_reasons: tuple[str, ...] = ()

    def screened(self, retargeter: Retargeter) -> Frames:
        """Return the frames with NaN where the tracker has lost the hand."""
        if self.keypoints:
            keypoints, reasons = retargeter.screened(self.keypoints, self.times)
            return replace(self, keypoints=keypoints, rejection_reasons=tuple(reasons))
        reasons = [lost_contacts_reason(frame) for frame in self.points]
        points = self.points.copy()
        points[[i for i, reason in enumerate(reasons) if reason]] = np.nan
        return replace(self, points=points, rejection_reasons=tuple(filter(None, reasons)))

    def interpolate(self, times: Array, values: Array) -> Array:
        """Return values of frames interpolated at other times; NaN next to a frame with NaN."""
        next_frame = np.clip(np.searchsorted(self.times, times), 1, max(len(self.times) - 1, 1))
        if len(self.times) == 1:
            return np.repeat(values, len(times), axis=0)
        start, end = self.times[next_frame - 1], self.times[next_frame]
        share = np.clip((times - start) / (end - start), 0.0, 1.0)[:, None, None]
        first, second = values[next_frame - 1], values[next_frame]
        with np.errstate(invalid="ignore"):  # invalid frames are NaN
            interpolated = first + share * (second - first)
        return np.where(share <= 0, first, np.where(share >= 1, second, interpolated))

    def cycles(self, period: float) -> Array:
        """Return the end times of the cycles that follow the frames [s].

        Raises:
            InputError: There are too many cycles.
        """
        # The last cycle ends after the last frame.
        count = cycle_count(float(self.times[-1]), period, f"{self.path}: times")
        return period * np.arange(1, count + 2, dtype=float)


def read_frames(path: Path, fingers: int, sides: Sequence[str] = ()) -> Frames:
    """Read the stream of a file.

    Args:
        path: Path of an npz file.
        fingers: Number of fingers of the robot.
        sides: Names of the sides of a multi-arm robot.

    Raises:
        DescriptionError: The file is missing, damaged or too large; the message names it.
        InputError: An array is missing, unknown or invalid; the message names file and key.
    """
    arrays = read_npz(path, LIMITS.stream_bytes)
    hands = {side_name("keypoints", side): side for side in sides or (None,)}
    keys = [*hands, "normals", "points", "times"]
    has_keypoints, has_points = any(name in arrays for name in hands), "points" in arrays
    if has_keypoints == has_points:
        raise InputError(
            f"{path}: expected {' and '.join(hands)} (k, {KEYPOINTS}, 3) or points "
            f"(k, {fingers}, 3); found {', '.join(arrays) or 'nothing'}"
        )
    for name in sorted(set(arrays).difference(keys)):
        raise InputError(f"{path}: {name}: unknown, expected {', '.join(keys)}")
    if has_points:
        return _read_contacts(path, arrays, fingers)
    keypoints = dict[str | None, Array]()
    for name, side in hands.items():
        if name not in arrays:
            continue
        frames = as_keypoints(arrays[name], f"{path}: {name}")
        length = len(next(iter(keypoints.values()), frames))
        if frames.ndim != 3 or not len(frames) or len(frames) != length:
            expected = f"({length}, " if keypoints else "(k, "
            raise InputError(
                f"{path}: {name}: found shape {arrays[name].shape}, expected "
                f"{expected}{KEYPOINTS}, 3), k >= 1"
            )
        with np.errstate(invalid="ignore"):  # invalid frames are not an error
            centred = frames - frames.mean(axis=1, keepdims=True)
        _check_distances(centred, path, name, "middle of the hand")
        keypoints[side] = frames
    if "normals" in arrays:
        raise InputError(f"{path}: normals: found in a stream of keypoints, expected points")
    times = _times(path, arrays, len(next(iter(keypoints.values()))), MAX_FRAME_INTERVAL)
    no_contacts = np.zeros((len(times), 0, 3))
    return Frames(path, times, keypoints, no_contacts, no_contacts)


def _read_contacts(path: Path, arrays: dict[str, Array], fingers: int) -> Frames:
    points = arrays["points"]
    if points.ndim != 3 or points.shape[1:] != (fingers, 3) or not len(points):
        raise InputError(
            f"{path}: points: found shape {points.shape}, expected (k, {fingers}, 3), k >= 1"
        )
    _check_distances(points, path, "points", "base")
    normals = arrays.get("normals", np.full(points.shape, np.nan))
    if normals.shape != points.shape:
        raise InputError(f"{path}: normals: found shape {normals.shape}, expected {points.shape}")
    times = _times(path, arrays, len(points), MAX_WAYPOINT_INTERVAL)
    return Frames(path, times, {}, points, normals)


def _check_distances(vectors: Array, path: Path, key: str, origin: str) -> None:
    # Single invalid frames are not an error; a large median indicates other units.
    with np.errstate(invalid="ignore"):
        distances = np.linalg.norm(vectors, axis=2)
    distances = distances[np.isfinite(distances)]
    if len(distances) and np.median(distances) > LIMITS.stream_reach:
        raise InputError(
            f"{path}: {key}: found {np.median(distances):.4g} m from the {origin}, expected at "
            f"most {LIMITS.stream_reach:g} m (numbers in mm?)"
        )


def _times(path: Path, arrays: dict[str, Array], count: int, max_interval: float) -> Array:
    """Return the times (k,) from the first frame [s], whose median interval is limited [s]."""
    times = arrays.get("times", np.arange(count) / RATE)
    is_finite = times.shape == (count,) and np.isfinite(times).all()
    if not (is_finite and (np.diff(times) > 0).all()):
        raise InputError(f"{path}: times: expected {count} increasing numbers [s], one per frame")
    check_time_unit(times, f"{path}: times", max_interval)
    return times - times[0]


def follow_frames(
    robot: ArmHand, follower: Follower, frames: Frames, retargeter: Retargeter
) -> Motion:
    """Follow all frames of a stream.

    Args:
        robot: Robot that moves.
        follower: Follower of the robot; it starts at its present state.
        frames: Frames of the stream.
        retargeter: Converter of keypoints to targets.

    Returns:
        Motion whose notes contain the status and the contacts' position errors of every cycle.

    Raises:
        InputError: There are too many cycles, or keypoints are not those of a hand.
    """
    times = frames.cycles(follower.period)
    q = np.empty((len(times) + 1, len(robot.actuators)))
    q[0] = follower.state.q
    status = np.full(len(q), FollowStatus.HOLDING.value, dtype="<U9")
    error = np.full((len(q), len(robot.fingers)), np.nan)
    for i, positions in enumerate(_cycles(follower, frames, times, retargeter), start=1):
        state = follower.state
        q[i], status[i], error[i] = positions, state.status.value, state.position_error
    notes = {"status": status, "position_error": error}
    return Motion.of_cycles(robot, follower.period, q, notes)


def _cycles(
    follower: Follower, frames: Frames, times: Array, retargeter: Retargeter
) -> Iterator[Array]:
    """Yield the positions of the motors at the end of each cycle."""
    weight = retargeter.config.wrist_weight, retargeter.config.wrist_weight
    for first in range(0, len(times), CYCLES_PER_BLOCK):
        block_times = times[first : first + CYCLES_PER_BLOCK]
        if not frames.keypoints:
            points = frames.interpolate(block_times, frames.points)
            normals = frames.interpolate(block_times, frames.normals)
            yield from (follower(*target) for target in zip(points, normals, strict=True))
            continue
        hands = {
            side: frames.interpolate(block_times, values)
            for side, values in frames.keypoints.items()
        }
        for i in range(len(block_times)):
            frame = {side: values[i] for side, values in hands.items()}
            single_hand = frame.get(None)
            by_side = {str(side): values for side, values in frame.items()}
            keypoints = by_side if single_hand is None else single_hand
            goal = retargeter(keypoints, follower.period)
            palm = goal.palm if follower.moves_palm else None
            yield follower(goal.points, palm=palm, palm_weight=weight)
