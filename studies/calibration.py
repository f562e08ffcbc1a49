"""Does calibration find a hand's true dimensions, and are its error bars true?

Hands are drawn from the priors about the described AR10, measured with noise and outliers, and
calibrated; the truth is known, so the estimates and their intervals can be judged. One command::

    python studies/calibration.py                # studies/results/calibration/
    python studies/calibration.py --hands 20 --out out/calibration
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from runner.figures import OURS, PAPER, THIRD, figure, title
from runner.parts import code_version
from runner.report import command, markdown_table, program, publish

import casadi_ik as ik
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.papers.chandra.calibration import (
    LOSSES,
    Calibration,
    HandModel,
    Measurements,
    calibrate,
    hand_parameters,
    simulate,
    true_values,
)

OUTLIERS = 0.1, 0.25
"""Parts of the poses that are outliers, beside none, if not asked otherwise."""


FINGER = "index"
NOISE = (2e-4, math.radians(0.5))
"""Noise of a measured coordinate [m] and angle [rad]. Assumption: as for marker tracking."""

POSES = 60
EXACT = (1e-9, 1e-9)


@dataclass(frozen=True, eq=False)
class Trials:
    """Estimates for many hands: h hands, k parameters.

    Attributes:
        deviations: (h, k) estimate minus truth, over the estimated standard deviation.
        misses: (h,) root mean square distance of the estimated tip from the true one [mm].
        described: (h,) the same of the description.
        noise: (h,) estimated noise of a coordinate over the true one.
        converged: (h,) whether the estimate converged.
        last: One of the estimates.
    """

    deviations: Array
    misses: Array
    described: Array
    noise: Array
    converged: NDArray[np.bool_]
    last: Calibration

    def coverage(self, level: float = 1.959964) -> float:
        """Part of the true numbers within so many standard deviations [%]."""
        return 100 * float(np.mean(np.abs(self.deviations) <= level))


def trials(
    model: HandModel,
    hands: int,
    seed: int,
    loss: str,
    outliers: float,
    poses: int = POSES,
    noise: tuple[float, float] = NOISE,
) -> Trials:
    """Calibrate hands drawn from the priors, each with its own data and random numbers."""
    rows = []
    for hand in range(hands):
        rng = np.random.default_rng([seed, hand])
        truth = true_values(model, rng)
        data = simulate(model, truth, FINGER, poses, rng, noise=noise, outliers=outliers)
        estimate = calibrate(model, data, loss=loss)
        fresh = simulate(model, truth, FINGER, 100, rng, noise=EXACT)
        miss, described = (
            tip_miss(model, values, fresh) for values in (estimate.values, model.nominal)
        )
        scaled = (estimate.values - truth) / estimate.deviation
        rows.append(
            (scaled, miss, described, estimate.noise[0] / noise[0], estimate.converged, estimate)
        )
    scaled, misses, described, ratios, converged, estimates = zip(*rows, strict=True)
    return Trials(
        np.array(scaled),
        np.array(misses),
        np.array(described),
        np.array(ratios),
        np.array(converged),
        estimates[-1],
    )


def tip_miss(model: HandModel, values: Array, exact: Measurements) -> float:
    """Root mean square distance of a model's tip from exact measurements [mm]."""
    error, _ = model.misfit(FINGER, exact.q, values, exact.poses)
    return 1e3 * float(np.sqrt((error[:, :3] ** 2).sum(axis=1).mean()))


LEVELS = np.array([0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99])
NORMAL = np.array([0.6745, 0.8416, 1.0364, 1.2816, 1.6449, 1.96, 2.5758])
"""Half widths in standard deviations that hold so much of a normal variable."""


def draw_bars(results: dict[tuple[str, float], Trials], share: float, path: Path) -> None:
    """Coverage against its level, and errors over deviations, without and with `share` outliers."""
    plot, grid = figure(1, 2, 5, 4)
    levels, errors = grid[0]
    colors = dict(zip(LOSSES, (OURS, THIRD, PAPER), strict=True))
    for (loss, outliers), result in results.items():
        if outliers not in (0.0, share):
            continue
        off = [result.coverage(width) for width in NORMAL] - 100 * LEVELS
        style, fill = ("-", colors[loss]) if outliers else ("--", "white")
        label = f"{loss}, {100 * outliers:.0f} % outliers"
        levels.plot(100 * LEVELS, off, style, color=colors[loss], marker="o", ms=5, mfc=fill,
                    label=label)  # fmt: skip
    levels.axhline(0, color="black", lw=0.8)
    name = "Intervals that hold too often (above 0) or too rarely"
    title(levels, name, "level of the interval [%]", "true values within, minus level [%]")
    low, high = levels.get_ylim()
    levels.set_ylim(low, high + 0.55 * (high - low))  # room for the legend
    levels.legend(frameon=False, fontsize=8, ncols=2, loc="upper left")
    bins = np.linspace(-4, 4, 81)
    pooled = results["cauchy", share].deviations.ravel()
    errors.hist(pooled, bins=bins, density=True, color="#9fc3e6", label="all hands and numbers")
    normal = np.exp(-0.5 * bins**2) / math.sqrt(2 * math.pi)
    errors.plot(bins, normal, color="black", lw=1, label="what the intervals assume: normal")
    name = f"Errors, Cauchy loss, {100 * share:g} % outliers"
    title(errors, name, "error / its estimated standard deviation", "density")
    errors.set_ylim(0, 0.55)
    errors.legend(frameon=False, fontsize=8, loc="upper left")
    plot.tight_layout()
    plot.savefig(path)


NONE = 1e-6
"""Singular values below this are zero to rounding."""


def draw_spectrum(estimate: Calibration, path: Path) -> None:
    """Singular values, with the level of the priors."""
    plot, ((axes,),) = figure(1, 1, 7, 3.4)
    values, order = estimate.singular_values, np.arange(1, len(estimate.singular_values) + 1)
    for is_selected, color, label in (
        (values >= 1, OURS, "known from the measurements"),
        ((values < 1) & (values > NONE), "#9fc3e6", "known from the priors for the most part"),
    ):
        axes.semilogy(order[is_selected], values[is_selected], "o", color=color, ms=5, label=label)
    zero = order[values <= NONE]
    axes.semilogy(zero, np.full(len(zero), NONE), "v", color=PAPER, ms=6,
                  label="zero: no measurement of the tip tells")  # fmt: skip
    axes.axhline(1, color="black", lw=0.8, ls="--")
    axes.annotate(
        "1: measurements say as much as priors", (0.99, 1.25), fontsize=8, ha="right",
        xycoords=("axes fraction", "data"),
    )  # fmt: skip
    across = "direction in the space of dimensions, best known first"
    title(axes, "What the measurements tell", across, "singular value, priors = 1")
    axes.set_ylim(3e-7, None)
    axes.legend(frameon=False, fontsize=8, loc="lower left")
    plot.tight_layout()
    plot.savefig(path)


def main(arguments: list[str] | None = None) -> None:
    """Run the study and write report and figures."""
    parser = argparse.ArgumentParser(description="Calibration of the AR10's index finger.")
    parser.add_argument("--robot", default="ar10")
    parser.add_argument("--hands", type=int, default=150, help="hands per table row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--poses", type=int, default=POSES, help="measured of a hand")
    parser.add_argument(
        "--noise",
        type=float,
        nargs=2,
        default=NOISE,
        metavar=("METRES", "RADIANS"),
        help="standard deviation of a measured coordinate and angle",
    )
    parser.add_argument(
        "--outliers",
        type=float,
        nargs=2,
        default=OUTLIERS,
        metavar=("FEW", "MANY"),
        help="shares of outliers beside none; all but the first table are of the first",
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "calibration"
    )
    options = parser.parse_args(arguments)
    few, most_outliers = options.outliers
    if not 0 < few < most_outliers < 1:
        raise InputError(
            f"--outliers: found {few:g} {most_outliers:g}, expected 0 < FEW < MANY < 1"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    robot = ik.load_robot(options.robot).description
    model = HandModel(robot, hand_parameters(robot, [FINGER]))
    hands, seed, poses, noise = options.hands, options.seed, options.poses, tuple(options.noise)
    results = {
        (loss, outliers): trials(model, hands, seed, loss, outliers, poses, noise)
        for outliers in (0.0, few, most_outliers)
        for loss in LOSSES
    }
    sizes = {
        part: trials(model, hands, seed, "cauchy", few, part, noise)
        for part in (poses // 4, poses // 2, 2 * poses)
    }
    sizes[poses] = results["cauchy", few]
    sizes = dict(sorted(sizes.items()))
    text = REPORT.format(
        numbers=len(model.parameters),
        hands=hands,
        poses=poses,
        position=1e3 * noise[0],
        angle=math.degrees(noise[1]),
        few=100 * few,
        many=100 * most_outliers,
        described=np.median(results["cauchy", few].described),
        losses=loss_table(results),
        sizes=size_table(sizes),
        groups=group_table(results["cauchy", few]),
        unknown=results["cauchy", 0.0].last.unknown_directions,
        weak=len(results["cauchy", 0.0].last.unidentified()),
        directions=direction_table(results["cauchy", 0.0].last),
    )
    robust = results["cauchy", few]
    result = (
        f"With {100 * few:g} % outliers and the Cauchy loss, calibration reduces the error of the "
        f"tip from {np.median(robust.described):.2f} mm to {np.median(robust.misses):.2f} mm, and "
        f"{robust.coverage():.1f} % of the true values are in the 95 % intervals."
    )
    run_by, code = command(__file__, arguments), {"calibration": code_version()}
    publish("Calibration of the AR10's index finger", result, [text], options.out, run_by, code)
    draw_bars(results, few, options.out / "error_bars.png")
    draw_spectrum(results["cauchy", 0.0].last, options.out / "singular_values.png")


REPORT = """
{hands} hands are drawn from the priors about the described one ({numbers} numbers: triangles,
four-bar, joint axes, contact frame), each measured at {poses} random slider positions with noise of
{position:g} mm and {angle:g} deg per component, and calibrated. A tip of such a hand is
{described:.2f} mm (median over hands, root mean square over postures) from where the description
has it. Noise, priors and hands are made up; the truth is known.

## Robust or not

An outlier is a pose with twenty times the noise. "Tip" is the root mean square distance of the
estimated from the true tip at 100 new postures, median / 90th percentile over hands.

{losses}
The 95 % intervals hold what they say with every loss, outliers or not: the covariance counts the
scatter that there is. What robust losses gain is the size of the intervals and of the errors. The
noise is estimated with the rest, from medians, which {many:g} % of outliers move a little.

![Coverage of the intervals, and the distribution of the errors](error_bars.png)

## How many poses

With {few:g} % outliers and the Cauchy loss:

{sizes}
## What is learned

By kind of number, {few:g} % outliers: the part of the prior's variance that the data took
away, and how many of the true numbers the 95 % intervals hold.

{groups}
## What the data cannot know

Two sliders move the finger in a plane; not everything can be seen in that. In units of the priors,
the whitened Jacobian has {unknown} singular values that are zero and {weak} below one, where the
data say less than the priors. The estimate then stays where the priors have it, and its interval
says so.

![Singular values](singular_values.png)

The weakest directions of one estimate without outliers, with their larger components. Among those
with zero are, mixed with one another: the size of the four-bar, of which angles know only ratios;
a shift of each of the three axes along itself, made up for by what follows; and a turn about each,
made up for by the reference angles.

{directions}"""


def loss_table(results: dict[tuple[str, float], Trials]) -> str:
    """Return a table with a row for each loss and fraction of outliers."""
    rows = [
        (f"{100 * outliers:.0f} %", loss, f"{t.coverage():.1f} %", spread(t.misses),
         f"{np.median(t.noise):.2f}", f"{100 * t.converged.mean():.0f} %")
        for (loss, outliers), t in results.items()
    ]  # fmt: skip
    header = ("outliers", "loss", "held by 95 % intervals", "tip [mm]", "noise found / true")
    return markdown_table((*header, "converged"), rows)


def size_table(sizes: dict[int, Trials]) -> str:
    """Return a table with a row for each number of poses."""
    rows = [
        (str(count), f"{t.coverage():.1f} %", spread(t.misses), spread(t.described))
        for count, t in sizes.items()
    ]
    return markdown_table(
        ("poses", "held by 95 % intervals", "tip [mm]", "tip as described [mm]"), rows
    )


def group_table(result: Trials) -> str:
    """Return a table with a row for each kind of parameter."""
    learned, parts = result.last.learned, [p.part for p in result.last.parameters]
    names = {
        "coupling": "triangles and four-bar",
        "origin": "points of the axes",
        "axis": "tilts of the axes",
        "tip": "contact point",
        "turn": "contact frame's turn",
    }
    rows = []
    for part, name in names.items():
        columns = np.array([is_in_group == part for is_in_group in parts])
        coverage_share = 100 * np.mean(np.abs(result.deviations[:, columns]) <= 1.959964)
        learned_share = 100 * learned[columns]
        learned_range = f"{learned_share.min():.0f} to {learned_share.max():.0f} %"
        rows.append((name, str(columns.sum()), learned_range, f"{coverage_share:.1f} %"))
    return markdown_table(("numbers", "how many", "learned (one hand)", "held"), rows)


def direction_table(estimate: Calibration) -> str:
    """Return a table of the weakest directions of an estimate."""
    rows = [
        ("0" if value < 1e-6 else f"{value:.3f}",
         ", ".join(f"{part:+.2f} {name}" for name, part in list(names.items())[:5]))
        for value, names in estimate.unidentified()[:12]
    ]  # fmt: skip
    return markdown_table(("singular value", "direction"), rows)


def spread(values: Array) -> str:
    """Median and 90th percentile."""
    return f"{np.median(values):.3f} / {np.percentile(values, 90):.3f}"


if __name__ == "__main__":
    program(main)
