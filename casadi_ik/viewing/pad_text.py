"""Pads corrected in the text of a description: everything else in it stays as it was written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import Frame, frame_matrix, read_yaml
from casadi_ik.files.writing import written_whole
from casadi_ik.grasps.pose import inverse
from casadi_ik.robots.load import load_description

GUESS = "GUESS:"
"""What `casadi-ik import` marks a guess with."""

CORRECTED = "corrected by hand"
"""What it becomes."""

SAME = 1e-6
"""A pad that is read back differs by no more [m, or in its normal]."""


@dataclass(frozen=True, eq=False)
class LinkPad:
    """A pad in the frame of the link that moves it.

    Attributes:
        point: (3,) [m].
        normal: (3,) outward, unit.
    """

    point: Array
    normal: Array


def save_pads(path: Path, pads: Mapping[str, LinkPad]) -> None:
    """Write corrected pads into a description; what was written is read back before it counts.

    Args:
        path: The description.
        pads: By finger.

    Raises:
        DescriptionError: The description does not state its pads, or cannot be written.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror or error}") from error
    frames = read_yaml(path).get("fingers")
    if not isinstance(frames, dict):
        raise DescriptionError(f"{path}: fingers: expected the pads of the fingers, by name")
    before = load_description(path)
    for finger, pad in pads.items():
        entry = frames.get(finger)
        if not isinstance(entry, dict):
            raise DescriptionError(f"{path}: fingers.{finger}: missing, expected a pad")
        place = before.finger(finger).placement
        xyz, rpy = (tuple(entry.get(key, (0.0, 0.0, 0.0))) for key in ("xyz", "rpy"))
        # The link that the file names may be fixed to the one that moves.
        named = place @ inverse(frame_matrix(Frame(xyz, rpy)))
        point = (inverse(named) @ np.append(pad.point, 1.0))[:3]
        text = corrected(text, finger, point, place[:3, :3].T @ pad.normal)
    try:
        with written_whole(path) as part:
            part.write_text(text, encoding="utf-8")
            _check(part, pads)
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be written: {error.strerror or error}") from error


def corrected(text: str, finger: str, point: Array, normal: Array) -> str:
    """A description with another pad.

    Args:
        text: The YAML.
        finger: Whose pad.
        point: (3,) in the link's frame [m].
        normal: (3,) in the contact frame.

    Raises:
        DescriptionError: The text has no such pad.
    """
    key, entry = _finger(text, finger)
    values = {"xyz": _vector(point), "normal": _vector(normal)}
    edits: list[tuple[int, int, str]] = []
    there = {name.value: value for name, value in entry.value}
    for name, value in values.items():
        if name in there:
            node = there[name]
            edits.append((node.start_mark.index, node.end_mark.index, value))
        elif entry.flow_style:
            edits.append((entry.end_mark.index - 1, entry.end_mark.index - 1, f", {name}: {value}"))
        else:
            first, _ = entry.value[0]
            indent = " " * first.start_mark.column
            at = first.start_mark.index
            edits.append((at, at, f"{name}: {value}\n{indent}"))
    for start, end, value in sorted(edits, reverse=True):
        text = text[:start] + value + text[end:]
    return _marked(text, key.start_mark.line)


def _finger(text: str, finger: str) -> tuple[yaml.ScalarNode, yaml.MappingNode]:
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    for above in ("fingers", finger):
        pairs = root.value if isinstance(root, yaml.MappingNode) else []
        found = next(((key, value) for key, value in pairs if key.value == above), None)
        if found is None:
            raise DescriptionError(f"fingers.{finger}: not in the description")
        key, root = found
    if not isinstance(root, yaml.MappingNode):
        raise DescriptionError(f"fingers.{finger}: expected a pad (link, xyz, normal)")
    return key, root


def _marked(text: str, line: int) -> str:
    """The comment above a finger says that it is no guess any more, and what the guess was."""
    lines = text.split("\n")
    above = lines[line - 1] if line else ""
    indent = re.match(r"\s*", lines[line])
    if above.lstrip().startswith("#") and GUESS in above:
        lines[line - 1] = above.replace(GUESS, f"{CORRECTED}; the guess was:")
    elif CORRECTED not in above:
        lines.insert(line, f"{indent[0] if indent else ''}# {CORRECTED}")
    return "\n".join(lines)


def _check(part: Path, pads: Mapping[str, LinkPad]) -> None:
    """See to it that what was written is what was meant.

    Raises:
        DescriptionError: It is not.
    """
    description = load_description(part)
    for finger, pad in pads.items():
        found = description.finger(finger)
        normal = found.placement[:3, :3] @ found.normal
        point = found.placement[:3, 3]
        if np.abs(np.concatenate([point - pad.point, normal - pad.normal])).max() > SAME:
            raise DescriptionError(f"fingers.{finger}: could not be corrected in the text")


def _vector(values: Array) -> str:
    return "[" + ", ".join(_number(float(value)) for value in values) + "]"


def _number(value: float) -> str:
    text = f"{value:.7f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
