"""The same targets, restarts and rule of success for other solvers: success and speed.

    pip install -e ".[peers]"
    python studies/peers.py --count 300

Each peer starts from `robot.home`, then from one evenly spread configuration after the other until
the contacts are within tolerance and the motors within limits. What it reports is judged by our
own verdict. The peers' times include their Python loop, as users run them.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from bench_report import Section
from peer_qp import Mink, Pink, Placo
from peer_steps import Peer, Scipy
from samplers import random_arm_targets

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import judge
from casadi_ik.symbolic.even_spread import evenly

Targets = tuple[Array, Array]

STARTS = 400
"""Restarts before a target is given up, unless said otherwise."""

STALL = 0.9
"""A start is left when its cost has not fallen below this part of what it was some steps ago."""


@dataclass(frozen=True)
class Setting:
    """How a peer is run.

    Attributes:
        package: What has to be installed.
        make: Builds it for a robot and for tight tolerances or not.
        steps: Steps from one start.
        cap: Largest change of a motor in a step [rad].
        wait: Steps without much gain before a start is left.
    """

    package: str
    make: Callable[[ik.ArmHand, bool], Peer]
    steps: int
    cap: float
    wait: int


SETTINGS = {
    "placo": Setting("placo", lambda robot, _: Placo(robot, 1e-1), 40, 0.7, 5),
    "Pink": Setting("pink", lambda robot, _: Pink(robot, 1e-2), 40, 0.7, 5),
    "mink": Setting("mink", lambda robot, _: Mink(robot, 1e-2), 40, 0.7, 5),
    "scipy": Setting("scipy", lambda robot, tight: Scipy(robot, 50, tight), 1, np.inf, 1),
}
"""Chosen on other targets than those measured (`--seed 1`), on this robot and three pairs of the
catalogue."""


@dataclass(frozen=True)
class Run:
    """The answers to some targets.

    Attributes:
        solved: Part of the targets that our verdict accepts [0, 1].
        first: Part that was solved from the first start.
        times: Seconds of each.
    """

    solved: float
    first: float
    times: Array


def installed() -> list[str]:
    """Peers that can be imported."""
    return [name for name, s in SETTINGS.items() if importlib.util.find_spec(s.package)]


def run_peer(
    name: str,
    robot: ik.ArmHand,
    targets: Targets,
    tolerance: ik.Tolerance,
    restarts: int,
) -> Run:
    """Solve targets with restarts, then judge."""
    setting = SETTINGS[name]
    peer = setting.make(robot, tolerance.position < 1e-4)
    spread = evenly(restarts, len(robot.actuators))
    starts = np.vstack([robot.home, robot.lower + spread * (robot.upper - robot.lower)])
    count = len(targets[0])
    q, used, times = np.empty((count, len(robot.home))), np.empty(count), np.empty(count)
    for row, (points, normals) in enumerate(zip(*targets, strict=True)):
        begin = time.thread_time()
        peer.aim(points, normals)
        q[row], used[row] = _restarted(peer, robot, setting, points, normals, starts, tolerance)
        times[row] = time.thread_time() - begin
    verdict = judge(robot, Problems(*targets, tolerance, True), q)
    solved = verdict.ok.all(axis=1) & verdict.limits_ok
    return Run(float(solved.mean()), float((solved & (used == 0)).mean()), times)


def _restarted(
    peer: Peer,
    robot: ik.ArmHand,
    setting: Setting,
    points: Array,
    normals: Array,
    starts: Array,
    tolerance: ik.Tolerance,
) -> tuple[Array, int]:
    chord = 2 * np.sin(tolerance.angle / 2)
    q = starts[0]
    for number, start in enumerate(starts):
        q, costs = start, []
        for _ in range(setting.steps + 1):
            p, n = peer.contacts(q)
            far, turned = p - points, n - normals
            off, away = (far * far).sum(axis=1), (turned * turned).sum(axis=1)
            if off.max() <= tolerance.position**2 and away.max() <= chord**2:
                return q, number
            costs.append(100 * off.sum() + away.sum())
            if len(costs) > setting.wait and costs[-1] > STALL * costs[-1 - setting.wait]:
                break
            if len(costs) > setting.steps:
                break
            change = peer.step(q)
            change *= min(1.0, setting.cap / max(np.abs(change).max(), 1e-12))
            q = np.clip(q + change, robot.lower, robot.upper)
    return q, len(starts)


def run_ours(method: str, robot: ik.ArmHand, targets: Targets, tolerance: ik.Tolerance) -> Run:
    """One of our methods on the same targets, one call of `Solver.solve` each."""
    solver = ik.Solver(robot, method, tolerance)
    count = len(targets[0])
    solved, first, times = np.zeros(count), np.zeros(count), np.zeros(count)
    solver.solve(_grasp(robot, targets, 0))
    for row in range(count):
        grasp = _grasp(robot, targets, row)
        begin = time.thread_time()
        solution = solver.solve(grasp, diagnose=False)
        times[row] = time.thread_time() - begin
        solved[row], first[row] = solution.success, solution.success and solution.restarts == 0
    return Run(float(solved.mean()), float(first.mean()), times)


def run_batch(robot: ik.ArmHand, targets: Targets, tolerance: ik.Tolerance) -> Run:
    """Hand-first on all targets in one call; every target is given the mean time."""
    solver = ik.Solver(robot, tolerance=tolerance)
    solver.solve_batch(*targets)
    begin = time.thread_time()
    batch = solver.solve_batch(*targets)
    times = np.full(len(batch), (time.thread_time() - begin) / len(batch))
    first = batch.success & (batch.restarts == 0)
    return Run(float(batch.success.mean()), float(first.mean()), times)


def _grasp(robot: ik.ArmHand, targets: Targets, row: int) -> ik.Grasp:
    pairs = zip(robot.fingers, targets[0][row], targets[1][row], strict=True)
    return ik.Grasp({name: ik.Contact(point, normal) for name, point, normal in pairs})


def measured(count: int, seed: int, names: Sequence[str], restarts: int = STARTS) -> Section:
    """The table of all kinds of targets and tolerances."""
    robot = ik.load_robot("kuka_lwr_barrett")
    rows = []
    for kind, tolerance, targets in kinds(robot, count, seed):
        ours = run_batch(robot, targets, tolerance)
        runs = {"hand-first, in a batch": ours}
        for method in ("hand-first", "ipopt"):
            runs[method] = run_ours(method, robot, targets, tolerance)
        runs |= {name: run_peer(name, robot, targets, tolerance, restarts) for name in names}
        for name, run in runs.items():
            cells = (
                f"{100 * run.solved:.1f}",
                f"{100 * run.first:.0f}",
                f"{1e3 * run.times.mean():.3f}",
                f"{1e3 * np.quantile(run.times, 0.99):.2f}",
                f"{run.times.mean() / ours.times.mean():.1f}",
            )
            rows.append((kind, name, *cells))
    missing = [name for name in SETTINGS if name not in names]
    note = (
        f"{count} targets of each kind, one start from home, then evenly spread restarts "
        "until solved; CPU time of the one thread, Python loops included, as users run them; "
        "solved by our own verdict."
        + (f" Not measured (extra `peers`): {', '.join(missing)}." if missing else "")
    )
    columns = "targets", "solver", "solved %", "first start %", "mean ms", "99 % ms", "ratio"
    return Section("Other solvers", columns, rows, note)


def kinds(robot: ik.ArmHand, count: int, seed: int) -> list[tuple[str, ik.Tolerance, Targets]]:
    """Grasps and random hands, at the usual and at a tight tolerance."""
    rng = np.random.default_rng(seed)
    grasps = ik.shipped_grasps(robot.name)
    sets = {
        "grasps": random_arm_targets(robot, grasps, max(count // len(grasps), 1), rng),
        "random hands": robot.contacts(robot.random(rng, count)),
    }
    tolerances = {"5 mm / 3 deg": ik.Tolerance(), "1e-6 m / 1e-6 rad": ik.Tolerance(1e-6, 1e-6)}
    return [(f"{s}, {t}", tolerances[t], sets[s]) for t in tolerances for s in sets]


def main(arguments: list[str] | None = None) -> None:
    """Run all that are installed and print a table."""
    parser = argparse.ArgumentParser(description="Other solvers on the same targets.")
    parser.add_argument("--count", type=int, default=120, help="targets of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--restarts", type=int, default=STARTS, help="of a peer for a target")
    parser.add_argument("--peers", nargs="+", default=installed(), choices=SETTINGS)
    options = parser.parse_args(arguments)
    measured(options.count, options.seed, options.peers, options.restarts).show()


if __name__ == "__main__":
    main()
