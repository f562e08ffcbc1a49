"""Units in files: what they are in SI, and whether they fit where they stand.

Numbers may carry a unit (``90 deg``, ``50 mm``, ``110 deg/s``); without one they are SI. A field
declares its dimension and what it has to be above by its type (`Length`, `Size`, `Angle`, ...); a
plain `float` takes any.

JSON Schemas come from the very types that check files, so that editors complete keys: draft 7, the
one that editors' language servers know. Keys, defaults and alternatives are those of
the type; what a key means is its line under ``Attributes:`` in the type's docstring; a number may
carry a unit of the dimension that its type declares.
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
Angle = Annotated[float, Dimension("rad")]
Mass = Annotated[float, Dimension("kg"), msgspec.Meta(gt=0)]
PureNumber = Annotated[float, Dimension("")]
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


def to_si(value: Any) -> Any:
    """Nested data with every quantity as a float."""
    if isinstance(value, dict):
        return {key: to_si(item) for key, item in value.items()}
    if isinstance(value, list):
        return [to_si(item) for item in value]
    found = quantity(value)
    return value if found is None else found[0]


def item_name(items: Any, place: int) -> str:
    """What to call an item of a list: by its name, if it has one, else by its number."""
    item = items[place] if isinstance(items, list) and place < len(items) else None
    name = item.get("name") if isinstance(item, dict) else None
    return name if isinstance(name, str) else str(place)


def units_in(value: Any) -> dict[str, str]:
    """The SI unit of every quantity that has one, by key."""
    found = ((key, quantity(text)) for key, text in leaf_values(value))
    return {key: DIMENSIONS.get(one[1], one[1]) for key, one in found if one and one[1]}


def leaf_values(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """What nested data consist of, each with its key ("sides.left.at.xyz[0]")."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from leaf_values(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from leaf_values(item, f"{key}[{item_name(value, i)}]")
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
        msgspec.convert(to_si(value), type_)
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


DRAFT = "http://json-schema.org/draft-07/schema#"

NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"

NOT_BELOW_ZERO = rf"(?!-){NUMBER}"

ABOVE_ZERO = rf"(?=[^eE]*[1-9]){NOT_BELOW_ZERO}"

NO_BOUND = msgspec.Meta()

PLAIN = {int: "integer", bool: "boolean"}
"""JSON's names of types."""

TEXT = {
    "type": "string",
    "not": {"pattern": rf"^\s*{NUMBER}\s*({'|'.join(filter(None, UNITS))})?\s*$"},
}
"""What reads as a number with a unit is a number, wherever it stands."""

QUANTITIES = {
    "": "pure number",
    "m": "length",
    "rad": "angle",
    "kg": "mass",
    "rad m": "position",
    "joint": "position",
    "joint /s": "velocity",
}
"""What a dimension is called."""


def json_schema(type_: Any, title: str) -> dict[str, Any]:
    """The schema of a file of a type.

    Args:
        type_: Of the file.
        title: What the file is.
    """
    definitions: dict[str, Any] = {}
    root = _schema(type_, definitions)
    whole = root if "$ref" not in root else {"allOf": [root]}
    return {"$schema": DRAFT, "title": title, **whole, "definitions": definitions}


def key_texts(struct: type[Any]) -> dict[str, str]:
    """What the docstrings of a struct and of those it is made from say of each key."""
    texts: dict[str, str] = {}
    for one in reversed(struct.__mro__):
        section = (inspect.cleandoc(one.__doc__ or "")).partition("Attributes:\n")[2]
        for entry in re.split(r"\n    (?=\S)", "\n" + section.split("\n\n")[0]):
            name, colon, text = entry.strip().partition(":")
            if colon:
                texts[name] = " ".join(text.split()).replace("``", "`")
    return texts


def _schema(type_: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    origin, args = get_origin(type_), get_args(type_)
    if origin is Annotated:
        mark = next((one for one in args[1:] if isinstance(one, Dimension)), None)
        bound = next((one for one in args[1:] if isinstance(one, msgspec.Meta)), None)
        return _quantity(mark, definitions, bound or msgspec.Meta())
    if type_ is float:
        return _quantity(None, definitions)
    if origin in (Union, UnionType):
        some = [_schema(one, definitions) for one in args if one is not NoneType]
        some += [{"type": "null"}] if NoneType in args else []
        return {"anyOf": some}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema(args[1], definitions)}
    if origin is list or (origin is tuple and args[-1] is Ellipsis):
        return {"type": "array", "items": _schema(args[0], definitions)}
    if origin is tuple:
        items: Any = [_schema(one, definitions) for one in args]
        items = items[0] if all(one == items[0] for one in items) else items
        return {"type": "array", "items": items, "minItems": len(args), "maxItems": len(args)}
    if isinstance(type_, type) and issubclass(type_, msgspec.Struct):
        return _reference(type_, definitions)
    if type_ is str:
        definitions.setdefault("text", TEXT)
        return {"$ref": "#/definitions/text"}
    return {"type": PLAIN[type_]}


def _quantity(
    mark: Dimension | None, definitions: dict[str, Any], bound: msgspec.Meta = NO_BOUND
) -> dict[str, Any]:
    """A reference to a number that may have a unit behind; any unit, if nothing is declared."""
    name = "number" if mark is None else QUANTITIES[mark]
    limit, before = {}, NUMBER
    if bound.gt is not None:
        name, limit, before = f"{name} above zero", {"exclusiveMinimum": 0}, ABOVE_ZERO
    elif bound.ge is not None:
        name, limit, before = f"{name} not below zero", {"minimum": 0}, NOT_BELOW_ZERO
    if name not in definitions:
        words = str(mark or "").replace("joint", "rad m").split()
        words = [f"{word}/s" for word in words[:-1]] if words[-1:] == ["/s"] else words
        fits = [unit for unit in UNITS if unit and DIMENSIONS.get(unit, unit) in words]
        units = [unit for unit in UNITS if unit] if mark is None else fits
        behind = rf"\s*({'|'.join(units)})?" if units else ""
        text = {"type": "string", "pattern": rf"^\s*{before}{behind}\s*$"}
        said = f"A number, or one with its unit: {', '.join(units)}." if units else "A number."
        definitions[name] = {"description": said, "anyOf": [{"type": "number"} | limit, text]}
    return {"$ref": f"#/definitions/{name}"}


def _reference(struct: type[msgspec.Struct], definitions: dict[str, Any]) -> dict[str, Any]:
    """A reference to a struct's schema, which is made when it is first met."""
    name = f"{struct.__module__.rpartition('.')[2]}.{struct.__name__}"
    if name not in definitions:
        definitions[name] = {}
        definitions[name] = _object(struct, definitions)
    return {"$ref": f"#/definitions/{name}"}


def _object(struct: type[msgspec.Struct], definitions: dict[str, Any]) -> dict[str, Any]:
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
        if reference := entry.pop("$ref", None):  # what stands beside a reference is not read
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
