"""Recorded frames, keypoints of a person's hand or contacts, and the motion that follows them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.keypoints import KEYPOINTS, lost_contacts_reason
from casadi_ik.files.input_checks.times import (
    MAX_FRAME_INTERVAL,
    MAX_WAYPOINT_INTERVAL,
    check_time_unit,
    cycle_count,
)
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import read_npz
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.motion.cycle import of_side
from casadi_ik.motion.follower import Follower, FollowStatus
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.retarget import RATE, Retargeter, as_keypoints

AT_ONCE = 1024
"""Cycles whose targets are in memory."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of a stream.

    Attributes:
        path: The file they are from.
        times: (k,) [s], the first 0.
        keypoints: (k, 21, 3) by side of a person's hands [m], None is the only one; nothing:
            contacts are given.
        points: (k, f, 3) contact points [m], base frame; nothing where keypoints are given.
        normals: (k, f, 3) outward pad normals; NaN where free.
        lost: Why frames were rejected as those of a tracker that has lost the hand, one for each.
    """

    path: Path
    times: Array
    keypoints: dict[str | None, Array]
    points: Array
    normals: Array
    lost: tuple[str, ...] = ()

    def screened(self, retargeter: Retargeter) -> Frames:
        """Return the frames with NaN in those of a tracker that has lost the hand."""
        if self.keypoints:
            keypoints, reasons = retargeter.screened(self.keypoints, self.times)
            return replace(self, keypoints=keypoints, lost=tuple(reasons))
        reasons = [lost_contacts_reason(frame) for frame in self.points]
        points = self.points.copy()
        points[[i for i, reason in enumerate(reasons) if reason]] = np.nan
        return replace(self, points=points, lost=tuple(filter(None, reasons)))

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

    def cycles(self, period: float) -> Array:
        """Ends of the cycles that it takes to follow them [s].

        Raises:
            InputError: There are too many of them.
        """
        count = cycle_count(float(self.times[-1]), period, f"{self.path}: times")
        return period * np.arange(1, count + 2, dtype=float)


def read_frames(path: Path, fingers: int, sides: Sequence[str] = ()) -> Frames:
    """Read a stream for a robot of so many fingers.

    Args:
        path: An npz file.
        fingers: Of the robot.
        sides: Of a body.

    Raises:
        DescriptionError: Missing, damaged or too large; the message names the file.
        InputError: Other arrays than expected; the message names file and key.
    """
    arrays = read_npz(path, LIMITS.stream_bytes)
    hands = {of_side("keypoints", side): side for side in sides or (None,)}
    known = [*hands, "normals", "points", "times"]
    if any(name in arrays for name in hands) == ("points" in arrays):
        raise InputError(
            f"{path}: expected {' and '.join(hands)} (k, {KEYPOINTS}, 3) or points "
            f"(k, {fingers}, 3); found {', '.join(arrays) or 'nothing'}"
        )
    for name in sorted(set(arrays).difference(known)):
        raise InputError(f"{path}: {name}: unknown, expected {', '.join(known)}")
    if "points" in arrays:
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
        with np.errstate(invalid="ignore"):  # one bad frame is no error of a stream
            away = frames - frames.mean(axis=1, keepdims=True)
        _check_reach(away, path, name, "middle of the hand")
        keypoints[side] = frames
    if "normals" in arrays:
        raise InputError(f"{path}: normals: found them beside keypoints, expected points")
    times = _times(path, arrays, len(next(iter(keypoints.values()))), MAX_FRAME_INTERVAL)
    nothing = np.zeros((len(times), 0, 3))
    return Frames(path, times, keypoints, nothing, nothing)


def _read_contacts(path: Path, arrays: dict[str, Array], fingers: int) -> Frames:
    points = arrays["points"]
    if points.ndim != 3 or points.shape[1:] != (fingers, 3) or not len(points):
        raise InputError(
            f"{path}: points: found shape {points.shape}, expected (k, {fingers}, 3), k >= 1"
        )
    _check_reach(points, path, "points", "base")
    normals = arrays.get("normals", np.full(points.shape, np.nan))
    if normals.shape != points.shape:
        raise InputError(f"{path}: normals: found shape {normals.shape}, expected {points.shape}")
    times = _times(path, arrays, len(points), MAX_WAYPOINT_INTERVAL)
    return Frames(path, times, {}, points, normals)


def _check_reach(vectors: Array, path: Path, key: str, origin: str) -> None:
    # One bad frame is no error of a stream; most of them too large are in other units.
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(vectors, axis=2)
    away = away[np.isfinite(away)]
    if len(away) and np.median(away) > LIMITS.stream_reach:
        raise InputError(
            f"{path}: {key}: found {np.median(away):.4g} m from the {origin}, expected at most "
            f"{LIMITS.stream_reach:g} m (numbers in mm?)"
        )


def _times(path: Path, arrays: dict[str, Array], count: int, longest: float) -> Array:
    """Return the times (k,) [s], the first 0; `longest` is their largest median interval [s]."""
    times = arrays.get("times", np.arange(count) / RATE)
    steady = times.shape == (count,) and np.isfinite(times).all()
    if not (steady and (np.diff(times) > 0).all()):
        raise InputError(
            f"{path}: times: expected {count} growing numbers of seconds, one per frame"
        )
    check_time_unit(times, f"{path}: times", longest)
    return times - times[0]


def follow_frames(
    robot: ArmHand, follower: Follower, frames: Frames, retargeter: Retargeter
) -> Motion:
    """Follow frames to their end.

    Args:
        robot: The robot.
        follower: Follows, from where it is.
        frames: The frames.
        retargeter: Makes targets of keypoints.

    Returns:
        The motion; of every cycle its notes have the status and the contacts' position errors.

    Raises:
        InputError: There are too many cycles, or keypoints are none of a hand.
    """
    times = frames.cycles(follower.period)
    q = np.empty((len(times) + 1, len(robot.actuators)))
    q[0] = follower.state.q
    status = np.full(len(q), FollowStatus.HOLDING.value, dtype="<U9")
    error = np.full((len(q), len(robot.fingers)), np.nan)
    for i, reached in enumerate(_followed(follower, frames, times, retargeter), start=1):
        state = follower.state
        q[i], status[i], error[i] = reached, state.status.value, state.position_error
    notes = {"status": status, "position_error": error}
    return Motion.of_cycles(robot, follower.period, q, notes)


def _followed(
    follower: Follower, frames: Frames, times: Array, retargeter: Retargeter
) -> Iterator[Array]:
    """Where the motors are at the end of each cycle."""
    weight = retargeter.config.wrist_weight, retargeter.config.wrist_weight
    for first in range(0, len(times), AT_ONCE):
        now = times[first : first + AT_ONCE]
        if not frames.keypoints:
            both = frames.at(now, frames.points), frames.at(now, frames.normals)
            yield from (follower(*target) for target in zip(*both, strict=True))
            continue
        hands = {side: frames.at(now, values) for side, values in frames.keypoints.items()}
        for i in range(len(now)):
            seen = {side: values[i] for side, values in hands.items()}
            alone = seen.get(None)
            both = {str(side): values for side, values in seen.items()}
            wanted = retargeter(both if alone is None else alone, follower.period)
            palm = wanted.palm if follower.moves_palm else None
            yield follower(wanted.points, palm=palm, palm_weight=weight)
