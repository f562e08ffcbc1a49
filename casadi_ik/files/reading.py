"""Reading description files: YAML with units in, checked data out.

Nothing in a file is run, and none takes for ever, whoever wrote it.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import yaml
from yaml.composer import ComposerError

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.units import (
    QUANTITY,
    UNITS,
    Angle,
    Length,
    PureNumber,
    check_units,
    item_name,
    leaf_values,
    to_si,
    units_in,
)

MERGE = "tag:yaml.org,2002:merge"

# libyaml where PyYAML has it: a tenth of the time.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _UniqueKeyLoader(_SafeLoader):
    """YAML's own loader keeps the last of two equal keys without a word; this one objects.

    Merge keys (``<<``) are refused: they are no part of YAML 1.2, and what they override is easily
    overlooked.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == MERGE:
                raise yaml.constructor.ConstructorError(
                    None, None, "merge keys (<<) are not taken", key_node.start_mark
                )
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, (str, int, float)) and key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} appears twice", key_node.start_mark
                )
            if isinstance(key, (str, int, float)):
                seen.add(key)
        return super().construct_mapping(node, deep)


def read_bytes(path: Path, where: str, most: int, note: str = "") -> bytes:
    """All of a file.

    Args:
        path: The file.
        where: What to call it in a message.
        most: Bytes that it may have.
        note: How that is raised, for the message.

    Raises:
        DescriptionError: It cannot be read, or is larger.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(most + 1)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise DescriptionError(f"{where}: cannot be read: {reason}") from error
    if len(data) > most:
        size = f"{most / 2**20:.3g} MiB {note}".rstrip()
        raise DescriptionError(f"{where}: cannot be read: is larger than {size}")
    return data


def read_text(path: Path, most: int, note: str = "", encoding: str = "utf-8") -> str:
    """The text of a file; see `read_bytes`.

    Raises:
        DescriptionError: As there, or it is no text.
    """
    try:
        return read_bytes(path, str(path), most, note).decode(encoding)
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{path}: cannot be read: not UTF-8 text") from error


def parse_yaml(path: Path) -> Any:
    """Parse a YAML file.

    Raises:
        DescriptionError: The file is missing, unreadable, not UTF-8, not YAML, or beyond a limit.
    """
    text = read_text(path, LIMITS.yaml_bytes)
    try:
        _check_events(text)
        found = yaml.load(text, Loader=_UniqueKeyLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise DescriptionError(f"{path}{where}: not valid YAML: {problem}") from error
    except (ValueError, OverflowError, RecursionError) as error:  # an impossible date
        raise DescriptionError(f"{path}: not valid YAML: {error}") from error
    try:
        _count(found, 0, 0)
    except ValueError as error:
        raise DescriptionError(f"{path}: {error}") from error
    return found


def _check_events(text: str) -> None:
    """Look at a text one event at a time: building nested data from it could end the process.

    Raises:
        yaml.YAMLError: Not YAML, or beyond a limit.
    """
    depth = 0
    for event in yaml.parse(text, Loader=_SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        problem = ""
        if depth > LIMITS.yaml_depth:
            problem = f"nested more than {LIMITS.yaml_depth} deep"
        elif isinstance(event, yaml.ScalarEvent) and len(event.value) > LIMITS.yaml_text:
            problem = f"a text of more than {LIMITS.yaml_text} characters"
        elif isinstance(event, yaml.ScalarEvent) and not _readable(event.value):
            problem = "a text with control characters"
        if problem:
            raise ComposerError(None, None, problem, event.start_mark)


def _readable(text: str) -> bool:
    return text.isprintable() or all(c.isprintable() or c in "\n\t" for c in text)


def _count(value: Any, count: int, depth: int) -> int:
    """How many values there are, aliases followed.

    Raises:
        ValueError: Too many, or too deep.
    """
    count += 1
    if count > LIMITS.yaml_values:
        raise ValueError(f"holds more than {LIMITS.yaml_values} values")
    if depth > LIMITS.yaml_depth:
        raise ValueError("nested too deeply, or holds itself")
    if isinstance(value, dict):
        for item in value.values():
            count = _count(item, count, depth + 1)
    elif isinstance(value, (list, tuple, set)):
        for item in value:
            count = _count(item, count, depth + 1)
    return count


T = TypeVar("T")
Vector = tuple[PureNumber, PureNumber, PureNumber]
Point = tuple[Length, Length, Length]
Angles = tuple[Angle, Angle, Angle]


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
    return to_si(parse_yaml(path))


def read(path: Path, type_: type[T]) -> tuple[T, dict[str, str]]:
    """Read a YAML file of a type; see `validated`.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    return validated(parse_yaml(path), type_, path)


def validated(raw: Any, type_: type[T], path: Path) -> tuple[T, dict[str, str]]:
    """Parsed YAML as a type: all numbers finite, every unit of the dimension that its place has.

    Args:
        raw: As it was parsed, units and all.
        type_: The type.
        path: The file.

    Returns:
        The entry, and the units in the file by key ("home.spread": "deg").

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    data = to_si(raw)
    for key, value in leaf_values(data):
        if isinstance(value, float) and not math.isfinite(value):
            raise DescriptionError(f"{path}: {key}: found {value}, expected a finite number")
    entry = convert_entry(data, type_, path)
    check_units(raw, type_, path)
    return entry, units_in(raw)


def convert_entry(data: Any, type_: type[T], path: Path) -> T:
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
        elif "`float` >" in text:
            text = f"found {value:g}, {text.replace('`float` ', '').replace('0.0', '0')}"
        raise DescriptionError(f"{path}: {key or '(top level)'}: {text}") from error


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
