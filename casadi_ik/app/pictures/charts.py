"""Diagrams: how a solve converges, over its iterations; and figures, which are written whole."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, NullFormatter
from numpy.typing import NDArray

from casadi_ik.app.drawing import palette
from casadi_ik.errors import InputError, PictureError, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.writing import atomic_write
from casadi_ik.logs import Table
from casadi_ik.logs.events import EVENT_COLORS, bits_of
from casadi_ik.model.targets import Tolerance

DPI = 160
"""Dots per inch of a picture unless said."""

INK, FAINT = palette.INK, palette.FAINT
"""Colours of text."""


@dataclass(frozen=True)
class Ground:
    """What a picture is drawn on.

    Attributes:
        paper: Its colour.
        ink: Of text.
        faint: Of text beside.
    """

    paper: str
    ink: str
    faint: str


LIGHT = Ground("#ffffff", INK, FAINT)
DARK = Ground(palette.DARK_PAPER, palette.DARK_INK, palette.DARK_FAINT)


def new_figure(width: float, height: float, dpi: float = DPI, ground: Ground = LIGHT) -> Figure:
    """An empty figure.

    Args:
        width: [inch].
        height: [inch].
        dpi: Dots per inch.
        ground: What it is drawn on.
    """
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=ground.paper)
    FigureCanvasAgg(figure)
    return figure


def save_picture(picture: Figure | bytes, path: str | PathLike[str]) -> None:
    """Write a figure as PNG, or what is a picture already; there is a whole file or none.

    Raises:
        PictureError: It cannot be written; the message names path and reason.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        raise PictureError(f"{target}: cannot write the picture: not a regular file")
    drawn = io.BytesIO()
    if isinstance(picture, Figure):
        picture.savefig(drawn, format="png", dpi=picture.dpi)
    refused = os_errors(f"{target}: cannot write the picture", PictureError)
    with refused, atomic_write(target) as part:
        part.write_bytes(picture if isinstance(picture, bytes) else drawn.getvalue())


DASHES = ("-", (0, (4, 1.2)), (0, (1, 1)), (0, (6, 1.5, 1, 1.5)))
"""Of lines of a panel that have the same of its colours."""

FIELDS = {
    "position_error": ("distance to the contact [mm]", 1e3, 1e-6),
    "angle_error": ("angle to the normal [deg]", float(np.rad2deg(1.0)), 1e-6),
    "cost": ("cost", 1.0, 1e-16),
    "step_size": ("largest motor change [rad or m]", 1.0, 1e-10),
    "damping": ("damping", 1.0, 1e-8),
}
"""What is drawn if the method records it: label, factor to the unit drawn, and the value below
which nothing is told apart (zero, above all, would need all the height of a logarithm)."""


@dataclass(frozen=True)
class Panel:
    """One diagram.

    Attributes:
        label: What it shows.
        lines: Values (k,) by name; NaN where not computed.
        bound: What has to be fallen below, if anything.
        linear: Whether the scale is linear; otherwise logarithmic.
        thresholds: Below what each line is an event, by its name.
    """

    label: str
    lines: dict[str, Array]
    bound: float | None = None
    linear: bool = False
    thresholds: dict[str, float] = field(default_factory=dict)


def draw_convergence(
    iterations: Table,
    path: str | PathLike[str] | None = None,
    *,
    events: Table | None = None,
    tolerance: Tolerance | None = None,
    span: tuple[int, int] | None = None,
    title: str = "",
    dpi: float = DPI,
) -> Figure:
    """Draw one solve: errors, steps, damping, singular values and joints over its iterations.

    Phases are shaded, events marked, and below stands which actuator was at a limit when.

    Args:
        iterations: Of one solve, e.g. ``log.iterations(method="hand-first", solve=3)``.
        path: PNG file to write, if any.
        events: Its events, e.g. ``log.events(method="hand-first", solve=3)``.
        tolerance: What counts as reached; `Tolerance()` unless said.
        span: First and last iteration drawn, counted from 1; all unless said.
        title: Above the picture; method, number of iterations and ending unless said.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        InputError: No iterations, those of several solves, or none in the span.
        PictureError: The file cannot be written.
    """
    if len(iterations.rows) == 0:
        raise InputError("iterations: none to draw")
    if len(np.unique(iterations.solve_id)) > 1:
        raise InputError("iterations: of several solves, expected one (give a solve)")
    count = len(iterations.rows)
    first, last = span or (1, count)
    if not 1 <= first <= last <= count:
        raise InputError(f"span: found {first} to {last}, expected within 1 to {count}")
    first, last = first - 1, last - 1
    panels = _panels(iterations, tolerance or Tolerance(), _thresholds(events))
    for panel in panels:
        for values in panel.lines.values():
            values[:first] = values[last + 1 :] = np.nan  # the scale is that of what is seen
    strips = {"events": event_rows(events), "at a limit": _limits(iterations)}
    strips = {title: rows for title, rows in strips.items() if rows}
    heights = [1.0] * len(panels) + [0.12 + 0.11 * len(rows) for rows in strips.values()]
    figure = new_figure(9.0, 1.25 + 1.7 * sum(heights), dpi)
    grid = figure.subplots(
        len(heights), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for axes in grid:
        _dress(axes, iterations)
    for axes, panel in zip(grid, panels, strict=False):
        _draw(axes, panel, last - first + 1)
        _mark_events(axes, events)
    for axes, (title_of, rows) in zip(grid[len(panels) :], strips.items(), strict=True):
        _draw_rows(axes, title_of, rows)
    grid[-1].set_xlabel("iteration", color=INK)
    grid[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[-1].xaxis.set_major_formatter(lambda place, _: f"{place + 1:.0f}")
    grid[-1].set_xlim(first - 0.5, last + 0.5)
    _head(figure, iterations, title)
    inches = float(figure.get_size_inches()[1])
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 1 - 0.8 / inches), h_pad=0.6)
    if path is not None:
        save_picture(figure, path)
    return figure


def _thresholds(events: Table | None) -> dict[str, float]:
    """Thresholds of the singular values that were passed, by the Jacobian's name."""
    records = events.records() if events is not None and len(events) else ()
    return {
        record["subject"].replace("_", " "): float(record["threshold"])
        for record in records
        if record["kind"] == "NEAR_SINGULAR"
    }


def _panels(iterations: Table, tolerance: Tolerance, thresholds: dict[str, float]) -> list[Panel]:
    names = iterations.names
    bounds = {
        "position_error": 1e3 * tolerance.position,
        "angle_error": float(np.rad2deg(tolerance.angle)),
    }
    panels = [
        Panel(label, _lines(iterations, name, factor, smallest), bounds.get(name))
        for name, (label, factor, smallest) in FIELDS.items()
        if name in names
    ]
    sigmas: dict[str, Array] = {}
    for name in names:
        if name.startswith("sigma_"):
            sigmas |= _lines(iterations, name, 1.0, 1e-9)
    if sigmas:
        panels.append(Panel("smallest singular value", sigmas, thresholds=thresholds))
    if "q" in names:
        joints = _lines(iterations, "q", 1.0, -np.inf)
        panels.append(
            Panel(f"actuators [{iterations.part.units.get('q', '')}]", joints, linear=True)
        )
    return [panel for panel in panels if panel.lines]


def _lines(iterations: Table, name: str, factor: float, smallest: float) -> dict[str, Array]:
    """The columns of a field by name, without those that never are a number."""
    values = iterations.rows[name].reshape(len(iterations.rows), -1).astype(float) * factor
    labels = iterations.labels.get(name, ())
    lines = {}
    for column in range(values.shape[1]):
        plain = name.removeprefix("sigma_").replace("_", " ")
        label = labels[column] if column < len(labels) else plain
        if np.isfinite(values[:, column]).any():
            lines[label] = np.maximum(values[:, column], smallest)
    return lines


def _draw(axes: Axes, panel: Panel, shown: int) -> None:
    """Draw a panel of so many iterations."""
    marker = "." if shown <= 60 else ""
    long = shown >= 400  # thick lines would fill the panel
    many = len(panel.lines) > len(palette.LINES)
    for i, (label, values) in enumerate(panel.lines.items()):
        axes.plot(
            values,
            color=palette.LINES[i % len(palette.LINES)],
            ls=DASHES[i // len(palette.LINES) % len(DASHES)],
            # Equal lines must not hide one another.
            lw=0.7 if long else 1.2 if many else max(2.8 - 0.7 * i, 1.2),
            marker="" if many else marker,
            markersize=5,
            label=label.replace("_", " "),
        )
        if label in panel.thresholds:
            style = {"color": palette.LINES[i % len(palette.LINES)], "lw": 1.0, "ls": (0, (1, 1.5))}
            axes.axhline(panel.thresholds[label], label=f"{label}: near singular", **style)
    if not panel.linear:
        axes.set_yscale("log")
    if panel.bound is not None:
        axes.axhline(panel.bound, color=INK, lw=1.0, ls=(0, (4, 3)), label="tolerance")
    if not panel.linear:
        _show_decades(axes)
    axes.set_title(panel.label, loc="left", size=10, color=INK, pad=4)
    if len(panel.lines) == 1 and panel.bound is None:
        return
    axes.legend(
        loc="center left",
        bbox_to_anchor=(1.005, 0.5),
        frameon=False,
        fontsize=6 if many else 9,
        labelcolor=INK,
        handlelength=1.6,
        labelspacing=0.15 if many else 0.5,
    )


def _show_decades(axes: Axes) -> None:
    """At least one whole decade, so that its ends are marked."""
    low, high = axes.get_ylim()
    if high < 20 * low:
        low, high = 10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high))
        axes.set_ylim(float(low), float(high))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _dress(axes: Axes, iterations: Table) -> None:
    """Phases as shades, a faint grid, no box."""
    if "phase" in iterations.names:
        codes = iterations.rows["phase"].astype(np.int64)
        for first, last in _runs(codes):
            color = palette.PHASES[codes[first] % len(palette.PHASES)]
            axes.axvspan(first - 0.5, last + 0.5, color=color, lw=0, zorder=0)
    axes.grid(visible=True, color="white", lw=0.9)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=9, which="both", length=2)
    for side in axes.spines.values():
        side.set_visible(False)


def _head(figure: Figure, iterations: Table, title: str) -> None:
    rows, labels = iterations.rows, iterations.labels
    if not title:
        title = f"{iterations.method} · {len(rows)} iterations"
        status = int(rows["status"][-1]) if "status" in iterations.names else 0
        known = labels.get("status", ())
        if 0 < status < len(known):
            title += f" · {known[status]}"
    top = 1 - 0.3 / float(figure.get_size_inches()[1])
    figure.text(0.015, top, title, size=13, weight="bold", color=INK, va="center")
    if "phase" not in iterations.names:
        return
    names = labels.get("phase", ())
    handles = [
        Patch(
            color=palette.PHASES[code % len(palette.PHASES)],
            label=(names[code] if code < len(names) else f"phase {code}").replace("-", " "),
        )
        for code in np.unique(rows["phase"]).astype(int).tolist()
    ]
    figure.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=(0.005, top - 0.28 / float(figure.get_size_inches()[1])),
        ncols=len(handles),
        frameon=False,
        fontsize=10,
        labelcolor=INK,
    )


Rows = dict[str, tuple[list[tuple[float, float]], str]]
"""Bars (where one begins, how wide it is) and their colour, by the name of the row."""


def _limits(iterations: Table) -> Rows:
    """When each actuator was at a limit, of those that ever were."""
    rows: Rows = {}
    if "limit_mask" in iterations.names:
        bits = bits_of(iterations.rows["limit_mask"].reshape(len(iterations), -1))
        for name, hit in zip(iterations.labels.get("limit_mask", ()), bits.T, strict=False):
            if hit.any():
                held = [pair for pair in _runs(hit.astype(np.int64)) if hit[pair[0]]]
                bars = [(first - 0.5, last - first + 1.0) for first, last in held]
                rows[name.replace("_", " ")] = bars, palette.LINES[4]
    return rows


def event_rows(events: Table | None) -> Rows:
    """When what happened that is marked, by kind and Jacobian."""
    rows: Rows = {}
    for kind, subject, iteration in _marked(events):
        name = " ".join((kind.lower(), subject if "_" in kind else "")).replace("_", " ").strip()
        rows.setdefault(name, ([], EVENT_COLORS[kind]))[0].append((iteration - 0.5, 1.0))
    return rows


def _mark_events(axes: Axes, events: Table | None) -> None:
    """Draw a faint line through a diagram where something happened that is marked."""
    for kind, _, iteration in _marked(events):
        axes.axvline(iteration, color=EVENT_COLORS[kind], lw=0.7, alpha=0.5, zorder=1)


def _draw_rows(axes: Axes, title: str, rows: Rows) -> None:
    for row, (bars, color) in enumerate(rows.values()):
        # The edge keeps an iteration among thousands visible.
        axes.broken_barh(bars, (row - 0.32, 0.64), facecolor=color, edgecolor=color, lw=0.8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.yaxis.set_ticks_position("right")
    axes.set_yticks(range(len(rows)), list(rows), fontsize=9)
    axes.tick_params(axis="y", length=0, colors=INK)
    axes.grid(visible=False, axis="y")
    axes.set_title(title, loc="left", size=10, color=INK, pad=4)


def _runs(values: NDArray[np.int64]) -> list[tuple[int, int]]:
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
