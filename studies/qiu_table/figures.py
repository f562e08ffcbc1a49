"""The figures of the report: success by object, iterations, convergence."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import matplotlib as mpl
import numpy as np
import polars as pl
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from runner import Setting, Study, rate_metric
from runner.study import robot_of

import casadi_ik as ik
from casadi_ik.palette import method_colors
from qiu_table.paper import TABLE_I, printed_mean
from qiu_table.settings import LIMITS, METHODS
from qiu_table.tables import HEADS

mpl.use("Agg")
COLOURS = method_colors(METHODS)
DPI = 130
CURVES = 8
"""Solved and failed runs drawn per method."""
LONGEST = 1000
"""Iterations drawn of a run."""


def draw_success(table: pl.DataFrame, path: Path) -> None:
    """Success by object and method, with 95 % intervals, and what the paper printed."""
    objects = sorted(table["targets"].unique())
    figure, panels = plt.subplots(2, 1, figsize=(11, 7.5), sharex=True, layout="constrained")
    for panel, limits in zip(panels, LIMITS, strict=True):
        rows = table.filter(pl.col("limits") == limits)
        present = [name for name in METHODS if name in rows["method"].unique()]
        width = 0.84 / max(1, len(present))
        for i, method in enumerate(present):
            mine = rows.filter(pl.col("method") == method)
            x = np.arange(len(objects)) - 0.42 + width * (i + 0.5)
            for at, name in zip(x, objects, strict=True):
                solved = mine.filter(pl.col("targets") == name)["success"]
                rate = rate_metric(name, int(solved.sum()), len(solved))
                error = [[rate.value - rate.low], [rate.high - rate.value]]
                panel.bar(at, rate.value, width, color=COLOURS[method], yerr=error)
            panel.bar(0, 0, color=COLOURS[method], label=method)
            if limits == "ignore":
                printed = [
                    (at, TABLE_I[o]) for at, o in zip(x, objects, strict=True) if o in TABLE_I
                ]
                pairs = [(at, cells[method].success) for at, cells in printed if method in cells]
                panel.plot(*zip(*pairs, strict=True), "kD", ms=4) if pairs else None
        panel.set(ylabel="solved [%]", ylim=(0, 105), title=HEADS[limits])
        panel.grid(axis="y", alpha=0.3)
    panels[0].plot([], [], "kD", ms=4, label="printed in the paper")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=7)
    panels[1].set_xticks(range(len(objects)), [o.replace("_", " ") for o in objects], rotation=25)
    _save(figure, path)


def draw_iterations(table: pl.DataFrame, path: Path) -> None:
    """How many iterations the solved cases took; the paper's means as dashed lines."""
    figure, panels = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
    edges = np.logspace(0, 4, 61)
    for panel, limits in zip(panels, LIMITS, strict=True):
        rows = table.filter((pl.col("limits") == limits) & pl.col("success"))
        for method in METHODS:
            counts = rows.filter(pl.col("method") == method)["iterations"].to_numpy()
            if len(counts):
                shares = np.histogram(counts, edges)[0] / len(counts)
                panel.stairs(100 * shares, edges, color=COLOURS[method], label=method, lw=1.6)
            if limits == "ignore" and method in TABLE_I["cup"]:
                panel.axvline(printed_mean(method).iterations, color=COLOURS[method], ls="--", lw=1)
        panel.set(xscale="log", xlabel="iterations of a solved case", title=HEADS[limits])
        panel.set(yscale="log", ylim=(0.02, 110))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("share of the solved cases [%]")
    panels[0].plot([], [], color="black", ls="--", lw=1, label="mean printed in the paper")
    panels[0].legend(fontsize="small")
    panels[1].legend(fontsize="small")
    _save(figure, path)


def draw_convergence(studies: Sequence[Study], table: pl.DataFrame, path: Path) -> None:
    """The worst error over the iterations, of solved and of failed runs, limits ignored.

    The runs are the first solved and the first failed ones; they are stepped through once more,
    from targets whose last bit may differ, and drawn as what they are then.
    """
    settings = [
        (study, setting)
        for study in studies
        for setting in study.settings
        if setting.limits == "ignore" and setting.method.startswith(("enhanced", "original"))
    ]
    figure, panels = plt.subplots(
        2, 2, figsize=(11, 7), sharex=True, sharey=True, layout="constrained"
    )
    for panel, (study, setting) in zip(panels.flat, settings, strict=True):
        rows = table.filter(pl.col("setting") == setting.key).sort("target", "targets")
        for solved in (False, True):
            for row in rows.filter(pl.col("success") == solved).head(CURVES).iter_rows(named=True):
                _curve(panel, study, setting, row["targets"], row["target"])
        panel.axhline(1, color="black", lw=0.8, ls=":")
        panel.set(xscale="log", yscale="log", title=setting.method)
        panel.grid(alpha=0.3)
    for label, colour in (("solved", "tab:blue"), (f"not within {LONGEST}", "tab:red")):
        panels[0, 1].plot([], [], color=colour, label=label)
    panels[0, 1].legend()
    for panel in panels[1]:
        panel.set_xlabel("iteration")
    for panel in panels[:, 0]:
        panel.set_ylabel("worst error / tolerance")
    _save(figure, path)


def _curve(panel: Axes, study: Study, setting: Setting, targets: str, target: int) -> None:
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
    colour = "tab:blue" if stepper.status == ik.Status.SOLVED else "tab:red"
    panel.plot(np.arange(1, len(errors) + 1), errors, color=colour, lw=0.9, alpha=0.7)


def _save(figure: plt.Figure, path: Path) -> None:  # type: ignore[name-defined]
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
