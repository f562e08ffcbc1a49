"""What held or happened when, as bars and marks under the diagrams of a solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from casadi_ik.logs import Table
from casadi_ik.logs.detect import bits_of
from casadi_ik.logs.events import EVENT_COLORS
from casadi_ik.views.picture import INK

LIMIT_COLOR = "#c2334d"

Span = tuple[float, float]
"""Where a bar begins, and how wide it is."""


@dataclass(frozen=True)
class Strip:
    """Rows of bars.

    Attributes:
        title: What they show.
        rows: Bars and their colour, by the name of the row.
    """

    title: str
    rows: dict[str, tuple[list[Span], str]]


def limits_strip(iterations: Table) -> Strip:
    """When each actuator was at a limit, of those that ever were."""
    rows: dict[str, tuple[list[Span], str]] = {}
    if "limit_mask" in iterations.names:
        bits = bits_of(iterations.rows["limit_mask"].reshape(len(iterations), -1))
        for name, hit in zip(iterations.labels.get("limit_mask", ()), bits.T, strict=False):
            if hit.any():
                held = [pair for pair in runs(hit.astype(np.int64)) if hit[pair[0]]]
                bars = [(first - 0.5, last - first + 1.0) for first, last in held]
                rows[name.replace("_", " ")] = bars, LIMIT_COLOR
    return Strip("at a limit", rows)


def events_strip(events: Table | None) -> Strip:
    """When what happened that is marked, by kind and Jacobian."""
    rows: dict[str, tuple[list[Span], str]] = {}
    for kind, subject, iteration in _marked(events):
        name = " ".join((kind.lower(), subject if "_" in kind else "")).replace("_", " ").strip()
        rows.setdefault(name, ([], EVENT_COLORS[kind]))[0].append((iteration - 0.5, 1.0))
    return Strip("events", rows)


def mark_events(axes: Axes, events: Table | None) -> None:
    """Draw a faint line through a diagram where something happened that is marked."""
    for kind, _, iteration in _marked(events):
        axes.axvline(iteration, color=EVENT_COLORS[kind], lw=0.7, alpha=0.5, zorder=1)


def draw_strip(axes: Axes, strip: Strip) -> None:
    """Draw a strip; axes of their own."""
    for row, (bars, color) in enumerate(strip.rows.values()):
        # The edge keeps an iteration among thousands visible.
        axes.broken_barh(bars, (row - 0.32, 0.64), facecolor=color, edgecolor=color, lw=0.8)
    axes.set_ylim(len(strip.rows) - 0.5, -0.5)
    axes.yaxis.set_ticks_position("right")
    axes.set_yticks(range(len(strip.rows)), list(strip.rows), fontsize=9)
    axes.tick_params(axis="y", length=0, colors=INK)
    axes.grid(visible=False, axis="y")
    axes.set_title(strip.title, loc="left", size=10, color=INK, pad=4)


def runs(values: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First and last index of every run of equal values."""
    edges = np.flatnonzero(np.diff(values)) + 1
    return list(zip([0, *edges.tolist()], [*(edges - 1).tolist(), len(values) - 1], strict=True))


def _marked(events: Table | None) -> list[tuple[str, str, int]]:
    """Kind, subject and iteration of every event that is marked."""
    if events is None or len(events) == 0:
        return []
    return [
        (record["kind"], record["subject"], record["iteration"])
        for record in events.records()
        if record["kind"] in EVENT_COLORS
    ]
