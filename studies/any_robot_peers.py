"""Other solvers on pairs of the catalogue: the same targets, restarts and verdict as ours.

    pip install -e ".[peers,studies]"
    python studies/any_robot_peers.py --targets 64 --report studies/results/any_robot

Targets are the random hands of `any_robot.py` with all their fingers. What is found goes into a
file beside the report of that study, which shows it; a run that is killed goes on with the
pair where it stopped. Set up and restarted as in `peers.py`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from catalogue_pair import KINDS, LATE, MOVED, TOLERANCES, Pair, targets
from peers import SETTINGS, STARTS, Run, Targets, installed, run_peer
from runner import markdown_table, program
from runner.results import code_version

import casadi_ik as ik
from casadi_ik.logs.write.provenance import machine, package_versions
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import judge

PAIRS = (
    ("iiwa14", "allegro_right"),
    ("fr3", "allegro_right"),
    ("panda", "leap"),
    ("ur5e", "shadow"),
    ("xarm7", "ability"),
    ("kinova_gen3", "inspire_rh56"),
)

PEERS = ("placo", "Pink", "mink")

PACKAGES = ("placo", "pin-pink", "mink", "mujoco", "pin", "qpsolvers", "daqp", "numpy")

BATCH, LONG = "ours, in a batch", "ours, more in a batch"
SINGLE = "ours, one at a time (`Solver.fast`)"

MORE = 2000
"""Targets of ours, the first of which are the peers': what a hundred solve says little."""

WARM = 20
"""Calls before times of single ones are taken."""

FILE = "peers.json"

WANTED = 40.0
"""How many times as long as we the best peer is to take."""

SAME = 1e-9
"""Largest difference of a peer's kinematics to ours [m, and of unit vectors]."""

EXPLAINED = """
{count} random hands of every pair, all fingers; one start from home, then evenly spread ones, at
most {starts}, until the contacts are met, the same for all three. Ours on the same targets one at a
time, and in a batch (of {more:,}, each again and again) before and after every peer, in one
process; *more* is a batch of {more:,} others, these the first of them: a rare target that takes all
rounds weighs on its mean. Times are of the processor in one thread, Python loops included, as users
run them. *Solved:* by our verdict. *Ratio:* of the mean to ours in a batch, and to ours one at a
time. Joints that follow others are hard constraints of the peers' programs; their forward
kinematics equal ours within {apart:.0e}. Damping, caps and the patience of restarts were chosen on
other targets (seed 1). Code {code}; {packages}; {machine}.
"""


def measure(pair: Pair, names: list[str], restarts: int) -> dict[str, Any]:
    """All solvers on a pair.

    Returns:
        "code", "packages", "machine", "apart" (largest difference of forward kinematics) and
        "cells": by tolerance and solver a dictionary of "count", "solved", "first" [0, 1], "mean",
        "median", "p99" [us] and "ratio".
    """
    robot = ik.load_robot(pair.robot)
    many = Pair(pair.arm, pair.hand, max(MORE, pair.count), pair.seed)
    _, points, normals = targets(robot, many, KINDS[0], list(range(len(robot.fingers))))
    asked = points[: pair.count], normals[: pair.count]
    apart = max(difference(name, robot) for name in names)
    if apart > SAME:
        raise SystemExit(f"{pair.robot}: a peer's kinematics differ from ours by {apart:.1e}")
    off = np.random.default_rng(pair.seed).normal(0, MOVED, (LATE, *points.shape[1:]))
    cells = {}
    for name, tolerance in TOLERANCES.items():
        solver = ik.Solver(robot, tolerance=tolerance)
        solver.solve_batch(points, normals)
        solver.solve_batch(points[:LATE] + off, normals[:LATE])
        copies = len(points) // pair.count, 1, 1
        again = np.tile(asked[0], copies), np.tile(asked[1], copies)
        runs, ours = dict[str, Run](), [_batch(solver, again)]
        runs[SINGLE] = _single(solver, asked, tolerance)
        for peer in names:
            runs[peer] = run_peer(peer, robot, asked, tolerance, restarts)
            ours.append(_batch(solver, again))
        spent = np.concatenate([run.times for run in ours])
        same = Run(ours[0].solved, ours[0].first, spent)
        runs = {BATCH: same, LONG: _batch(solver, (points, normals)), **runs}
        cells[name] = {
            solver: {
                "count": len(points) if solver == LONG else pair.count,
                "solved": run.solved,
                "first": None if np.isnan(run.first) else run.first,
                "mean": 1e6 * float(run.times.mean()),
                "median": 1e6 * float(np.median(run.times)),
                "p99": 1e6 * float(np.quantile(run.times, 0.99)),
                "ratio": float(run.times.mean() / spent.mean()),
                "ratio, single": float(run.times.mean() / runs[SINGLE].times.mean()),
            }
            for solver, run in runs.items()
        }
    return {
        "code": code_version(),
        "packages": package_versions(PACKAGES),
        "machine": machine()["processor"],
        "apart": apart,
        "cells": cells,
    }


def _batch(solver: ik.Solver, asked: Targets) -> Run:
    """All targets in one call; their times are in proportion to what the batch says of each."""
    begun = time.thread_time()
    batch = solver.solve_batch(*asked)
    spent = time.thread_time() - begun
    first = batch.success & (batch.restarts == 0)
    return Run(
        float(batch.success.mean()), float(first.mean()), batch.time * (spent / batch.time.sum())
    )


def _single(solver: ik.Solver, asked: Targets, tolerance: ik.Tolerance) -> Run:
    """One call a target, as for a loop that cannot wait."""
    fast, robot = solver.fast(), solver.robot
    count = len(asked[0])
    q, times = np.empty((count, len(robot.home))), np.empty(count)
    for points, normals in zip(*(array[:WARM] for array in asked), strict=True):
        fast(points, normals, robot.home)
    for row, (points, normals) in enumerate(zip(*asked, strict=True)):
        begun = time.thread_time()
        q[row], _ = fast(points, normals, robot.home)
        times[row] = time.thread_time() - begun
    verdict = judge(robot, Problems(*asked, tolerance, True), q)
    solved = float((verdict.ok.all(axis=1) & verdict.limits_ok).mean())
    return Run(solved, np.nan, times)


def difference(name: str, robot: ik.ArmHand) -> float:
    """How far a peer's contacts are from ours, on 20 random postures [m, and of unit vectors]."""
    peer = SETTINGS[name].make(robot, True)
    q = robot.random(np.random.default_rng(0), 20)
    here: Targets = robot.contacts(q)
    there = [np.stack(parts) for parts in zip(*(peer.contacts(one) for one in q), strict=True)]
    return max(float(np.abs(a - b).max()) for a, b in zip(here, there, strict=True))


def read(folder: Path) -> dict[str, Any]:
    """What was found: "count", "seed", "restarts" and "pairs" by robot; empty if nothing."""
    path = folder / FILE
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def run(options: argparse.Namespace) -> None:
    """Measure the pairs that have not been, and keep each as soon as it is done."""
    asked = {"count": options.targets, "seed": options.seed, "restarts": options.restarts}
    found = read(options.report)
    if {key: found.get(key) for key in asked} != asked:
        found = {**asked, "pairs": {}}
    options.report.mkdir(parents=True, exist_ok=True)
    path = options.report / FILE
    for arm, hand in PAIRS:
        pair = Pair(arm, hand, options.targets, options.seed)
        if pair.robot in found["pairs"] or pair.robot not in (options.pair or [pair.robot]):
            continue
        found["pairs"][pair.robot] = measure(pair, options.peers, options.restarts)
        part = path.with_suffix(".part")
        part.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        part.replace(path)
        print(markdown_table(*table({**found, "pairs": {pair.robot: found["pairs"][pair.robot]}})))


def table(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of all pairs, tolerances and solvers."""
    heads = ["robot", "tolerance", "solver", "n", "solved %", "first start %", "mean [us]"]
    heads += ["median", "99 %", "ratio", "to one at a time"]
    rows = [
        [
            robot,
            tolerance,
            solver,
            f"{cell['count']:,}",
            f"{100 * cell['solved']:.5g}",
            "" if cell["first"] is None else f"{100 * cell['first']:.0f}",
            *(f"{cell[key]:,.0f}" for key in ("mean", "median", "p99")),
            f"{cell['ratio']:,.0f}" if cell["ratio"] > WANTED else f"{cell['ratio']:.2g}",
            f"{cell['ratio, single']:.3g}",
        ]
        for robot, entry in found["pairs"].items()
        for tolerance, cells in entry["cells"].items()
        for solver, cell in cells.items()
    ]
    return heads, rows


def parts(found: dict[str, Any]) -> list[str]:
    """The part of the report."""
    heads = ["## Other solvers on six of the pairs"]
    if not found:
        return [*heads, "Not run yet: `python studies/any_robot_peers.py` (extra `peers`)."]
    entries = found["pairs"].values()
    text = EXPLAINED.format(
        count=found["count"],
        starts=found["restarts"],
        more=MORE,
        apart=max(entry["apart"] for entry in entries),
        code=_all(f"`{entry['code']}`" for entry in entries),
        packages=_all(", ".join(f"{n} {v}" for n, v in e["packages"].items()) for e in entries),
        machine=_all(entry["machine"] for entry in entries),
    )
    left = [f"{arm}+{hand}" for arm, hand in PAIRS if f"{arm}+{hand}" not in found["pairs"]]
    named = {name for e in entries for cells in e["cells"].values() for name in cells}
    left += [name for name in PEERS if name not in named]
    tail = [f"Not run yet: {', '.join(left)}."] if left else []
    return [*heads, text, markdown_table(*table(found)), *tail]


def goal_row(found: dict[str, Any]) -> list[str]:
    """Row of the table of goals: the quickest peer of every pair, whatever it solved."""
    name, wanted = "best peer's mean to ours, in a batch", f">= {WANTED:g}"
    ratios = {
        f"{robot}, {peer}, {tolerance}": cells[peer]["ratio"]
        for robot, entry in found.get("pairs", {}).items()
        for tolerance, cells in entry["cells"].items()
        for peer in cells
        if peer in PEERS
    }
    if not ratios:
        return [name, wanted, "not run yet", "-", ""]
    least = min(ratios, key=lambda key: ratios[key])
    kept = {robot for robot in found["pairs"] if _least(ratios, robot) >= WANTED}
    text = f"{len(kept)} of {len(found['pairs'])} pairs; least {ratios[least]:.3g} ({least})"
    whole = len(kept) == len(found["pairs"])
    return [name, wanted, text, "yes" if whole else "**no**", "" if whole else "see its table"]


def _least(ratios: dict[str, float], robot: str) -> float:
    return min(ratio for key, ratio in ratios.items() if key.startswith(f"{robot},"))


def _all(texts: Any) -> str:
    return "; ".join(sorted(set(texts)))


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing."""
    parser = argparse.ArgumentParser(description="Other solvers on pairs of the catalogue.")
    parser.add_argument("--targets", type=int, default=64, help="of every pair")
    parser.add_argument("--seed", type=int, default=0, help="of the targets")
    parser.add_argument("--restarts", type=int, default=STARTS, help="of a peer for a target")
    parser.add_argument("--pair", action="append", help="only this one", metavar="ARM+HAND")
    here = [name for name in installed() if name in PEERS]
    parser.add_argument("--peers", nargs="+", default=here, choices=PEERS)
    parser.add_argument(
        "--report", type=Path, default=Path("out/any_robot/report"), help=f"folder of {FILE}"
    )
    run(parser.parse_args(arguments))


if __name__ == "__main__":
    program(main)
