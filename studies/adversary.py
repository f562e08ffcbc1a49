"""A search for reachable targets that hand-first misses: it climbs towards them.

Many climbers walk over all configurations within limits. A step moves some of a climber's motors,
a little or far, or puts them at a limit; the contacts of where it leads are solved at two
tolerances, and the climber stays there if that took more iterations (half of them: if it also made
the contacts tell less about the motors, by the smallest singular value). Who has not risen for a
while begins anew, somewhere at random or next to the hardest target so far. Whatever is missed is
kept, with its configuration. Two of the robots were made up for the purpose; seeds and robots are
none that anything was tuned on::

    python studies/adversary.py --minutes 5
    python studies/adversary.py --minutes 60 --seed 77 --out out/adversary

A run that is stopped goes on where it was: its state is written after every turn.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from hard_targets import contact_slopes, corners
from miss_causes import CAUSE_HEADS, CAUSES, causes
from missed import ROBOTS, TOLERANCES, load
from rich.console import Console
from runner import markdown_table, provenance, write_metrics, write_page
from runner.metric import rate_metric
from runner.results import code_version

import casadi_ik as ik
from casadi_ik.arrays import Array

CLIMBERS = 512
PATIENCE = 25
"""Steps without a rise before a climber begins anew."""

TURN = 20.0
"""Seconds of a robot's turn."""

CONDITION = 0.3
"""What a power of ten of the smallest singular value is worth, against iterations' e-folds."""

SHOWN = 20

INTRODUCTION = """
Climbers walk over the configurations within limits, towards targets whose solve takes many
iterations (half of them also towards badly conditioned ones). All targets are contacts of
configurations, hence reachable. *Missed:* the verdict, recomputed from the answer by forward
kinematics, finds a contact outside its tolerance or a limit passed. *Hardest:* the most iterations
and restarts a solve took.
"""


@dataclass
class Search:
    """The climbers of one robot, and what they have come upon."""

    q: Array
    score: Array
    waited: Array
    tried: int = 0
    seconds: float = 0.0
    most: dict[str, list[int]] = field(
        default_factory=lambda: {name: [0, 0] for name in TOLERANCES}
    )
    total: dict[str, int] = field(default_factory=lambda: dict.fromkeys(TOLERANCES, 0))
    missed: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def begun(cls, robot: ik.ArmHand, rng: np.random.Generator) -> Search:
        """Climbers at random, half of them with motors at limits."""
        q = np.concatenate([robot.random(rng, CLIMBERS // 2), corners(robot, rng, CLIMBERS // 2)])
        return cls(q, np.full(CLIMBERS, -np.inf), np.zeros(CLIMBERS))

    def step(self, robot: ik.ArmHand, rng: np.random.Generator) -> None:
        """Every climber makes one step."""
        q = _moved(robot, self.q, rng)
        points, normals = robot.contacts(q)
        iterations = np.zeros(CLIMBERS)
        lost = np.zeros(CLIMBERS, dtype=bool)
        for name, tolerance in TOLERANCES.items():
            batch = ik.Solver(robot, tolerance=tolerance).solve_batch(points, normals)
            iterations += batch.iterations
            self.most[name][0] = max(self.most[name][0], int(batch.iterations.max()))
            self.most[name][1] = max(self.most[name][1], int(batch.restarts.max()))
            self.total[name] += CLIMBERS
            for row in np.flatnonzero(~batch.success):
                lost[row] = True
                self.missed.append({"tolerance": name, "q": q[row].tolist()})
        score = np.log(iterations)
        half = slice(0, None, 2)
        score[half] -= CONDITION * np.log10(contact_slopes(robot, q[half]) + 1e-16)
        better = (score >= self.score) & ~lost
        self.waited = np.where(score > self.score, 0.0, self.waited + 1)
        self.q[better], self.score[better] = q[better], score[better]
        # What is missed is known by then: the search goes on elsewhere.
        again = np.flatnonzero(lost | (self.waited > PATIENCE))
        fresh = np.where(rng.random((len(again), 1)) < 0.5, robot.random(rng, len(again)), 0.0)
        hardest = self.q[rng.permutation(np.argsort(self.score)[-CLIMBERS // 8 :])]
        near = hardest[rng.integers(0, len(hardest), len(again))]
        self.q[again] = np.where(fresh.any(axis=1, keepdims=True), fresh, near)
        self.score[again], self.waited[again] = -np.inf, 0.0
        self.tried += CLIMBERS


def _moved(robot: ik.ArmHand, q: Array, rng: np.random.Generator) -> Array:
    """Steps from configurations (k, n): of some motors, of any size, some of them to a limit."""
    ranges = robot.upper - robot.lower
    size = 10.0 ** rng.uniform(-4, 0, (len(q), 1))
    some = rng.random(q.shape) < rng.uniform(0.1, 1, (len(q), 1))
    moved = q + np.where(some, rng.normal(0, 1, q.shape) * size * ranges, 0.0)
    snapped = rng.random(q.shape) < 0.05
    ends = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
    return np.clip(np.where(snapped, ends, moved), robot.lower, robot.upper)


def take_turn(name: str, options: argparse.Namespace, seconds: float) -> Search:
    """Go on with a robot's search for a while, from its file if there is one."""
    folder = options.out / name
    folder.mkdir(parents=True, exist_ok=True)
    robot = load(name, options.out / "robots")
    rng = np.random.default_rng([options.seed, len(name), *name.encode()])
    search = Search.begun(robot, rng)
    path = folder / "state.json"
    if path.exists():
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["code"] != code_version() or kept["seed"] != options.seed:
            raise SystemExit(f"{path}: made by other code or seed; use another folder")
        rng.bit_generator.state = kept["rng"]
        arrays = {key: np.array(kept["search"][key]) for key in ("q", "score", "waited")}
        search = Search(**(kept["search"] | arrays))
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        begin = time.perf_counter()
        search.step(robot, rng)
        search.seconds += time.perf_counter() - begin
    data = vars(search) | {key: getattr(search, key).tolist() for key in ("q", "score", "waited")}
    state = {"code": code_version(), "seed": options.seed, "rng": rng.bit_generator.state}
    part = path.with_suffix(".part")
    part.write_text(json.dumps(state | {"search": data}, default=float), encoding="utf-8")
    part.replace(path)
    return search


def write_report(options: argparse.Namespace) -> None:
    """Write the report on what all searches have come to."""
    rows, misses, metrics, codes = [], [], [], set[str]()
    why: list[list[str]] = []
    for name in ROBOTS:
        path = options.out / name / "state.json"
        if not path.exists():
            continue
        kept = json.loads(path.read_text(encoding="utf-8"))
        codes.add(kept["code"])
        search = kept["search"]
        for tolerance in TOLERANCES:
            lost = [miss for miss in search["missed"] if miss["tolerance"] == tolerance]
            count = search["total"][tolerance]
            most = search["most"][tolerance]
            text = [f"{count:,}", f"{len(lost)}", f"{most[0]:,}", f"{most[1]}"]
            rows.append([name.replace("_", " "), tolerance, f"{search['seconds'] / 60:.1f}", *text])
            metrics.append(rate_metric(f"adversary/{name}/{tolerance}", count - len(lost), count))
            misses += [(name, miss) for miss in lost]
            if lost:
                robot = load(name, options.out / "robots")
                found = causes(robot, TOLERANCES[tolerance], np.array([miss["q"] for miss in lost]))
                why.append([name.replace("_", " "), tolerance, *found])
    heads = [
        "robot",
        "tolerance",
        "minutes",
        "targets",
        "missed",
        "most iterations",
        "most restarts",
    ]
    shown = [
        [name, miss["tolerance"], " ".join(f"{x:.9g}" for x in miss["q"])]
        for name, miss in misses[:SHOWN]
    ]
    listed = markdown_table(["robot", "tolerance", "q"], shown) if shown else "None."
    body = [INTRODUCTION, markdown_table(heads, rows)]
    if why:
        body += ["## Why", CAUSES, markdown_table(["robot", "tolerance", *CAUSE_HEADS], why)]
    body += ["## Misses", listed]
    body += [
        "## Where this comes from",
        provenance({"adversary": ", ".join(sorted(codes)) or None}),
    ]
    write_page(
        "Search for targets that hand-first misses",
        [*body, f"Seed {options.seed}."],
        options.report,
    )
    write_metrics(metrics, options.report / "metrics.json")


def main(arguments: list[str] | None = None) -> None:
    """Search for some time, robot by robot in turns, and write the report."""
    parser = argparse.ArgumentParser(description="Search for targets that hand-first misses.")
    parser.add_argument("--minutes", type=float, default=1.0, help="how long to search")
    parser.add_argument("--seed", type=int, default=0, help="of everything random")
    parser.add_argument("--robot", action="append", choices=ROBOTS, help="only this one")
    parser.add_argument("--out", type=Path, default=Path("out/adversary"), help="state and misses")
    parser.add_argument("--report", type=Path, default=Path("out/adversary/report"), help="folder")
    options = parser.parse_args(arguments)
    console, robots = Console(stderr=True), options.robot or ROBOTS
    end = time.monotonic() + 60 * options.minutes
    turn = 0
    while (left := end - time.monotonic()) > 0:
        name = robots[turn % len(robots)]
        found = take_turn(name, options, min(TURN, left))
        hardest = max(most for most, _ in found.most.values())
        console.print(
            f"{left / 60:5.1f} min left  {name}: {found.tried:,} targets, "
            f"{len(found.missed)} missed, hardest {hardest:,} iterations",
            soft_wrap=True,
        )
        turn += 1
    write_report(options)


if __name__ == "__main__":
    main()
