"""Reading description files: YAML with units in, checked data out.

Numbers may carry a unit (``90 deg``, ``50 mm``, ``110 deg/s``); without one they are SI.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError

T = TypeVar("T")
Vector = tuple[float, float, float]

UNITS = {
    "": 1.0,
    "rad": 1.0,
    "deg": math.pi / 180.0,
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "m/s": 1.0,
    "mm/s": 1e-3,
    "kg": 1.0,
}
_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z/]*)\s*$")


class Struct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A mapping of a file; unknown keys are errors."""


class Frame(Struct, frozen=True):
    """A pose relative to the parent: xyz [m], then rpy about the fixed axes [rad] (as URDF)."""

    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)


def frame_matrix(frame: Frame) -> NDArray[np.float64]:
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


# libyaml where PyYAML has it: a tenth of the time.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _UniqueKeyLoader(_SafeLoader):
    """YAML's own loader keeps the last of two equal keys without a word; this one objects."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, (str, int, float)) and key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} appears twice", key_node.start_mark
                )
            if isinstance(key, (str, int, float)):
                seen.add(key)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """Parse a YAML file; quantities with units become SI floats.

    Raises:
        DescriptionError: The file is missing, unreadable, not UTF-8 or not YAML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise DescriptionError(f"{path}: cannot be read: {reason}") from error
    try:
        data = yaml.load(text, Loader=_UniqueKeyLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise DescriptionError(f"{path}{where}: not valid YAML: {problem}") from error
    except (ValueError, RecursionError) as error:  # an impossible date, a bottomless nesting
        raise DescriptionError(f"{path}: not valid YAML: {error}") from error
    try:
        return _with_units(data)
    except RecursionError as error:
        raise DescriptionError(f"{path}: nested too deeply, or holds itself") from error


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
            match = _QUANTITY.match(value)
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
            yield from _numbers(item, f"{key}[{i}]")
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
            key += part
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


def _with_units(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_units(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_units(item) for item in value]
    if isinstance(value, str):
        match = _QUANTITY.match(value)
        if match and match[2] in UNITS:
            return float(match[1]) * UNITS[match[2]]
    return value
