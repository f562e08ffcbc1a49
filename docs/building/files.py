"""Reference of the files that people write, from the schemas that check them."""

from __future__ import annotations

import json
import re
from typing import Any

from casadi_ik.app.cli.lists import FILES, schema_of

OF = {
    "schema": "robot",
    "collision_entries": "robot",
    "couplings": "coupling",
    "load": "grasp",
    "candidates": "grasp",
    "scene": "scene",
    "objects": "object",
    "shapes": "object",
    "reading": "",
    "retarget": "",
}
"""Kind of file by the module of its types."""

NAMES = {"ArmHandFile": "Robot described in full", "ImportedFile": "Robot from URDF or MJCF"}


def file_reference() -> str:
    """Return a section for each kind of file, with a table for each mapping."""
    parts: list[str] = []
    written: set[str] = set()
    for kind, (_, summary) in FILES.items():
        schema = schema_of(kind)
        parts += [f"## {kind.capitalize()} files", f"{summary}.", _schema_line(kind)]
        for name, mapping in schema["definitions"].items():
            if "properties" in mapping and name not in written:
                written.add(name)
                parts += [f"({_anchor(name)})=\n### {_title(name)}", _mapping(mapping)]
    return "\n\n".join(parts)


def quantities() -> str:
    """Return a table of the types of numbers and their units."""
    rows = ["| type | value |", "|---|---|"]
    definitions: dict[str, Any] = {}
    for kind in FILES:
        definitions |= schema_of(kind)["definitions"]
    for name in sorted(name for name, entry in definitions.items() if "properties" not in entry):
        text = definitions[name].get("description", "A text.")
        rows.append(f"| {name} | {text} |")
    return "\n".join(rows)


def _schema_line(kind: str) -> str:
    return f"Schema for editors: [`{kind}.json`](../../models/schemas/{kind}.json)."


def _mapping(mapping: dict[str, Any]) -> str:
    rows = [mapping["description"].rstrip(".") + ".", "", "| key | value | |", "|---|---|---|"]
    for key, schema in mapping["properties"].items():
        required = key in mapping["required"]
        default = schema.get("default")
        plain = default not in (None, "", [], {}, 0.0) and not isinstance(default, (dict, list))
        text = schema.get("description", "")
        text += f" Default: {json.dumps(default)}." if plain else ""
        key_text = f"**`{key}`**" if required else f"`{key}`"
        rows.append(f"| {key_text} | {_value(schema)} | {text} |".replace("\n", " "))
    return "\n".join(rows)


def _value(schema: dict[str, Any]) -> str:
    """Return the type of a value in words."""
    if "allOf" in schema:
        return _value(schema["allOf"][0])
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{_title(name).lower()}](#{_anchor(name)})" if "." in name else name
    if "const" in schema:
        return f"`{schema['const']}`"
    if "anyOf" in schema:
        return " or ".join(
            _value(option) for option in schema["anyOf"] if option.get("type") != "null"
        )
    if schema["type"] == "object":
        return f"by name: {_value(schema['additionalProperties'])}"
    if schema["type"] == "array":
        items = schema["items"]
        if isinstance(items, list):  # a fixed number of them, all of one kind
            items = items[0]
        value = _value(items)
        return f"[{schema['minItems']} × {value}]" if "minItems" in schema else f"list of {value}"
    return {"integer": "whole number", "boolean": "true or false"}[schema["type"]]


def _anchor(name: str) -> str:
    return "file-" + name.replace(".", "-").replace("_", "-").lower()


def _title(name: str) -> str:
    module, _, title = name.rpartition(".")
    if title in NAMES:
        return NAMES[title]
    words = re.sub(r"(Entry|File)$", "", title)
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", words).capitalize()
    of = OF.get(module, "")
    return words if not of or of == words.lower() else f"{words} ({of})"
