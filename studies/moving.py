"""Moving targets: followed cycle by cycle, along known paths, and as it was done before.

Random smooth paths (at rest first, then at up to half the velocity limits), targets that leap, and
the same paths solved target by target from the solution before. What is done stays done: a second
run with more paths adds to them::

    python studies/moving.py --count 100 --report studies/results/moving
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from moving_study.choosing import TEXT as CHOOSING
from moving_study.choosing import choice_table, chosen
from moving_study.goals import goal_table
from moving_study.lost import TEXT as LOST
from moving_study.lost import again, lost_table
from moving_study.one_path import (
    EVERY,
    LEAPS,
    PERIOD,
    SHARE,
    STEPS,
    TIMES,
    WAIT,
    calls,
    measure,
)
from moving_study.paths import smooth_path
from rich.console import Console
from runner import markdown_table, write_page
from runner.metric import Metric, mean_metric, median_metric, rate_metric, write_metrics

import casadi_ik as ik

ROBOTS = ("kuka_lwr_barrett", "panda+allegro_right", "ur5e+shadow")
TRACKS = 5
"""Paths that are also followed as known ones."""


def rows_of(robot: str, count: int, folder: Path, done: bool = False) -> list[dict[str, Any]]:
    """Figures of a robot's paths, those that are there already among them (or only those)."""
    place = folder / robot
    place.mkdir(parents=True, exist_ok=True)
    solver, rows = None, []
    for number in range(count):
        file = place / f"{number:04d}.json"
        if not file.exists():
            if done:
                break
            if solver is None:
                solver = ready(robot)
            part = file.with_suffix(".part")
            part.write_text(json.dumps(measure(solver, number)))
            part.replace(file)
        rows.append(json.loads(file.read_text()))
    return rows


def ready(robot: str) -> ik.Solver:
    """A solver whose kernels are compiled."""
    solver = ik.Solver(ik.load_robot(robot))
    measure(solver, 0)
    return solver


def spent(robot: str, count: int, folder: Path) -> list[float]:
    """CPU seconds of each call on some paths."""
    file = folder / robot / f"least_calls_{count}.json"
    if not file.exists():
        solver = ik.Solver(ik.load_robot(robot))
        file.write_text(json.dumps([one for i in range(count) for one in calls(solver, i)]))
    return json.loads(file.read_text())


def lost(robot: str, rows: list[dict[str, Any]], folder: Path) -> list[dict[str, Any]]:
    """The paths that are not wholly within tolerance, with other limits."""
    found, solver = [], None
    for number in [row["number"] for row in rows if row["met"] < 1]:
        file = folder / robot / f"lost_{number:04d}.json"
        if not file.exists():
            solver = solver or ik.Solver(ik.load_robot(robot))
            file.write_text(json.dumps(again(solver, number)))
        found.append(json.loads(file.read_text()))
    return found


def choices(robot: str, folder: Path) -> list[dict[str, Any]]:
    """Figures of choosing."""
    file = folder / robot / "choices.json"
    if not file.exists():
        file.write_text(json.dumps(chosen(ik.load_robot(robot))))
    return json.loads(file.read_text())


def tracked(robot: str, count: int, folder: Path) -> list[dict[str, float]]:
    """Time and errors of known paths."""
    file = folder / robot / f"tracks_{count}.json"
    if file.exists():
        return json.loads(file.read_text())
    solver, found = ik.Solver(ik.load_robot(robot)), []
    for number in range(count):
        path = smooth_path(solver.robot, number, STEPS, PERIOD, SHARE)
        grasps = [
            ik.Grasp({n: ik.Contact(*c) for n, *c in zip(solver.robot.fingers, *pair, strict=True)})
            for pair in zip(*solver.robot.contacts(path), strict=True)
        ]
        solver.track(grasps[:2], q0=path[0])
        begin = time.process_time()
        track = solver.track(grasps, q0=path[0])
        spent = time.process_time() - begin
        found.append({"time": spent, "met": float(track.success.mean()), "jumps": len(track.jumps)})
    file.write_text(json.dumps(found))
    return found


def figures(robot: str, rows: list[dict[str, Any]]) -> list[Metric]:
    """Of a robot, with their confidence."""

    def values(key: str) -> np.ndarray:
        return np.array([row[key] for row in rows], dtype=float)

    whole = int((values("met") == 1).sum())
    return [
        rate_metric(f"{robot}/paths within tolerance", whole, len(rows)),
        mean_metric(f"{robot}/cycles within tolerance", 100 * values("met"), "%", "higher"),
        median_metric(f"{robot}/largest error", 1e3 * values("error"), "mm"),
        median_metric(f"{robot}/cycle", 1e6 * values("median"), "us"),
        mean_metric(f"{robot}/leaps met", 100 * values("leaps_met"), "%", "higher"),
    ]


def tables(
    found: dict[str, list[dict[str, Any]]], tracks: dict[str, Any], times: dict[str, list[float]]
) -> list[str]:
    """The parts of the report."""
    cycle, limits, before, known = [], [], [], []
    for robot, rows in found.items():
        value = {key: np.array([row[key] for row in rows], dtype=float) for key in rows[0]}
        lost = value["met"] < 1
        cycle.append(
            [
                robot,
                str(len(rows)),
                f"{(~lost).sum()}",
                f"{100 * value['met'].mean():.2f}",
                f"{int(value['singular'][lost].sum())} of {int(lost.sum())}",
                f"{1e3 * np.median(value['error']):.2f}",
                f"{1e6 * np.median(value['median']):.0f}",
                *(f"{1e6 * np.percentile(times[robot], part):.0f}" for part in (50, 99)),
            ]
        )
        limits.append(
            [
                robot,
                *(
                    f"{value[f'{w}_{k}'].max():.6f}"
                    for w in ("smooth", "leaping")
                    for k in ("velocity", "acceleration")
                ),
                f"{100 * value['leaps_met'].mean():.0f}",
            ]
        )
        before.append(
            [
                robot,
                f"{np.degrees(value['own_step'].max()):.2f}",
                f"{np.degrees(value['anew_step'].max()):.1f}",
                f"{np.degrees(np.median(value['anew_step'])):.1f}",
                f"{np.degrees(EVERY * value['smooth_step'].max()):.2f}",
                f"{1e6 * np.median(value['anew_time']):.0f}",
            ]
        )
        some = tracks[robot]
        known.append(
            [
                robot,
                str(len(some)),
                f"{np.median([one['time'] for one in some]):.2f}",
                f"{100 * np.mean([one['met'] for one in some]):.1f}",
                str(sum(one["jumps"] for one in some)),
            ]
        )
    return [
        f"Random smooth paths of {STEPS} cycles of {1e3 * PERIOD:g} ms, from rest, at up to "
        f"{100 * SHARE:g} % of the velocity limits, seeds 0 on. Default tolerances (5 mm, 3 deg) "
        "and accelerations (full speed in a quarter of a second). Times are from Python; the "
        "machine was busy with other work, so beside the median of what a cycle takes there is the "
        "processor's time of single calls on some of the paths, the least of "
        f"{TIMES} runs of each call.",
        "## Followed cycle by cycle",
        markdown_table(
            [
                "robot",
                "paths",
                "wholly within tolerance",
                "cycles within %",
                "lost near a singular arm",
                "largest error, median [mm]",
                "cycle [us]",
                "CPU [us]",
                "CPU p99 [us]",
            ],
            cycle,
        ),
        "*Lost near a singular arm*: of the paths that are not wholly within tolerance, those "
        "whose own postures had a smallest singular value of the arm below 0.05 within the 300 "
        "cycles before; the postures there are the path's own, which the follower does not know, "
        "and from others the motors would have to be faster. See also below.",
        "## Limits",
        f"Largest values as parts of the limits, on the smooth paths and on {LEAPS} targets a path "
        f"that leap and then wait {WAIT} cycles.",
        markdown_table(
            [
                "robot",
                "velocity",
                "acceleration",
                "velocity, leaping",
                "acceleration, leaping",
                "leaps met %",
            ],
            limits,
        ),
        "## Before and after",
        f"Every {EVERY}th target solved anew from the solution before (`solve(q0=previous)`): the "
        "largest step of a motor between two of them; the follower's is its largest step of a "
        f"cycle times {EVERY}.",
        markdown_table(
            [
                "robot",
                "the path's own step [deg]",
                "solved anew, largest [deg]",
                "median of paths [deg]",
                "followed, at most [deg]",
                "a solve [us]",
            ],
            before,
        ),
        "## Known paths",
        markdown_table(
            ["robot", "paths", f"{STEPS} grasps [s CPU]", "grasps met %", "jumps"], known
        ),
    ]


def main(arguments: list[str] | None = None) -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description="Targets that move.")
    parser.add_argument("--count", type=int, default=100, help="paths of each robot")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--done", action="store_true", help="report the paths that are done")
    parser.add_argument("--tracks", type=int, default=TRACKS, help="known paths of each robot")
    parser.add_argument("--folder", type=Path, default=Path("out/moving"), help="of what is done")
    parser.add_argument("--report", type=Path, default=Path("out/moving/report"), help="folder")
    options = parser.parse_args(arguments)
    found, tracks, times, missed, taken = {}, {}, {}, {}, {}
    for robot in options.robots:
        found[robot] = rows_of(robot, options.count, options.folder, options.done)
        tracks[robot] = tracked(robot, options.tracks, options.folder)
        times[robot] = spent(robot, options.tracks, options.folder)
        missed[robot] = lost(robot, found[robot], options.folder)
        taken[robot] = choices(robot, options.folder)
        Console().print(robot, "done")
    parts = [
        *tables(found, tracks, times),
        "## Paths that are lost",
        LOST,
        lost_table(missed, found),
        "## Choosing",
        CHOOSING,
        choice_table(taken),
        "## Goals",
        "From the figures above; times are the processor's, of one thread.",
        goal_table(found, times, tracks, taken, missed),
    ]
    write_page("Moving targets", parts, options.report)
    metrics = [one for robot, rows in found.items() for one in figures(robot, rows)]
    write_metrics(metrics, options.report / "metrics.json")


if __name__ == "__main__":
    main()
