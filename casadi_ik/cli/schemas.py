"""`casadi-ik schemas`: JSON Schemas of the files that people write."""

from __future__ import annotations

import argparse
import json
from typing import Any

from rich.console import Group
from rich.text import Text

from casadi_ik.cli.answer import Answer
from casadi_ik.cli.outputs import writing
from casadi_ik.cli.report import headline
from casadi_ik.collision.scene import SceneFile
from casadi_ik.datasets.conventions import ConventionFile
from casadi_ik.files.json_schema import json_schema
from casadi_ik.files.writing import written_whole
from casadi_ik.grasps.load import CandidatesFile, GraspFile
from casadi_ik.grasps.objects import ObjectFile
from casadi_ik.motion.retarget import Retarget
from casadi_ik.robots.schema import ArmFile, ArmHandFile, HandFile, ImportedFile

FILES: dict[str, tuple[Any, str]] = {
    "robot": (ArmHandFile | ImportedFile, "A robot: an arm, a hand, and what joins them"),
    "arm": (ArmFile, "An arm, described in full"),
    "hand": (HandFile, "A hand, described in full"),
    "grasp": (GraspFile, "A grasp: a contact per finger, or a palm and a posture"),
    "candidates": (CandidatesFile, "Grasps, of which one is to be chosen"),
    "scene": (SceneFile, "A scene: what answers must not touch"),
    "object": (ObjectFile, "An object to be grasped"),
    "retarget": (Retarget, "How a person's hand moves a robot's"),
    "dataset": (ConventionFile, "How a data set has a hand: its joints and its frame"),
}
"""By kind of file its type, and a title."""

IN_A_FILE: dict[str, Any] = {
    "anyOf": [
        {"required": ["robot"]},
        {"required": ["hand"], "properties": {"hand": {"type": "object", "required": ["file"]}}},
    ]
}
"""Of which robots the hand is in somebody's file: those that are read as `ImportedFile`."""


def schema_of(kind: str) -> dict[str, Any]:
    """The JSON Schema of a kind of `FILES`."""
    schema = json_schema(*FILES[kind])
    if kind == "robot":
        described, imported = schema.pop("anyOf")
        schema |= {"if": IN_A_FILE, "then": imported, "else": described}
    return schema


def schemas(arguments: argparse.Namespace) -> Answer:
    """Write the schemas.

    Raises:
        OutputError: The folder cannot be written.
    """
    folder = arguments.out
    lines = []
    for kind, (_, title) in FILES.items():
        path = folder / f"{kind}.json"
        with writing(path, "--out"):
            folder.mkdir(parents=True, exist_ok=True)
            with written_whole(path) as part:
                part.write_text(json.dumps(schema_of(kind), indent=1) + "\n", encoding="utf-8")
        lines.append(Text(f"  {path}  {title}"))
    return Answer(Group(headline(True, "WRITTEN", f"{len(FILES)} schemas"), *lines))
