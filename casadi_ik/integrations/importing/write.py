"""The description of an imported robot as YAML with a comment at each guess."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.integrations.importing.fingers import Pad
from casadi_ik.model.link_shapes import Touching
from casadi_ik.model.schema import ShapeEntry

PLAIN_SCALAR = re.compile(r"[A-Za-z_/.][A-Za-z0-9_./+-]*")
"""Texts that YAML reads as strings without quotes, except for `RESERVED_WORDS`."""

RESERVED_WORDS = {"true", "false", "yes", "no", "on", "off", "null", "y", "n", "."}

MAX_SHAPE_LINE = 98
"""Maximum number of characters of a line with a collision shape."""

SHAPES_COMMENT = (
    "# Shapes as in the files; meshes are enclosed by capsules or boxes, which exceed them by "
    "`excess`."
)

DEFAULT_LOCK_REASON = "has no single axis"


def scalar(text: str) -> str:
    """Return a text as a YAML value or key."""
    if PLAIN_SCALAR.fullmatch(text) and text.lower() not in RESERVED_WORDS:
        return text
    return json.dumps(text, ensure_ascii=False)


def one_line(text: str) -> str:
    """Return a text without line breaks and unprintable characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def vector(values: Array, digits: int = 6) -> str:
    """Return numbers as a YAML list with at most `digits` decimals."""
    texts = (f"{float(value):.{digits}f}".rstrip("0").rstrip(".") for value in values)
    return "[" + ", ".join("0" if text in ("-0", "") else text for text in texts) + "]"


def collision_lines(
    shapes: Mapping[str, Sequence[ShapeEntry]],
    touching: Sequence[Touching],
    source: str = "",
    srdf: str = "",
) -> list[str]:
    """Return the lines of the key ``collision``.

    Args:
        shapes: Shapes by link.
        touching: Pairs of links that may touch.
        source: Tag of the source of the shapes, if any.
        srdf: File with further pairs that may touch, if any.
    """
    lines = ["collision:"]
    lines += [f"  source: {scalar(source)}"] if source else []
    lines += [f"  srdf: {scalar(srdf)}"] if srdf else []
    lines.append("  links:")
    for link, link_shapes in shapes.items():
        lines.append(f"    {scalar(link)}:")
        for shape in link_shapes:
            lines += _shape_lines(shape)
    if touching:
        lines.append("  touching:")
        for pair in touching:
            first, second = (scalar(link) for link in pair.links)
            lines.append(f"    - links: [{first}, {second}]")
            if math.isfinite(pair.depth):
                lines.append(f"      depth: {_value_text(pair.depth, '')}")
            lines.append(f"      reason: {one_line(pair.reason)}")
    return lines


def _shape_lines(shape: ShapeEntry) -> list[str]:
    """Return the lines of a shape, broken after `MAX_SHAPE_LINE` characters."""
    pairs = [f"kind: {shape.__struct_config__.tag}"]
    for key, value in msgspec.structs.asdict(shape).items():
        if key not in ("excess", "rpy", "xyz") or np.any(value):
            pairs.append(f"{key}: {_value_text(value, key)}")
    lines, line = [], "      - {"
    for pair in pairs:
        if len(line) + len(pair) > MAX_SHAPE_LINE and not line.endswith("{"):
            lines.append(line.rstrip())
            line = "         "
        line += pair + ", "
    return [*lines, line.removesuffix(", ") + "}"]


def _value_text(value: object, key: str) -> str:
    """Return a length in mm, an angle of the key ``rpy`` in rad, or a list of them."""
    if isinstance(value, tuple):
        return f"[{', '.join(_value_text(item, key) for item in value)}]"
    assert isinstance(value, (int, float))
    if key == "rpy":
        return f"{round(value, 6) + 0.0:g}"
    return f"{round(1e3 * value, 4) + 0.0:.10g} mm"


@dataclass(frozen=True)
class FileEntry:
    """The entry of an arm's or a hand's file.

    Attributes:
        file: File name in the description.
        end_link: Tip link of an arm, or palm link of a hand.
        reason: Reason why this is the end link.
        limits: Limits that are assumed for joints without limits [rad or m].
        locked: Positions of the joints that are fixed [rad or m].
        xacro: Arguments of the file, NAME:=VALUE; True: its macros are expanded although its suffix
            is not ``.xacro``.
        lock_reasons: Reason by fixed joint; `DEFAULT_LOCK_REASON` for a joint without one.
    """

    file: str
    end_link: str
    reason: str
    limits: Mapping[str, tuple[float, float]]
    locked: Mapping[str, float]
    xacro: bool | Sequence[str] = False
    lock_reasons: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class HandEntry:
    """The entries of a hand.

    Attributes:
        side: Name of the side of a multi-arm robot; "" for a single hand.
        palm_pose: (4, 4) palm frame in the palm link.
        palm_link: Palm link.
        reason: Reason why this is the palm link.
        pads: Pad by finger.
        thumb: Name of the thumb and the reason; None if no finger is one.
    """

    side: str
    palm_pose: Array
    palm_link: str
    reason: str
    pads: Mapping[str, Pad]
    thumb: tuple[str, str] | None

    def palm_text(self) -> str:
        """Return the palm frame in one line."""
        return (
            f"{{link: {scalar(self.palm_link)}, xyz: {vector(self.palm_pose[:3, 3])}, "
            f"rpy: {vector(roll_pitch_yaw(self.palm_pose[:3, :3]))}}}"
        )

    def finger_lines(self) -> list[str]:
        """Return the lines of the thumb and of all pads."""
        lines = []
        if self.thumb is not None:
            lines.append(f"thumb: {scalar(self.thumb[0])}  # {_guess_comment(self.thumb[1])}")
        lines.append("fingers:  # xyz [m] and outward normal of the pad, in the link's frame")
        for name, pad in self.pads.items():
            lines.append(f"  # GUESS: {one_line(pad.reason)}")
            lines.append(
                f"  {scalar(name)}: {{link: {scalar(pad.link)}, xyz: {vector(pad.point)}, "
                f"normal: {vector(pad.normal)}}}"
            )
        return lines


@dataclass(frozen=True, eq=False)
class ImportedDescription:
    """The content of the description of an imported robot.

    Attributes:
        command: Command that wrote the description.
        name: Name of the robot.
        arm: Entry of the arm's file; None if the hand's file contains the arm, or there is no arm.
        hand: Entry of the file of the hand or of the complete robot.
        key: Key of `hand`: "hand" or "robot".
        mount: (6,) pose of the hand on the arm, x y z roll pitch yaw [m, rad]; None without `arm`.
        mount_reason: Origin of `mount`.
        hands: The hand, or the hands of a multi-arm robot.
        notes: Messages about what could not be read.
        home: Home position by actuator [rad or m]; empty until it is known.
        shapes: Shapes by link; empty until they are known.
        touching: Pairs of links whose shapes may touch.
        srdf: File with further pairs that may touch; "" if there is none.
    """

    command: str
    name: str
    arm: FileEntry | None
    hand: FileEntry
    key: str
    mount: Sequence[float] | None
    mount_reason: str
    hands: Sequence[HandEntry]
    notes: Sequence[str]
    home: Mapping[str, float] = field(default_factory=dict)
    shapes: Mapping[str, Sequence[ShapeEntry]] = field(default_factory=dict)
    touching: Sequence[Touching] = ()
    srdf: str = ""

    def to_yaml(self) -> str:
        """Return the description as YAML."""
        lines = [
            f"# Made by: {self.command}",
            "# Fingertips, palm, thumb and home are not stated in the files of a robot. Check the",
            "# lines marked GUESS and correct them here. To draw the pads: casadi-ik import",
            "# THIS.yaml --picture FILE.png; to drag them: casadi-ik view THIS.yaml --pads. To",
            "# remove a false finger, delete its line under `fingers`, and the line `thumb` if it",
            "# names that finger. `home` and `collision` may be deleted, too.",
            *(f"# {one_line(note)}" for note in self.notes),
            f"name: {scalar(self.name)}",
        ]
        if self.arm is not None:
            lines += _file_lines("arm", self.arm, "tip", scalar(self.arm.end_link))
        palm_comment = "# z away from the palm, y towards the thumb, origin amid the fingers' bases"
        first_hand, *more_hands = self.hands
        if more_hands:
            lines += _file_lines(self.key, self.hand, "palm", None)
        else:
            palm = first_hand.palm_text()
            lines += _file_lines(self.key, self.hand, "palm", palm, palm_comment)
        if self.mount is not None:
            xyz, rpy = vector(np.array(self.mount[:3])), vector(np.array(self.mount[3:]))
            lines.append(f"mount: {{xyz: {xyz}, rpy: {rpy}}}  # {self.mount_reason}")
        if more_hands:
            lines += [
                "sides:  # the trunk ends where the chains to the palms separate",
                f"  {palm_comment}",
            ]
            for hand in self.hands:
                lines += [
                    f"  {scalar(hand.side)}:",
                    f"    palm: {hand.palm_text()}  # {_guess_comment(hand.reason)}",
                    *(f"    {line}" for line in hand.finger_lines()),
                ]
        else:
            lines += first_hand.finger_lines()
        if self.home:
            lines.append("home:  # GUESS: half closed, the arm away from limits and singularities")
            lines += [f"  {scalar(name)}: {value:.6g}" for name, value in self.home.items()]
        if self.shapes:
            lines.append(SHAPES_COMMENT)
            lines += collision_lines(self.shapes, self.touching, srdf=self.srdf)
        return "\n".join(lines) + "\n"


def _file_lines(
    key: str, entry: FileEntry, end_key: str, end: str | None, end_comment: str = ""
) -> list[str]:
    """Return the lines of an arm's or a hand's file.

    Args:
        key: Key of the entry.
        entry: The entry.
        end_key: Key of the end link, "tip" or "palm".
        end: Value of `end_key`; None to omit it.
        end_comment: Comment before the line of `end_key`, if any.
    """
    lines = [f"{key}:", f"  file: {scalar(entry.file)}"]
    if entry.xacro:
        lines.append(f"  xacro: {_xacro_text(entry.xacro)}")
    if end is not None:
        lines += [f"  {end_comment}"] if end_comment else []
        lines.append(f"  {end_key}: {end}  # {_guess_comment(entry.reason)}")
    if entry.limits:
        lines.append("  limits:  # GUESS: the file states none")
        lines += [
            f"    {scalar(name)}: [{low:.6g}, {high:.6g}]"
            for name, (low, high) in entry.limits.items()
        ]
    if entry.locked:
        lines.append("  locked:  # GUESS: these joints are fixed; delete a line to release a joint")
        for name, value in entry.locked.items():
            reason = entry.lock_reasons.get(name, DEFAULT_LOCK_REASON)
            lines.append(f"    {scalar(name)}: {value:.6g}  # {reason}")
    return lines


def _xacro_text(xacro: bool | Sequence[str]) -> str:
    if isinstance(xacro, bool):
        return "true"
    return f"[{', '.join(json.dumps(argument) for argument in xacro)}]"


def _guess_comment(reason: str) -> str:
    """Return the comment at a value: the option that gave it, or the reason of a guess."""
    reason = one_line(reason)
    return reason if reason.startswith("--") else f"GUESS: {reason}"
