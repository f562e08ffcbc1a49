"""The description of an imported robot as YAML, in which each guess says that it is one."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.importing.pads import Pad

PLAIN = re.compile(r"[A-Za-z_/.][A-Za-z0-9_./+-]*")
"""What YAML takes for text without quotes; nothing that it could take for anything else."""

RESERVED = {"true", "false", "yes", "no", "on", "off", "null", "y", "n", "."}


@dataclass(frozen=True)
class FileLine:
    """An arm or a hand and its file.

    Attributes:
        file: As it is named in the description.
        end: The tip's link, or the palm's.
        how: How the end was found.
        limits: What is assumed of joints without limits.
        locked: Joints that stand still.
    """

    file: str
    end: str
    how: str
    limits: Mapping[str, tuple[float, float]]
    locked: Mapping[str, float]


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
        palm: (4, 4) frame of the palm in its link.
        fingers: By name the pad.
        thumb: The thumb's name, and how it was found.
        notes: What could not be read.
        home: By actuator; empty as long as it is not known.
    """

    command: str
    name: str
    arm: FileLine | None
    hand: FileLine
    key: str
    mount: Sequence[float] | None
    mount_how: str
    palm: Array
    fingers: Mapping[str, Pad]
    thumb: tuple[str, str]
    notes: Sequence[str]
    home: Mapping[str, float] = field(default_factory=dict)

    def text(self) -> str:
        """The YAML."""
        lines = [
            f"# Made by: {self.command}",
            "# What no file of a robot says was guessed: look at the lines marked GUESS, correct",
            "# them here. To see them: casadi-ik import THIS.yaml --picture FILE.png",
            *(f"# {_one_line(note)}" for note in self.notes),
            f"name: {_scalar(self.name)}",
        ]
        if self.arm is not None:
            lines += _file_lines("arm", self.arm, "tip", [_scalar(self.arm.end)])
        palm = (
            f"{{link: {_scalar(self.hand.end)}, xyz: {_vector(self.palm[:3, 3])}, "
            f"rpy: {_vector(_rpy(self.palm[:3, :3]))}}}"
        )
        about = ["# z away from the palm, y towards the thumb, origin amid the fingers' bases"]
        lines += _file_lines(self.key, self.hand, "palm", [palm, *about])
        if self.mount is not None:
            x = _vector(np.array(self.mount[:3])), _vector(np.array(self.mount[3:]))
            lines.append(f"mount: {{xyz: {x[0]}, rpy: {x[1]}}}  # {self.mount_how}")
        lines.append(f"thumb: {_scalar(self.thumb[0])}  # {_guess(self.thumb[1])}")
        lines.append("fingers:  # xyz [m] and outward normal of the pad, in the link's frame")
        for name, pad in self.fingers.items():
            lines.append(f"  # GUESS: {_one_line(pad.how)}")
            lines.append(
                f"  {_scalar(name)}: {{link: {_scalar(pad.link)}, xyz: {_vector(pad.point)}, "
                f"normal: {_vector(pad.normal)}}}"
            )
        if self.home:
            lines.append("home:  # GUESS: half closed, the arm away from limits and singularities")
            lines += [f"  {_scalar(name)}: {value:.6g}" for name, value in self.home.items()]
        return "\n".join(lines) + "\n"


def _file_lines(key: str, line: FileLine, end: str, ends: Iterable[str]) -> list[str]:
    value, *more = ends
    found = [
        f"{key}:",
        f"  file: {_scalar(line.file)}",
        *(f"  {text}" for text in more),
        f"  {end}: {value}  # {_guess(line.how)}",
    ]
    if line.limits:
        found.append("  limits:  # GUESS: the file states none")
        found += [
            f"    {_scalar(name)}: [{low:.6g}, {high:.6g}]"
            for name, (low, high) in line.limits.items()
        ]
    if line.locked:
        found.append("  locked:  # these joints have no single axis")
        found += [f"    {_scalar(name)}: {value:.6g}" for name, value in line.locked.items()]
    return found


def _guess(how: str) -> str:
    how = _one_line(how)
    return how if how.startswith("--") else f"GUESS: {how}"


def _one_line(text: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _scalar(text: str) -> str:
    if PLAIN.fullmatch(text) and text.lower() not in RESERVED:
        return text
    return json.dumps(text, ensure_ascii=False)


def _vector(values: Array) -> str:
    return "[" + ", ".join(_number(float(value)) for value in values) + "]"


def _number(value: float) -> str:
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def _rpy(rotation: Array) -> Array:
    """Angles (3,) about the fixed axes, as URDF has them."""
    flat = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], flat)
    if flat > 1e-9:
        roll = math.atan2(rotation[2, 1], rotation[2, 2])
        return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])
    return np.array([math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
