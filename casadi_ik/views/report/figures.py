"""Figures of a study: how long solves take, and where they fail."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from casadi_ik.arrays import Array
from casadi_ik.palette import method_colors
from casadi_ik.views.picture import FAINT, INK, new_figure
from casadi_ik.views.report.groups import Group

SOLVED, SINGULAR, FAILED = "#c9d3dc", "#e08a2e", "#c2334d"
"""Colours of solves: as they should be, near a singularity on their way, not solved."""

SHOWN = 20_000
"""Points of one kind in a picture; of more every so manieth is drawn."""

VIEWS = (("from above", 0, 1, "x [m]", "y [m]"), ("from the side", 0, 2, "x [m]", "z [m]"))


def effort(groups: Sequence[Group]) -> str:
    """How many iterations and how much time, as shares of the solves of each method."""
    figure = new_figure(9.0, 3.2, 110)
    methods = list(dict.fromkeys(group.method for group in groups))
    panels = (("iterations", "iterations"), ("time", "time of a solve [µs]"))
    for place, (name, label) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, 2, place)
        for method, color in method_colors(methods).items():
            values = np.concatenate([getattr(g, name) for g in groups if g.method == method])
            values = np.sort(values * (1e6 if name == "time" else 1.0))
            share = 100 * np.arange(1, len(values) + 1) / len(values)
            axes.plot(np.maximum(values, 1e-3), share, color=color, lw=1.8, label=method)
        axes.set_xscale("log")
        axes.set_ylim(0, 101)
        axes.set_xlabel(label)
        axes.set_ylabel("solves with no more [%]")
        _plain(axes)
        if place == 1:
            axes.legend(frameon=False, fontsize=8, loc="lower right")
    figure.tight_layout()
    return _embedded(figure, "shares of the solves by iterations and by time")


def places(groups: Sequence[Group]) -> str:
    """Where the middle of the contacts is, of solved, near-singular and failed solves."""
    figure = new_figure(9.0, 4.2, 110)
    centre = np.concatenate([group.centre for group in groups])
    success = np.concatenate([group.success for group in groups])
    singular = np.concatenate([group.singular for group in groups])
    kinds = (
        ("solved", SOLVED, success & ~singular, 4),
        ("solved, singular on the way", SINGULAR, success & singular, 7),
        ("not solved", FAILED, ~success, 12),
    )
    panels = figure.subplots(1, len(VIEWS))
    for axes, (title, first, second, across, up) in zip(panels, VIEWS, strict=True):
        for label, color, rows, size in kinds:
            chosen = _some(centre[rows])
            axes.scatter(
                chosen[:, first],
                chosen[:, second],
                s=size,
                color=color,
                lw=0,
                label=f"{label} ({int(rows.sum()):,})",
            )
        axes.plot([0], [0], marker="+", color=INK, ms=9, ls="none", label="base")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(across)
        axes.set_ylabel(up)
        axes.set_title(title, fontsize=9, color=INK)
        _plain(axes)
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(lines, labels, frameon=False, fontsize=8, loc="lower center", ncols=4)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    return _embedded(figure, "where solves fail and where they meet singularities")


def curve(errors: Array) -> str:
    """The worst error of a solve over its iterations as a small drawing.

    Args:
        errors: (m,) in multiples of the tolerance; inf where not measured.
    """
    width, height, low, high = 320, 70, 1e-3, 1e3
    level = np.clip(np.nan_to_num(errors, nan=high, posinf=high), low, high)
    y = height * np.log10(high / level) / np.log10(high / low)
    x = np.linspace(0, width, len(y)) if len(y) > 1 else np.array([0.0])
    if len(y) > width:  # the worst of the iterations that share a dot
        cuts = np.linspace(0, len(y), width, endpoint=False).astype(int)
        x, y = np.arange(width), np.minimum.reduceat(y, cuts)
    dots = " ".join(f"{a:.0f},{b:.1f}" for a, b in zip(x, y, strict=True))
    middle = height / 2
    return (
        f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img">'
        f"<title>worst error in multiples of its tolerance, {low:g} to {high:g}</title>"
        f'<line x1="0" x2="{width}" y1="{middle}" y2="{middle}" class="bound"/>'
        f'<polyline points="{dots}"/></svg>'
    )


def _some(points: Array) -> Array:
    return points[:: max(1, -(-len(points) // SHOWN))]


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8, colors=FAINT)
    axes.grid(color="#eceff2", lw=0.6)
    axes.set_axisbelow(True)


def _embedded(figure: Figure, text: str) -> str:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=figure.dpi)
    data = base64.b64encode(drawn.getvalue()).decode("ascii")
    return f'<img alt="{text}" src="data:image/png;base64,{data}">'
