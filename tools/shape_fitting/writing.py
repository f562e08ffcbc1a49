"""Replace the shapes of a description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from casadi_ik.integrations.importing.write import collision_lines
from casadi_ik.model.link_shapes import Touching
from casadi_ik.model.schema import ShapeEntry


def write(
    path: Path,
    shapes: Mapping[str, Sequence[ShapeEntry]],
    touching: Sequence[Touching],
    names: str,
) -> None:
    """Write the key ``collision`` and its source to the end of a description."""
    text = path.read_text(encoding="utf-8")
    text = text.split("\ncollision:", 1)[0].rstrip("\n") + "\n"
    source = (
        f"  shapes: \"Fitted by tools/fit_shapes.py to the shapes of {names}: a link's mesh is "
        "held by its capsules, which stand out beyond it by at most what is called excess. "
        'Assumption: rounded up to 0.1 mm."\n'
    )
    lines = without_source(text.split("\n"))
    at = lines.index("sources:") + 1
    while lines[at].startswith("  "):
        at += 1
    lines[at:at] = wrapped(source)
    out = ["\n".join(lines).rstrip("\n"), "", *collision_lines(shapes, touching, "shapes")]
    path.write_text("\n".join(out) + "\n", encoding="utf-8")


def without_source(lines: list[str]) -> list[str]:
    """Return the lines of a description without the previous source of shapes."""
    if not any(line.startswith("  shapes: ") for line in lines):
        return lines
    start = next(i for i, line in enumerate(lines) if line.startswith("  shapes: "))
    end = start + 1
    while lines[end].startswith("    "):
        end += 1
    return lines[:start] + lines[end:]


def wrapped(text: str) -> list[str]:
    """Format a source in lines of at most 98 characters."""
    lines, line = [], " "
    for word in text.split():
        if len(line) + 1 + len(word) > 98:
            lines.append(line)
            line = "   "
        line += f" {word}"
    return [*lines, line]
