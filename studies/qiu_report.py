"""The report on Table I of Qiu & Kermani 2021: tables, figures, words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from qiu_settings import LIMITS, METHODS, TABLE_I, Printed, printed_mean
from runner.figures import figure, title
from runner.report import (
    Metric,
    interval_text,
    markdown_table,
    mean_metric,
    publish,
    rate_metric,
)
from runner.study import Setting, Study, code_of, read_results, robot_of

import casadi_ik as ik
from casadi_ik.app.drawing.palette import method_colors
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array

BUDGET = 10_000
"""Iterations of a solve (section III of the paper)."""

HEADS = {"ignore": "limits ignored", "enforce": "within limits"}


NEAREST = 5
"""Readings that are shown for both methods together."""


def figures_of(name: str, rows: pl.DataFrame) -> tuple[Metric, Metric, Metric]:
    """Success, iterations and time of the solved cases."""
    solved = rows.filter(pl.col("success"))
    return (
        rate_metric(f"{name}/success", len(solved), len(rows)),
        mean_metric(f"{name}/iterations", solved["iterations"], "1"),
        mean_metric(f"{name}/time", 1e3 * solved["time"], "ms"),
    )


def summary(table: pl.DataFrame) -> tuple[str, list[Metric]]:
    """Return the table of all objects: the paper, and our results without and with limits."""
    heads = ["method", "paper: solved %", "iterations", "time [ms]"]
    for limits in LIMITS:
        heads += [f"{HEADS[limits]}: solved %", "iterations", "time [ms]", "n"]
    rows, metrics = [], []
    for method in METHODS:
        printed = printed_mean(method) if method in TABLE_I["cup"] else None
        cells = [f"`{method}`", *_printed(printed)]
        for limits in LIMITS:
            part = _part(table, method, limits)
            cell_figures = figures_of(f"table-one/{method}/{limits}", part)
            metrics += cell_figures
            cells += [
                interval_text(cell_figures[0], 3 if cell_figures[0].value > 99.9 else 1),
                interval_text(cell_figures[1], 1 if cell_figures[1].value < 20 else 0),
                _milliseconds(cell_figures[2]),
                f"{len(part):,}",
            ]
        rows.append(cells)
    return markdown_table(heads, rows), metrics


def by_object(table: pl.DataFrame) -> tuple[str, list[Metric]]:
    """Return the table by object: the paper, and our results without and with limits."""
    heads = ["object", "method", "paper: solved %", "iterations", "time [ms]"]
    heads += ["limits ignored: solved %", "iterations", "time [ms]"]
    heads += ["within limits: solved %", "iterations"]
    rows, metrics = [], []
    for name in sorted(table["targets"].unique()):
        for method in METHODS:
            cells = [name.replace("_", " "), f"`{method}`"]
            cells += _printed(TABLE_I.get(name, {}).get(method))
            for limits in LIMITS:
                part = _part(table, method, limits).filter(pl.col("targets") == name)
                cell_figures = figures_of(f"table-one/{method}/{limits}/{name}", part)
                metrics += cell_figures
                cells += [interval_text(cell_figures[0]), _plain(cell_figures[1])]
                cells += [_milliseconds(cell_figures[2])] if limits == "ignore" else []
            rows.append(cells)
    return markdown_table(heads, rows), metrics


def by_setting(table: pl.DataFrame, study: Study) -> tuple[str, list[Metric]]:
    """Return the table with a row for each setting that has results."""
    rows, metrics = [], []
    for setting, part, cell_figures in _settings_with_results(table, study):
        metrics += cell_figures
        rows.append([setting.key, *_cells(cell_figures), f"{len(part):,}"])
    return markdown_table(["choice", "solved %", "iterations", "n"], rows), metrics


def readings(table: pl.DataFrame, study: Study) -> tuple[str, list[Metric]]:
    """Return the table of readings of the original methods, with distances from the paper.

    The distance is |ln(rate / printed rate)| + |ln(iterations / printed iterations)|; none if
    nothing was solved. A second table has the readings that suit both methods together best.
    """
    rows, metrics = [], []
    distances: dict[str, list[float]] = {}
    for setting, part, cell_figures in _settings_with_results(table, study):
        metrics += cell_figures
        printed = printed_mean(setting.method)
        distance = "-"
        if cell_figures[0].value > 0:
            ratios = (
                cell_figures[0].value / printed.success,
                cell_figures[1].value / printed.iterations,
            )
            log_distance = sum(abs(math.log(ratio)) for ratio in ratios)
            distance = f"{log_distance:.2f}"
            distances.setdefault(setting.key.partition(", ")[2], []).append(log_distance)
        rows.append([setting.key, *_cells(cell_figures), distance, f"{len(part):,}"])
    for method in ("original-dls", "original-sdls"):
        printed = printed_mean(method)
        rows.append([f"{method}, printed", *_printed(printed)[:2], "0", ""])
    both = {reading: sum(pair) for reading, pair in distances.items() if len(pair) == 2}
    nearest = sorted(both, key=lambda reading: both[reading])[:NEAREST]
    tables = [
        markdown_table(["reading", "solved %", "iterations", "distance", "n"], rows),
        markdown_table(
            ["reading of both methods", "sum of the distances"],
            [[reading, f"{both[reading]:.2f}"] for reading in nearest],
        ),
    ]
    return "\n\n".join(tables), metrics


def _settings_with_results(
    table: pl.DataFrame, study: Study
) -> Iterator[tuple[Setting, pl.DataFrame, tuple[Metric, Metric, Metric]]]:
    for setting in study.settings:
        part = table.filter(pl.col("setting") == setting.key)
        if len(part):
            yield setting, part, figures_of(f"{study.name}/{setting.key}", part)


def _cells(cell_figures: tuple[Metric, Metric, Metric]) -> list[str]:
    return [interval_text(cell_figures[0]), interval_text(cell_figures[1], 0)]


def endings(table: pl.DataFrame) -> str:
    """Return the table of statuses by setting, and of iterations saved."""
    statuses = sorted(table["status"].unique())
    rows = []
    for method in METHODS:
        for limits in LIMITS:
            part = _part(table, method, limits)
            if len(part):
                shares = [100 * (part["status"] == status).mean() for status in statuses]
                stalled = part.filter(pl.col("status") == "STALLED")["iterations"]
                saved = int((BUDGET - stalled).sum())
                rows.append(
                    [
                        f"`{method}`, {HEADS[limits]}",
                        *(f"{share:.2f} %" for share in shares),
                        f"{100 * saved / (saved + int(part['iterations'].sum())):.1f} %",
                    ]
                )
    return markdown_table(["method", *statuses, "iterations saved"], rows)


def _part(table: pl.DataFrame, method: str, limits: str) -> pl.DataFrame:
    return table.filter((pl.col("method") == method) & (pl.col("limits") == limits))


def _printed(cell: Printed | None) -> list[str]:
    if cell is None:
        return ["", "", ""]
    return [f"{cell.success:.1f}", f"{cell.iterations:.0f}", f"{1e3 * cell.time:.0f}"]


def _plain(metric: Metric) -> str:
    return "-" if metric.n == 0 else f"{metric.value:.0f}"


def _milliseconds(metric: Metric) -> str:
    return "-" if metric.n == 0 else f"{metric.value:.3g}"


COLOURS = method_colors(METHODS)
RUNS = 40
"""Solved and failed runs behind a band of a panel."""
LONGEST = 1000
"""Iterations of a run that are drawn."""
SOLVED, FAILED = "#2f6db3", "#c0392b"


def draw_dots(metrics: Sequence[Metric], quantity: str, label: str, path: Path) -> None:
    """Draw a dot with its 95 % interval for each object and method, diamonds for the paper.

    Args:
        metrics: Figures of the table by object (`by_object`).
        quantity: "success" or "iterations".
        label: What is drawn, with its unit.
        path: Of the picture.
    """
    values = {metric.name: metric for metric in metrics}
    objects = sorted({name.split("/")[3] for name in values if name.count("/") == 4})
    plot, grid = figure(1, 2, 5.4, 0.42 * len(objects) + 1.4)
    for panel, limits in zip(grid[0], LIMITS, strict=True):
        for i, method in enumerate(METHODS):
            for row, name in enumerate(objects):
                at = row + 0.7 * ((i + 0.5) / len(METHODS) - 0.5)
                metric = values.get(f"table-one/{method}/{limits}/{name}/{quantity}")
                if metric is not None and metric.n:
                    ends = [[metric.value - metric.low], [metric.high - metric.value]]
                    panel.errorbar(
                        metric.value, at, xerr=ends, fmt="o", ms=4, color=COLOURS[method]
                    )
                printed = TABLE_I.get(name, {}).get(method) if limits == "ignore" else None
                if printed:
                    x = getattr(printed, quantity)
                    panel.plot(x, at, "D", ms=5, mfc="none", mec=COLOURS[method])
            panel.plot([], [], "o", ms=4, color=COLOURS[method], label=method)
        title(panel, HEADS[limits], label, "")
        panel.set_yticks(range(len(objects)), [name.replace("_", " ") for name in objects])
        panel.set_ylim(len(objects) - 0.5, -0.5)
        panel.grid(axis="y", alpha=0.15)
        if quantity == "iterations":
            panel.set(xscale="log", xlim=(1, 1e4))
        panel.plot([], [], "D", ms=5, mfc="none", mec="black", label="printed in the paper")
    grid[0, 1].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plot.tight_layout()
    plot.savefig(path)


def draw_convergence(studies: Sequence[Study], table: pl.DataFrame, path: Path) -> None:
    """Draw the largest error over the iterations of solved and failed runs, without limits.

    Drawn are the median and the band from 10 to 90 % of the first solved and the first failed
    runs. They are stepped through once more, from targets whose last bit may differ, and drawn as
    what they are then; a run that has ended keeps its last error.
    """
    settings = [
        (study, setting)
        for study in studies
        for setting in study.settings
        if setting.limits == "ignore" and setting.method.startswith(("enhanced", "original"))
    ]
    plot, panels = figure(2, 2, 5.5, 3.5)
    for panel, (study, setting) in zip(panels.flat, settings, strict=True):
        rows = table.filter(pl.col("setting") == setting.key).sort("target", "targets")
        runs: dict[bool, list[Array]] = {True: [], False: []}
        for success in (True, False):
            part = rows.filter(pl.col("success") == success).head(RUNS)
            for row in part.iter_rows(named=True):
                solved, errors = _run(study, setting, row["targets"], row["target"])
                runs[solved].append(errors)
        for solved, errors in runs.items():
            if errors:
                _band(panel, np.stack(errors), solved)
        panel.axhline(1, color="black", lw=0.8, ls=":")
        panel.set(xscale="log", yscale="log", ylim=(0.3, 400))
        title(panel, setting.method, "iteration", "worst error / tolerance")
    panels[0, 0].legend(frameon=False, fontsize=8, loc="lower left")
    plot.tight_layout()
    plot.savefig(path)


def _band(panel: Axes, errors: Array, solved: bool) -> None:
    """Median and 10 to 90 % of runs (k, iterations)."""
    low, middle, high = np.percentile(errors, [10, 50, 90], axis=0)
    color, iterations = (SOLVED if solved else FAILED), np.arange(1, LONGEST + 1)
    name = f"solved within {LONGEST}" if solved else f"not within {LONGEST}"
    panel.fill_between(iterations, low, high, color=color, alpha=0.2, lw=0)
    panel.plot(iterations, middle, color=color, lw=1.8, label=name)


def _run(study: Study, setting: Setting, targets: str, target: int) -> tuple[bool, Array]:
    """Return whether a run is solved, and its largest error over tolerance (LONGEST,)."""
    group = next(item for item in study.sets if item.key == targets)
    number, row = divmod(target, study.block)
    robot = robot_of(study.robot)
    points, normals = robot.contacts(study.configurations(group, number)[row])
    contacts = {finger: ik.Contact(points[i], normals[i]) for i, finger in enumerate(robot.fingers)}
    stepper = study.solver(setting).stepper(ik.Grasp(contacts), study.start(setting))
    position, angle = setting.tolerance
    errors = [
        max(record["position_error"].max() / position, record["angle_error"].max() / angle)
        for record in islice(stepper, LONGEST)
    ]
    return stepper.status == ik.Status.SOLVED, np.pad(errors, (0, LONGEST - len(errors)), "edge")


NOT_RUN = "*Not run yet.*"
TITLE = "Table I of Qiu & Kermani 2021"

INTRODUCTION = """
*Targets.* Each of the 12 shipped grasps (computed pinches of YCB objects) keeps its hand posture;
the arm is drawn uniformly within its limits, and forward kinematics gives contact points and
normals that are reachable by construction (section III of the paper). *Solved:* every contact
within 5 mm and 3 deg; "within limits" also asks that every joint is within its limits, and the
method keeps to them in every iteration. *One start* from the robot's home for the paper's methods,
at most 10,000 iterations. Means of iterations and time are over solved cases, as in the paper.
Intervals are 95 % confidence (Wilson's for rates). `n` is the number of targets; the paper's is
120,000. Where less was run the targets are the first of every object, as many of each.

The paper prints six of its twelve objects; its means here are over those six. It publishes
neither its grasps, nor its start as numbers, nor whether limits were enforced: the grasps and so
the targets are our own. Its "Can" stands beside our tomato soup can, which is a guess, and of that
can's enhanced DLS it prints time and iterations the wrong way round (put right here). Times are
a solve's share of the compiled loop, which makes four at once, on this machine while others were at
work on it, beside MATLAB's: an order of magnitude, no more.
"""

DIFFERENCES = """
What the original methods are, the paper says only as "the methods without the enhancement of the
proposed approach". Every reading below is on the same targets, limits ignored. The distance is
|ln(rate / printed rate)| + |ln(iterations / printed iterations)|. Most readings solve several times
as many targets as the paper prints; few they become only under an augmented projection: with
damped pseudoinverses in the projectors and the palm first, or with exact ones finger by finger.
The methods of the paper differ in the step alone, so one reading has to serve both: taken as
`original-*` is "augmented, damped projectors, palm first, finger by finger", which carries the
paper's own hierarchy of thumb reaching on to the other fingers. The last table says how it compares
with the others for both methods together; for one method alone another may come closer.
"""

CYCLES = """
A solve of a paper's method ends early only if it provably repeats: its state has come back bit for
bit, and since a step is a function of the state it will for ever (STALLED). All others that fail
count to 10,000 (ITERATION_LIMIT): they creep on where tasks conflict, or go round a cycle that
closes only to rounding, not to the last bit. "Iterations saved" is the share of all iterations that
the proofs spared.
"""

DOTS = "Lines are 95 % intervals, where they are wider than a dot; diamonds, in the paper's table."

ABLATION = """
One choice changed at a time, limits ignored, on the first targets of every object: the same
targets for every line, so differences are more certain than the intervals look.
"""


def write_report(studies: Sequence[Study], results: Path, folder: Path, command: str) -> None:
    """Write `report.md`, figures and `metrics.json`.

    Args:
        studies: The table, its part by the original methods, the ablation and the readings.
        results: Folder with a folder per study.
        folder: Where the report goes.
        command: What was run.

    Raises:
        InputError: There are no results of the table.
    """
    fast, slow, ablation, cell_figures = (
        read_results(study, results / study.name) for study in studies
    )
    table = pl.concat([fast, slow], how="diagonal")
    if not len(table):
        raise InputError(f"{results}: found no results of the table, expected some")
    folder.mkdir(parents=True, exist_ok=True)
    draw_convergence(studies[:2], table, folder / "convergence.png")
    metrics: list[Metric] = []

    def collect(section: tuple[str, list[Metric]]) -> str:
        metrics.extend(section[1])
        return section[0]

    parts = [
        INTRODUCTION,
        "## All objects",
        collect(summary(table)),
        "![Success by object](success.png)",
        "![Iterations of solved cases](iterations.png)",
        DOTS,
        "## Convergence",
        "The worst error over all contacts in units of its tolerance, limits ignored: median and "
        f"10 to 90 % of the first {RUNS} targets that were solved and of the first {RUNS} that "
        "were not.",
        "![Convergence of solved and failed runs](convergence.png)",
        "## How solves end",
        CYCLES,
        endings(table),
        "## The paper's open choices: enhanced methods",
        ABLATION,
        collect(by_setting(ablation, studies[2])) if len(ablation) else NOT_RUN,
        "## Readings of the original methods",
        DIFFERENCES,
        collect(readings(cell_figures, studies[3])) if len(cell_figures) else NOT_RUN,
        "## Every object",
        collect(by_object(table)),
    ]
    draw_dots(metrics, "success", "solved [%]", folder / "success.png")
    draw_dots(metrics, "iterations", "mean iterations of solved cases", folder / "iterations.png")
    rates = {metric.name: metric.value for metric in metrics}
    solved = {m: rates[f"table-one/{m}/ignore/success"] for m in ("enhanced-dls", "hand-first")}
    result = (
        f"The method of the paper solves {solved['enhanced-dls']:.1f} % "
        f"(paper: {printed_mean('enhanced-dls').success:.1f} %), `hand-first` solves "
        f"{solved['hand-first']:.5g} %."
    )
    code = {study.name: code_of(results / study.name) for study in studies}
    publish(TITLE, result, parts, folder, command, code, metrics)
