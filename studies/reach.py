"""Study of reachability maps: time, open cells and wrong verdicts, for arms of every family.

For each arm a part is written to studies/results/reach/ARM.json, so that an interrupted run
continues with the next arm:

- `cells` exact palm poses around the arm: time and share of open cells;
- `forward` palm poses of random configurations, a tenth with joints at their limits: none may be
  UNREACHABLE;
- `solved` palm poses that are also solved: none that is UNREACHABLE within tolerance may be solved.

    python studies/reach.py [--cells 1000000] [--forward 1000000] [--solved 20000]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

import casadi_ik as ik
from casadi_ik.files.progress import progress

ARMS = ("ur5e", "irb140", "jaco2", "kuka_lwr4", "iiwa14", "panda", "xarm7")
"""Arms of every family with an exact closed form."""

RESULTS = Path(__file__).parent / "results" / "reach"
CHUNK = 100_000
"""Number of palm poses of configurations that are decided together."""


def measure(name: str, cells: int, forward: int, solved: int, seed: int) -> dict[str, float]:
    """Return the figures of one arm."""
    robot = ik.load_robot(name)
    solver = ik.Solver(robot)
    solver.reach_map(robot.palm(robot.random(np.random.default_rng(1), 64)))  # compiles
    palms = robot.palm(robot.random(np.random.default_rng(0), 2000))[:, :3, 3]
    box = palms.min(axis=0), palms.max(axis=0)
    orientations = 32
    volume = float(np.prod(box[1] - box[0]))
    resolution = (volume * orientations / cells) ** (1 / 3)
    started = time.process_time()
    grid = solver.reach_map(box, orientations, resolution, keep_q=False)
    figures: dict[str, float] = {"cells": grid.code.size}
    figures["seconds"] = time.process_time() - started
    figures |= {key.lower(): value for key, value in grid.counts.items()}
    rng = np.random.default_rng(seed)
    figures |= {"forward": forward, "forward_unreachable": 0, "forward_open": 0}
    with progress(forward) as advance:
        for first in range(0, forward, CHUNK):
            count = min(CHUNK, forward - first)
            q = robot.random(rng, count)
            at_limit = (rng.random(q.shape) < 0.2) & (np.arange(count)[:, None] % 10 == 0)
            q = np.where(at_limit, robot.upper, q)
            counts = solver.reach_map(robot.palm(q), keep_q=False).counts
            figures["forward_unreachable"] += counts["UNREACHABLE"]
            figures["forward_open"] += counts["OPEN"]
            advance(count)
    rows = rng.permutation(len(grid.positions))[: -(-solved // orientations)]
    poses = np.concatenate([grid.palms(row) for row in rows.tolist()])[:solved]
    batch = solver.solve_palms(poses, robot.home)
    tolerant = solver.reach_map(poses, meaning="within tolerance", keep_q=False).status[:, 0]
    exact = grid.status[rows].ravel()[:solved]
    figures["solved_cells"] = len(poses)
    figures["unreachable_but_solved"] = int((batch.success & (tolerant == "UNREACHABLE")).sum())
    figures["reachable_but_not_solved"] = int((~batch.success & (exact == "REACHABLE")).sum())
    figures["open_within_tolerance"] = int((tolerant == "OPEN").sum())
    return figures


def report(results: dict[str, dict[str, float]]) -> str:
    """Return the results as a Markdown table."""
    columns = (
        "arm",
        "cells",
        "time [s]",
        "open",
        "forward",
        "forward UNREACHABLE",
        "forward open",
        "solved too",
        "UNREACHABLE but solved",
        "REACHABLE but not solved",
        "open within tolerance",
    )
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for name, f in results.items():
        values = (
            name,
            f"{f['cells']:,}",
            f"{f['seconds']:.2f}",
            f"{f['open']:,}",
            f"{f['forward']:,}",
            f"{f['forward_unreachable']:,}",
            f"{f['forward_open']:,}",
            f"{f['solved_cells']:,}",
            f"{f['unreachable_but_solved']:,}",
            f"{f['reachable_but_not_solved']:,}",
            f"{f['open_within_tolerance']:,}",
        )
        lines.append("| " + " | ".join(values) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure the arms that have no part yet, and write the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("arms", nargs="*", default=ARMS)
    parser.add_argument("--cells", type=int, default=1_000_000)
    parser.add_argument("--forward", type=int, default=1_000_000)
    parser.add_argument("--solved", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    for name in args.arms:
        part = RESULTS / f"{name}.json"
        if not part.exists():
            figures = measure(name, args.cells, args.forward, args.solved, args.seed)
            part.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    results = {
        name: json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
        for name in ARMS
        if (RESULTS / f"{name}.json").exists()
    }
    text = "# Reachability maps\n\nProcessor time of one core; seed 0.\n\n" + report(results)
    (RESULTS / "report.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
