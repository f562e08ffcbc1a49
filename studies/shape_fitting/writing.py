"""The shapes of a description as YAML, in the place of those it had."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.importing.boxes import FittedBox
from casadi_ik.importing.capsules import FittedCapsule
from casadi_ik.robots.collision import BoxEntry

GRID = 1e4
"""Numbers are written in steps of a tenth of a millimetre."""


def box_entry(one: FittedBox) -> BoxEntry:
    """A box in steps of a tenth of a millimetre, no smaller."""
    size = np.ceil(one.size * GRID + 1.1) / GRID
    center = np.round(one.center * GRID) / GRID
    rpy = np.round(roll_pitch_yaw(one.rotation), 4)
    if np.any(rpy):  # what rounding may turn it by
        size = np.ceil((size + 1e-4 * np.linalg.norm(size)) * GRID) / GRID
    return BoxEntry(size=tuple(size), xyz=tuple(center), rpy=tuple(rpy))


def write(
    path: Path,
    fitted: dict[str, tuple[list[FittedCapsule], list[FittedBox], float]],
    touching: list[tuple[tuple[str, str], str]],
    names: str,
) -> None:
    """Put ``collision:`` at the end of a description, and its source."""
    text = path.read_text(encoding="utf-8")
    text = text.split("\ncollision:", 1)[0].rstrip("\n") + "\n"
    source = (
        f"  shapes: \"Fitted by studies/fit_shapes.py to the shapes of {names}: a link's mesh is "
        "held by its capsules, which stand out beyond it by at most what is called excess. "
        'Assumption: rounded up to 0.1 mm."\n'
    )
    lines = text.split("\n")
    lines = without_source(lines)
    at = lines.index("sources:") + 1
    while lines[at].startswith("  "):
        at += 1
    lines[at:at] = wrapped(source)
    out = ["\n".join(lines).rstrip("\n"), "", "collision:", "  source: shapes", "  links:"]
    for link, (found, boxes, beyond) in fitted.items():
        out.append(f"    {link}:")
        stated = f"excess: {1e3 * math.ceil(1e3 * beyond) / 1e3:g} mm"
        for one in found:
            numbers = [
                f"[{', '.join(f'{1e3 * v:.1f} mm' for v in end + 0.0)}]"
                for end in (one.first, one.last)
            ]
            radius = f"{1e3 * one.radius:.1f} mm"
            if np.allclose(one.first, one.last):
                out.append(
                    f"      - {{kind: sphere, center: {numbers[0]}, radius: {radius}, {stated}}}"
                )
            else:
                out.append(f"      - {{kind: capsule, ends: [{numbers[0]},")
                out.append(f"         {numbers[1]}], radius: {radius}, {stated}}}")
        for one in map(box_entry, boxes):
            size, xyz = (
                ", ".join(f"{1e3 * v + 0.0:.1f} mm" for v in values)
                for values in (one.size, one.xyz)
            )
            turn = f", rpy: [{', '.join(f'{v + 0.0:g}' for v in one.rpy)}]" if any(one.rpy) else ""
            out.append(f"      - {{kind: box, size: [{size}],")
            out.append(f"         xyz: [{xyz}]{turn}, {stated}}}")
    if touching:
        out.append("  touching:")
        for links, reason in touching:
            out.append(f"    - links: [{links[0]}, {links[1]}]")
            out.append(f"      reason: {reason}")
    path.write_text("\n".join(out) + "\n", encoding="utf-8")


def roll_pitch_yaw(rotation: Array) -> Array:
    """(3,) angles about the fixed axes [rad]."""
    r = rotation
    return np.array(
        [
            math.atan2(r[2, 1], r[2, 2]),
            math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0])),
            math.atan2(r[1, 0], r[0, 0]),
        ]
    )


def without_source(lines: list[str]) -> list[str]:
    """A description's lines without an earlier source of shapes."""
    if not any(line.startswith("  shapes: ") for line in lines):
        return lines
    start = next(i for i, line in enumerate(lines) if line.startswith("  shapes: "))
    end = start + 1
    while lines[end].startswith("    "):
        end += 1
    return lines[:start] + lines[end:]


def wrapped(text: str) -> list[str]:
    """A source in lines of at most 98 characters."""
    lines, line = [], " "
    for word in text.split():
        if len(line) + 1 + len(word) > 98:
            lines.append(line)
            line = "   "
        line += f" {word}"
    return [*lines, line]
