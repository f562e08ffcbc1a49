"""Reading of description files: YAML with units in, validated records out.

Files are untrusted: nothing in them is executed, and size and depth are limited.
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
from casadi_ik.files.input_checks import warn_of_angles
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

# libyaml, if PyYAML includes it, takes a tenth of the time.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _UniqueKeyLoader(_SafeLoader):
    """YAML loader that refuses duplicate keys, which YAML's own loader accepts silently.

    It refuses merge keys (``<<``), too: they are not part of YAML 1.2, and the values that
    they override are easily overlooked.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == MERGE:
                raise yaml.constructor.ConstructorError(
                    None, None, "merge keys (<<) are not supported", key_node.start_mark
                )
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, (str, int, float)) and key in keys:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} appears twice", key_node.start_mark
                )
            if isinstance(key, (str, int, float)):
                keys.add(key)
        return super().construct_mapping(node, deep)


LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""Start of the text that a checkout without Git LFS contains in place of a large file."""


def read_bytes(path: Path, location: str, max_size: int, note: str = "") -> bytes:
    """Read a file.

    Args:
        path: The file.
        location: Name of the file in messages.
        max_size: Largest size [bytes].
        note: Hint how to raise the limit, for the message.

    Raises:
        DescriptionError: The file cannot be read, is larger, or is a Git LFS pointer.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(max_size + 1)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise DescriptionError(f"{location}: cannot be read: {reason}") from error
    if len(data) > max_size:
        size = f"{max_size / 2**20:.3g} MiB {note}".rstrip()
        raise DescriptionError(f"{location}: cannot be read: is larger than {size}")
    if data.startswith(LFS_POINTER):
        raise DescriptionError(
            f"{location}: the file is a Git LFS pointer; expected its contents (run git lfs pull)"
        )
    return data


def read_text(path: Path, max_size: int, note: str = "", encoding: str = "utf-8") -> str:
    """Read a text file; see `read_bytes`.

    Raises:
        DescriptionError: The file cannot be read, is larger, or is not text.
    """
    try:
        return read_bytes(path, str(path), max_size, note).decode(encoding)
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
        data = yaml.load(text, Loader=_UniqueKeyLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        location = f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise DescriptionError(f"{path}{location}: not valid YAML: {problem}") from error
    except (ValueError, OverflowError, RecursionError) as error:  # an impossible date
        raise DescriptionError(f"{path}: not valid YAML: {error}") from error
    try:
        _count_values(data, 0, 0)
    except ValueError as error:
        raise DescriptionError(f"{path}: {error}") from error
    return data


def _check_events(text: str) -> None:
    """Check the events of a text before nested data, which could crash the process, are built.

    Raises:
        yaml.YAMLError: The text is not YAML, or beyond a limit.
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
            problem = f"text is longer than {LIMITS.yaml_text} characters"
        elif isinstance(event, yaml.ScalarEvent) and not _is_printable(event.value):
            problem = "text contains control characters"
        if problem:
            raise ComposerError(None, None, problem, event.start_mark)


def _is_printable(text: str) -> bool:
    return text.isprintable() or all(c.isprintable() or c in "\n\t" for c in text)


def _count_values(value: Any, count: int, depth: int) -> int:
    """Return `count` plus the number of values of nested data.

    A value that is used twice counts twice.

    Raises:
        ValueError: There are too many values, or they are nested too deeply.
    """
    count += 1
    if count > LIMITS.yaml_values:
        raise ValueError(f"holds more than {LIMITS.yaml_values} values")
    if depth > LIMITS.yaml_depth:
        raise ValueError("nested too deeply, or contains itself")
    if isinstance(value, dict):
        for item in value.values():
            count = _count_values(item, count, depth + 1)
    elif isinstance(value, (list, tuple, set)):
        for item in value:
            count = _count_values(item, count, depth + 1)
    return count


T = TypeVar("T")
Vector = tuple[PureNumber, PureNumber, PureNumber]
Point = tuple[Length, Length, Length]
Angles = tuple[Angle, Angle, Angle]


class Struct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A mapping of a file; unknown keys are errors."""


class Frame(Struct, frozen=True):
    """A pose relative to the parent: xyz, then rpy about the fixed axes (as in URDF).

    Attributes:
        xyz: Origin in the parent's frame [m].
        rpy: Angles about the parent's fixed axes x, y, z [rad].
    """

    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)


def frame_matrix(frame: Frame, location: str = "") -> Array:
    """Return the pose (4, 4) of a frame: rotation rpy about fixed axes, then translation xyz.

    Args:
        frame: The frame.
        location: File and key; with them, angles that are probably in degrees cause a warning.
    """
    if location:
        warn_of_angles(frame.rpy, f"{location}.rpy")
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
    """Return the angles (3,) about the fixed axes [rad] of a rotation (3, 3)."""
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
        DescriptionError: The file is malformed; the message names file, key and expected value.
    """
    return validated(parse_yaml(path), type_, path)


def validated(raw: Any, type_: type[T], path: Path) -> tuple[T, dict[str, str]]:
    """Return parsed YAML as a type, with finite numbers and units of the declared dimensions.

    Args:
        raw: Parsed YAML, with units.
        type_: The type.
        path: The file.

    Returns:
        The entry, and the units in the file by key ("home.spread": "deg").

    Raises:
        DescriptionError: The data do not fit; the message names file, key, and the expected value.
    """
    data = to_si(raw)
    for key, value in leaf_values(data):
        if isinstance(value, float) and not math.isfinite(value):
            raise DescriptionError(f"{path}: {key}: found {value}, expected a finite number")
    entry = convert_entry(data, type_, path)
    check_units(raw, type_, path)
    return entry, units_in(raw)


def convert_entry(data: Any, type_: type[T], path: Path) -> T:
    """Convert parsed YAML to a type.

    Raises:
        DescriptionError: The data do not fit; the message names file, key, and the expected value.
    """
    try:
        return msgspec.convert(data, type_)
    except msgspec.ValidationError as error:
        text, _, msgspec_path = str(error).partition(" - at `")
        in_key = msgspec_path.startswith("key` in `")
        key, value = _invalid_item(
            data, type_, msgspec_path.removeprefix("key` in `")[1:-1], str(error)
        )
        text = f"{text[0].lower()}{text[1:]}"
        if in_key:
            text = f"one of its keys is not text: {text}"
        elif isinstance(value, str):
            match = QUANTITY.match(value)
            if match and "float" in text:
                text = f"unknown unit {match[2]!r}; known: {', '.join(filter(None, UNITS))}"
            text = f"found {value!r}, {text}"
        elif "`float` >" in text:
            text = f"found {value:g}, {text.replace('`float` ', '').replace('0.0', '0')}"
        raise DescriptionError(f"{path}: {key or '(top level)'}: {text}") from error


def _invalid_item(data: Any, type_: type[Any], msgspec_path: str, message: str) -> tuple[str, Any]:
    """Return key and value that a validation error is about.

    msgspec writes ``[...]`` for the keys of a mapping with free names; which of them is invalid is
    found by validating each one without the others.
    """
    key, value, trimmed = "", data, data
    steps: list[Any] = []
    for part in re.findall(r"\[\.\.\.\]|\[\d+\]|\.[^.\[]+", msgspec_path):
        if part == "[...]" and isinstance(value, dict):
            for name in value:
                single = _replace_item(trimmed, steps, {name: value[name]})
                if _raises(single, type_, message):
                    break
            else:
                return f"{key}[...]", None
            trimmed, step = single, name
            key += f".{name}"
        else:
            step = int(part[1:-1]) if part.startswith("[") else part[1:]
            key += f"[{item_name(value, step)}]" if isinstance(step, int) else part
        steps.append(step)
        value = value[step]
    return key.lstrip("."), value


def _raises(data: Any, type_: type[Any], message: str) -> bool:
    try:
        msgspec.convert(data, type_)
    except msgspec.ValidationError as error:
        return str(error) == message
    return False


def _replace_item(data: Any, steps: list[Any], value: Any) -> Any:
    """Return a copy of nested data with another value at the end of a path of keys."""
    if not steps:
        return value
    copy = data.copy()
    copy[steps[0]] = _replace_item(data[steps[0]], steps[1:], value)
    return copy
