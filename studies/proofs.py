"""Is a proof of impossibility ever wrong, and how much of the impossible is proved?

Reachable targets are contacts of random hands and arms, a part of them at limits, moved by up to
99 % of the tolerance: none may be proved impossible. Impossible ones are those that many searches
do not solve even with 20 mm and 10 deg more than the tolerance. Counts are kept in a file, so that
a run goes on where the last one ended::

    nice python studies/proofs.py --reachable 2000 --kept counts.json    # again and again
    python studies/proofs.py --reachable 0 --impossible 60 --kept counts.json
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from diagnosis import Targets, at_limits, impossible, moved

import casadi_ik as ik
from casadi_ik.problem.problems import Problems
from casadi_ik.solving.diagnosis.prover import Prover

ROBOTS = "kuka_lwr_barrett", "kuka_lwr_barrett_coupled", "ar10", "baxter_ar10"
BLOCK = 64
"""Targets that are made with one seed."""

CASES = (
    (1e-12, 0.0, True),
    (1e-12, 0.0, False),
    (1e-6, 0.9, True),
    (5e-3, 0.9, True),
    (5e-3, 0.99, True),
    (5e-3, 0.9, False),
    (2e-2, 0.99, True),
)
"""Tolerance t [m], and 10 t [rad]; the part of it that contacts are moved by; limits enforced."""

BEYOND = 20e-3, float(np.deg2rad(10))
"""What is impossible is so by this much more than the tolerance [m, rad]."""


def reachable(robot: ik.ArmHand, seed: int, case: tuple[float, float, bool]) -> Problems:
    """Targets that can be reached."""
    tolerance, part, limits = case
    rng = np.random.default_rng(seed)
    q = at_limits(robot, rng, BLOCK, 0.3)
    if not limits:
        turning = [a.unit == "rad" for a in robot.description.actuators]
        q[:, turning] = rng.uniform(-7, 7, (BLOCK, sum(turning)))
    targets = moved(robot.contacts(q), rng, part * tolerance, part * 10 * tolerance)
    return Problems(*targets, ik.Tolerance(tolerance, 10 * tolerance), limits)


def beyond_reach(robot: ik.ArmHand, count: int, seed: int) -> dict[str, Targets]:
    """Targets that are not solved with a much wider tolerance either."""
    usual = ik.Tolerance()
    wide = ik.Tolerance(usual.position + BEYOND[0], usual.angle + BEYOND[1])
    solver, found = ik.Solver(robot, tolerance=wide), {}
    for name, (points, normals) in impossible(robot, count, seed).items():
        left = ~solver.solve_batch(points, normals, diagnose=True).success
        found[name] = points[left], normals[left]
    return found


def main(arguments: list[str] | None = None) -> None:
    """Prove, count, print."""
    parser = argparse.ArgumentParser(description="Proofs of impossibility")
    parser.add_argument("--reachable", type=int, default=2000, help="further targets per robot")
    parser.add_argument("--impossible", type=int, default=0, help="targets per set")
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--kept", type=Path, required=True, help="JSON file of the counts")
    options = parser.parse_args(arguments)
    kept = json.loads(options.kept.read_text()) if options.kept.exists() else {}
    for name in options.robots:
        robot = ik.load_robot(name)
        prover = Prover(robot.description)
        counts = kept.setdefault(name, {"blocks": 0, "targets": 0, "false": 0})
        for _ in range(-(-options.reachable // BLOCK)):
            case = CASES[counts["blocks"] % len(CASES)]
            problems = reachable(robot, counts["blocks"], case)
            counts["false"] += sum(proof is not None for proof in prover.prove(problems))
            counts["targets"] += len(problems)
            counts["blocks"] += 1
            options.kept.write_text(json.dumps(kept, indent=2) + "\n")
        print(f"{name}: {counts['targets']:,} reachable, {counts['false']} called impossible")
    if options.impossible:
        robot = ik.load_robot(ROBOTS[0])
        prover = Prover(robot.description)
        for title, (points, normals) in beyond_reach(robot, options.impossible, 2026).items():
            begin = time.thread_time()
            proofs = prover.prove(Problems(points, normals, ik.Tolerance(), True))
            each = 1e3 * (time.thread_time() - begin) / max(len(points), 1)
            share = sum(proof is not None for proof in proofs)
            print(f"{title}: {share} of {len(points)} proved, {each:.2f} ms each")


if __name__ == "__main__":
    main()
