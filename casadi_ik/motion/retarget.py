"""A person's hand moves a robot's: keypoints of a hand become fingertip positions and a wrist.

A configuration of about ten lines (`load_retarget`) says which of the 21 keypoints each finger
follows (the usual numbering: 0 the wrist, 4, 8, 12, 16, 20 the tips from the thumb on), how much
larger the robot's hand is, and how much is smoothed. The robot begins where it is: the wrist's and
the hand's *motion* is what counts, so no camera has to be calibrated. How large the hands are tells
neither's posture: a person's bones and how far the robot's fingertips reach do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import DescriptionError, InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.keypoint_orders import STANDARD_ORDER, OrderConverter
from casadi_ik.files.input_checks.keypoints import KEYPOINTS, KNUCKLES, FrameFilter
from casadi_ik.files.reading import Angles, Frame, Point, Struct, frame_matrix, read
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import real_array
from casadi_ik.motion.motion import seconds

OPENXR = (1, *range(2, 6), *range(7, 11), *range(12, 16), *range(17, 21), *range(22, 26))
"""Joints of OpenXR that are the keypoints: all but palm and metacarpals of four fingers."""

LAYOUTS = {
    KEYPOINTS: tuple(range(KEYPOINTS)),
    26: OPENXR,
    25: tuple(joint - 1 for joint in OPENXR),
}
"""Where the keypoints are among so many joints."""

RATE = 30.0
"""Frames in a second of which `Retarget.low_pass` is the share of one."""


@dataclass(frozen=True)
class SizeTuning:
    """How sizes of hands are told.

    Attributes:
        postures: Random ones (seed 0) that tell how far a robot's fingertips reach from its palm.
        inside: An origin nearer to the middle of a hand's keypoints, in lengths of its palm, is in
            the hand.
        longest: Of a palm that is in metres [m].
        largest: Of a person's palm [m]; in a picture whose size is one, hands are mostly larger.
    """

    postures: int = 4096
    inside: float = 0.4
    longest: float = 5.0
    largest: float = 0.15


SIZES = SizeTuning()


class RetargetSide(Struct, frozen=True, kw_only=True):
    """What is a side's own where two hands move a body.

    Attributes:
        fingers: Keypoint by finger of that side, with the side in its name or without.
        mirror: As for one hand.
        xyz: As for one hand.
    """

    fingers: dict[str, int]
    mirror: bool = False
    xyz: Point | None = None


class Retarget(Struct, frozen=True, kw_only=True):
    """How a person's hand moves a robot's, or both hands a body's.

    Attributes:
        fingers: Keypoint by finger of the robot; fingers left out are free.
        sides: Of a body instead, by side.
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

    fingers: dict[str, int] = msgspec.field(default_factory=dict)
    sides: dict[str, RetargetSide] = msgspec.field(default_factory=dict)
    wrist: int = 0
    scaling: float = 0.0
    travel: float | None = None
    mirror: bool = False
    rpy: Angles | None = None
    xyz: Point | None = None
    low_pass: float = 1.0
    wrist_weight: float = 0.05
    robot: str = ""

    def by_side(self) -> dict[str | None, RetargetSide]:
        """What each hand follows; None: the only one."""
        if self.sides:
            return {**self.sides}
        return {None: RetargetSide(fingers=self.fingers, mirror=self.mirror, xyz=self.xyz)}


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
    if config.sides:
        for name, given in (("fingers", config.fingers), ("xyz", config.xyz)):
            if given:
                return f"{name}: found it beside sides, expected one for each of them"
    numbers = {"wrist": config.wrist}
    for side, own in config.by_side().items():
        where = "fingers" if side is None else f"sides.{side}.fingers"
        if not own.fingers:
            return f"{where}: found none, expected a keypoint by finger"
        numbers |= {f"{where}.{name}": number for name, number in own.fingers.items()}
    for where, number in numbers.items():
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
    """The configuration for hands whose fingers have their usual names, or are in their order.

    Raises:
        InputError: A hand has more than five fingers.
    """
    body = robot.description
    if not body.sides:
        return Retarget(fingers=_usual_fingers(robot.fingers, robot.thumb, robot.name))
    sides = {
        side.name: RetargetSide(
            fingers=_usual_fingers(side.fingers, side.named_thumb or side.fingers[0], robot.name)
        )
        for side in body.sides
    }
    return Retarget(sides=sides)


def _usual_fingers(fingers: Sequence[str], thumb: str, robot: str) -> dict[str, int]:
    tips = {"thumb": 4, "index": 8, "middle": 12, "ring": 16, "little": 20, "pinky": 20}
    plain = {name: name.rsplit("_", 1)[-1] for name in fingers}
    if all(name in tips for name in plain.values()) and len(set(plain.values())) == len(fingers):
        return {name: tips[short] for name, short in plain.items()}
    others = [name for name in fingers if name != thumb]
    if len(others) > 4:
        raise InputError(
            f"robot {robot!r}: has {len(fingers)} fingers, expected a retarget file that says what "
            "each follows"
        )
    return {thumb: 4} | dict(zip(others, (8, 12, 16, 20), strict=False))


@dataclass(frozen=True, eq=False)
class Wanted:
    """What a frame asks for.

    Attributes:
        points: (f, 3) fingertips [m], base frame; NaN where free or where the frame is none.
        palm: (4, 4) the wrist; of a body by side those whose frame is one; None where the frame is
            none.
        reason: Why a frame was rejected, with its side if there are two; "": none was.
    """

    points: Array
    palm: Array | dict[str, Array] | None
    reason: str = ""


def as_keypoints(joints: ArrayLike, name: str = "keypoints") -> Array:
    """(..., 21, 3) keypoints of (..., 21, 3), or of OpenXR's joints (..., 26, 3).

    25 joints are those of OpenXR without the palm, as Vision Pro streams them.

    Raises:
        InputError: Another shape, or no numbers.
    """
    try:
        found = real_array(joints)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array of numbers: {error}") from error
    if found.ndim < 2 or found.shape[-1] != 3 or found.shape[-2] not in LAYOUTS:
        raise InputError(
            f"{name}: found shape {found.shape}, expected ({KEYPOINTS}, 3), or the 26 joints of "
            "OpenXR, or 25 without the palm"
        )
    return found[..., LAYOUTS[found.shape[-2]], :]


class Retargeter:
    """Turns keypoints of a person's hand, or of both, into targets of a robot.

    Called once a frame, or once a cycle of a follower with the newest frame and the cycle's time:
    then what is smoothed moves on between the frames.

    Attributes:
        config: How.

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
            robot: The robot; its sides and fingers must be those of the configuration.
            q0: (n,) where it is [rad or m]; None: at home.

        Raises:
            InputError: A side or a finger that the robot has not, or bad q0.
        """
        self.config, self._robot = config, robot
        here = robot.configuration(q0, "q0")
        self._hands = {
            side: _Hand(config, robot, here, side, own) for side, own in config.by_side().items()
        }
        self._turn: Array | None = None

    @property
    def in_hand(self) -> bool:
        """Whether the keypoints' origin is in a hand (MediaPipe's world landmarks).

        Where the wrist is cannot be told then; known from the first frame on.
        """
        return any(hand.in_hand for hand in self._hands.values())

    def __call__(
        self, keypoints: ArrayLike | Mapping[str, ArrayLike], elapsed: float = 1 / RATE
    ) -> Wanted:
        """One frame.

        Args:
            keypoints: (21, 3) [m], in any frame that stays the same, or in one whose origin is in
                the hand; or joints of OpenXR, see `as_keypoints`. Of two hands by side, in the
                same frame; a side left out is not seen.
            elapsed: Time since the call before [s].

        Raises:
            InputError: Another shape, no numbers, places in a picture instead of metres, a side
                that the configuration has not, or a bad time. A frame of a tracker that has lost
                the hand (NaN, zeros, -1, a jump, a bone that is too long) is not an error: then
                nothing is wanted, and `Wanted.reason` says why.
        """
        elapsed = seconds("elapsed", elapsed)
        points, frames = np.full((len(self._robot.fingers), 3), np.nan), dict[str | None, Array]()
        reasons = list[str]()
        for side, joints in self._by_side(keypoints).items():
            hand = self._hands[side]
            frame = as_keypoints(joints, "keypoints" if side is None else f"keypoints.{side}")
            if frame.ndim != 2:
                raise InputError(f"keypoints: found shape {frame.shape}, expected one frame")
            if np.shape(joints)[0] == KEYPOINTS:
                was_decided = hand.order.is_decided
                frame = hand.in_usual_order(frame)
                if hand.order.is_decided and not was_decided and not hand.has_begun:
                    self._turn = None
            if hand.accepts(frame, elapsed):
                frames[side] = hand.smoothed(frame, elapsed)
            else:
                reasons.append(
                    hand.filter.reason if side is None else f"{side}: {hand.filter.reason}"
                )
        reason = "; ".join(reasons)
        known = self.config.rpy is not None or len(frames) == len(self._hands)
        if self._turn is None and known:
            self._turn = self._aligned(frames)
        if self._turn is None or not frames:
            return Wanted(points, None, reason)
        palms = dict[str | None, Array]()
        for side, frame in frames.items():
            hand = self._hands[side]
            points[hand.rows], palms[side] = hand.wanted(frame, self._turn)
        if None in palms:
            return Wanted(points, palms[None], reason)
        return Wanted(points, {str(side): palm for side, palm in palms.items()}, reason)

    def screened(
        self, recorded: Mapping[str | None, Array], times: Array
    ) -> tuple[dict[str | None, Array], list[str]]:
        """Return recorded frames with NaN in those of a lost hand, and the reasons.

        Args:
            recorded: (k, 21, 3) by side [m].
            times: (k,) [s].
        """
        kept, reasons = dict[str | None, Array](), list[str]()
        for side, frames in recorded.items():
            hand = self._hands[side]
            frames = hand.order.converted(frames)
            hand.order.assume_standard()
            lost = hand.filter.rejection_reasons(frames, times)
            kept[side] = frames.copy()
            kept[side][[i for i, reason in enumerate(lost) if reason]] = np.nan
            reasons += [reason for reason in lost if reason]
        return kept, reasons

    def _by_side(
        self, keypoints: ArrayLike | Mapping[str, ArrayLike]
    ) -> Mapping[str | None, ArrayLike]:
        sides = ", ".join(self.config.sides)
        if not isinstance(keypoints, Mapping):
            if sides:
                raise InputError(f"keypoints: found one hand, expected them by side: {sides}")
            return {None: keypoints}
        for side in keypoints:
            if side not in self._hands:
                raise InputError(f"keypoints.{side}: no such side, expected {sides or 'one hand'}")
        return {**keypoints}

    def _aligned(self, frames: Mapping[str | None, Array]) -> Array:
        """(3, 3) from the keypoints' frame to the base frame, the same for all hands."""
        if self.config.rpy is not None:
            return _rotation(self.config.rpy)
        hands = [self._hands[side] for side in frames]
        spread = [hand.spread(frame) for hand, frame in zip(hands, frames.values(), strict=True)]
        wrists = np.array([frame[self.config.wrist] for frame in frames.values()])
        palms = np.array([hand.palm[:3, 3] for hand in hands])
        # How hands stand to each other tells most of how a body stands; of one hand it is nothing.
        spread.append((wrists - wrists.mean(axis=0), palms - palms.mean(axis=0)))
        return _aligned(*(np.concatenate(both) for both in zip(*spread, strict=True)))


class _Hand:
    """A hand of the robot, and what it follows.

    Attributes:
        rows: Its fingers that follow, as positions in those of the robot.
        palm: (4, 4) where it begins.
        in_hand: Whether the keypoints' origin is in the hand.
        filter: Rejects frames of a tracker that has lost the hand.
        order: Converts frames to the usual order.
    """

    def __init__(
        self, config: Retarget, robot: ArmHand, here: Array, side: str | None, own: RetargetSide
    ) -> None:
        if side not in robot.hands:
            sides = ", ".join(name for name in robot.hands if name)
            if side is None:
                raise InputError(f"sides: missing, expected the robot's sides: {sides}")
            known = f"the robot's sides: {sides}" if sides else "the robot has one hand"
            raise InputError(f"sides.{side}: no such side; {known}")
        where = "fingers" if side is None else f"sides.{side}.fingers"
        names, rows = [robot.fingers[i] for i in robot.hands[side]], list[int]()
        for name in own.fingers:
            full = name if name in names else f"{side}_{name}"
            if full not in names:
                raise InputError(
                    f"{where}.{name}: no such finger; the robot's fingers: {', '.join(names)}"
                )
            rows.append(robot.fingers.index(full))
        self._config, self._own, self._robot, self._side = config, own, robot, side
        self.palm, (self._tips, _) = robot.palm(here, side), robot.contacts(here)
        self.rows, self._keys = np.array(rows), np.array(list(own.fingers.values()))
        self.filter = FrameFilter(self._keys.tolist(), config.wrist)
        self.order = OrderConverter("keypoints" if side is None else f"keypoints.{side}")
        self.in_hand = False
        self._known = False
        self._first: tuple[Array, Array] | None = None
        self._smooth: Array | None = None

    @property
    def has_begun(self) -> bool:
        """Whether there was a frame to follow."""
        return self._first is not None

    def in_usual_order(self, frame: Array) -> Array:
        """Return a frame (21, 3) in the usual order.

        Frames that were followed before another order was recognised are forgotten.
        """
        was_decided = self.order.is_decided
        frame = self.order.converted(frame[None])[0]
        if self.order.is_decided and not was_decided and self.order.name != STANDARD_ORDER:
            self._first, self._smooth, self._known = None, None, False
            self.filter = FrameFilter(self._keys.tolist(), self._config.wrist)
        return frame

    def accepts(self, frame: Array, elapsed: float) -> bool:
        """Decide whether keypoints (21, 3) are those of a hand; the first must be in metres."""
        if not self.filter.accepts(frame, elapsed):
            return False
        if not self._known:
            self._recognise(frame)
            self._known = True
        return True

    def smoothed(self, frame: Array, elapsed: float) -> Array:
        """The newest frame (21, 3) as it is followed."""
        if self._own.mirror:
            frame = _mirrored(frame, self._config.wrist)
        share = 1 - (1 - self._config.low_pass) ** (RATE * elapsed)
        before = frame if self._smooth is None else self._smooth
        self._smooth = smooth = before + share * (frame - before)
        return smooth

    def spread(self, frame: Array) -> tuple[Array, Array]:
        """(k, 3) how fingertips lie to the wrist: the person's, and the robot's at the start."""
        tips = frame[self._keys] - frame[self._config.wrist]
        return tips, self._tips[self.rows] - self.palm[:3, 3]

    def wanted(self, frame: Array, turn: Array) -> tuple[Array, Array]:
        """Fingertips (k, 3) and palm (4, 4) that a frame asks for, base frame."""
        wrist, tips = frame[self._config.wrist], frame[self._keys]
        if self._first is None:
            self._begin(frame)
        assert self._first is not None
        start, first_axes = self._first
        travel = self._config.travel
        travel = (0.0 if self.in_hand else 1.0) if travel is None else travel
        origin = self._origin + turn @ (travel * (wrist - start))
        points = origin + self._size * (tips - wrist) @ turn.T
        turned = turn @ _hand_axes(frame, self._config.wrist) @ first_axes.T @ turn.T
        palm = np.eye(4)
        palm[:3, :3], palm[:3, 3] = turned @ self.palm[:3, :3], origin
        return points, palm

    def _recognise(self, frame: Array) -> None:
        """Whether a first frame is in metres, and whether its origin is in the hand."""
        wrist = frame[self._config.wrist]
        palm = frame[list(KNUCKLES)].mean(axis=0) - wrist
        length, seen = float(np.linalg.norm(palm)), frame[np.isfinite(frame).all(axis=1)]
        # In a picture x and y go from 0 to 1, a little beyond at its edges; depths count from the
        # wrist.
        inside = (np.abs(seen[:, :2] - 0.5) < 1).all() and abs(wrist[2]) < 1e-5
        if inside and (length > SIZES.largest or wrist[2] != 0):
            raise InputError(
                "keypoints: found places in a picture, from 0 to 1 (MediaPipe's image landmarks), "
                "expected metres: take its world landmarks, or a camera with depth"
            )
        if length > SIZES.longest:
            raise InputError(
                f"keypoints: found a palm {length:.4g} m long, expected metres (pixels, or mm?)"
            )
        self.in_hand = bool(np.linalg.norm(seen.mean(axis=0)) < SIZES.inside * length)

    def _begin(self, frame: Array) -> None:
        """Where the first frame is, and how large its hand."""
        config = self._config
        if config.scaling > 0:
            self._size = config.scaling
        else:
            person = sum(_reach(frame, config.wrist, int(key)) for key in self._keys)
            reaches = _reaches(self._robot, self._side)[self.rows]
            self._size = float(reaches.sum() / max(person, 1e-9))
        self._origin = self.palm[:3, 3] if self._own.xyz is None else np.array(self._own.xyz)
        self._first = frame[config.wrist].copy(), _hand_axes(frame, config.wrist)


def _reaches(robot: ArmHand, side: str | None) -> Array:
    """(f,) how far from a palm a robot's fingertips come [m]."""
    q = robot.random(np.random.default_rng(0), SIZES.postures)
    away = robot.contacts(q)[0] - robot.palm(q, side)[:, None, :3, 3]
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
