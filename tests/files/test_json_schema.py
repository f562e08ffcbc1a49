"""The schemas for editors accept what the readers accept, no more and no less."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from commands import main
from processes import MODELS

import casadi_ik as ik
from casadi_ik.app.cli.lists import FILES, schema_of
from casadi_ik.files.reading import validated
from casadi_ik.model.load_robot import file_type

FOLDERS = {
    "robot": "arm_hands",
    "arm": "arms",
    "body": "bodies",
    "hand": "hands",
    "grasp": "grasps",
    "object": "objects",
    "scene": "scenes",
    "dataset": "datasets",
}
HAND = {"file": "h.urdf", "palm": {"link": "p", "xyz": ["1 mm", 0, 0]}, "locked": {"a": "3 deg"}}
EXAMPLES: dict[str, Any] = {
    "robot": {
        "name": "mine",
        "arm": {"file": "a.urdf", "tip": "flange", "limits": {"j": ["-90 deg", 1.5]}},
        "hand": HAND,
        "mount": {"xyz": [0, 0, "95 mm"]},
        "thumb": "t",
        "fingers": {"t": {"link": "l", "xyz": ["12 mm", 0, 0], "normal": [1, 0, 0]}},
        "home": {"j": "20 deg"},
        "collision": {
            "links": {
                "l": [
                    {"kind": "capsule", "ends": [[0, 0, 0], [0, 0, "5 cm"]], "radius": "9 mm"},
                    {"kind": "box", "size": [1, 1, 1], "rpy": [0, "90 deg", 0]},
                ]
            },
            "touching": [{"links": ["l", "p"], "reason": "always", "depth": "3 mm"}],
        },
    },
    "candidates": {
        "object": {"name": "cup", "pose": {"xyz": [0, 0, "1 m"]}},
        "candidates": [{"contacts": {"t": {"point": [0, 0, 1], "normal": [0, 0, 1]}}}],
    },
    "scene": {
        "margin": "2 mm",
        "solids": {
            "post": {"kind": "cylinder", "radius": "2 cm", "length": 1, "margin": None},
            "wall": {"kind": "half-space", "rpy": ["90 deg", 0, 0]},
            "part": {"kind": "mesh", "file": "part.stl", "scale": 0.001},
            "cup": {"kind": "object", "object": "cup"},
            "seen": {"kind": "point-cloud", "file": "seen.ply", "radius": "5 mm", "voxel": "1 cm"},
            "lid": {"kind": "sphere", "radius": 1, "quaternion_wxyz": [1, 0, 0, 0]},
            "rug": {"kind": "sphere", "radius": 1, "pose": [[1, 0, 0, "1 m"]] + 3 * [4 * [0.5]]},
            "rock": {"kind": "convex", "points": [[0, 0, "1 mm"], [1, 1, 1]]},
        },
        "grasped": "cup",
        "margins": [{"links": ["a", "b"], "margin": "5 mm"}],
    },
    "retarget": {"fingers": {"t": 4}, "rpy": [0, 0, "90 deg"], "low_pass": 0.3, "mirror": True},
}


@cache
def checker(kind: str) -> jsonschema.Draft7Validator:
    schema = schema_of(kind)
    jsonschema.Draft7Validator.check_schema(schema)
    return jsonschema.Draft7Validator(schema)


def reads(kind: str, data: Any) -> bool:
    """Return the error of the reader for a kind of file, or ""."""
    type_ = file_type(data) if kind in ("robot", "body") else FILES[kind][0]
    try:
        validated(data, type_, Path("file"))
    except ik.errors.DescriptionError:
        return False
    return True


def shipped(kind: str) -> list[Path]:
    return sorted((MODELS / FOLDERS[kind]).glob("*.yaml"))


def loaded(path: Path) -> Any:
    return yaml.load(path.read_text(), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def small(value: Any) -> Any:
    """Return the data with one mapping of a list, and without shapes, which an example has."""
    if isinstance(value, dict):
        return {key: small(item) for key, item in value.items() if key != "collision"}
    if isinstance(value, list):
        return [small(item) for item in value[: 1 if value and isinstance(value[0], dict) else 3]]
    return value


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all values in nested data; of long lists the first item only."""
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        items = list(enumerate(value))[:1]
    for key, item in items:
        yield from places(item, (*path, key))


def changed(data: Any, path: tuple[Any, ...]) -> Iterator[Any]:
    """Return the data without the value at a path, with its key renamed, or with another value."""
    *parents, last = path

    def copied() -> tuple[Any, Any]:
        data_copy = copy.deepcopy(data)
        inner = data_copy
        for key in parents:
            inner = inner[key]
        return data_copy, inner

    copied_data, inner = copied()
    del inner[last]
    yield copied_data
    if isinstance(last, str):
        copied_data, inner = copied()
        inner[f"{last}_"] = inner.pop(last)
        yield copied_data
    # The unit of limits depends on the type of the joint, which a schema does not see.
    units = ("1 kg",) if {"limits", "velocity"} & {*path} else ("3 deg", "3 mm", "-3 mm", "1 kg")
    for replacement in ("some text", *units, 0.5, -0.5, None, [1, 2], {"some": "mapping"}):
        copied_data, inner = copied()
        inner[last] = replacement
        yield copied_data


@pytest.mark.parametrize("kind", FILES)
def test_stored_schemas_are_those_of_the_types(kind: str) -> None:
    stored = json.loads((MODELS / "schemas" / f"{kind}.json").read_text())
    assert stored == json.loads(json.dumps(schema_of(kind)))


def test_the_command_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schemas", "--out", str(tmp_path / "new")]) == 0
    assert sorted(path.stem for path in (tmp_path / "new").iterdir()) == sorted(FILES)
    assert "grasp.json" in capsys.readouterr().out.replace("\n", "")
    (tmp_path / "file").write_text("")
    assert main(["schemas", "--out", str(tmp_path / "file")]) == 2
    assert "--out" in capsys.readouterr().err


@pytest.mark.parametrize("kind", FOLDERS)
def test_shipped_files_validate(kind: str) -> None:
    assert shipped(kind)
    for path in shipped(kind):
        errors = list(checker(kind).iter_errors(loaded(path)))
        assert not errors, f"{path}: {errors[0].message}"


@pytest.mark.parametrize("kind", FILES)
def test_schema_and_reader_agree(kind: str) -> None:
    """For every key that is deleted, misspelt or changed, schema and reader agree."""
    examples = [EXAMPLES[kind]] if kind in EXAMPLES else []
    if kind in FOLDERS:
        # The unit of limits depends on the type of the joint.
        turning = [path for path in shipped(kind) if "prismatic" not in path.read_text()]
        smallest = min(turning, key=lambda path: path.stat().st_size)
        examples.append(small(loaded(smallest)))
    accepted_count = refused = 0
    for data in examples:
        assert reads(kind, data)
        assert checker(kind).is_valid(data)
        for path in places(data):
            for variant in changed(data, path):
                expected = reads(kind, variant)
                assert checker(kind).is_valid(variant) == expected, (path, variant)
                accepted_count, refused = accepted_count + expected, refused + (not expected)
    assert accepted_count > 10
    assert refused > 30


@pytest.mark.parametrize("kind", FILES)
def test_every_key_is_explained(kind: str) -> None:
    for name, definition in schema_of(kind)["definitions"].items():
        for key, property_schema in definition.get("properties", {}).items():
            assert "const" in property_schema or property_schema.get("description"), f"{name}.{key}"


def test_every_catalogue_file_has_a_kind() -> None:
    for folder in FOLDERS.values():
        assert ik.shipped_names(folder)
