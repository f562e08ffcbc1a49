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
"""Which file the types of a module are part of."""

NAMES = {"ArmHandFile": "Robot described in full", "ImportedFile": "Robot in somebody's files"}


def file_reference() -> str:
    """A section per kind of file, with a table per mapping in it; what several have, once."""
    parts: list[str] = []
    seen: set[str] = set()
    for kind, (_, about) in FILES.items():
        schema = schema_of(kind)
        parts += [f"## {kind.capitalize()} files", f"{about}.", _schema_line(kind)]
        for name, one in schema["definitions"].items():
            if "properties" in one and name not in seen:
                seen.add(name)
                parts += [f"({_anchor(name)})=\n### {_title(name)}", _mapping(one)]
    return "\n\n".join(parts)


def quantities() -> str:
    """What may stand for a number, by what it measures."""
    rows = ["| type | value |", "|---|---|"]
    found: dict[str, Any] = {}
    for kind in FILES:
        found |= schema_of(kind)["definitions"]
    for name in sorted(name for name, one in found.items() if "properties" not in one):
        text = found[name].get("description", "A text.")
        rows.append(f"| {name} | {text} |")
    return "\n".join(rows)


def _schema_line(kind: str) -> str:
    return f"Schema for editors: [`{kind}.json`](../../models/schemas/{kind}.json)."


def _mapping(one: dict[str, Any]) -> str:
    rows = [one["description"].rstrip(".") + ".", "", "| key | value | |", "|---|---|---|"]
    for key, said in one["properties"].items():
        needed = key in one["required"]
        default = said.get("default")
        plain = default not in (None, "", [], {}, 0.0) and not isinstance(default, (dict, list))
        text = said.get("description", "")
        text += f" Else {json.dumps(default)}." if plain else ""
        shown = f"**`{key}`**" if needed else f"`{key}`"
        rows.append(f"| {shown} | {_value(said)} | {text} |".replace("\n", " "))
    return "\n".join(rows)


def _value(said: dict[str, Any]) -> str:
    """The type of a value in words."""
    if "allOf" in said:
        return _value(said["allOf"][0])
    if "$ref" in said:
        name = said["$ref"].rpartition("/")[2]
        return f"[{_title(name).lower()}](#{_anchor(name)})" if "." in name else name
    if "const" in said:
        return f"`{said['const']}`"
    if "anyOf" in said:
        return " or ".join(_value(one) for one in said["anyOf"] if one.get("type") != "null")
    if said["type"] == "object":
        return f"by name: {_value(said['additionalProperties'])}"
    if said["type"] == "array":
        items = said["items"]
        if isinstance(items, list):  # a fixed number of them, all of one kind
            items = items[0]
        value = _value(items)
        return f"[{said['minItems']} × {value}]" if "minItems" in said else f"list of {value}"
    return {"integer": "whole number", "boolean": "true or false"}[said["type"]]


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
