"""Diagrams of a solve for a page, as SVG: lines over iterations, phases, events, where one is."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casadi_ik import palette
from casadi_ik.arrays import Array

WIDTH, HEIGHT = 340, 118
LEFT, RIGHT, TOP, BOTTOM = 40, 6, 8, 16
"""Of the picture and around the diagram [its own pixels]."""

MOST = 400
"""Points of a line; of more, the largest of neighbours are drawn."""


@dataclass(frozen=True, eq=False)
class Course:
    """What all diagrams of a solve share.

    Attributes:
        count: Iterations.
        phases: First and last iteration and colour of each phase.
        events: Iteration and colour of each event that is marked.
        now: The iteration that is shown.
    """

    count: int
    phases: Sequence[tuple[int, int, str]]
    events: Sequence[tuple[int, str]]
    now: int


def chart(
    title: str, lines: Mapping[str, Array], course: Course, bound: float | None = None
) -> str:
    """A diagram with a logarithmic scale.

    Args:
        title: What it shows, with its unit.
        lines: (k,) by name; what is not positive is not drawn.
        course: Of the solve.
        bound: What has to be fallen below.
    """
    values = np.concatenate([*lines.values(), np.array([] if bound is None else [bound])])
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return ""
    low = math.floor(math.log10(max(float(values.min()), float(values.max()) * 1e-9)))
    high = max(math.ceil(math.log10(float(values.max()))), low + 1)
    parts = _ground(course)
    step = max(1, (high - low) // 4)
    for decade in range(low, high + 1, step):
        y = _y(10.0**decade, low, high)
        parts.append(
            f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#fff"/>'
            f'<text x="{LEFT - 4}" y="{y + 3:.1f}" text-anchor="end">{_decade(decade)}</text>'
        )
    if bound is not None:
        y = _y(bound, low, high)
        parts.append(
            f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" '
            f'stroke="{palette.INK}" stroke-dasharray="4 3"/>'
        )
    for i, line in enumerate(lines.values()):
        parts.append(_line(line, course.count, low, high, palette.LINES[i % len(palette.LINES)]))
    x = _x(course.now, course.count)
    parts.append(
        f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}" '
        f'stroke="{palette.INK}" stroke-width="1.6" class="ik-now"/>'
    )
    parts.append(
        f'<text x="{LEFT}" y="{HEIGHT - 4}">0</text><text x="{WIDTH - RIGHT}" y="{HEIGHT - 4}" '
        f'text-anchor="end">{course.count - 1}</text>'
    )
    names = "".join(
        f'<span style="margin-right:0.8em;white-space:nowrap"><span style="color:'
        f'{palette.LINES[i % len(palette.LINES)]}">━</span> {html.escape(name)} '
        f"<b>{_shown(line[course.now])}</b></span> "
        for i, (name, line) in enumerate(lines.items())
    )
    style = f"font-size:0.72em;color:{palette.INK};padding:0 1em;margin-bottom:0.45em"
    return (
        f'<div style="{style}"><div><b>{html.escape(title)}</b></div>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" style="width:100%;display:block;font-size:9px;'
        f'fill:{palette.FAINT}">{"".join(parts)}</svg><div>{names}</div></div>'
    )


def _ground(course: Course) -> list[str]:
    """Phases as shades, events as lines."""
    parts = []
    for first, last, color in course.phases:
        x, end = _x(first - 0.5, course.count), _x(last + 0.5, course.count)
        parts.append(
            f'<rect x="{x:.1f}" width="{end - x:.1f}" y="{TOP}" '
            f'height="{HEIGHT - TOP - BOTTOM}" fill="{color}"/>'
        )
    for iteration, color in course.events:
        x = _x(iteration, course.count)
        parts.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}" '
            f'stroke="{color}" stroke-opacity="0.55"/>'
        )
    return parts


def _line(values: Array, count: int, low: int, high: int, color: str) -> str:
    at = np.arange(len(values))
    if count > MOST:
        size = -(-count // MOST)
        kept = [
            group[int(np.nanargmax(values[group]))]
            if np.isfinite(values[group]).any()
            else group[0]
            for group in np.array_split(at, -(-count // size))
        ]
        at = np.array(kept)
    drawn, runs = values[at], []
    run: list[str] = []
    for i, value in zip(at.tolist(), drawn.tolist(), strict=True):
        if math.isfinite(value) and value > 0:
            run.append(f"{_x(i, count):.1f},{_y(value, low, high):.1f}")
        elif run:
            runs.append(run)
            run = []
    runs.append(run)
    look = f'fill="none" stroke="{color}" stroke-width="1.6" stroke-linejoin="round"'
    return "".join(
        f'<polyline points="{" ".join(run)}" {look}/>'
        if len(run) > 1
        else f'<circle cx="{run[0].split(",")[0]}" cy="{run[0].split(",")[1]}" r="1.8" '
        f'fill="{color}"/>'
        for run in runs
        if run
    )


def _x(iteration: float, count: int) -> float:
    share = (iteration + 0.5) / max(count, 1)
    return LEFT + min(max(share, 0.0), 1.0) * (WIDTH - LEFT - RIGHT)


def _y(value: float, low: int, high: int) -> float:
    share = (math.log10(value) - low) / (high - low)
    return TOP + (1 - min(max(share, 0.0), 1.0)) * (HEIGHT - TOP - BOTTOM)


def _decade(power: int) -> str:
    return f"{10.0**power:g}" if -3 <= power <= 3 else f"1e{power}"


def _shown(value: float) -> str:
    return "" if not math.isfinite(value) else f"{value:.3g}"
