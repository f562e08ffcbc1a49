"""Units in files: what they are in SI, and whether they fit where they stand.

Numbers may carry a unit (``90 deg``, ``50 mm``, ``110 deg/s``); without one they are SI. A field
declares its dimension and what it has to be above by its type (`Length`, `Size`, `Turn`, ...); a
plain `float` takes any.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import msgspec

from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import LIMITS

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

QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z/]*)\s*$")

DIMENSIONS = {"deg": "rad", "cm": "m", "mm": "m", "deg/s": "rad/s", "mm/s": "m/s"}
"""The SI unit of a unit, where that is another."""


class Dimension(str):
    """The SI units that a number may be in, parted by blanks; "" for a pure number.

    "joint" stands for those of the position of what is described: by its ``type`` or ``unit``.
    """

    __slots__ = ()


Length = Annotated[float, Dimension("m")]
Size = Annotated[float, Dimension("m"), msgspec.Meta(gt=0)]
Distance = Annotated[float, Dimension("m"), msgspec.Meta(ge=0)]
Turn = Annotated[float, Dimension("rad")]
Mass = Annotated[float, Dimension("kg"), msgspec.Meta(gt=0)]
Pure = Annotated[float, Dimension("")]
Factor = Annotated[float, Dimension(""), msgspec.Meta(gt=0)]
JointValue = Annotated[float, Dimension("joint")]
JointRate = Annotated[float, Dimension("joint /s"), msgspec.Meta(gt=0)]
AnyValue = Annotated[float, Dimension("rad m")]


def quantity(text: Any) -> tuple[float, str] | None:
    """The number in SI of a text with a known unit, and the unit; None if it is something else."""
    if not isinstance(text, str) or len(text) > LIMITS.quantity_text:
        return None
    match = QUANTITY.match(text)
    if match is None or match[2] not in UNITS:
        return None
    return float(match[1]) * UNITS[match[2]], match[2]


def in_si(value: Any) -> Any:
    """Nested data with every quantity as a float."""
    if isinstance(value, dict):
        return {key: in_si(item) for key, item in value.items()}
    if isinstance(value, list):
        return [in_si(item) for item in value]
    found = quantity(value)
    return value if found is None else found[0]


def item_name(items: Any, place: int) -> str:
    """What to call an item of a list: by its name, if it has one, else by its number."""
    item = items[place] if isinstance(items, list) and place < len(items) else None
    name = item.get("name") if isinstance(item, dict) else None
    return name if isinstance(name, str) else str(place)


def units_in(value: Any) -> dict[str, str]:
    """The SI unit of every quantity that has one, by key."""
    found = ((key, quantity(text)) for key, text in leaves(value))
    return {key: DIMENSIONS.get(one[1], one[1]) for key, one in found if one and one[1]}


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """What nested data consist of, each with its key ("sides.left.at.xyz[0]")."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from leaves(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from leaves(item, f"{key}[{item_name(value, i)}]")
    else:
        yield key, value


def check_units(value: Any, type_: Any, path: Path, key: str = "", owner: Any = None) -> None:
    """Whether every unit in parsed YAML is of the dimension that its type declares.

    Args:
        value: As it was parsed, units and all; it fits the type.
        type_: Its type.
        path: The file.
        key: Where it stands.
        owner: The mapping it stands in.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    origin = get_origin(type_)
    if origin is Annotated:
        inner, *marks = get_args(type_)
        for mark in marks:
            if isinstance(mark, Dimension):
                _check_unit(value, mark, path, key, owner)
                return
        check_units(value, inner, path, key, owner)
    elif origin in (Union, UnionType):
        for one in get_args(type_):
            if _fits(value, one):
                check_units(value, one, path, key, owner)
                return
    elif isinstance(value, dict):
        hints = _hints(type_)
        named = get_args(type_)[1] if origin is dict else Any
        for name, item in value.items():
            inner = hints.get(name, named)
            check_units(item, inner, path, f"{key}.{name}" if key else str(name), value)
    elif isinstance(value, list) and origin in (list, tuple):
        types = get_args(type_)
        for i, item in enumerate(value):
            inner = types[min(i, len(types) - 1)]
            check_units(item, inner, path, f"{key}[{item_name(value, i)}]", owner)


def _hints(type_: Any) -> dict[str, Any]:
    structure = isinstance(type_, type) and issubclass(type_, msgspec.Struct)
    return get_type_hints(type_, include_extras=True) if structure else {}


def _fits(value: Any, type_: Any) -> bool:
    """Whether a member of a union is meant, of a value that fits one of them."""
    try:
        msgspec.convert(in_si(value), type_)
    except msgspec.ValidationError:
        return False
    return True


def _check_unit(value: Any, allowed: Dimension, path: Path, key: str, owner: Any) -> None:
    found = quantity(value)
    if found is None or not found[1]:
        return
    words = str(allowed).split()
    if words[:1] == ["joint"]:
        words = [f"{unit}{''.join(words[1:])}" for unit in _joint_units(owner)]
    if DIMENSIONS.get(found[1], found[1]) not in words:
        expected = " or ".join(words) or "a number without a unit"
        raise DescriptionError(f"{path}: {key}: found {value!r}, expected {expected}")


def _joint_units(owner: Any) -> tuple[str, ...]:
    """The units of a joint or an actuator as it is described; both if that does not say."""
    described = owner if isinstance(owner, dict) else {}
    if "type" in described or "axis" in described:
        return ("m",) if described.get("type") == "prismatic" else ("rad",)
    unit = described.get("unit")
    return (unit,) if unit in ("rad", "m") else ("rad", "m")
