"""Reading description files: YAML with units in, checked data out."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.files.units import (
    QUANTITY,
    UNITS,
    Length,
    Pure,
    Turn,
    check_units,
    in_si,
    item_name,
    units_in,
)
from casadi_ik.files.yaml_text import parse_yaml

T = TypeVar("T")
Vector = tuple[Pure, Pure, Pure]
Point = tuple[Length, Length, Length]
Angles = tuple[Turn, Turn, Turn]


class Struct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A mapping of a file; unknown keys are errors."""


class Frame(Struct, frozen=True):
    """A pose relative to the parent: xyz, then rpy about the fixed axes (as URDF).

    Attributes:
        xyz: Origin in the parent's frame [m].
        rpy: Angles about the parent's fixed axes x, y, z [rad].
    """

    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)


def frame_matrix(frame: Frame) -> Array:
    """(4, 4) pose of a frame: translation xyz after rotation rpy about the fixed axes (URDF)."""
    roll, pitch, yaw = frame.rpy
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    pose = np.eye(4)
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = frame.xyz
    return pose


def roll_pitch_yaw(rotation: Array) -> Array:
    """(3,) angles about the fixed axes [rad] of a rotation (3, 3): `frame_matrix` turned round."""
    flat = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], flat)
    if flat > 1e-9:
        roll = math.atan2(rotation[2, 1], rotation[2, 2])
        return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])
    return np.array([math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])


def read_yaml(path: Path) -> Any:
    """Parse a YAML file; quantities with units become SI floats.

    Raises:
        DescriptionError: See `parse_yaml`.
    """
    return in_si(parse_yaml(path))


def read(path: Path, type_: type[T]) -> tuple[T, dict[str, str]]:
    """Read a YAML file of a type; every unit has to be of the dimension that its place has.

    Returns:
        The entry, and the units in the file by key ("home.spread": "deg").

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    raw = parse_yaml(path)
    entry = convert(in_si(raw), type_, path)
    check_units(raw, type_, path)
    return entry, units_in(raw)


def convert(data: Any, type_: type[T], path: Path) -> T:
    """Check parsed YAML against a type.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    try:
        return msgspec.convert(data, type_)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `")
        in_key = place.startswith("key` in `")
        key, value = _culprit(data, type_, place.removeprefix("key` in `")[1:-1], str(error))
        text = f"{text[0].lower()}{text[1:]}"
        if in_key:
            text = f"one of its keys is no text: {text}"
        elif isinstance(value, str):
            match = QUANTITY.match(value)
            if match and "float" in text:
                text = f"unknown unit {match[2]!r}; known: {', '.join(filter(None, UNITS))}"
            text = f"found {value!r}, {text}"
        raise DescriptionError(f"{path}: {key or '(top level)'}: {text}") from error


def refuse_non_finite(data: Any, path: Path) -> None:
    """Refuse NaN and infinity anywhere in parsed YAML.

    Raises:
        DescriptionError: With file and key.
    """
    for key, value in _numbers(data, ""):
        if not math.isfinite(value):
            raise DescriptionError(f"{path}: {key}: found {value}, expected a finite number")


def _numbers(value: Any, key: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _numbers(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _numbers(item, f"{key}[{item_name(value, i)}]")
    elif isinstance(value, float):
        yield key, value


def _culprit(data: Any, type_: type[Any], place: str, message: str) -> tuple[str, Any]:
    """Key and value that a validation error is about.

    msgspec writes ``[...]`` for the keys of a mapping of the user's own names; which one it was
    comes out by leaving out all the others.
    """
    key, value, trimmed = "", data, data
    steps: list[Any] = []
    for part in re.findall(r"\[\.\.\.\]|\[\d+\]|\.[^.\[]+", place):
        if part == "[...]" and isinstance(value, dict):
            for name in value:
                alone = _replaced(trimmed, steps, {name: value[name]})
                if _complains(alone, type_, message):
                    break
            else:
                return f"{key}[...]", None
            trimmed, step = alone, name
            key += f".{name}"
        else:
            step = int(part[1:-1]) if part.startswith("[") else part[1:]
            key += f"[{item_name(value, step)}]" if isinstance(step, int) else part
        steps.append(step)
        value = value[step]
    return key.lstrip("."), value


def _complains(data: Any, type_: type[Any], message: str) -> bool:
    try:
        msgspec.convert(data, type_)
    except msgspec.ValidationError as error:
        return str(error) == message
    return False


def _replaced(data: Any, steps: list[Any], value: Any) -> Any:
    """A copy of nested data with another value at a place."""
    if not steps:
        return value
    copy = data.copy()
    copy[steps[0]] = _replaced(data[steps[0]], steps[1:], value)
    return copy
