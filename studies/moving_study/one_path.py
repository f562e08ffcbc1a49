"""What is measured on one path of one robot."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import casadi_ik as ik
from casadi_ik.arrays import Array
from moving_study.paths import smooth_path

PERIOD = 1e-3
STEPS = 2000
SHARE = 0.5
"""Of the velocity limits, and of the accelerations that reach them in 0.25 s, that paths need."""

EVERY = 20
"""Of so many targets one is solved anew, as it was done before there was a follower."""

LEAPS = 4
"""Targets that leap, each given so many cycles:"""

WAIT = 2000

TIMES = 3
"""So often a path is followed for the time of its calls."""

SINGULAR = 0.05
"""Smallest singular value [m per rad, or rad per rad] of an arm that counts as near singular."""


def measure(solver: ik.Solver, number: int) -> dict[str, Any]:
    """Figures of one path.

    Args:
        solver: On the robot.
        number: Of the path, also its seed.
    """
    robot = solver.robot
    path = smooth_path(robot, number, STEPS, PERIOD, SHARE)
    return {
        "number": number,
        **_smooth(solver, path),
        **_leaping(solver, number),
        **_anew(solver, path[::EVERY]),
    }


def _smooth(solver: ik.Solver, path: Array) -> dict[str, Any]:
    robot = solver.robot
    points, normals = robot.contacts(path)
    follower = solver.follow(path[0], PERIOD)
    q, seconds = np.empty_like(path), np.empty(len(path))
    for i, target in enumerate(zip(points, normals, strict=True)):
        begin = time.perf_counter()
        q[i] = follower(*target)
        seconds[i] = time.perf_counter() - begin
    position, angle = robot.errors(q, points, normals)
    met = ((position <= 5e-3) & (angle <= np.radians(3))).all(axis=1)
    lost = int(np.argmin(met)) if not met.all() else -1
    return {
        "median": float(np.median(seconds)),
        "met": float(met.mean()),
        "error": float(position.max()),
        "singular": bool(
            lost >= 0 and _least_gain(robot, path[max(lost - 300, 0) : lost + 1 : 10])
        ),
        **_kept("smooth", follower, np.concatenate([path[:1], q])),
    }


def calls(solver: ik.Solver, number: int) -> list[float]:
    """CPU seconds of each call on a path, the least of `TIMES` runs.

    The same calls do the same: what differs is where the processor was taken away and had to come
    back to its caches, which falls on other calls each time.
    """
    path = smooth_path(solver.robot, number, STEPS, PERIOD, SHARE)
    targets = list(zip(*solver.robot.contacts(path), strict=True))
    found = np.full(len(targets), np.inf)
    for _ in range(TIMES):
        follower = solver.follow(path[0], PERIOD)
        for i, target in enumerate(targets):
            begin = time.thread_time()
            follower(*target)
            found[i] = min(found[i], time.thread_time() - begin)
    return found.tolist()


def _leaping(solver: ik.Solver, number: int) -> dict[str, Any]:
    """Targets that leap: limits are kept, and what can be met on the branch is met at rest."""
    robot, rng = solver.robot, np.random.default_rng([number, 1])
    start = smooth_path(robot, number, STEPS, PERIOD, SHARE)[0]
    follower, q, met = solver.follow(start, PERIOD), [start], 0
    for _ in range(LEAPS):
        goal = start + 0.2 * (robot.random(rng, 1)[0] - start)
        target = robot.contacts(goal)
        q += [follower(*target) for _ in range(WAIT)]
        met += follower.state.status is ik.FollowStatus.FOLLOWING
    return {"leaps_met": met / LEAPS, **_kept("leaping", follower, np.array(q))}


def _anew(solver: ik.Solver, path: Array) -> dict[str, Any]:
    """Every target solved from the solution before: the steps between, and their time."""
    robot = solver.robot
    q, steps, seconds = path[0], [], []
    for points, normals in zip(*robot.contacts(path), strict=True):
        grasp = ik.Grasp(
            {n: ik.Contact(*c) for n, *c in zip(robot.fingers, points, normals, strict=True)}
        )
        begin = time.perf_counter()
        found = solver.solve(grasp, q0=q, diagnose=False).q
        seconds.append(time.perf_counter() - begin)
        steps.append(np.abs(found - q))
        q = found
    own = np.abs(np.diff(path, axis=0)).max()
    return {
        "anew_step": float(np.max(steps)),
        "own_step": float(own),
        "anew_time": float(np.median(seconds)),
    }


def _kept(what: str, follower: ik.Follower, q: Array) -> dict[str, float]:
    """Largest velocity and acceleration as parts of their limits, and how far beyond a limit."""
    steps = np.diff(q, axis=0)
    changes = np.diff(steps, axis=0, prepend=np.zeros((1, q.shape[1])))
    return {
        f"{what}_velocity": float((np.abs(steps) / (follower.velocity * PERIOD)).max()),
        f"{what}_acceleration": float(
            (np.abs(changes) / (follower.acceleration * PERIOD**2)).max()
        ),
        f"{what}_step": float(np.abs(steps).max()),
    }


def _least_gain(robot: ik.ArmHand, path: Array) -> bool:
    """Whether the arm is near a singular posture somewhere on a path."""
    arm, nudge = list(robot.description.arm_actuators), 1e-5
    for q in path:
        moved = np.repeat(q[None], len(arm), axis=0)
        moved[np.arange(len(arm)), arm] += nudge
        here, there = robot.palm(q), robot.palm(moved)
        turned = (there[:, :3, :3] @ here[:3, :3].T).transpose(1, 2, 0)
        spin = np.array([turned[2, 1], turned[0, 2], turned[1, 0]])
        jacobian = np.concatenate([(there[:, :3, 3] - here[:3, 3]).T, spin]) / nudge
        if np.linalg.svd(jacobian, compute_uv=False)[-1] < SINGULAR:
            return True
    return False
