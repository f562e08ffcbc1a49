"""A person's hand moves a robot's: keypoints of a hand become fingertip positions and a wrist.

A configuration of about ten lines (`load_retarget`) says which of the 21 keypoints each finger
follows (the usual numbering: 0 the wrist, 4, 8, 12, 16, 20 the tips from the thumb on), how much
larger the robot's hand is, and how much is smoothed. The robot begins where it is: the wrist's and
the hand's *motion* is what counts, so no camera has to be calibrated.
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
from casadi_ik.grasps.arrays import real_array

KEYPOINTS = 21
"""Of a hand."""

KNUCKLES = (5, 17)
"""Of index and little finger: with the wrist they tell how a hand is turned."""


class Retarget(Struct, frozen=True, kw_only=True):
    """How a person's hand moves a robot's.

    Attributes:
        fingers: Keypoint by finger of the robot; fingers left out are free.
        wrist: Keypoint of the wrist.
        scaling: Size of the robot's hand over the person's; 0: found from the first frame.
        travel: How far the robot's wrist goes for one metre of the person's.
        rpy: How the keypoints' frame is turned against the robot's base frame [rad]; left out: so
            that the first frame's fingertips point as the robot's do.
        xyz: Where the robot's wrist is while the person's is where it was first [m]; left out:
            where it is.
        low_pass: Share of every new frame in what is followed, 1: nothing is smoothed.
        wrist_weight: How much the wrist's pose counts, a fingertip counting 1.
        robot: Its name; the command line's goes before.
    """

    fingers: dict[str, int]
    wrist: int = 0
    scaling: float = 0.0
    travel: float = 1.0
    rpy: Angles | None = None
    xyz: Point | None = None
    low_pass: float = 1.0
    wrist_weight: float = 0.05
    robot: str = ""


def load_retarget(path: str | Path) -> Retarget:
    """Read a configuration.

    Raises:
        DescriptionError: The file is missing or malformed; the message names file and key.

    Example:
        >>> text = "fingers: {thumb: 4, finger_2: 8, finger_3: 12}"
        >>> _ = Path("hand.yaml").write_text(text)
        >>> ik.load_retarget("hand.yaml").fingers["thumb"]
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
        if not 0 <= value < np.inf:
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
    """Turns the frames of one stream into what a robot is to do.

    Example:
        >>> config = ik.load_retarget("hand.yaml")
        >>> retargeter = ik.Retargeter(config, robot, robot.home)
        >>> wanted = retargeter(keypoints)
        >>> wanted.points.shape, wanted.palm.shape
        ((3, 3), (4, 4))
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
        self._first: tuple[Array, Array] | None = None
        self._smooth: Array | None = None

    def __call__(self, keypoints: ArrayLike) -> Wanted:
        """One frame.

        Args:
            keypoints: (21, 3) [m], in any frame that stays the same.

        Raises:
            InputError: Another shape, or no numbers. NaN is no error: then nothing is wanted.
        """
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
        share = self.config.low_pass
        before = self._smooth
        self._smooth = frame if before is None else before + share * (frame - before)
        return self._wanted(self._smooth, points)

    def _wanted(self, frame: Array, points: Array) -> Wanted:
        config = self.config
        wrist, tips = frame[config.wrist], frame[self._keys]
        if self._first is None:
            self._begin(frame)
        assert self._first is not None
        turn, size = self._turn, self._size
        start, first_axes = self._first
        origin = self._origin + turn @ (config.travel * (wrist - start))
        points[self._rows] = origin + size * (tips - wrist) @ turn.T
        turned = turn @ _hand_axes(frame, config.wrist) @ first_axes.T @ turn.T
        palm = np.eye(4)
        palm[:3, :3], palm[:3, 3] = turned @ self._palm[:3, :3], origin
        return Wanted(points, palm)

    def _begin(self, frame: Array) -> None:
        """How the frames lie to the robot, from the first one."""
        config, origin = self.config, self._palm[:3, 3]
        wrist, tips = frame[config.wrist], frame[self._keys] - frame[config.wrist]
        own = self._tips[self._rows] - origin
        if config.scaling > 0:
            size = config.scaling
        else:
            size = float(np.linalg.norm(own) / max(np.linalg.norm(tips), 1e-9))
        turn = _aligned(tips, own) if config.rpy is None else _rotation(config.rpy)
        self._origin = origin if config.xyz is None else np.array(config.xyz)
        self._turn, self._size = turn, size
        self._first = wrist.copy(), _hand_axes(frame, config.wrist)


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
