"""Units in files: conversion to SI, checks of dimensions, and JSON Schemas.

Numbers may carry a unit (``90 deg``, ``50 mm``, ``110 deg/s``); without one they are in SI. A field
declares its dimension and its lower bound by its type (`Length`, `Size`, `Angle`, ...); a plain
`float` accepts any unit.

JSON Schemas are built from the types that check the files, so that editors complete keys. They are
draft 7, which the language servers of editors support. Descriptions of keys are the lines under
``Attributes:`` in the docstrings of the types.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
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
"""Factor to SI by unit."""

QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z/]*)\s*$")
"""Pattern of a number with an optional unit."""

SI_UNITS = {"deg": "rad", "cm": "m", "mm": "m", "deg/s": "rad/s", "mm/s": "m/s"}
"""SI unit by unit, where they differ."""


class Dimension(str):
    """SI units that a number may have, separated by spaces; "" for a pure number.

    "joint" denotes the unit of the described joint, which depends on its ``type`` or ``unit``.
    """

    __slots__ = ()


Length = Annotated[float, Dimension("m")]
Size = Annotated[float, Dimension("m"), msgspec.Meta(gt=0)]
Distance = Annotated[float, Dimension("m"), msgspec.Meta(ge=0)]
Angle = Annotated[float, Dimension("rad")]
Mass = Annotated[float, Dimension("kg"), msgspec.Meta(gt=0)]
PureNumber = Annotated[float, Dimension("")]
Factor = Annotated[float, Dimension(""), msgspec.Meta(gt=0)]
JointValue = Annotated[float, Dimension("joint")]
JointRate = Annotated[float, Dimension("joint /s"), msgspec.Meta(gt=0)]
AnyValue = Annotated[float, Dimension("rad m")]


def quantity(text: Any) -> tuple[float, str] | None:
    """Return the SI value and the unit of a text with a known unit; None for anything else."""
    if not isinstance(text, str) or len(text) > LIMITS.quantity_text:
        return None
    match = QUANTITY.match(text)
    if match is None or match[2] not in UNITS:
        return None
    return float(match[1]) * UNITS[match[2]], match[2]


def to_si(value: Any) -> Any:
    """Return nested data with every quantity as a float in SI."""
    if isinstance(value, dict):
        return {key: to_si(item) for key, item in value.items()}
    if isinstance(value, list):
        return [to_si(item) for item in value]
    parsed = quantity(value)
    return value if parsed is None else parsed[0]


def item_name(items: Any, index: int) -> str:
    """Return the name of an item of a list, or its index if it has no name."""
    item = items[index] if isinstance(items, list) and index < len(items) else None
    name = item.get("name") if isinstance(item, dict) else None
    return name if isinstance(name, str) else str(index)


def units_in(value: Any) -> dict[str, str]:
    """Return the SI unit of every quantity that has a unit, by key."""
    quantities = ((key, quantity(text)) for key, text in leaf_values(value))
    return {key: SI_UNITS.get(pair[1], pair[1]) for key, pair in quantities if pair and pair[1]}


def leaf_values(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the scalar values of nested data, each with its key ("sides.left.at.xyz[0]")."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from leaf_values(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from leaf_values(item, f"{key}[{item_name(value, i)}]")
    else:
        yield key, value


def check_units(value: Any, type_: Any, path: Path, key: str = "", owner: Any = None) -> None:
    """Check that every unit in parsed YAML has the dimension that its type declares.

    Args:
        value: Parsed YAML with units, which fits the type.
        type_: The type.
        path: The file.
        key: Key of the value.
        owner: Mapping that contains the value.

    Raises:
        DescriptionError: A unit does not fit; the message names file, key, and the expected unit.
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
        for member in get_args(type_):
            if _is_instance(value, member):
                check_units(value, member, path, key, owner)
                return
    elif isinstance(value, dict):
        hints = _hints(type_)
        value_type = get_args(type_)[1] if origin is dict else Any
        for name, item in value.items():
            inner = hints.get(name, value_type)
            check_units(item, inner, path, f"{key}.{name}" if key else str(name), value)
    elif isinstance(value, list) and origin in (list, tuple):
        types = get_args(type_)
        for i, item in enumerate(value):
            inner = types[min(i, len(types) - 1)]
            check_units(item, inner, path, f"{key}[{item_name(value, i)}]", owner)


def _hints(type_: Any) -> dict[str, Any]:
    is_struct = isinstance(type_, type) and issubclass(type_, msgspec.Struct)
    return get_type_hints(type_, include_extras=True) if is_struct else {}


def _is_instance(value: Any, type_: Any) -> bool:
    """Return True if a value fits one type of a union."""
    try:
        msgspec.convert(to_si(value), type_)
    except msgspec.ValidationError:
        return False
    return True


def _check_unit(value: Any, allowed: Dimension, path: Path, key: str, owner: Any) -> None:
    """Check that a number with a unit has the dimension of its field."""
    parsed = quantity(value)
    if parsed is None or not parsed[1]:
        return
    words = str(allowed).split()
    if words[:1] == ["joint"]:
        words = [f"{unit}{''.join(words[1:])}" for unit in _joint_units(owner)]
    if SI_UNITS.get(parsed[1], parsed[1]) not in words:
        expected = " or ".join(words) or "a number without a unit"
        raise DescriptionError(f"{path}: {key}: found {value!r}, expected {expected}")


def _joint_units(owner: Any) -> tuple[str, ...]:
    """Return the units of a described joint or actuator; both if the description leaves it open."""
    entry = owner if isinstance(owner, dict) else {}
    if "type" in entry or "axis" in entry:
        return ("m",) if entry.get("type") == "prismatic" else ("rad",)
    unit = entry.get("unit")
    return (unit,) if unit in ("rad", "m") else ("rad", "m")


DRAFT = "http://json-schema.org/draft-07/schema#"

NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"

NOT_BELOW_ZERO = rf"(?!-){NUMBER}"

ABOVE_ZERO = rf"(?=[^eE]*[1-9]){NOT_BELOW_ZERO}"

NO_BOUND = msgspec.Meta()

JSON_TYPES = {int: "integer", bool: "boolean"}
"""JSON Schema type by Python type."""

TEXT = {
    "type": "string",
    "not": {"pattern": rf"^\s*{NUMBER}\s*({'|'.join(filter(None, UNITS))})?\s*$"},
}
"""Schema of text: text that reads as a number with a unit is a number."""

QUANTITIES = {
    "": "pure number",
    "m": "length",
    "rad": "angle",
    "kg": "mass",
    "rad m": "position",
    "joint": "position",
    "joint /s": "velocity",
}
"""Name of each dimension."""


def json_schema(type_: Any, title: str) -> dict[str, Any]:
    """Return the JSON Schema of a file type.

    Args:
        type_: Type of the file.
        title: Description of the file.
    """
    definitions: dict[str, Any] = {}
    root = _schema(type_, definitions)
    schema = root if "$ref" not in root else {"allOf": [root]}
    return {"$schema": DRAFT, "title": title, **schema, "definitions": definitions}


def key_texts(struct: type[Any]) -> dict[str, str]:
    """Return the description of each key from the docstrings of a struct and its base classes."""
    texts: dict[str, str] = {}
    for base in reversed(struct.__mro__):
        section = (inspect.cleandoc(base.__doc__ or "")).partition("Attributes:\n")[2]
        for entry in re.split(r"\n    (?=\S)", "\n" + section.split("\n\n")[0]):
            name, colon, text = entry.strip().partition(":")
            if colon:
                texts[name] = " ".join(text.split()).replace("``", "`")
    return texts


def _schema(type_: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a type; structs are added to `definitions`."""
    origin, args = get_origin(type_), get_args(type_)
    if origin is Annotated:
        mark = next((arg for arg in args[1:] if isinstance(arg, Dimension)), None)
        bound = next((arg for arg in args[1:] if isinstance(arg, msgspec.Meta)), None)
        return _quantity(mark, definitions, bound or msgspec.Meta())
    if type_ is float:
        return _quantity(None, definitions)
    if origin in (Union, UnionType):
        members = [_schema(arg, definitions) for arg in args if arg is not NoneType]
        members += [{"type": "null"}] if NoneType in args else []
        return {"anyOf": members}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema(args[1], definitions)}
    if origin is list or (origin is tuple and args[-1] is Ellipsis):
        return {"type": "array", "items": _schema(args[0], definitions)}
    if origin is tuple:
        items: Any = [_schema(arg, definitions) for arg in args]
        items = items[0] if all(item == items[0] for item in items) else items
        return {"type": "array", "items": items, "minItems": len(args), "maxItems": len(args)}
    if isinstance(type_, type) and issubclass(type_, msgspec.Struct):
        return _reference(type_, definitions)
    if type_ is str:
        definitions.setdefault("text", TEXT)
        return {"$ref": "#/definitions/text"}
    return {"type": JSON_TYPES[type_]}


def _quantity(
    mark: Dimension | None, definitions: dict[str, Any], bound: msgspec.Meta = NO_BOUND
) -> dict[str, Any]:
    """Return a reference to the schema of a number with an optional unit.

    Args:
        mark: Dimension; None for any unit.
        definitions: Definitions of the schema, to which the number is added.
        bound: Lower bound.
    """
    name = "number" if mark is None else QUANTITIES[mark]
    minimum, number = {}, NUMBER
    if bound.gt is not None:
        name, minimum, number = f"{name} above zero", {"exclusiveMinimum": 0}, ABOVE_ZERO
    elif bound.ge is not None:
        name, minimum, number = f"{name} not below zero", {"minimum": 0}, NOT_BELOW_ZERO
    if name not in definitions:
        words = str(mark or "").replace("joint", "rad m").split()
        words = [f"{word}/s" for word in words[:-1]] if words[-1:] == ["/s"] else words
        matching = [unit for unit in UNITS if unit and SI_UNITS.get(unit, unit) in words]
        units = [unit for unit in UNITS if unit] if mark is None else matching
        suffix = rf"\s*({'|'.join(units)})?" if units else ""
        text = {"type": "string", "pattern": rf"^\s*{number}{suffix}\s*$"}
        summary = f"A number, or one with its unit: {', '.join(units)}." if units else "A number."
        definitions[name] = {"description": summary, "anyOf": [{"type": "number"} | minimum, text]}
    return {"$ref": f"#/definitions/{name}"}


def _reference(struct: type[msgspec.Struct], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return a reference to the schema of a struct, which is built at the first use."""
    name = f"{struct.__module__.rpartition('.')[2]}.{struct.__name__}"
    if name not in definitions:
        definitions[name] = {}
        definitions[name] = _object(struct, definitions)
    return {"$ref": f"#/definitions/{name}"}


def _object(struct: type[msgspec.Struct], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a struct: its keys with descriptions and defaults."""
    texts, hints = key_texts(struct), get_type_hints(struct, include_extras=True)
    properties: dict[str, Any] = {}
    required: list[str] = []
    config = struct.__struct_config__
    if config.tag is not None and config.tag_field is not None:
        properties[config.tag_field] = {"const": config.tag}
        required.append(config.tag_field)
    for field in msgspec.structs.fields(struct):
        entry = _schema(hints[field.name], definitions)
        if field.required:
            required.append(field.encode_name)
        elif field.default is not msgspec.NODEFAULT and field.default is not None:
            entry = entry | {"default": msgspec.to_builtins(field.default)}
        if reference := entry.pop("$ref", None):  # draft 7 ignores keys next to $ref
            entry = {"allOf": [{"$ref": reference}], **entry}
        text = texts.get(field.name, "")
        properties[field.encode_name] = ({"description": text} if text else {}) | entry
    summary = inspect.cleandoc(struct.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    return {
        "description": summary.replace("``", "`"),
        "type": "object",
        "properties": properties,
        "required": required,
        "additionalProperties": False,
    }
