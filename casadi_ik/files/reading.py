"""Reading description files: YAML with units in, checked data out.

Numbers may carry a unit (``90 deg``, ``50 mm``, ``110 deg/s``); without one they are SI.
"""

from __future__ import annotations

import math
import re
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


class _UniqueKeyLoader(yaml.SafeLoader):
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
        return _with_units(yaml.load(text, Loader=_UniqueKeyLoader))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise DescriptionError(f"{path}{where}: not valid YAML: {problem}") from error


def convert(data: Any, type_: type[T], path: Path) -> T:
    """Check parsed YAML against a type.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    try:
        return msgspec.convert(data, type_)
    except msgspec.ValidationError as error:
        text, _, key = str(error).partition(" - at `$")
        key = key.rstrip("`").lstrip(".") or "(top level)"
        raise DescriptionError(f"{path}: {key}: {text[0].lower()}{text[1:]}") from error


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
