"""Charts of the convergence of a solve over its iterations, and writing of figures."""

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
from casadi_ik.logs.events import EVENT_COLORS
from casadi_ik.logs.traces import bits_of
from casadi_ik.model.targets import Tolerance

DPI = 160
"""Default resolution of pictures [dots per inch]."""

INK, FAINT = palette.INK, palette.FAINT
"""Colours of primary and secondary text."""


@dataclass(frozen=True)
class ChartTheme:
    """Colours of a figure.

    Attributes:
        paper: Background.
        ink: Primary text.
        faint: Secondary text.
    """

    paper: str
    ink: str
    faint: str


LIGHT = ChartTheme("#ffffff", INK, FAINT)
DARK = ChartTheme(palette.DARK_PAPER, palette.DARK_INK, palette.DARK_FAINT)


def new_figure(width: float, height: float, dpi: float = DPI, theme: ChartTheme = LIGHT) -> Figure:
    """Return an empty figure.

    Args:
        width: Width [inch].
        height: Height [inch].
        dpi: Dots per inch.
        theme: Colours.
    """
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=theme.paper)
    FigureCanvasAgg(figure)
    return figure


def save_picture(picture: Figure | bytes, path: str | PathLike[str]) -> None:
    """Write a figure as PNG, or encoded image data; the file is replaced atomically.

    Raises:
        PictureError: The file cannot be written; the message names path and reason.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        raise PictureError(f"{target}: cannot write the picture: not a regular file")
    buffer = io.BytesIO()
    if isinstance(picture, Figure):
        picture.savefig(buffer, format="png", dpi=picture.dpi)
    on_error = os_errors(f"{target}: cannot write the picture", PictureError)
    with on_error, atomic_write(target) as temporary:
        temporary.write_bytes(picture if isinstance(picture, bytes) else buffer.getvalue())


LINE_STYLES = ("-", (0, (4, 1.2)), (0, (1, 1)), (0, (6, 1.5, 1, 1.5)))
"""Line styles of curves that share a colour."""

CHART_FIELDS = {
    "position_error": ("distance to the contact [mm]", 1e3, 1e-6),
    "angle_error": ("angle to the normal [deg]", float(np.rad2deg(1.0)), 1e-6),
    "cost": ("cost", 1.0, 1e-16),
    "step_size": ("largest motor change [rad or m]", 1.0, 1e-10),
    "damping": ("damping", 1.0, 1e-8),
}
"""Fields that are drawn if the method records them: label, factor to the unit drawn, and lower
bound of the values drawn, because zero has no logarithm.
"""


@dataclass(frozen=True)
class Subplot:
    """A chart of a figure.

    Attributes:
        label: Quantity and unit.
        lines: Values (k,) by name; NaN where they were not computed.
        tolerance: Value that the lines should fall below; None: none.
        linear: Use a linear scale instead of a logarithmic one.
        thresholds: Values by line below which an event is recorded.
    """

    label: str
    lines: dict[str, Array]
    tolerance: float | None = None
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
    """Draw one solve: errors, steps, damping, singular values and actuators over its iterations.

    Phases are shaded, events are marked, and bars show when actuators were at a limit.

    Args:
        iterations: Iterations of one solve, e.g. ``log.iterations(method="hand-first", solve=3)``.
        path: PNG file to write; None: none.
        events: Events of the solve, e.g. ``log.events(method="hand-first", solve=3)``.
        tolerance: Tolerances that are drawn; None: `Tolerance()`.
        span: First and last iteration drawn, counted from 1; None: all.
        title: Title; "": method, number of iterations and status.
        dpi: Dots per inch.

    Returns:
        The figure, without a pyplot window.

    Raises:
        InputError: There are no iterations, several solves, or no iterations in the span.
        PictureError: The file cannot be written.
    """
    if len(iterations.rows) == 0:
        raise InputError("iterations: found none; expected those of a solve")
    if len(np.unique(iterations.solve_id)) > 1:
        raise InputError("iterations: found several solves; expected one (pass `solve`)")
    count = len(iterations.rows)
    start, stop = span or (1, count)
    if not 1 <= start <= stop <= count:
        raise InputError(f"span: found {start} to {stop}, expected within 1 to {count}")
    start, stop = start - 1, stop - 1
    subplots = _subplots(iterations, tolerance or Tolerance(), _singularity_thresholds(events))
    for subplot in subplots:
        for values in subplot.lines.values():
            values[:start] = values[stop + 1 :] = np.nan  # only the span sets the scale
    strips = {"events": event_rows(events), "at a limit": _limit_rows(iterations)}
    strips = {title: rows for title, rows in strips.items() if rows}
    heights = [1.0] * len(subplots) + [0.12 + 0.11 * len(rows) for rows in strips.values()]
    figure = new_figure(9.0, 1.25 + 1.7 * sum(heights), dpi)
    grid = figure.subplots(
        len(heights), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for axes in grid:
        _style_axes(axes, iterations)
    for axes, subplot in zip(grid, subplots, strict=False):
        _draw_subplot(axes, subplot, stop - start + 1)
        _mark_events(axes, events)
    for axes, (title_of, rows) in zip(grid[len(subplots) :], strips.items(), strict=True):
        _draw_rows(axes, title_of, rows)
    grid[-1].set_xlabel("iteration", color=INK)
    grid[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[-1].xaxis.set_major_formatter(lambda place, _: f"{place + 1:.0f}")
    grid[-1].set_xlim(start - 0.5, stop + 0.5)
    _add_header(figure, iterations, title)
    inches = float(figure.get_size_inches()[1])
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 1 - 0.8 / inches), h_pad=0.6)
    if path is not None:
        save_picture(figure, path)
    return figure


def _singularity_thresholds(events: Table | None) -> dict[str, float]:
    """Return the thresholds of singular values that were crossed, by Jacobian."""
    records = events.records() if events is not None and len(events) else ()
    return {
        record["subject"].replace("_", " "): float(record["threshold"])
        for record in records
        if record["kind"] == "NEAR_SINGULAR"
    }


def _subplots(
    iterations: Table, tolerance: Tolerance, thresholds: dict[str, float]
) -> list[Subplot]:
    names = iterations.names
    bounds = {
        "position_error": 1e3 * tolerance.position,
        "angle_error": float(np.rad2deg(tolerance.angle)),
    }
    subplots = [
        Subplot(label, _field_lines(iterations, name, factor, floor), bounds.get(name))
        for name, (label, factor, floor) in CHART_FIELDS.items()
        if name in names
    ]
    sigmas: dict[str, Array] = {}
    for name in names:
        if name.startswith("sigma_"):
            sigmas |= _field_lines(iterations, name, 1.0, 1e-9)
    if sigmas:
        subplots.append(Subplot("smallest singular value", sigmas, thresholds=thresholds))
    if "q" in names:
        joints = _field_lines(iterations, "q", 1.0, -np.inf)
        subplots.append(
            Subplot(f"actuators [{iterations.part.units.get('q', '')}]", joints, linear=True)
        )
    return [subplot for subplot in subplots if subplot.lines]


def _field_lines(iterations: Table, name: str, factor: float, floor: float) -> dict[str, Array]:
    """Return the columns of a field by name, without those that are never finite."""
    values = iterations.rows[name].reshape(len(iterations.rows), -1).astype(float) * factor
    labels = iterations.labels.get(name, ())
    lines = {}
    for column in range(values.shape[1]):
        default_label = name.removeprefix("sigma_").replace("_", " ")
        label = labels[column] if column < len(labels) else default_label
        if np.isfinite(values[:, column]).any():
            lines[label] = np.maximum(values[:, column], floor)
    return lines


def _draw_subplot(axes: Axes, subplot: Subplot, count: int) -> None:
    """Draw a subplot with a given number of iterations."""
    marker = "." if count <= 60 else ""
    is_long = count >= 400  # thick lines would fill the subplot
    has_many_lines = len(subplot.lines) > len(palette.LINE_COLORS)
    for i, (label, values) in enumerate(subplot.lines.items()):
        axes.plot(
            values,
            color=palette.LINE_COLORS[i % len(palette.LINE_COLORS)],
            ls=LINE_STYLES[i // len(palette.LINE_COLORS) % len(LINE_STYLES)],
            # Decreasing widths keep coincident lines visible.
            lw=0.7 if is_long else 1.2 if has_many_lines else max(2.8 - 0.7 * i, 1.2),
            marker="" if has_many_lines else marker,
            markersize=5,
            label=label.replace("_", " "),
        )
        if label in subplot.thresholds:
            style = {
                "color": palette.LINE_COLORS[i % len(palette.LINE_COLORS)],
                "lw": 1.0,
                "ls": (0, (1, 1.5)),
            }
            axes.axhline(subplot.thresholds[label], label=f"{label}: near singular", **style)
    if not subplot.linear:
        axes.set_yscale("log")
    if subplot.tolerance is not None:
        axes.axhline(subplot.tolerance, color=INK, lw=1.0, ls=(0, (4, 3)), label="tolerance")
    if not subplot.linear:
        _show_decades(axes)
    axes.set_title(subplot.label, loc="left", size=10, color=INK, pad=4)
    if len(subplot.lines) == 1 and subplot.tolerance is None:
        return
    axes.legend(
        loc="center left",
        bbox_to_anchor=(1.005, 0.5),
        frameon=False,
        fontsize=6 if has_many_lines else 9,
        labelcolor=INK,
        handlelength=1.6,
        labelspacing=0.15 if has_many_lines else 0.5,
    )


def _show_decades(axes: Axes) -> None:
    """Show at least one whole decade, so that its ends are labelled."""
    low, high = axes.get_ylim()
    if high < 20 * low:
        low, high = 10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high))
        axes.set_ylim(float(low), float(high))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _style_axes(axes: Axes, iterations: Table) -> None:
    """Shade the phases, and use a faint grid without a frame."""
    if "phase" in iterations.names:
        codes = iterations.rows["phase"].astype(np.int64)
        for first, last in _runs(codes):
            color = palette.PHASE_COLORS[codes[first] % len(palette.PHASE_COLORS)]
            axes.axvspan(first - 0.5, last + 0.5, color=color, lw=0, zorder=0)
    axes.grid(visible=True, color="white", lw=0.9)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=9, which="both", length=2)
    for side in axes.spines.values():
        side.set_visible(False)


def _add_header(figure: Figure, iterations: Table, title: str) -> None:
    rows, labels = iterations.rows, iterations.labels
    if not title:
        title = f"{iterations.method} · {len(rows)} iterations"
        status = int(rows["status"][-1]) if "status" in iterations.names else 0
        statuses = labels.get("status", ())
        if 0 < status < len(statuses):
            title += f" · {statuses[status]}"
    top = 1 - 0.3 / float(figure.get_size_inches()[1])
    figure.text(0.015, top, title, size=13, weight="bold", color=INK, va="center")
    if "phase" not in iterations.names:
        return
    names = labels.get("phase", ())
    handles = [
        Patch(
            color=palette.PHASE_COLORS[code % len(palette.PHASE_COLORS)],
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
"""Bars (start, width) and their colour by the name of the row."""


def _limit_rows(iterations: Table) -> Rows:
    """Return the iterations in which each actuator was at a limit."""
    rows: Rows = {}
    if "limit_mask" in iterations.names:
        bits = bits_of(iterations.rows["limit_mask"].reshape(len(iterations), -1))
        for name, at_limit in zip(iterations.labels.get("limit_mask", ()), bits.T, strict=False):
            if at_limit.any():
                spans = [pair for pair in _runs(at_limit.astype(np.int64)) if at_limit[pair[0]]]
                bars = [(first - 0.5, last - first + 1.0) for first, last in spans]
                rows[name.replace("_", " ")] = bars, palette.LINE_COLORS[4]
    return rows


def event_rows(events: Table | None) -> Rows:
    """Return the iterations of events by kind and Jacobian."""
    rows: Rows = {}
    for kind, subject, iteration in _marked_events(events):
        name = " ".join((kind.lower(), subject if "_" in kind else "")).replace("_", " ").strip()
        rows.setdefault(name, ([], EVENT_COLORS[kind]))[0].append((iteration - 0.5, 1.0))
    return rows


def _mark_events(axes: Axes, events: Table | None) -> None:
    """Draw a faint vertical line at each event."""
    for kind, _, iteration in _marked_events(events):
        axes.axvline(iteration, color=EVENT_COLORS[kind], lw=0.7, alpha=0.5, zorder=1)


def _draw_rows(axes: Axes, title: str, rows: Rows) -> None:
    for row, (bars, color) in enumerate(rows.values()):
        # The edge keeps a single iteration visible among thousands.
        axes.broken_barh(bars, (row - 0.32, 0.64), facecolor=color, edgecolor=color, lw=0.8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.yaxis.set_ticks_position("right")
    axes.set_yticks(range(len(rows)), list(rows), fontsize=9)
    axes.tick_params(axis="y", length=0, colors=INK)
    axes.grid(visible=False, axis="y")
    axes.set_title(title, loc="left", size=10, color=INK, pad=4)


def _runs(values: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first and last index of each run of equal values."""
    edges = np.flatnonzero(np.diff(values)) + 1
    return list(zip([0, *edges.tolist()], [*(edges - 1).tolist(), len(values) - 1], strict=True))


def _marked_events(events: Table | None) -> list[tuple[str, str, int]]:
    """Return kind, subject and iteration of the events that have a colour."""
    if events is None or len(events) == 0:
        return []
    return [
        (record["kind"], record["subject"], record["iteration"])
        for record in events.records()
        if record["kind"] in EVENT_COLORS
    ]
