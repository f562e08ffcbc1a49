"""The tables of the report, every cell a `Metric`."""

from __future__ import annotations

import math
from collections.abc import Iterator

import polars as pl
from runner import (
    Metric,
    Setting,
    Study,
    interval_text,
    markdown_table,
    mean_metric,
    rate_metric,
)

from qiu_table.paper import TABLE_I, Printed, printed_mean
from qiu_table.settings import LIMITS, METHODS

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
    """All objects together: the paper's means, ours with limits ignored and enforced."""
    heads = ["method", "paper: solved %", "iterations", "time [ms]"]
    for limits in LIMITS:
        heads += [f"{HEADS[limits]}: solved %", "iterations", "time [ms]", "n"]
    rows, metrics = [], []
    for method in METHODS:
        printed = printed_mean(method) if method in TABLE_I["cup"] else None
        cells = [f"`{method}`", *_printed(printed)]
        for limits in LIMITS:
            part = _part(table, method, limits)
            found = figures_of(f"table-one/{method}/{limits}", part)
            metrics += found
            cells += [
                interval_text(found[0], 3 if found[0].value > 99.9 else 1),
                interval_text(found[1], 1 if found[1].value < 20 else 0),
                _milliseconds(found[2]),
                f"{len(part):,}",
            ]
        rows.append(cells)
    return markdown_table(heads, rows), metrics


def by_object(table: pl.DataFrame) -> tuple[str, list[Metric]]:
    """Every object: the paper's cell, and ours with limits ignored and enforced."""
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
                found = figures_of(f"table-one/{method}/{limits}/{name}", part)
                metrics += found
                cells += [interval_text(found[0]), _plain(found[1])]
                cells += [_milliseconds(found[2])] if limits == "ignore" else []
            rows.append(cells)
    return markdown_table(heads, rows), metrics


def by_setting(table: pl.DataFrame, study: Study) -> tuple[str, list[Metric]]:
    """One line per setting that has results."""
    rows, metrics = [], []
    for setting, part, found in _found(table, study):
        metrics += found
        rows.append([setting.key, *_cells(found), f"{len(part):,}"])
    return markdown_table(["choice", "solved %", "iterations", "n"], rows), metrics


def readings(table: pl.DataFrame, study: Study) -> tuple[str, list[Metric]]:
    """One line per reading of the original methods, with its distance from the printed means.

    The distance is |ln(rate / printed rate)| + |ln(iterations / printed iterations)|; none if
    nothing was solved. A second table has the readings that suit both methods together best.
    """
    rows, metrics = [], []
    distances: dict[str, list[float]] = {}
    for setting, part, found in _found(table, study):
        metrics += found
        printed = printed_mean(setting.method)
        distance = "-"
        if found[0].value > 0:
            ratios = (found[0].value / printed.success, found[1].value / printed.iterations)
            apart = sum(abs(math.log(ratio)) for ratio in ratios)
            distance = f"{apart:.2f}"
            distances.setdefault(setting.key.partition(", ")[2], []).append(apart)
        rows.append([setting.key, *_cells(found), distance, f"{len(part):,}"])
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


def _found(
    table: pl.DataFrame, study: Study
) -> Iterator[tuple[Setting, pl.DataFrame, tuple[Metric, Metric, Metric]]]:
    for setting in study.settings:
        part = table.filter(pl.col("setting") == setting.key)
        if len(part):
            yield setting, part, figures_of(f"{study.name}/{setting.key}", part)


def _cells(found: tuple[Metric, Metric, Metric]) -> list[str]:
    return [interval_text(found[0]), interval_text(found[1], 0)]


def endings(table: pl.DataFrame) -> str:
    """How the solves of each setting ended, and the iterations that proofs of repetition saved."""
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
