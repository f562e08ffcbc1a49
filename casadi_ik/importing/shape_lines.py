"""The key ``collision`` of a description as YAML."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from casadi_ik.importing.words import one_line, scalar
from casadi_ik.robots.collision import Touching
from casadi_ik.robots.collision_entries import ShapeEntry

WIDTH = 98
"""Characters of a line, as far as a shape can be broken."""


def collision_lines(
    shapes: Mapping[str, Sequence[ShapeEntry]],
    touching: Sequence[Touching],
    source: str = "",
    srdf: str = "",
) -> list[str]:
    """The key with everything below it.

    Args:
        shapes: By link its shapes.
        touching: Links that may touch.
        source: Tag of their source, if any.
        srdf: File with more such links, if any.
    """
    lines = ["collision:"]
    lines += [f"  source: {scalar(source)}"] if source else []
    lines += [f"  srdf: {scalar(srdf)}"] if srdf else []
    lines.append("  links:")
    for link, found in shapes.items():
        lines.append(f"    {scalar(link)}:")
        for one in found:
            lines += _of_shape(one)
    if touching:
        lines.append("  touching:")
        for pair in touching:
            first, second = (scalar(link) for link in pair.links)
            lines.append(f"    - links: [{first}, {second}]")
            if math.isfinite(pair.depth):
                lines.append(f"      depth: {_text(pair.depth, '')}")
            lines.append(f"      reason: {one_line(pair.reason)}")
    return lines


def _of_shape(one: ShapeEntry) -> list[str]:
    parts = [f"kind: {one.__struct_config__.tag}"]
    for key, value in msgspec.structs.asdict(one).items():
        if key not in ("excess", "rpy", "xyz") or np.any(value):
            parts.append(f"{key}: {_text(value, key)}")
    lines, line = [], "      - {"
    for part in parts:
        if len(line) + len(part) > WIDTH and not line.endswith("{"):
            lines.append(line.rstrip())
            line = "         "
        line += part + ", "
    return [*lines, line.removesuffix(", ") + "}"]


def _text(value: object, key: str) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_text(item, key) for item in value)}]"
    assert isinstance(value, (int, float))
    if key == "rpy":
        return f"{round(value, 6) + 0.0:g}"
    return f"{round(1e3 * value, 4) + 0.0:.10g} mm"
