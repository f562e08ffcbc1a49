"""A person's hand moves a robot's: keypoints of a hand become fingertip positions and a wrist.

A configuration of about ten lines (`load_retarget`) says which of the 21 keypoints each finger
follows (the usual numbering: 0 the wrist, 4, 8, 12, 16, 20 the tips from the thumb on), how much
larger the robot's hand is, and how much is smoothed. The robot begins where it is: the wrist's and
the hand's *motion* is what counts, so no camera has to be calibrated. How large the hands are tells
neither's posture: a person's bones and how far the robot's fingertips reach do.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError, InputError
from casadi_ik.files.reading import Angles, Frame, Point, Struct, frame_matrix, read
from casadi_ik.grasps.grasp import real_array

KEYPOINTS = 21
"""Of a hand."""

KNUCKLES = (5, 17)
"""Of index and little finger: with the wrist they tell how a hand is turned."""


RATE = 30.0
"""Frames in a second of which `Retarget.low_pass` is the share of one."""

POSTURES = 4096
"""Random ones (seed 0) that tell how far a robot's fingertips reach from its palm."""

INSIDE = 0.4
"""An origin nearer to the middle of a hand's keypoints, in lengths of its palm, is in the hand."""

LONGEST = 5.0
"""Of a palm that is in metres [m]."""

LARGEST = 0.15
"""Of a person's palm [m]; in a picture whose size is one, hands are mostly larger."""


class Retarget(Struct, frozen=True, kw_only=True):
    """How a person's hand moves a robot's.

    Attributes:
        fingers: Keypoint by finger of the robot; fingers left out are free.
        wrist: Keypoint of the wrist.
        scaling: Size of the robot's hand over the person's; 0: how far both reach when they are
            open, found from the robot's fingertips and the person's bones.
        travel: How far the robot's wrist goes for one metre of the person's; left out: 1, or 0
            where the keypoints' origin is in the hand (MediaPipe's world landmarks).
        mirror: Whether the person's hand is the other one: a left hand moves a right robot hand.
        rpy: How the keypoints' frame is turned against the robot's base frame [rad]; left out: so
            that the first frame's fingertips point as the robot's do.
        xyz: Where the robot's wrist is while the person's is where it was first [m]; left out:
            where it is.
        low_pass: Share of every new frame in what is followed, 1: nothing is smoothed; of 30 frames
            a second, however often it is called.
        wrist_weight: How much the wrist's pose counts, a fingertip counting 1.
        robot: Its name; the command line's goes before.
    """

    fingers: dict[str, int]
    wrist: int = 0
    scaling: float = 0.0
    travel: float | None = None
    mirror: bool = False
    rpy: Angles | None = None
    xyz: Point | None = None
    low_pass: float = 1.0
    wrist_weight: float = 0.05
    robot: str = ""


def load_retarget(path: str | Path) -> Retarget:
    """Read a retargeting file.

    Raises:
        DescriptionError: The file is missing or malformed; the message names file and key.

    Example:
        >>> text = "fingers: {thumb: 4, finger_2: 8, finger_3: 12}"
        >>> _ = Path("hand.yaml").write_text(text)
        >>> ik.motion.load_retarget("hand.yaml").fingers["thumb"]
        4
    """
    found, _ = read(Path(path), Retarget)
    problem = _problem(found)
    if problem:
        raise DescriptionError(f"{path}: {problem}")
    return found


def _problem(config: Retarget) -> str:
    if not config.fingers:
        return "fingers: found none, expected a keypoint by finger"
    for name, number in {**config.fingers, "wrist": config.wrist}.items():
        where = name if name == "wrist" else f"fingers.{name}"
        if not 0 <= number < KEYPOINTS:
            return f"{where}: found {number}, expected a keypoint from 0 to {KEYPOINTS - 1}"
    if not 0 < config.low_pass <= 1:
        return f"low_pass: found {config.low_pass:g}, expected a number above 0 up to 1"
    for name in ("scaling", "travel", "wrist_weight"):
        value = getattr(config, name)
        if value is not None and not 0 <= value < np.inf:
            return f"{name}: found {value:g}, expected a number >= 0"
    return ""


def usual_retarget(robot: ArmHand) -> Retarget:
    """The configuration for a hand whose fingers have their usual names, or are in their order.

    Raises:
        InputError: The robot has more than five fingers.
    """
    tips = {"thumb": 4, "index": 8, "middle": 12, "ring": 16, "little": 20, "pinky": 20}
    named = {name: tips[name] for name in robot.fingers if name in tips}
    if len(named) < len(robot.fingers):
        others = [name for name in robot.fingers if name != robot.thumb]
        if len(others) > 4:
            raise InputError(
                f"robot {robot.name!r}: has {len(robot.fingers)} fingers, expected a retarget file "
                "that says what each follows"
            )
        named = {robot.thumb: 4} | dict(zip(others, (8, 12, 16, 20), strict=False))
    return Retarget(fingers=named)


@dataclass(frozen=True, eq=False)
class Wanted:
    """What a frame asks for.

    Attributes:
        points: (f, 3) fingertips [m], base frame; NaN where free or where the frame is none.
        palm: (4, 4) the wrist; None where the frame is none.
    """

    points: Array
    palm: Array | None


class Retargeter:
    """Turns keypoints of a person's hand into targets of a robot.

    Called once a frame, or once a cycle of a follower with the newest frame and the cycle's time:
    then what is smoothed moves on between the frames.

    Attributes:
        config: How.
        in_hand: Whether the keypoints' origin is in the hand (MediaPipe's world landmarks), so that
            where the wrist is cannot be told; known from the first frame on.

    Example:
        >>> config = ik.motion.load_retarget("hand.yaml")
        >>> retargeter = ik.motion.Retargeter(config, robot, robot.home)
        >>> wanted = retargeter(keypoints)
        >>> wanted.points.shape, wanted.palm.shape
        ((3, 3), (4, 4))
        >>> for _ in range(33):  # a frame at 30 Hz, cycles of a millisecond
        ...     wanted = retargeter(keypoints, elapsed=0.001)
    """

    def __init__(self, config: Retarget, robot: ArmHand, q0: ArrayLike | None = None) -> None:
        """Take the robot where it is.

        Args:
            config: How.
            robot: The robot; its fingers must be those of the configuration.
            q0: (n,) where it is [rad or m]; None: at home.

        Raises:
            InputError: A finger that the robot has not, or bad q0.
        """
        for name in config.fingers:
            if name not in robot.fingers:
                raise InputError(
                    f"fingers.{name}: no such finger; the robot's fingers: "
                    f"{', '.join(robot.fingers)}"
                )
        self.config, self._robot = config, robot
        here = robot.configuration(q0, "q0")
        self._palm, (self._tips, _) = robot.palm(here), robot.contacts(here)
        rows = [robot.fingers.index(name) for name in config.fingers]
        self._rows, self._keys = np.array(rows), np.array(list(config.fingers.values()))
        self.in_hand = False
        self._first: tuple[Array, Array] | None = None
        self._smooth: Array | None = None

    def __call__(self, keypoints: ArrayLike, elapsed: float = 1 / RATE) -> Wanted:
        """One frame.

        Args:
            keypoints: (21, 3) [m], in any frame that stays the same, or in one whose origin is in
                the hand.
            elapsed: Time since the call before [s].

        Raises:
            InputError: Another shape, no numbers, places in a picture instead of metres, or a bad
                time. NaN is no error: then nothing is wanted.
        """
        if not 0 < elapsed < np.inf:
            raise InputError(f"elapsed: found {elapsed}, expected seconds above 0")
        try:
            frame = real_array(keypoints)
        except (TypeError, ValueError) as error:
            raise InputError(f"keypoints: expected an array of numbers: {error}") from error
        if frame.shape != (KEYPOINTS, 3):
            raise InputError(f"keypoints: found shape {frame.shape}, expected ({KEYPOINTS}, 3)")
        points = np.full((len(self._robot.fingers), 3), np.nan)
        used = np.concatenate([frame[self._keys], frame[[self.config.wrist, *KNUCKLES]]])
        if not np.isfinite(used).all():
            return Wanted(points, None)
        if self._first is None:
            self._recognise(frame)
        if self.config.mirror:
            frame = _mirrored(frame, self.config.wrist)
        share = 1 - (1 - self.config.low_pass) ** (RATE * elapsed)
        before = frame if self._smooth is None else self._smooth
        self._smooth = smooth = before + share * (frame - before)
        return self._wanted(smooth, points)

    def _wanted(self, frame: Array, points: Array) -> Wanted:
        config = self.config
        wrist, tips = frame[config.wrist], frame[self._keys]
        if self._first is None:
            self._begin(frame)
        assert self._first is not None
        turn, size = self._turn, self._size
        start, first_axes = self._first
        travel = (0.0 if self.in_hand else 1.0) if config.travel is None else config.travel
        origin = self._origin + turn @ (travel * (wrist - start))
        points[self._rows] = origin + size * (tips - wrist) @ turn.T
        turned = turn @ _hand_axes(frame, config.wrist) @ first_axes.T @ turn.T
        palm = np.eye(4)
        palm[:3, :3], palm[:3, 3] = turned @ self._palm[:3, :3], origin
        return Wanted(points, palm)

    def _recognise(self, frame: Array) -> None:
        """Whether a first frame is in metres, and whether its origin is in the hand."""
        wrist = frame[self.config.wrist]
        palm = frame[list(KNUCKLES)].mean(axis=0) - wrist
        length, seen = float(np.linalg.norm(palm)), frame[np.isfinite(frame).all(axis=1)]
        # In a picture x and y go from 0 to 1, a little beyond at its edges; depths count from the
        # wrist.
        inside = (np.abs(seen[:, :2] - 0.5) < 1).all() and abs(wrist[2]) < 1e-5
        if inside and (length > LARGEST or wrist[2] != 0):
            raise InputError(
                "keypoints: found places in a picture, from 0 to 1 (MediaPipe's image landmarks), "
                "expected metres: take its world landmarks, or a camera with depth"
            )
        if length > LONGEST:
            raise InputError(
                f"keypoints: found a palm {length:.4g} m long, expected metres (pixels, or mm?)"
            )
        self.in_hand = bool(np.linalg.norm(seen.mean(axis=0)) < INSIDE * length)

    def _begin(self, frame: Array) -> None:
        """How the frames lie to the robot, from the first one."""
        config, origin = self.config, self._palm[:3, 3]
        wrist, tips = frame[config.wrist], frame[self._keys] - frame[config.wrist]
        own = self._tips[self._rows] - origin
        if config.scaling > 0:
            size = config.scaling
        else:
            person = sum(_reach(frame, config.wrist, int(key)) for key in self._keys)
            size = float(_reaches(self._robot)[self._rows].sum() / max(person, 1e-9))
        turn = _aligned(tips, own) if config.rpy is None else _rotation(config.rpy)
        self._origin = origin if config.xyz is None else np.array(config.xyz)
        self._turn, self._size = turn, size
        self._first = wrist.copy(), _hand_axes(frame, config.wrist)


def _reaches(robot: ArmHand) -> Array:
    """(f,) how far from its palm a robot's fingertips come [m]."""
    q = robot.random(np.random.default_rng(0), POSTURES)
    away = robot.contacts(q)[0] - robot.palm(q)[:, None, :3, 3]
    return np.linalg.norm(away, axis=2).max(axis=0)


def _reach(frame: Array, wrist: int, key: int) -> float:
    """How far from the wrist a keypoint is on a straight finger [m], however it is bent."""
    bones = [wrist, *range(4 * ((key - 1) // 4) + 1, key + 1)] if key else [wrist, key]
    length = float(np.linalg.norm(np.diff(frame[bones], axis=0), axis=1).sum())
    return length if np.isfinite(length) else float(np.linalg.norm(frame[key] - frame[wrist]))


def _mirrored(frame: Array, wrist: int) -> Array:
    """The other hand where this one is: its fingers on the other side, its wrist turned alike."""
    across = _hand_axes(frame, wrist)[:, 1]
    return frame - 2 * np.outer((frame - frame[wrist]) @ across, across)


def _rotation(rpy: tuple[float, float, float]) -> Array:
    return frame_matrix(Frame(rpy=rpy))[:3, :3]


def _aligned(tips: Array, own: Array) -> Array:
    """The rotation (3, 3) that brings fingertips nearest to a robot's (Kabsch 1976)."""
    u, _, v = np.linalg.svd(own.T @ tips)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v


def _hand_axes(frame: Array, wrist: int) -> Array:
    """(3, 3) how a hand is turned: along it, across it, out of it."""
    index, little = (frame[number] - frame[wrist] for number in KNUCKLES)
    along = _unit(index + little)
    out = _unit(np.cross(index, little))
    return np.stack([along, np.cross(out, along), out], axis=1)


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
