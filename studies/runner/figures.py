"""Figures in one style, and pages of one figure."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh

from casadi_ik.app.drawing.palette import FAINT, INK
from casadi_ik.app.pictures.charts import new_figure
from casadi_ik.files.arrays import Array
from runner.report import page

RESULTS = Path(__file__).parents[1] / "results"

PAPER, OURS, THIRD, FOURTH = COLORS = "#e08a2e", "#2f6db3", "#1f9d55", "#8e4ec6"
"""Colours of the paper, of our results, and of a third series."""


def figure(rows: int, columns: int, width: float = 4.2, height: float = 3.7) -> tuple[Any, Any]:
    """Return a figure and its axes (rows, columns); sizes of a panel in inches."""
    plot = new_figure(width * columns, height * rows, 110)
    grid = plot.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.tick_params(colors=FAINT, labelsize=8)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    return plot, grid


def title(axes: Axes, text: str, x: str, y: str) -> None:
    """Say what a panel shows."""
    axes.set_title(text, loc="left", size=10, color=INK)
    axes.set_xlabel(x, size=9, color=INK)
    axes.set_ylabel(y, size=9, color=INK)


def field(
    axes: Axes, x: Array, y: Array, values: Array, bins: int, low: float, high: float, cmap: str
) -> QuadMesh:
    """Median of values over cells of the plane; cells with fewer than five are left white."""
    edges = [np.linspace(v.min(), v.max(), bins + 1) for v in (x, y)]
    i, j = (np.clip(np.digitize(v, e) - 1, 0, bins - 1) for v, e in zip((x, y), edges, strict=True))
    cell = i * bins + j
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(bins * bins + 1))
    sorted_values = values[order]
    medians = np.full(bins * bins, np.nan)
    for c in range(bins * bins):
        part = sorted_values[starts[c] : starts[c + 1]]
        if len(part) >= 5:
            medians[c] = np.median(part)
    grid = medians.reshape(bins, bins).T
    return axes.pcolormesh(*edges, grid, cmap=cmap, vmin=low, vmax=high, rasterized=True)


def options(
    description: str,
    count: int,
    arguments: list[str] | None,
    **parameters: tuple[int | float | str, str],
) -> argparse.Namespace:
    """Size, seed and place of a study, and its own parameters: default and meaning by name."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--count", type=int, default=count, help="configurations")
    parser.add_argument("--seed", type=int, default=0)
    for name, (default, meaning) in parameters.items():
        parser.add_argument(f"--{name}", type=type(default), default=default, help=meaning)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    return parser.parse_args(arguments)


def write(folder: Path, name: str, plot: Any, heading: str, result: str, text: str) -> None:
    """Write ``name/README.md`` with a picture, and print its path and text.

    Args:
        folder: Folder of the results of all studies.
        name: Name of the study.
        plot: Figure of the page.
        heading: Title of the page.
        result: Sentence that states the main result.
        text: Markdown.
    """
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    plot.tight_layout()
    plot.savefig(place / f"{name}.png")
    text = page(heading, result, [text, f"![{name}]({name}.png)"])
    (place / "README.md").write_text(text, encoding="utf-8")
    print(f"{place / 'README.md'}\n\n{text}")
