"""Every arm of the catalogue with every hand: are reachable targets missed, and how long they take.

Targets are the contacts of configurations within limits: random ones, ones near limits, hands at
corners on arms near singular; all fingers and, of hands with more, three of them; at two
tolerances::

    python studies/any_robot.py --tour                 # every arm and every hand once or twice
    python studies/any_robot.py --jobs 2               # all pairs; kernels are compiled for each
    python studies/any_robot.py --arm panda --hand allegro_right --count 10000

A third of the pairs, another for every seed, is asked ten times as much. A run that is killed goes
on where it stopped. Misses are counted by kind; a file beside the report has them all. What
`any_robot_peers.py` found of other solvers, in that folder too, is shown as it is.
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import any_robot_peers
import joblib
import numpy as np
from any_robot_goals import HEADS, goal_rows, missed_parts
from catalogue_pair import KINDS, REFERENCE, TOLERANCES, Pair, try_pair
from closed_chain.report import figure, title
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn
from runner import (
    Metric,
    command,
    interval_text,
    markdown_table,
    program,
    provenance,
    rate_metric,
    write_metrics,
    write_page,
)
from runner.cluster import backend
from runner.results import code_version

from casadi_ik.files.shipped import shipped_names

ARMS, HANDS = shipped_names("arms"), shipped_names("hands")

TIMES = 10
"""How much more is asked of a third of the pairs."""

DARK = 4.5
"""Ratio from which on a cell is so dark that its number is white."""

INTRODUCTION = """
All targets are contacts of configurations within limits, hence reachable. *Missed:* the verdict,
which is recomputed from the answer by forward kinematics, finds a contact outside its tolerance or
a motor or joint outside its limits. *Ratio:* mean processor time of a target to that of a random
target of `{}` at the same tolerance, solved just before and after in the same process; *largest* of
a pair's kinds. *99 %* and *worst* are times of single targets of a batch [us] and hold whatever
else the machine did meanwhile. *First use:* processor time from `load_robot` with an empty cache to
the first single answer and the first batch, compilers included. Intervals are Wilson's, 95 %.
"""


def pairs(options: argparse.Namespace) -> Iterator[Pair]:
    """The pairs that are asked for."""
    for i, arm in enumerate(ARMS):
        for j, hand in enumerate(HANDS):
            toured = j == (i + options.seed) % len(HANDS)
            if options.tour and not toured:
                continue
            if arm in (options.arm or ARMS) and hand in (options.hand or HANDS):
                more = TIMES if (i + j) % 3 == options.seed % 3 else 1
                yield Pair(arm, hand, options.count * more, options.seed)


def _path(pair: Pair, folder: Path) -> Path:
    return folder / f"{pair.robot}-{pair.count}-{pair.seed}.json"


def solve(pair: Pair) -> tuple[Pair, dict[str, Any]]:
    """Try a pair; runs on any machine."""
    return pair, {"code": code_version(), **try_pair(pair)}


def run(options: argparse.Namespace) -> None:
    """Try the pairs that have not been."""
    todo = [pair for pair in pairs(options) if not _path(pair, options.out).exists()]
    # Mixed, so that a run that is stopped has seen something of every arm and every hand.
    todo.sort(key=lambda pair: zlib.crc32(pair.robot.encode()))
    if not todo:
        return
    options.out.mkdir(parents=True, exist_ok=True)
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with backend(options.jobs, options.dask), Progress(*columns, console=console) as progress:
        task = progress.add_task("pairs", total=len(todo))
        parallel = joblib.Parallel(return_as="generator_unordered")
        calls = (joblib.delayed(solve)(pair) for pair in todo)
        for done in parallel(calls):
            assert isinstance(done, tuple)
            pair, found = done
            path = _path(pair, options.out)
            part = path.with_suffix(".part")
            part.write_text(json.dumps(found), encoding="utf-8")
            part.replace(path)
            progress.advance(task)


def write_report(options: argparse.Namespace, run_by: str) -> None:
    """Write the report on the pairs asked for that there are."""
    paths = {pair: _path(pair, options.out) for pair in pairs(options)}
    found = {
        pair: json.loads(path.read_text(encoding="utf-8"))
        for pair, path in paths.items()
        if path.exists()
    }
    parts, metrics = [INTRODUCTION.format(REFERENCE)], list[Metric]()
    total = sum(cell["count"] for entry in found.values() for cell in entry["cells"].values())
    lost = sum(len(cell["missed"]) for entry in found.values() for cell in entry["cells"].values())
    parts += [f"{len(found)} pairs, {total:,} solves, {lost} missed."]
    left = [pair.robot for pair in paths if pair not in found]
    if left:
        parts += [f"Not run yet: {len(left)} of {len(paths)} pairs ({', '.join(left)})."]
    options.report.mkdir(parents=True, exist_ok=True)
    others = any_robot_peers.read(options.report)
    if found:
        _heat_map(found, options.report / "any_robot.png")
        parts += ["![time and misses of every pair](any_robot.png)"]
    for tolerance in TOLERANCES:
        parts += [f"## {tolerance}", _table(found, tolerance, metrics)]
    if found:
        rows = [*goal_rows(found), any_robot_peers.goal_row(others)]
        parts += ["## Goals", markdown_table(HEADS, rows)]
    parts += any_robot_peers.parts(others)
    parts += ["## Misses", *missed_parts(found, options.report / "misses.csv")]
    codes = ", ".join(sorted({entry["code"] for entry in found.values()}))
    parts += ["## Where this comes from", f"`{run_by}`", provenance({"any_robot": codes or None})]
    write_page("Every arm with every hand", [*parts, f"Seed {options.seed}."], options.report)
    write_metrics(metrics, options.report / "metrics.json")


def _table(found: dict[Pair, dict[str, Any]], tolerance: str, metrics: list[Metric]) -> str:
    rows = []
    for pair, entry in found.items():
        cells = {name: cell for name, cell in entry["cells"].items() if name.endswith(tolerance)}
        count = sum(cell["count"] for cell in cells.values())
        missed = sum(len(cell["missed"]) for cell in cells.values())
        rate = rate_metric(f"any_robot/{pair.robot}/{tolerance}", count - missed, count)
        metrics.append(rate)
        usual = cells.get(f"all fingers/{KINDS[0]}/{tolerance}", {})
        rows.append(
            [
                pair.robot,
                f"{entry['motors']}",
                f"{entry['fingers']}",
                f"{count:,}",
                f"{missed}",
                interval_text(rate, 3),
                f"{usual['ratio']:.1f}",
                f"{max(cell['ratio'] for cell in cells.values()):.1f}",
                f"{usual['mean']:.0f}",
                f"{usual['p99']:.0f}",
                f"{max(cell['max'] for cell in cells.values()):,.0f}",
                f"{entry['first use']:.0f}",
            ]
        )
    heads = ["robot", "motors of the hand", "fingers", "n", "missed", "solved %", "ratio, random"]
    heads += ["largest", "mean [us]", "99 %", "worst", "first use [s]"]
    return markdown_table(heads, rows)


def _heat_map(found: dict[Pair, dict[str, Any]], path: Path) -> None:
    """Ratio of times as colour, misses as numbers, at the finer tolerance."""
    arms = [arm for arm in ARMS if any(pair.arm == arm for pair in found)]
    hands = [hand for hand in HANDS if any(pair.hand == hand for pair in found)]
    ratios = np.full((len(arms), len(hands)), np.nan)
    finest = list(TOLERANCES)[-1]
    drawn, grid = figure(1, 1, 4.5 + 0.3 * len(hands), 3.4 + 0.25 * len(arms))
    axes = grid[0, 0]
    for pair, entry in found.items():
        i, j = arms.index(pair.arm), hands.index(pair.hand)
        ratios[i, j] = entry["cells"][f"all fingers/{KINDS[0]}/{finest}"]["ratio"]
        missed = sum(len(cell["missed"]) for cell in entry["cells"].values())
        text = f"{ratios[i, j]:.1f}" + (f"\n({missed})" if missed else "")
        color = "white" if ratios[i, j] > DARK else "#c0392b" if missed else "black"
        axes.text(j, i, text, ha="center", va="center", fontsize=7, color=color)
    image = axes.imshow(ratios, cmap="YlGnBu", vmin=0, vmax=8, alpha=0.7, aspect="auto")
    axes.set_xticks(range(len(hands)), hands, rotation=45, ha="right")
    axes.set_yticks(range(len(arms)), arms)
    bar = drawn.colorbar(image, ax=axes, shrink=0.6)
    bar.set_label("mean time of a target, ratio")
    title(axes, f"random targets, all fingers, {finest}; (missed of all kinds)", "hand", "arm")
    drawn.tight_layout()
    drawn.savefig(path)


def main(arguments: list[str] | None = None) -> None:
    """Try what has not been tried and write the report."""
    parser = argparse.ArgumentParser(description="Every arm of the catalogue with every hand.")
    parser.add_argument("--count", type=int, default=1000, help="targets of every kind")
    parser.add_argument("--seed", type=int, default=0, help="of targets, and whom more is asked of")
    parser.add_argument("--tour", action="store_true", help="one hand for every arm, by turns")
    parser.add_argument("--arm", action="append", choices=ARMS, help="only this one")
    parser.add_argument("--hand", action="append", choices=HANDS, help="only this one")
    parser.add_argument("--jobs", type=int, default=1, help="processes on this machine")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster instead")
    parser.add_argument("--out", type=Path, default=Path("out/any_robot"), help="results")
    parser.add_argument(
        "--report", type=Path, default=Path("out/any_robot/report"), help="folder of the report"
    )
    options = parser.parse_args(arguments)
    run(options)
    write_report(options, command(__file__, arguments))


if __name__ == "__main__":
    program(main)
