"""Study of reachability maps: time, open cells and wrong verdicts, for arms of every family.

For each arm a part is written to studies/results/reach/ARM.json, so that an interrupted run
continues with the next arm:

- `cells` exact palm poses around the arm: time and share of open cells;
- `forward` palm poses of random configurations, a tenth with joints at their limits: none may be
  UNREACHABLE;
- `solved` palm poses that are also solved: none that is UNREACHABLE within tolerance may be solved;
- a sampled map of the same cells in the same time, as other packages compute it: a cell is
  reachable if the palm of a random configuration is nearest to it.

    python studies/reach.py [--cells 1000000] [--forward 1000000] [--solved 20000]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import casadi_ik as ik
from casadi_ik.files.progress import progress
from casadi_ik.planning.reach.reach_map import ReachMap

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
    is_sampled = sampled_map(robot, grid, figures["seconds"], seed)
    is_unreachable, is_reachable = grid.status == "UNREACHABLE", grid.status == "REACHABLE"
    figures["sampled_unreachable"] = float(is_unreachable[is_sampled].mean())
    figures["missed_reachable"] = float((~is_sampled)[is_reachable].mean())
    return figures


def sampled_map(robot: ik.ArmHand, grid: ReachMap, seconds: float, seed: int) -> NDArray[np.bool_]:
    """Return (g, m) True for the cells nearest to the palm of a random configuration.

    Args:
        robot: The robot.
        grid: Map with the cells.
        seconds: Processor time of the sampling [s].
        seed: Seed of the configurations.
    """
    rng = np.random.default_rng(seed)
    lower, upper = grid.positions[0], grid.positions[-1]
    shape = np.array(grid.shape)
    spacing = (upper - lower) / (shape - 1)
    directions = grid.rotations.reshape(-1, 9).T
    is_sampled = np.zeros(grid.code.shape, dtype=bool)
    started = time.process_time()
    while time.process_time() - started < seconds:
        palms = robot.palm(robot.random(rng, 20_000))
        numbers = np.rint((palms[:, :3, 3] - lower) / spacing).astype(int)
        is_inside = ((numbers >= 0) & (numbers < shape)).all(axis=1)
        # The nearest rotation has the largest trace of the relative rotation.
        nearest = (palms[:, :3, :3].reshape(-1, 9) @ directions).argmax(axis=1)
        rows = np.ravel_multi_index(tuple(numbers[is_inside].T), grid.shape)
        is_sampled[rows, nearest[is_inside]] = True
    return is_sampled


TABLES = (
    {
        "arm": "name",
        "cells": "cells",
        "time [s]": "seconds",
        "open": "open",
        "forward": "forward",
        "forward UNREACHABLE": "forward_unreachable",
        "forward open": "forward_open",
    },
    {
        "arm": "name",
        "solved too": "solved_cells",
        "UNREACHABLE but solved": "unreachable_but_solved",
        "REACHABLE but not solved": "reachable_but_not_solved",
        "open within tolerance": "open_within_tolerance",
        "share sampled and UNREACHABLE": "sampled_unreachable",
        "share REACHABLE and not sampled": "missed_reachable",
    },
)
"""Columns of the tables of the report, with the names of their figures."""


def report(results: dict[str, dict[str, float]]) -> str:
    """Return the results as a sentence and Markdown tables."""
    total = {
        key: sum(figures[key] for figures in results.values())
        for key in ("cells", "open", "forward", "solved_cells")
    }
    # Parts of earlier revisions do not have this figure.
    tolerant = [f for f in results.values() if "open_within_tolerance" in f]
    open_share = sum(f["open_within_tolerance"] for f in tolerant) / max(
        sum(f["solved_cells"] for f in tolerant), 1
    )
    tolerance_result = (
        f"; within tolerance {open_share:.0%} of the palm poses of {len(tolerant)} of the arms "
        "are open"
        if tolerant
        else ""
    )
    wrong_keys = "forward_unreachable", "unreachable_but_solved", "reachable_but_not_solved"
    wrong = sum(figures[key] for figures in results.values() for key in wrong_keys)
    lines = [
        f"# Reachability maps of {len(results)} arms",
        "",
        f"**The maps of {len(results)} arms leave {total['open']:,} of {total['cells']:,} exact "
        f"palm poses open; {wrong:,} verdicts are wrong in {total['forward']:,} forward "
        f"configurations and {total['solved_cells']:,} solved palm poses{tolerance_result}.**",
        "",
        "Processor time of one core, not counting the compilation; seed 0. The sampled maps have "
        "the same cells and took the same time. Their shares refer to all sampled cells, and to "
        "all REACHABLE cells; a sampled cell is not an exact pose, so that a part of the first "
        "share is due to the size of the cells.",
    ]
    for columns in TABLES:
        lines += ["", "| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
        for name, figures in results.items():
            values = [_text({"name": name, **figures}.get(key)) for key in columns.values()]
            lines.append("| " + " | ".join(values) + " |")
    return "\n".join(lines) + "\n"


def _text(value: str | float | None) -> str:
    if value is None:
        return "not measured"
    if isinstance(value, str):
        return value
    return f"{value:,}" if isinstance(value, int) else f"{value:.2f}"


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
    (RESULTS / "report.md").write_text(report(results), encoding="utf-8")


if __name__ == "__main__":
    main()
