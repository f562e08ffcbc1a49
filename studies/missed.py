"""Is any reachable target missed? Millions of them, on five robots, at two tolerances.

Targets are the contacts of configurations within limits, so all of them are reachable: random
hands on random arms and on one arm, every motor at a corner or next to a limit, hands at corners on
arms near singular. Two of the robots were made up for this study, with limits of followers that are
narrower than their motors'::

    python studies/missed.py                                   # 10,000 targets of every kind
    python studies/missed.py --count 200000 --jobs 2           # ten millions in all
    python studies/missed.py --robot ar10 --set "near limits"  # a part of it

A run that is killed goes on where it stopped. Every miss is listed with its configuration.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from hard_targets import SETS
from miss_causes import CAUSE_HEADS, CAUSES, causes
from other_robots import MADE, made_robot
from rich.console import Console
from rich.progress import Progress
from runner import (
    Metric,
    interval_text,
    markdown_table,
    provenance,
    rate_metric,
    write_metrics,
    write_page,
)
from runner.results import code_version

import casadi_ik as ik

ROBOTS = ("kuka_lwr_barrett", "kuka_lwr_barrett_coupled", "ar10", "baxter_ar10", *MADE)
TOLERANCES = {
    "5 mm, 3 deg": ik.Tolerance(),
    "1e-6 m, 1e-6 rad": ik.Tolerance(1e-6, 1e-6),
}
SHOWN = 30
"""Misses listed in the report."""

INTRODUCTION = """
All targets are contacts of configurations within limits, hence reachable. *Missed:* the verdict,
which is recomputed from the answer by forward kinematics, finds a contact outside its tolerance or
a motor or joint outside its limits. *Hands on one arm:* the hand uniform, the arm at 60 % of its
range. *Corners:* every motor by itself at its lower limit, at its upper one, or anywhere, a third
each; *near limits:* within 1 deg (a slider: a fiftieth of its stroke) of them. *Near-singular
arms:* of 32 random arms the one whose palm Jacobian has the smallest singular value. Intervals are
Wilson's, 95 %. Times were taken while others were at work on the machine.
"""


@dataclass(frozen=True)
class Part:
    """Some targets of a kind, solved in one call."""

    robot: str
    kind: str
    number: int
    size: int
    seed: int
    folder: Path

    @property
    def path(self) -> Path:
        """Where its counts are."""
        return self.folder / self.robot / f"{self.kind}-{self.number:05d}.json"


def load(name: str, folder: Path) -> ik.ArmHand:
    """A shipped robot, or a made one whose files are put into a folder."""
    return ik.load_robot(made_robot(name, folder) if name in MADE else name)


def solve(part: Part) -> Path:
    """Solve a part at every tolerance and keep its counts."""
    robot = load(part.robot, part.folder / "robots")
    rng = np.random.default_rng([part.seed, zlib.crc32(part.kind.encode()), part.number])
    q = SETS[part.kind](robot, rng, part.size)
    points, normals = robot.contacts(q)
    found: dict[str, Any] = {}
    for name, tolerance in TOLERANCES.items():
        solver = ik.Solver(robot, tolerance=tolerance)
        solver.solve_batch(points[:1], normals[:1])
        start = time.perf_counter()
        batch = solver.solve_batch(points, normals)
        seconds = time.perf_counter() - start
        lost = np.flatnonzero(~batch.success)
        found[name] = {
            "count": part.size,
            "seconds": seconds,
            "restarted": int((batch.restarts > 0).sum()),
            "most restarts": int(batch.restarts.max()),
            "missed": [{"row": int(row), "q": q[row].tolist()} for row in lost],
        }
    part.path.parent.mkdir(parents=True, exist_ok=True)
    kept = part.path.with_suffix(".part")
    kept.write_text(json.dumps({"code": code_version(), "found": found}), encoding="utf-8")
    kept.replace(part.path)
    return part.path


def parts(options: argparse.Namespace) -> Iterator[Part]:
    """All parts, a little of everything first."""
    for number in range(-(-options.count // options.block)):
        for robot in options.robot or ROBOTS:
            for kind in options.set or SETS:
                yield Part(robot, kind, number, options.block, options.seed, options.out)


def write_report(options: argparse.Namespace) -> None:
    """Write the report on all parts there are."""
    rows, metrics, listed, codes = [], list[Metric](), [], set[str]()
    whole = 0
    for robot in ROBOTS:
        for kind in SETS:
            paths = sorted((options.out / robot).glob(f"{kind}-*.json"))
            kept = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
            codes |= {entry["code"] for entry in kept}
            for name in TOLERANCES if kept else ():
                found = [entry["found"][name] for entry in kept]
                count = sum(entry["count"] for entry in found)
                lost = [
                    (p.stem, miss)
                    for p, e in zip(paths, found, strict=True)
                    for miss in e["missed"]
                ]
                rate = rate_metric(f"missed/{robot}/{kind}/{name}", count - len(lost), count)
                whole += count
                metrics.append(rate)
                listed += [(robot, name, stem, miss) for stem, miss in lost]
                seconds = sum(entry["seconds"] for entry in found)
                restarted = sum(entry["restarted"] for entry in found)
                rows.append(
                    [
                        robot.replace("_", " "),
                        kind,
                        name,
                        f"{count:,}",
                        f"{len(lost)}",
                        interval_text(rate, 5),
                        f"{100 * restarted / count:.2f}",
                        f"{max(entry['most restarts'] for entry in found)}",
                        f"{1e6 * seconds / count:.0f}",
                    ]
                )
    heads = ["robot", "targets", "tolerance", "n", "missed", "solved %", "restarted %"]
    table = markdown_table([*heads, "most restarts", "mean time [us]"], rows)
    misses = [
        [robot, name, f"{stem}, row {miss['row']}", " ".join(f"{x:.9g}" for x in miss["q"])]
        for robot, name, stem, miss in listed[:SHOWN]
    ]
    total = f"{whole:,} solves, {len(listed)} missed."
    shown = markdown_table(["robot", "tolerance", "target", "q"], misses) if misses else "None."
    code = {"missed": ", ".join(sorted(codes)) or None}
    body = [INTRODUCTION, total, table]
    if listed:
        places = [(robot, name, miss["q"]) for robot, name, _, miss in listed]
        body += ["## Why", CAUSES, _why(places, options.out / "robots")]
    body += ["## Misses", shown, "## Where this comes from"]
    body += [provenance(code), f"Seed {options.seed}."]
    write_page("Reachable targets that hand-first misses", body, options.report)
    write_metrics(metrics, options.report / "metrics.json")


def _why(missed: Sequence[tuple[str, str, list[float]]], folder: Path) -> str:
    """A table of the causes, of misses by robot, tolerance and configuration."""
    rows = []
    for robot, name in dict.fromkeys((robot, name) for robot, name, _ in missed):
        q = np.array([one[2] for one in missed if one[:2] == (robot, name)])
        found = causes(load(robot, folder), TOLERANCES[name], q)
        rows.append([robot.replace("_", " "), name, *found])
    return markdown_table(["robot", "tolerance", *CAUSE_HEADS], rows)


def main(arguments: list[str] | None = None) -> None:
    """Solve what is missing and write the report."""
    parser = argparse.ArgumentParser(description="Reachable targets that hand-first misses.")
    parser.add_argument("--count", type=int, default=10_000, help="targets of every kind")
    parser.add_argument("--block", type=int, default=10_000, help="targets solved in one call")
    parser.add_argument("--seed", type=int, default=1, help="of the targets")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--robot", action="append", choices=ROBOTS, help="only this one")
    parser.add_argument("--set", action="append", choices=tuple(SETS), help="only these targets")
    parser.add_argument("--out", type=Path, default=Path("out/missed"), help="counts by block")
    parser.add_argument("--report", type=Path, default=Path("out/missed/report"), help="folder")
    options = parser.parse_args(arguments)
    todo = [part for part in parts(options) if not part.path.exists()]
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("blocks", total=len(todo))
        parallel = joblib.Parallel(n_jobs=options.jobs, return_as="generator_unordered")
        for _ in parallel(joblib.delayed(solve)(part) for part in todo):
            progress.advance(task)
    write_report(options)


if __name__ == "__main__":
    main()
