"""JSON Schemas of files from the very types that check them: what editors complete keys with.

Draft 7, the one that editors' language servers know. Keys, defaults and alternatives are those of
the type; what a key means is its line under ``Attributes:`` in the type's docstring; a number may
carry a unit of the dimension that its type declares.
"""

from __future__ import annotations

import inspect
import re
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import msgspec

from casadi_ik.files.units import DIMENSIONS, UNITS, Dimension

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
