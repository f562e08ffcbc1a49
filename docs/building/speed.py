"""Draw the bar chart of speed in comparison with other solvers, from results of a study.

    python docs/building/speed.py

writes docs/speed_light.svg and docs/speed_dark.svg.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "studies" / "results" / "any_robot" / "peers.json"
CELL = "5 mm, 3 deg"

ROWS = {
    "ours, one at a time (`Solver.fast`)": "casadi_ik",
    "placo": "placo",
    "Pink": "Pink",
    "mink": "mink",
}
"""Name in the results, name in the chart."""

INKS = {"light": ("#24292f", "#e08a2e", "#8c959f"), "dark": ("#e6edf3", "#e8944a", "#6e7681")}
"""Colours of text, of the bar of casadi_ik, and of other bars."""


def times() -> dict[str, list[float]]:
    """Return the mean processor time of a target [ms] by solver, for each arm-hand pair."""
    pairs = json.loads(RESULTS.read_text(encoding="utf-8"))["pairs"].values()
    return {
        name: [pair["cells"][CELL][key]["mean"] / 1000.0 for pair in pairs]
        for key, name in ROWS.items()
    }


def means() -> dict[str, float]:
    """Return the geometric means of `times`."""
    return {
        name: math.exp(sum(map(math.log, values)) / len(values)) for name, values in times().items()
    }


def label(time: float) -> str:
    """Return the label of a bar."""
    return f"{time:.2g} ms"


def draw(paper: str) -> None:
    """Write the chart for light or dark pages."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams.update({"svg.hashsalt": "casadi_ik", "font.size": 11})
    import matplotlib.pyplot as plt

    ink, highlight, gray = INKS[paper]
    figure, axes = plt.subplots(figsize=(7.4, 1.9), layout="constrained")
    for row, mean in enumerate(means().values()):
        axes.barh(row, mean, height=0.7, color=gray if row else highlight)
        axes.text(mean, row, f" {label(mean)}", va="center", color=ink, zorder=4)
    axes.set_yticks(range(len(ROWS)), list(ROWS.values()), color=ink)
    axes.get_yticklabels()[0].set_fontweight("bold")
    axes.invert_yaxis()
    axes.set_xlim(0, 1.12 * max(means().values()))
    axes.xaxis.set_visible(False)
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    figure.savefig(ROOT / "docs" / f"speed_{paper}.svg", transparent=True, metadata={"Date": None})
    plt.close(figure)


if __name__ == "__main__":
    for background in INKS:
        draw(background)
