"""The description of an imported robot as YAML, in which each guess says that it is one."""

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
from casadi_ik.integrations.importing.guess import Pad
from casadi_ik.model.link_shapes import Touching
from casadi_ik.model.schema import ShapeEntry

PLAIN_SCALAR = re.compile(r"[A-Za-z_/.][A-Za-z0-9_./+-]*")
"""What YAML takes for text without quotes; nothing that it could take for anything else."""

RESERVED = {"true", "false", "yes", "no", "on", "off", "null", "y", "n", "."}


def scalar(text: str) -> str:
    """A text as a YAML value or key."""
    if PLAIN_SCALAR.fullmatch(text) and text.lower() not in RESERVED:
        return text
    return json.dumps(text, ensure_ascii=False)


def one_line(text: str) -> str:
    """A text without line ends and what cannot be printed."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


LINE_WIDTH = 98
"""Characters of a line, as far as a shape can be broken."""


def collision_lines(
    shapes: Mapping[str, Sequence[ShapeEntry]],
    touching: Sequence[Touching],
    source: str = "",
    srdf: str = "",
) -> list[str]:
    """The key with everything below it.

    Args:
        shapes: By link its shapes.
        touching: Links that may touch.
        source: Tag of their source, if any.
        srdf: File with more such links, if any.
    """
    lines = ["collision:"]
    lines += [f"  source: {scalar(source)}"] if source else []
    lines += [f"  srdf: {scalar(srdf)}"] if srdf else []
    lines.append("  links:")
    for link, found in shapes.items():
        lines.append(f"    {scalar(link)}:")
        for one in found:
            lines += _of_shape(one)
    if touching:
        lines.append("  touching:")
        for pair in touching:
            first, second = (scalar(link) for link in pair.links)
            lines.append(f"    - links: [{first}, {second}]")
            if math.isfinite(pair.depth):
                lines.append(f"      depth: {_text(pair.depth, '')}")
            lines.append(f"      reason: {one_line(pair.reason)}")
    return lines


def _of_shape(one: ShapeEntry) -> list[str]:
    parts = [f"kind: {one.__struct_config__.tag}"]
    for key, value in msgspec.structs.asdict(one).items():
        if key not in ("excess", "rpy", "xyz") or np.any(value):
            parts.append(f"{key}: {_text(value, key)}")
    lines, line = [], "      - {"
    for part in parts:
        if len(line) + len(part) > LINE_WIDTH and not line.endswith("{"):
            lines.append(line.rstrip())
            line = "         "
        line += part + ", "
    return [*lines, line.removesuffix(", ") + "}"]


def _text(value: object, key: str) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_text(item, key) for item in value)}]"
    assert isinstance(value, (int, float))
    if key == "rpy":
        return f"{round(value, 6) + 0.0:g}"
    return f"{round(1e3 * value, 4) + 0.0:.10g} mm"


MADE = (
    "# Shapes as in the files; meshes are held by capsules or boxes, which stand out by `excess`."
)
"""Before the shapes."""


@dataclass(frozen=True)
class FileLine:
    """An arm or a hand and its file.

    Attributes:
        file: As it is named in the description.
        end: The tip's link, or the palm's.
        how: How the end was found.
        limits: What is assumed of joints without limits.
        locked: Joints that stand still.
        xacro: Values of the file's arguments, NAME:=VALUE; True: its macros are expanded although
            it is not called ``.xacro``.
        why: Why they do, by joint; what has no single axis is not among them.
    """

    file: str
    end: str
    how: str
    limits: Mapping[str, tuple[float, float]]
    locked: Mapping[str, float]
    xacro: bool | Sequence[str] = False
    why: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class HandLines:
    """What is said of a hand.

    Attributes:
        side: What it is called, if there are several.
        palm: (4, 4) frame of the palm in its link.
        link: The link.
        how: How that was found.
        fingers: By name the pad.
        thumb: The thumb's name, and how it was found; None: there is none.
    """

    side: str
    palm: Array
    link: str
    how: str
    fingers: Mapping[str, Pad]
    thumb: tuple[str, str] | None

    def palm_text(self) -> str:
        """The palm's frame, in one line."""
        return (
            f"{{link: {scalar(self.link)}, xyz: {vector(self.palm[:3, 3])}, "
            f"rpy: {vector(roll_pitch_yaw(self.palm[:3, :3]))}}}"
        )

    def finger_lines(self) -> list[str]:
        """The thumb and all pads."""
        lines = []
        if self.thumb is not None:
            lines.append(f"thumb: {scalar(self.thumb[0])}  # {_guess(self.thumb[1])}")
        lines.append("fingers:  # xyz [m] and outward normal of the pad, in the link's frame")
        for name, pad in self.fingers.items():
            lines.append(f"  # GUESS: {one_line(pad.reason)}")
            lines.append(
                f"  {scalar(name)}: {{link: {scalar(pad.link)}, xyz: {vector(pad.point)}, "
                f"normal: {vector(pad.normal)}}}"
            )
        return lines


@dataclass(frozen=True, eq=False)
class Written:
    """Everything that stands in a description.

    Attributes:
        command: What made it.
        name: Of the robot.
        arm: Its line; None if the hand's file has the arm, or there is none.
        arm_name: The shipped arm that is used instead.
        hand: The hand's line.
        key: "hand" or "robot".
        mount: (6,) x y z roll pitch yaw; None if there is no arm.
        mount_how: How it came about.
        hands: The hand, or those of a body.
        notes: What could not be read.
        home: By actuator; empty as long as it is not known.
        shapes: By link; empty as long as they are not known.
        touching: Links whose shapes may touch.
        srdf: File that names more of them.
    """

    command: str
    name: str
    arm: FileLine | None
    hand: FileLine
    key: str
    mount: Sequence[float] | None
    mount_how: str
    hands: Sequence[HandLines]
    notes: Sequence[str]
    home: Mapping[str, float] = field(default_factory=dict)
    shapes: Mapping[str, Sequence[ShapeEntry]] = field(default_factory=dict)
    touching: Sequence[Touching] = ()
    srdf: str = ""

    def text(self) -> str:
        """The YAML."""
        lines = [
            f"# Made by: {self.command}",
            "# What no file of a robot says was guessed: look at the lines marked GUESS, correct",
            "# them here. To see them: casadi-ik import THIS.yaml --picture FILE.png; to drag pads",
            "# to where they belong: casadi-ik view THIS.yaml --pads. Of a finger that is none",
            "# delete its line under `fingers`, and the line `thumb` if that names it. `home` and",
            "# `collision` may be deleted as well.",
            *(f"# {one_line(note)}" for note in self.notes),
            f"name: {scalar(self.name)}",
        ]
        if self.arm is not None:
            lines += _file_lines("arm", self.arm, "tip", [scalar(self.arm.end)])
        about = "# z away from the palm, y towards the thumb, origin amid the fingers' bases"
        first, *others = self.hands
        palm = [] if others else [first.palm_text(), about]
        lines += _file_lines(self.key, self.hand, "palm", palm)
        if self.mount is not None:
            x = vector(np.array(self.mount[:3])), vector(np.array(self.mount[3:]))
            lines.append(f"mount: {{xyz: {x[0]}, rpy: {x[1]}}}  # {self.mount_how}")
        if others:
            lines += ["sides:  # the trunk ends where the chains to the palms part", f"  {about}"]
        for hand in self.hands if others else ():
            lines += [
                f"  {scalar(hand.side)}:",
                f"    palm: {hand.palm_text()}  # {_guess(hand.how)}",
            ]
            lines += [f"    {line}" for line in hand.finger_lines()]
        lines += [] if others else first.finger_lines()
        if self.home:
            lines.append("home:  # GUESS: half closed, the arm away from limits and singularities")
            lines += [f"  {scalar(name)}: {value:.6g}" for name, value in self.home.items()]
        if self.shapes:
            lines += [MADE, *collision_lines(self.shapes, self.touching, srdf=self.srdf)]
        return "\n".join(lines) + "\n"


def _file_lines(key: str, line: FileLine, end: str, ends: Sequence[str]) -> list[str]:
    found = [
        f"{key}:",
        f"  file: {scalar(line.file)}",
        *([f"  xacro: {_xacro(line.xacro)}"] if line.xacro else []),
    ]
    for value, *more in [list(ends)] if ends else []:
        found += [*(f"  {text}" for text in more), f"  {end}: {value}  # {_guess(line.how)}"]
    if line.limits:
        found.append("  limits:  # GUESS: the file states none")
        found += [
            f"    {scalar(name)}: [{low:.6g}, {high:.6g}]"
            for name, (low, high) in line.limits.items()
        ]
    if line.locked:
        found.append("  locked:  # GUESS: these joints stand still; delete a line to let one move")
        for name, value in line.locked.items():
            why = line.why.get(name, "has no single axis")
            found.append(f"    {scalar(name)}: {value:.6g}  # {why}")
    return found


def _xacro(xacro: bool | Sequence[str]) -> str:
    return (
        "true" if isinstance(xacro, bool) else f"[{', '.join(json.dumps(word) for word in xacro)}]"
    )


def _guess(how: str) -> str:
    how = one_line(how)
    return how if how.startswith("--") else f"GUESS: {how}"


def vector(values: Array, digits: int = 6) -> str:
    """Numbers as YAML has them, with so many digits behind the point at most."""
    texts = (f"{float(value):.{digits}f}".rstrip("0").rstrip(".") for value in values)
    return "[" + ", ".join("0" if text in ("-0", "") else text for text in texts) + "]"
