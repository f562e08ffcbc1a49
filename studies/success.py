"""Does `hand-first` solve everything that can be solved? Every miss is listed, to be rerun.

Targets are the contacts of configurations within limits, so all of them are reachable: the 12
shipped grasps on random arms, uniformly random hands, joints within a degree of their limits, arms
near singular; each at 5 mm / 3 deg and at 1e-6 m / 1e-6 rad, within limits::

    python studies/success.py                                     # 500 targets per set
    python studies/success.py --full --jobs 2                     # 10,000
    python studies/success.py --rerun "near limits" 4711          # one target, with a diagnosis
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
import targets
from rich.console import Console
from runner import (
    Metric,
    Setting,
    Study,
    TargetSet,
    add_run_arguments,
    code_of,
    interval_text,
    markdown_table,
    mean_metric,
    median_metric,
    program,
    provenance,
    rate_metric,
    read_results,
    run_from,
    write_metrics,
    write_page,
)
from runner.study import robot_of

import casadi_ik as ik

FULL = 10_000
SHOWN = 100
"""Misses listed per setting and set."""

SETTINGS = (
    Setting("5 mm, 3 deg", "hand-first"),
    Setting("1e-6 m, 1e-6 rad", "hand-first", tolerance=(1e-6, 1e-6)),
)
HARD = {
    "random hands": targets.any_configuration,
    "near limits": targets.near_limits,
    "near-singular arms": targets.singular,
    "grasps on near-singular arms": targets.shipped_hands_on_singular_arms,
    "near limits on near-singular arms": targets.near_limits_on_singular_arms,
}

INTRODUCTION = """
All targets are contacts of configurations within limits, hence reachable. *Solved:* every contact
within the tolerance and every actuator and joint within its limits, recomputed from the answer by
forward kinematics. *Grasps:* the hand posture of a shipped grasp on an arm uniform within its
limits. *Random hands:* every actuator uniform. *Near limits:* every actuator by itself within 1 deg
of its lower limit, within 1 deg of its upper one, or anywhere, a third each. *Near-singular arms:*
elbow straight, shoulder aligned, wrist aligned, or all three, off by 1e-3 to 1e-9 rad. Intervals
are 95 % confidence (Wilson's for rates). Times were taken while others were at work on the machine.
"""


def study(count: int, seed: int, block: int) -> Study:
    """The study."""
    sets = [
        TargetSet(name, partial(targets.grasp_arms, grasp=name))
        for name in ik.shipped_grasps("kuka_lwr_barrett")
    ]
    sets += [TargetSet(name, made) for name, made in HARD.items()]
    robot = "kuka_lwr_barrett"
    return Study("success", robot, tuple(sets), SETTINGS, count, seed, block)


def write_report(whole: Study, results: Path, folder: Path) -> None:
    """Write the report on what there is."""
    table = read_results(whole, results)
    parts, metrics = [INTRODUCTION], []
    for setting in whole.settings:
        parts += [f"## {setting.key}", _table(whole, setting, table, metrics)]
    parts += ["## Misses", _misses(whole, table), "## Where this comes from"]
    parts += [provenance({whole.name: code_of(results)}), f"Seed {whole.seed}."]
    write_page("Success of hand-first on targets that can be reached", parts, folder)
    write_metrics(metrics, folder / "metrics.json")


def _table(whole: Study, setting: Setting, table: pl.DataFrame, metrics: list[Metric]) -> str:
    rows = []
    for group in (*whole.sets, None):
        part = table.filter(pl.col("setting") == setting.key)
        part = part if group is None else part.filter(pl.col("targets") == group.key)
        name = "all" if group is None else group.key
        key = f"success/{setting.key}/{name}"
        rate = rate_metric(f"{key}/success", int(part["success"].sum()), len(part))
        iterations = mean_metric(f"{key}/iterations", part["iterations"], "1")
        time = median_metric(f"{key}/time", 1e6 * part["time"], "us")
        metrics += [rate, iterations, time]
        slow = 1e6 * np.quantile(part["time"].to_numpy(), 0.99)
        rows.append(
            [
                name.replace("_", " "),
                f"{len(part):,}",
                f"{len(part) - int(part['success'].sum())}",
                interval_text(rate, 3),
                interval_text(iterations),
                interval_text(time, 0),
                f"{slow:.0f}",
            ]
        )
    heads = [
        "targets",
        "n",
        "missed",
        "solved %",
        "iterations",
        "median time [us]",
        "99th percentile",
    ]
    return markdown_table(heads, rows)


def _misses(whole: Study, table: pl.DataFrame) -> str:
    missed = table.filter(~pl.col("success")).sort("setting", "targets", "target")
    if not len(missed):
        return "None."
    rows = [
        [
            row["setting"],
            row["targets"],
            str(row["target"]),
            row["status"],
            f'`python studies/success.py --seed {whole.seed} --rerun "{row["targets"]}" '
            f"{row['target']}`",
        ]
        for row in missed.head(SHOWN).iter_rows(named=True)
    ]
    more = f"\nand {len(missed) - SHOWN} more.\n" if len(missed) > SHOWN else ""
    return markdown_table(["tolerance", "targets", "number", "status", "again"], rows) + more


def rerun(whole: Study, key: str, target: int) -> None:
    """Solve one target once more at both tolerances, and say why not if not."""
    group = next(group for group in whole.sets if group.key == key)
    number, row = divmod(target, whole.block)
    points, normals = robot_of(whole.robot).contacts(whole.configurations(group, number))
    for setting in whole.settings:
        # The whole block: a target's random numbers are those of its place in it.
        solver = whole.solver(setting)
        status = solver.solve_batch(points, normals, seed=whole.seed).status_names[row]
        diagnosed = solver.solve_batch(points, normals, seed=whole.seed, diagnose=True)
        why = diagnosed.diagnoses[row]
        Console().print(setting.key, status, "" if why is None else why.reason.name, sep=": ")


def main(arguments: list[str] | None = None) -> None:
    """Run what is missing and write the report, or solve one target once more."""
    parser = argparse.ArgumentParser(description="Success of hand-first on reachable targets.")
    parser.add_argument("--count", type=int, default=500, help="targets per set")
    parser.add_argument(
        "--full", dest="count", action="store_const", const=FULL, help=f"--count {FULL}"
    )
    parser.add_argument("--seed", type=int, default=4242, help="of targets and method")
    parser.add_argument("--block", type=int, default=500, help="targets per file of results")
    parser.add_argument("--rerun", nargs=2, metavar=("SET", "NUMBER"), help="one target again")
    parser.add_argument(
        "--report", type=Path, default=Path("out/success/report"), help="folder of the report"
    )
    add_run_arguments(parser, "out/success")
    options = parser.parse_args(arguments)
    asked = study(options.count, options.seed, options.block)
    if options.rerun:
        rerun(asked, options.rerun[0], int(options.rerun[1]))
        return
    run_from(options, asked)
    write_report(asked, options.out / asked.name, options.report)


if __name__ == "__main__":
    program(main)
