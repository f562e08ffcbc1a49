"""Is a proof of impossibility ever wrong, and how much of the impossible is proved?

Reachable targets are contacts of random hands and arms, at and near limits, moved by up to 99 % of
the tolerance. A proof of one of them would have to refute every box of hand postures that holds the
posture it was made from: these boxes are all looked at. Impossible targets are those that many
searches do not solve even with 20 mm and 10 deg more than the tolerance::

    nice python studies/proofs.py                                  # 2,000 targets of every kind
    nice python studies/proofs.py --count 50000 --impossible 100
    nice python studies/proofs.py --robot kuka_lwr_barrett --report studies/results/proofs

A run that is killed goes on where it stopped. Every false proof is listed with its configuration.
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from impossible_targets import CLASSES, classes_of, impossible, rigidly_moved
from missed_targets import ROBOTS as SHIPPED_AND_MADE
from missed_targets import load
from runner.parts import read_parts, run_parts
from runner.report import (
    Metric,
    command,
    markdown_table,
    median_metric,
    program,
    publish,
    rate_metric,
)
from samplers import corners, near_limits, random_hands, singular_arms

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.prove import Prover

ROBOTS = (*SHIPPED_AND_MADE, "ur5e+shadow")

BLOCK = 2000
"""Reachable targets that are made with one seed."""

MIN_VIOLATION = 20.0, 10.0
"""What is impossible is so by this much more than the tolerance [mm, deg], as far as not asked."""

BLIND = np.deg2rad(
    [[0, 100, 48, 78, 48, 48, 48], [0, 90, 48, 78, 46, 60, 31], [4, 94, 48, 78, 48, 47, 48]]
)
"""Hands (spread, thumb, finger 2, finger 3) that a lookup of postures tells badly apart."""

MAX_LISTED = 30

INTRODUCTION = """
*Reachable* targets are contacts of configurations, moved by a part of the tolerance t (10 t rad
for normals). A proof would have to refute every box of hand postures, including the boxes around
the posture that made the target. These boxes are tested, down to a hundredth of the tolerance;
one that is refuted counts as a *false* proof. *Impossible* targets belong to a class and are not
solved, with a diagnosis and all its searches, at {} mm and {} deg more than the usual 5 mm and 3
deg. This is not a proof, so targets that are not proved may be possible. Times are processor
times in a batch of all proved targets, distributed in proportion to the boxes
of each. *Not proved:* by
whether a hand without an arm fits the contacts at the wider tolerance. If it does, the arm is the
reason, and its bound is too weak or has too many boxes; otherwise the hand has too many boxes.
"""


def blind_hands(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Hands next to the blind ones, any arm."""
    q = robot.random(rng, count)
    hand = BLIND[rng.integers(0, len(BLIND), count)] + rng.uniform(-0.06, 0.06, (count, 7))
    q[:, -7:] = np.clip(hand, robot.lower[-7:], robot.upper[-7:])
    return q


KINDS = {
    "random": random_hands,
    "corners": corners,
    "near limits": near_limits,
    "near-singular arms": singular_arms,
    "blind hands": blind_hands,
}

CASES = (
    ("random", 1e-11, 0.0, True),
    ("random", 5e-3, 0.99, True),
    ("random", 5e-3, 0.9, False),
    ("random", 1e-11, 0.0, False),
    ("corners", 5e-3, 0.99, True),
    ("corners", 1e-6, 0.9, True),
    ("near limits", 5e-3, 0.9, True),
    ("near limits", 1e-11, 0.0, True),
    ("near-singular arms", 2e-2, 0.99, True),
    ("blind hands", 5e-3, 0.99, True),
)
"""Kind, tolerance t [m], the part of it that contacts are moved by, whether limits are enforced."""


@dataclass(frozen=True)
class Part:
    """Targets of a robot: reachable ones of a case, or impossible ones of a class."""

    robot: str
    name: str
    number: int
    size: int
    seed: int
    beyond: tuple[float, float] = MIN_VIOLATION

    @property
    def path(self) -> Path:
        """Path of its counts."""
        return Path(self.robot) / f"{self.name}-{self.number:05d}.json"

    @property
    def rng(self) -> np.random.Generator:
        """Random generator of these targets."""
        return np.random.default_rng([self.seed, zlib.crc32(self.name.encode()), self.number])


def case_name(case: tuple[str, float, float, bool]) -> str:
    """Return the name of a case of reachable targets."""
    kind, tolerance, part, limits = case
    moved_by = f"moved by {part:.0%} of t" if part else "exact"
    return f"{kind}, t = {tolerance:g} m, {moved_by}{'' if limits else ', limits ignored'}"


def reachable(part: Part, case: tuple[str, float, float, bool]) -> dict[str, Any]:
    """Look for false proofs."""
    kind, tolerance, share, limits = case
    robot, rng = load(part.robot), part.rng
    q = KINDS[kind](robot, rng, part.size)
    if not limits:
        turning = [a.unit == "rad" for a in robot.description.actuators]
        q[:, turning] = rng.uniform(-7, 7, (len(q), sum(turning)))
    targets = rigidly_moved(robot.contacts(q), rng, share * tolerance, share * 10 * tolerance)
    problems = TargetBatch(*targets, ik.Tolerance(tolerance, 10 * tolerance), limits)
    prover = Prover(robot.description)
    places = robot.joints(q) | dict(zip(robot.actuators, q.T, strict=True))
    proofs = prover.prove(problems, prover.space.from_positions(places, problems))
    false = [q[row].tolist() for row, proof in enumerate(proofs) if proof is not None]
    return {"count": len(q), "false": false}


def clearly_impossible(part: Part) -> dict[str, Any]:
    """Look for proofs of what is impossible."""
    robot = load(part.robot)
    points, normals = impossible(robot, part.name, part.rng, part.size)
    usual = ik.Tolerance()
    further, angle = 1e-3 * part.beyond[0], float(np.deg2rad(part.beyond[1]))
    wide = ik.Tolerance(usual.position + further, usual.angle + angle)
    batch = ik.Solver(robot, tolerance=wide).solve_batch(points, normals, diagnose=True)
    rows = np.flatnonzero(~batch.success)
    results: dict[str, Any] = {"count": len(rows), "ms": [], "hand": 0, "arm": 0}
    if not len(rows):
        return results
    prover, problems = Prover(robot.description), TargetBatch(points, normals, usual, True)
    prover.prove(problems.rows(rows[:1]))
    proofs = prover.prove(problems.rows(rows))
    for row, proof in zip(rows, proofs, strict=True):
        diagnosis = batch.diagnoses[row]
        if proof is None:
            fits = diagnosis is not None and diagnosis.hand is not None and diagnosis.hand.ok
            results["arm" if fits else "hand"] += 1
    proved = [i for i, proof in enumerate(proofs) if proof is not None]
    if proved:
        boxes = np.array([proof.boxes for proof in proofs if proof is not None])
        begin = time.thread_time()
        prover.prove(problems.rows(rows[proved]))
        time_each = 1e3 * (time.thread_time() - begin) * boxes / boxes.sum()
        results["ms"] = time_each.tolist()
    return results


def solve(part: Part) -> dict[str, Any]:
    """Look for proofs of a part's targets and count."""
    cases = {case_name(case): case for case in CASES}
    case = cases.get(part.name)
    return clearly_impossible(part) if case is None else reachable(part, case)


def parts(options: argparse.Namespace) -> Iterator[Part]:
    """Return all parts, alternating between robots and cases."""
    robots = options.robot or ROBOTS
    for robot in robots if options.impossible else ():
        for name in classes_of(load(robot)):
            yield Part(robot, name, 0, options.impossible, options.seed, options.beyond)
    for number in range(-(-options.count // BLOCK)):
        for robot in robots:
            for case in CASES:
                if case[0] != "blind hands" or robot == ROBOTS[0]:
                    yield Part(robot, case_name(case), number, BLOCK, options.seed)


def write_report(options: argparse.Namespace, run_by: str) -> None:
    """Write the report on all parts there are."""
    done, codes = read_parts(options.out, parts(options))
    results: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for part, result in done:
        results.setdefault((part.robot, part.name), []).append(result)
        if part.name in CLASSES:
            results.setdefault((part.robot, "all"), []).append(result)
    rows, listed, table, metrics = [], [], [], list[Metric]()
    total = 0
    for (robot, name), results_of_case in results.items():
        count = sum(result["count"] for result in results_of_case)
        if "false" in results_of_case[0]:
            false = [q for result in results_of_case for q in result["false"]]
            total += count
            rows.append([robot, name, f"{count:,}", f"{len(false)}"])
            metrics.append(rate_metric(f"proofs/{robot}/{name}/true", count - len(false), count))
            listed += [[robot, name, " ".join(f"{x:.9g}" for x in q)] for q in false[:MAX_LISTED]]
        elif count:
            times = [ms for result in results_of_case for ms in result["ms"]]
            rate = rate_metric(f"proofs/{robot}/{name}/proved", len(times), count)
            metrics += [rate, median_metric(f"proofs/{robot}/{name}/time", times, "ms")]
            quantiles = np.quantile(times, [0.5, 0.99]) if times else [np.nan, np.nan]
            cells = [robot, name, f"{count}", f"{rate.value:.1f}"]
            left = [f"{sum(result[key] for result in results_of_case)}" for key in ("hand", "arm")]
            table.append([*cells, *(f"{q:.2f}" for q in quantiles), *left])
    heads = ["robot", "class", "n", "proved %", "median [ms]", "99 % [ms]"]
    result = f"Of {total:,} reachable targets, {len(listed)} are called unreachable by a proof."
    body = [
        INTRODUCTION.format(*(f"{x:g}" for x in options.beyond)),
        "## Reachable targets",
        markdown_table(["robot", "targets", "n", "false"], rows),
        *([markdown_table(["robot", "targets", "q"], listed)] if listed else []),
        "## Impossible targets",
        markdown_table([*heads, "not proved: hand", "not proved: arm"], table),
    ]
    code = {"proofs": codes or None}
    publish(options.title, result, body, options.report, run_by, code, metrics)


def main(arguments: list[str] | None = None) -> None:
    """Look for proofs of what is missing and write the report."""
    parser = argparse.ArgumentParser(description="Proofs of UNREACHABLE.")
    parser.add_argument("--count", type=int, default=BLOCK, help="reachable targets of every case")
    parser.add_argument("--impossible", type=int, default=30, help="targets of every class")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after so long")
    parser.add_argument("--seed", type=int, default=2026, help="of the targets")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--robot", action="append", choices=ROBOTS, help="only this one")
    parser.add_argument("--out", type=Path, default=Path("out/proofs"), help="counts by block")
    parser.add_argument("--report", type=Path, default=Path("out/proofs/report"), help="folder")
    parser.add_argument(
        "--beyond",
        type=float,
        nargs=2,
        default=MIN_VIOLATION,
        metavar=("MM", "DEG"),
        help="impossible is what is so by this much more than the tolerance",
    )
    parser.add_argument("--title", default="Proofs of UNREACHABLE", help="title of the report")
    options = parser.parse_args(arguments)
    options.beyond = tuple(options.beyond)
    if options.beyond != MIN_VIOLATION:  # other counts, which are not to be mixed
        options.out = options.out / "beyond {:g} mm {:g} deg".format(*options.beyond)
    until = time.monotonic() + 60 * options.minutes
    run_parts(solve, parts(options), options.out, jobs=options.jobs, until=until)
    write_report(options, command(__file__, arguments))


if __name__ == "__main__":
    program(main)
