"""Retargeting of a person's hand: keypoints become targets of a robot's fingertips and palm.

A configuration of about ten lines (`load_retarget`) assigns one of the 21 keypoints to each finger
(in the common numbering: 0 is the wrist, and 4, 8, 12, 16 and 20 are the tips from the thumb on),
and sets the scale and the smoothing. The robot starts at its present configuration: only the
*motion* of wrist and hand counts, so no camera has to be calibrated. The scale does not depend on
postures: it follows from a person's bones and from the reach of the robot's fingertips.
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
from casadi_ik.files.keypoints import (
    KEYPOINTS,
    KNUCKLES,
    STANDARD_ORDER,
    FrameFilter,
    OrderConverter,
)
from casadi_ik.files.reading import Angles, Frame, Point, Struct, frame_matrix, read
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import real_array
from casadi_ik.motion.motion import seconds

OPENXR = (1, *range(2, 6), *range(7, 11), *range(12, 16), *range(17, 21), *range(22, 26))
"""Joints of OpenXR that are keypoints: all but the palm and the metacarpals of four fingers."""

COLUMNS_BY_COUNT = {
    KEYPOINTS: tuple(range(KEYPOINTS)),
    26: OPENXR,
    25: tuple(joint - 1 for joint in OPENXR),
}
"""Indices of the keypoints by the number of joints of a frame."""

RATE = 30.0
"""Frame rate to which `Retarget.low_pass` refers [1/s]."""


@dataclass(frozen=True)
class SizeTuning:
    """Parameters of the estimation of hand sizes.

    Attributes:
        postures: Number of random postures (seed 0) from which the reach of a robot's fingertips is
            computed.
        max_origin_distance: Distance of the origin from the mean of the keypoints, relative to the
            length of the palm, below which the origin is in the hand.
        max_length_in_metres: Largest length of a palm that counts as given in metres [m].
        max_palm_length: Largest length of a person's palm [m]; hands in normalised images are
            usually larger.
    """

    postures: int = 4096
    max_origin_distance: float = 0.4
    max_length_in_metres: float = 5.0
    max_palm_length: float = 0.15


HAND_SIZE_TUNING = SizeTuning()


class RetargetSide(Struct, frozen=True, kw_only=True):
    """Retargeting of one side of a multi-arm robot.

    Attributes:
        fingers: Keypoint by finger of the side; the names may omit the side.
        mirror: See `Retarget.mirror`.
        xyz: See `Retarget.xyz`.
    """

    fingers: dict[str, int]
    mirror: bool = False
    xyz: Point | None = None


class Retarget(Struct, frozen=True, kw_only=True):
    """Configuration of the retargeting of a person's hand, or of both hands.

    Attributes:
        fingers: Keypoint by finger of the robot; other fingers are free.
        sides: Configuration by side of a multi-arm robot, in place of `fingers`.
        wrist: Keypoint of the wrist.
        scaling: Size of the robot's hand relative to the person's; 0: the ratio of the reaches of
            the open hands, from the robot's fingertips and the person's bones.
        travel: Motion of the robot's wrist relative to the person's; default: 1, or 0 if the origin
            of the keypoints is in the hand (MediaPipe's world landmarks).
        mirror: True if the hands differ: a person's left hand moves a right robot hand.
        rpy: Orientation of the keypoints' frame in the robot's base frame [rad]; default: the
            fingertips of the first frame are aligned with the robot's.
        xyz: Position of the robot's wrist at the person's first position [m]; default: the present
            position.
        low_pass: Weight of a new frame in the low-pass filter at 30 frames per second,
            independently of the rate of calls; 1: no filter.
        wrist_weight: Weight of the wrist's pose relative to a fingertip.
        robot: Name of the robot; an option of the command line takes precedence.
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
        """Return the configuration by side; the side is None for a single hand."""
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
    config, _ = read(Path(path), Retarget)
    problem = _invalid_reason(config)
    if problem:
        raise DescriptionError(f"{path}: {problem}")
    return config


def _invalid_reason(config: Retarget) -> str:
    """Return the reason why a configuration is invalid, "" if it is valid."""
    if config.sides:
        for name, value in (("fingers", config.fingers), ("xyz", config.xyz)):
            if value:
                return f"{name}: found in addition to sides, expected in each of them"
    numbers = {"wrist": config.wrist}
    for side, side_config in config.by_side().items():
        key = "fingers" if side is None else f"sides.{side}.fingers"
        if not side_config.fingers:
            return f"{key}: found no fingers, expected a keypoint by finger"
        numbers |= {f"{key}.{name}": number for name, number in side_config.fingers.items()}
    for key, number in numbers.items():
        if not 0 <= number < KEYPOINTS:
            return f"{key}: found {number}, expected a keypoint from 0 to {KEYPOINTS - 1}"
    if not 0 < config.low_pass <= 1:
        return f"low_pass: found {config.low_pass:g}, expected a number above 0 up to 1"
    for name in ("scaling", "travel", "wrist_weight"):
        value = getattr(config, name)
        if value is not None and not 0 <= value < np.inf:
            return f"{name}: found {value:g}, expected a number >= 0"
    return ""


def usual_retarget(robot: ArmHand) -> Retarget:
    """Return the configuration for hands whose fingers have common names or the common order.

    Raises:
        InputError: A hand has more than five fingers.
    """
    description = robot.description
    if not description.sides:
        return Retarget(fingers=_usual_fingers(robot.fingers, robot.thumb, robot.name))
    sides = {
        side.name: RetargetSide(
            fingers=_usual_fingers(side.fingers, side.named_thumb or side.fingers[0], robot.name)
        )
        for side in description.sides
    }
    return Retarget(sides=sides)


def _usual_fingers(fingers: Sequence[str], thumb: str, robot: str) -> dict[str, int]:
    tips = {"thumb": 4, "index": 8, "middle": 12, "ring": 16, "little": 20, "pinky": 20}
    short_names = {name: name.rsplit("_", 1)[-1] for name in fingers}
    are_known = all(name in tips for name in short_names.values())
    if are_known and len(set(short_names.values())) == len(fingers):
        return {name: tips[short] for name, short in short_names.items()}
    remaining = [name for name in fingers if name != thumb]
    if len(remaining) > 4:
        raise InputError(
            f"robot {robot!r}: found {len(fingers)} fingers, expected at most 5, or a retarget "
            "file with a keypoint by finger"
        )
    return {thumb: 4} | dict(zip(remaining, (8, 12, 16, 20), strict=False))


@dataclass(frozen=True, eq=False)
class RetargetGoal:
    """Targets of a robot that follow from a frame.

    Attributes:
        points: (f, 3) fingertip positions [m], base frame; NaN where free or the frame is invalid.
        palm: (4, 4) pose of the palm, or poses by side of a multi-arm robot without those of
            invalid frames; None if the frame is invalid.
        reason: Reason why a frame was rejected, with its side if there are two; "" if no frame
            was rejected.
    """

    points: Array
    palm: Array | dict[str, Array] | None
    reason: str = ""


def as_keypoints(joints: ArrayLike, name: str = "keypoints") -> Array:
    """Return the keypoints (..., 21, 3) of keypoints, or of OpenXR's joints (..., 26, 3).

    25 joints are those of OpenXR without the palm, as Vision Pro streams them.

    Raises:
        InputError: The shape is wrong, or the values are not numeric.
    """
    try:
        array = real_array(joints)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: array is not numeric: {error}") from error
    if array.ndim < 2 or array.shape[-1] != 3 or array.shape[-2] not in COLUMNS_BY_COUNT:
        raise InputError(
            f"{name}: found shape {array.shape}, expected ({KEYPOINTS}, 3), or the 26 joints of "
            "OpenXR, or 25 without the palm"
        )
    return array[..., COLUMNS_BY_COUNT[array.shape[-2]], :]


class Retargeter:
    """Converter of keypoints of a person's hands to targets of a robot.

    It is called once per frame, or once per cycle of a follower with the newest frame and the
    period of the cycle; smoothing then continues between the frames.

    Attributes:
        config: Configuration of the retargeting.

    Example:
        >>> config = ik.motion.load_retarget("hand.yaml")
        >>> retargeter = ik.motion.Retargeter(config, robot, robot.home)
        >>> goal = retargeter(keypoints)
        >>> goal.points.shape, goal.palm.shape
        ((3, 3), (4, 4))
        >>> for _ in range(33):  # a frame at 30 Hz, cycles of a millisecond
        ...     goal = retargeter(keypoints, elapsed=0.001)
    """

    def __init__(self, config: Retarget, robot: ArmHand, q0: ArrayLike | None = None) -> None:
        """Start at a configuration of the robot.

        Args:
            config: Configuration of the retargeting.
            robot: Robot with the sides and fingers of the configuration.
            q0: (n,) initial positions of the motors [rad or m]; None: home.

        Raises:
            InputError: The robot does not have a side or finger, or q0 is invalid.
        """
        self.config, self._robot = config, robot
        q = robot.configuration(q0, "q0")
        self._hands = {
            side: _Hand(config, robot, q, side, side_config)
            for side, side_config in config.by_side().items()
        }
        self._R_base_keypoints: Array | None = None  # None before the first frame of all hands

    @property
    def in_hand(self) -> bool:
        """True if the origin of the keypoints is in a hand (MediaPipe's world landmarks).

        The position of the wrist is unknown then. The value is known after the first frame.
        """
        return any(hand.in_hand for hand in self._hands.values())

    def __call__(
        self, keypoints: ArrayLike | Mapping[str, ArrayLike], elapsed: float = 1 / RATE
    ) -> RetargetGoal:
        """Return the targets of a frame.

        Args:
            keypoints: (21, 3) keypoints [m] in a fixed frame, or in a frame whose origin is in the
                hand; or joints of OpenXR, see `as_keypoints`. Keypoints of two hands are given by
                side in the same frame; a missing side is not visible.
            elapsed: Time since the previous call [s].

        Raises:
            InputError: Wrong shape, values that are not numeric, image coordinates in place of
                metres, a side that is not in the configuration, or an invalid time. A frame of a
                tracker that has lost the hand (NaN, zeros, -1, a jump, a bone that is too long) is
                not an error: its targets are free, and `RetargetGoal.reason` tells why.
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
                frame = hand.in_standard_order(frame)
                if hand.order.is_decided and not was_decided and not hand.has_begun:
                    self._R_base_keypoints = None
            if hand.accepts(frame, elapsed):
                frames[side] = hand.smoothed(frame, elapsed)
            else:
                reasons.append(
                    hand.filter.reason if side is None else f"{side}: {hand.filter.reason}"
                )
        reason = "; ".join(reasons)
        can_align = self.config.rpy is not None or len(frames) == len(self._hands)
        if self._R_base_keypoints is None and can_align:
            self._R_base_keypoints = self._aligned(frames)
        if self._R_base_keypoints is None or not frames:
            return RetargetGoal(points, None, reason)
        palms = dict[str | None, Array]()
        for side, frame in frames.items():
            hand = self._hands[side]
            points[hand.rows], palms[side] = hand.targets(frame, self._R_base_keypoints)
        if None in palms:
            return RetargetGoal(points, palms[None], reason)
        return RetargetGoal(points, {str(side): palm for side, palm in palms.items()}, reason)

    def screened(
        self, recorded: Mapping[str | None, Array], times: Array
    ) -> tuple[dict[str | None, Array], list[str]]:
        """Return recorded frames with NaN where the tracker has lost the hand, and the reasons.

        Args:
            recorded: (k, 21, 3) keypoints by side [m].
            times: (k,) times of the frames [s].
        """
        screened, reasons = dict[str | None, Array](), list[str]()
        for side, frames in recorded.items():
            hand = self._hands[side]
            frames = hand.order.converted(frames)
            hand.order.assume_standard()
            frame_reasons = hand.filter.rejection_reasons(frames, times)
            screened[side] = frames.copy()
            rejected = [i for i, reason in enumerate(frame_reasons) if reason]
            screened[side][rejected] = np.nan
            reasons += [reason for reason in frame_reasons if reason]
        return screened, reasons

    def _by_side(
        self, keypoints: ArrayLike | Mapping[str, ArrayLike]
    ) -> Mapping[str | None, ArrayLike]:
        sides = ", ".join(self.config.sides)
        if not isinstance(keypoints, Mapping):
            if sides:
                raise InputError(f"keypoints: found one hand, expected keypoints by side: {sides}")
            return {None: keypoints}
        for side in keypoints:
            if side not in self._hands:
                raise InputError(
                    f"keypoints.{side}: side is unknown, expected {sides or 'one hand'}"
                )
        return {**keypoints}

    def _aligned(self, frames: Mapping[str | None, Array]) -> Array:
        """Return the rotation (3, 3) from the keypoints' frame to the base frame, for all hands."""
        if self.config.rpy is not None:
            return _rotation(self.config.rpy)
        hands = [self._hands[side] for side in frames]
        pairs = [
            hand.tip_offsets(frame) for hand, frame in zip(hands, frames.values(), strict=True)
        ]
        wrists = np.array([frame[self.config.wrist] for frame in frames.values()])
        palms = np.array([hand.palm[:3, 3] for hand in hands])
        # The positions of the hands relative to each other; zero for a single hand.
        pairs.append((wrists - wrists.mean(axis=0), palms - palms.mean(axis=0)))
        return _aligning_rotation(
            *(np.concatenate(vectors) for vectors in zip(*pairs, strict=True))
        )


class _Hand:
    """Retargeting of one hand of the robot.

    Attributes:
        rows: Indices of its retargeted fingers among those of the robot.
        palm: (4, 4) initial pose of its palm.
        in_hand: True if the origin of the keypoints is in the hand.
        filter: Filter that rejects frames in which the tracker has lost the hand.
        order: Converter of frames to the common order.
    """

    def __init__(
        self,
        config: Retarget,
        robot: ArmHand,
        q: Array,
        side: str | None,
        side_config: RetargetSide,
    ) -> None:
        if side not in robot.hands:
            sides = ", ".join(name for name in robot.hands if name)
            if side is None:
                raise InputError(f"sides: sides are missing, expected the robot's sides: {sides}")
            expected = f"the robot's sides: {sides}" if sides else "fingers of one hand"
            raise InputError(f"sides.{side}: side is unknown, expected {expected}")
        key = "fingers" if side is None else f"sides.{side}.fingers"
        names, rows = [robot.fingers[i] for i in robot.hands[side]], list[int]()
        for name in side_config.fingers:
            full = name if name in names else f"{side}_{name}"
            if full not in names:
                raise InputError(
                    f"{key}.{name}: finger is unknown, expected one of {', '.join(names)}"
                )
            rows.append(robot.fingers.index(full))
        self._config, self._side_config = config, side_config
        self._robot, self._side = robot, side
        self.palm, (self._tips, _) = robot.palm(q, side), robot.contacts(q)
        self.rows = np.array(rows)
        self._keys = np.array(list(side_config.fingers.values()))
        self.filter = FrameFilter(self._keys.tolist(), config.wrist)
        self.order = OrderConverter("keypoints" if side is None else f"keypoints.{side}")
        self.in_hand = False
        self._is_recognised = False
        self._first: tuple[Array, Array] | None = None
        self._smooth: Array | None = None

    @property
    def has_begun(self) -> bool:
        """True after the first accepted frame."""
        return self._first is not None

    def in_standard_order(self, frame: Array) -> Array:
        """Return a frame (21, 3) in the common order.

        The hand starts again when another order is recognised.
        """
        was_decided = self.order.is_decided
        frame = self.order.converted(frame[None])[0]
        if self.order.is_decided and not was_decided and self.order.name != STANDARD_ORDER:
            self._first, self._smooth, self._is_recognised = None, None, False
            self.filter = FrameFilter(self._keys.tolist(), self._config.wrist)
        return frame

    def accepts(self, frame: Array, elapsed: float) -> bool:
        """Return True if keypoints (21, 3) form a hand; the first frame must be in metres."""
        if not self.filter.accepts(frame, elapsed):
            return False
        if not self._is_recognised:
            self._recognise(frame)
            self._is_recognised = True
        return True

    def smoothed(self, frame: Array, elapsed: float) -> Array:
        """Return the newest frame (21, 3), mirrored and smoothed as configured."""
        if self._side_config.mirror:
            frame = _mirrored(frame, self._config.wrist)
        gain = 1 - (1 - self._config.low_pass) ** (RATE * elapsed)
        previous = frame if self._smooth is None else self._smooth
        self._smooth = smooth = previous + gain * (frame - previous)
        return smooth

    def tip_offsets(self, frame: Array) -> tuple[Array, Array]:
        """Return the fingertips (k, 3) of the person and of the robot at q0, from the wrist."""
        tips = frame[self._keys] - frame[self._config.wrist]
        return tips, self._tips[self.rows] - self.palm[:3, 3]

    def targets(self, frame: Array, R_base_keypoints: Array) -> tuple[Array, Array]:
        """Return the targets of fingertips (k, 3) and palm (4, 4) of a frame, base frame."""
        wrist, tips = frame[self._config.wrist], frame[self._keys]
        if self._first is None:
            self._begin(frame)
        assert self._first is not None
        start, first_axes = self._first
        travel = self._config.travel
        travel = (0.0 if self.in_hand else 1.0) if travel is None else travel
        origin = self._origin + R_base_keypoints @ (travel * (wrist - start))
        points = origin + self._size * (tips - wrist) @ R_base_keypoints.T
        hand_rotation = _hand_axes(frame, self._config.wrist) @ first_axes.T
        rotation = R_base_keypoints @ hand_rotation @ R_base_keypoints.T
        palm = np.eye(4)
        palm[:3, :3], palm[:3, 3] = rotation @ self.palm[:3, :3], origin
        return points, palm

    def _recognise(self, frame: Array) -> None:
        """Check that the first frame is in metres, and detect an origin in the hand."""
        wrist = frame[self._config.wrist]
        palm = frame[list(KNUCKLES)].mean(axis=0) - wrist
        length, finite = float(np.linalg.norm(palm)), frame[np.isfinite(frame).all(axis=1)]
        # Image coordinates are between 0 and 1, slightly beyond at the edges; depths are relative
        # to the wrist.
        is_normalised = (np.abs(finite[:, :2] - 0.5) < 1).all() and abs(wrist[2]) < 1e-5
        if is_normalised and (length > HAND_SIZE_TUNING.max_palm_length or wrist[2] != 0):
            raise InputError(
                "keypoints: found image coordinates from 0 to 1 (MediaPipe's image landmarks), "
                "expected metres: use its world landmarks, or a camera with depth"
            )
        if length > HAND_SIZE_TUNING.max_length_in_metres:
            raise InputError(
                f"keypoints: found a palm {length:.4g} m long, expected metres (pixels, or mm?)"
            )
        self.in_hand = bool(
            np.linalg.norm(finite.mean(axis=0)) < HAND_SIZE_TUNING.max_origin_distance * length
        )

    def _begin(self, frame: Array) -> None:
        """Store the wrist of the first frame, and compute the scale."""
        config = self._config
        if config.scaling > 0:
            self._size = config.scaling
        else:
            person = sum(_reach(frame, config.wrist, int(key)) for key in self._keys)
            reaches = _reaches(self._robot, self._side)[self.rows]
            self._size = float(reaches.sum() / max(person, 1e-9))
        self._origin = (
            self.palm[:3, 3] if self._side_config.xyz is None else np.array(self._side_config.xyz)
        )
        self._first = frame[config.wrist].copy(), _hand_axes(frame, config.wrist)


def _reaches(robot: ArmHand, side: str | None) -> Array:
    """Return the maximum distances (f,) of a robot's fingertips from its palm [m]."""
    q = robot.random(np.random.default_rng(0), HAND_SIZE_TUNING.postures)
    vectors = robot.contacts(q)[0] - robot.palm(q, side)[:, None, :3, 3]
    return np.linalg.norm(vectors, axis=2).max(axis=0)


def _reach(frame: Array, wrist: int, key: int) -> float:
    """Return the distance of a keypoint from the wrist if the finger were straight [m]."""
    bones = [wrist, *range(4 * ((key - 1) // 4) + 1, key + 1)] if key else [wrist, key]
    length = float(np.linalg.norm(np.diff(frame[bones], axis=0), axis=1).sum())
    return length if np.isfinite(length) else float(np.linalg.norm(frame[key] - frame[wrist]))


def _mirrored(frame: Array, wrist: int) -> Array:
    """Return the frame of the other hand with the same wrist and the same orientation."""
    lateral = _hand_axes(frame, wrist)[:, 1]
    return frame - 2 * np.outer((frame - frame[wrist]) @ lateral, lateral)


def _rotation(rpy: tuple[float, float, float]) -> Array:
    return frame_matrix(Frame(rpy=rpy))[:3, :3]


def _aligning_rotation(tips: Array, robot_tips: Array) -> Array:
    """Return the rotation (3, 3) that best aligns fingertips with a robot's (Kabsch 1976)."""
    u, _, v = np.linalg.svd(robot_tips.T @ tips)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v


def _hand_axes(frame: Array, wrist: int) -> Array:
    """Return the axes (3, 3) of a hand as columns: longitudinal, lateral, dorsal."""
    index, little = (frame[number] - frame[wrist] for number in KNUCKLES)
    longitudinal = _unit(index + little)
    dorsal = _unit(np.cross(index, little))
    return np.stack([longitudinal, np.cross(dorsal, longitudinal), dorsal], axis=1)


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
