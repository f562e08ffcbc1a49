"""Whether error bars are true, and what measurements can tell, as pictures."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from calibrated_hands.trials import Trials
from casadi_ik.calibration import (
    LOSSES,
    Calibration,
)

LEVELS = np.array([0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99])
NORMAL = np.array([0.6745, 0.8416, 1.0364, 1.2816, 1.6449, 1.96, 2.5758])
"""Half widths in standard deviations that hold so much of a normal variable."""


def draw_bars(results: dict[tuple[str, float], Trials], share: float, path: Path) -> None:
    """Coverage against its level, and errors over deviations, without and with `share` outliers."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    levels, errors = figure.subplots(1, 2)
    colors = dict(zip(LOSSES, ("#2f6db3", "#1f9d55", "#e08a2e"), strict=True))
    for (loss, outliers), result in results.items():
        if outliers not in (0.0, share):
            continue
        off = [result.coverage(width) for width in NORMAL] - 100 * LEVELS
        style, fill = ("-", colors[loss]) if outliers else ("--", "white")
        label = f"{loss}, {100 * outliers:.0f} % outliers"
        levels.plot(100 * LEVELS, off, style, color=colors[loss], marker="o", ms=5, mfc=fill,
                    label=label)  # fmt: skip
    levels.axhline(0, color="black", lw=0.8)
    levels.set_title("Intervals that hold too often (above 0) or too rarely", size=10, loc="left")
    levels.set(xlabel="level of the interval [%]", ylabel="true values within, minus level [%]")
    low, high = levels.get_ylim()
    levels.set_ylim(low, high + 0.55 * (high - low))  # room for the legend
    levels.legend(frameon=False, fontsize=8, ncols=2, loc="upper left")
    grid = np.linspace(-4, 4, 81)
    pooled = results["cauchy", share].deviations.ravel()
    errors.hist(pooled, bins=grid, density=True, color="#9fc3e6", label="all hands and numbers")
    normal = np.exp(-0.5 * grid**2) / math.sqrt(2 * math.pi)
    errors.plot(grid, normal, color="black", lw=1, label="what the intervals assume: normal")
    errors.set_title(f"Errors, Cauchy loss, {100 * share:g} % outliers", size=10, loc="left")
    errors.set(xlabel="error / its estimated standard deviation", ylabel="density", ylim=(0, 0.55))
    errors.legend(frameon=False, fontsize=8, loc="upper left")
    figure.savefig(path, dpi=110)


NONE = 1e-6
"""Singular values below this are zero to rounding."""


def draw_spectrum(found: Calibration, path: Path) -> None:
    """Singular values, with the level of the priors."""
    figure = Figure(figsize=(7, 3.4), layout="constrained")
    axes = figure.subplots()
    values, order = found.singular_values, np.arange(1, len(found.singular_values) + 1)
    for chosen, color, label in (
        (values >= 1, "#2f6db3", "known from the measurements"),
        ((values < 1) & (values > NONE), "#9fc3e6", "known from the priors for the most part"),
    ):
        axes.semilogy(order[chosen], values[chosen], "o", color=color, ms=5, label=label)
    zero = order[values <= NONE]
    axes.semilogy(zero, np.full(len(zero), NONE), "v", color="#e08a2e", ms=6,
                  label="zero: no measurement of the tip tells")  # fmt: skip
    axes.axhline(1, color="black", lw=0.8, ls="--")
    axes.annotate(
        "1: measurements say as much as priors", (0.99, 1.25), fontsize=8, ha="right",
        xycoords=("axes fraction", "data"),
    )  # fmt: skip
    axes.set(xlabel="direction in the space of dimensions, best known first")
    axes.set(ylabel="singular value, priors = 1", ylim=(3e-7, None))
    axes.legend(frameon=False, fontsize=8, loc="lower left")
    figure.savefig(path, dpi=110)
