"""Other solvers on our problem, each set up as its experts would, with our restarts and verdict.

    pip install -r studies/peers.txt
    python studies/bench.py --part peers

Every peer sees the robot through a URDF, contacts as points and normals, and joints that follow
others. What is theirs is theirs: kinematics, tasks and quadratic program. All keep the limits in
every step. Each starts from `robot.home`, then from one evenly spread configuration after the other
until the contacts are within tolerance and the motors within limits. What it reports is judged by
our own verdict. The peers' times include their Python loop, as users run them.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peer_solvers import Mink, Peer, Pink, Placo, Scipy
from samplers import Array

import casadi_ik as ik

Targets = tuple[Array, Array]

STARTS = 400
"""Restarts before a target is given up, unless said otherwise."""

STALL = 0.9
"""A start is left when its cost has not fallen below this part of what it was some steps ago."""


@dataclass(frozen=True)
class Setting:
    """Parameters of a peer.

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
    return [name for name, s in SETTINGS.items() if importlib.util.find_spec(s.package)] + ["ipopt"]


def starts_of(robot: ik.ArmHand, count: int) -> Array:
    """Home, then evenly spread configurations."""
    qmc: Any = import_module("scipy.stats.qmc")
    spread = qmc.Halton(len(robot.actuators), scramble=False).random(count)
    return np.vstack([robot.home, robot.lower + spread * (robot.upper - robot.lower)])


def is_solved(
    robot: ik.ArmHand, q: Array, targets: Targets, tolerance: ik.Tolerance
) -> NDArray[np.bool_]:
    """Return whether solutions (k, n) meet their contacts within limits (k,)."""
    position, angle, limit_excess = robot.deviations(q, *targets)
    slack = 1 + 1e-9
    is_within = (position <= tolerance.position * slack) & (angle <= tolerance.angle * slack)
    return is_within.all(axis=1) & (limit_excess <= 1e-9)


def run_peer(
    name: str,
    robot: ik.ArmHand,
    targets: Targets,
    tolerance: ik.Tolerance,
    restarts: int = STARTS,
) -> Run:
    """Solve targets with restarts, then judge."""
    if name == "ipopt":
        return _by_ipopt(robot, targets, tolerance)
    setting = SETTINGS[name]
    peer = setting.make(robot, tolerance.position < 1e-4)
    starts = starts_of(robot, restarts)
    count = len(targets[0])
    q, starts_used, times = np.empty((count, len(robot.home))), np.empty(count), np.empty(count)
    for row, (points, normals) in enumerate(zip(*targets, strict=True)):
        begin = time.thread_time()
        peer.aim(points, normals)
        q[row], starts_used[row] = _restarted(
            peer, robot, setting, points, normals, starts, tolerance
        )
        times[row] = time.thread_time() - begin
    solved = is_solved(robot, q, targets, tolerance)
    return Run(float(solved.mean()), float((solved & (starts_used == 0)).mean()), times)


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
            point_error, normal_error = p - points, n - normals
            off, normal_distance = (
                (point_error * point_error).sum(axis=1),
                (normal_error * normal_error).sum(axis=1),
            )
            if off.max() <= tolerance.position**2 and normal_distance.max() <= chord**2:
                return q, number
            costs.append(100 * off.sum() + normal_distance.sum())
            if len(costs) > setting.wait and costs[-1] > STALL * costs[-1 - setting.wait]:
                break
            if len(costs) > setting.steps:
                break
            change = peer.step(q)
            change *= min(1.0, setting.cap / max(np.abs(change).max(), 1e-12))
            q = np.clip(q + change, robot.lower, robot.upper)
    return q, len(starts)


def _by_ipopt(robot: ik.ArmHand, targets: Targets, tolerance: ik.Tolerance) -> Run:
    """Solve each target with Ipopt as one nonlinear program."""
    solver, batch = ik.Solver(robot, "ipopt", tolerance), list[ik.BatchSolution]()
    times = []
    for points, normals in zip(*targets, strict=True):
        begin = time.thread_time()
        batch.append(solver.solve_batch(points[None], normals[None]))
        times.append(time.thread_time() - begin)
    solved = np.array([solution.success[0] for solution in batch])
    first = np.array([solution.restarts[0] == 0 for solution in batch])
    return Run(float(solved.mean()), float((solved & first).mean()), np.array(times))
