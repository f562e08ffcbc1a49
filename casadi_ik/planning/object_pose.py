"""A grasp of an object that may be anywhere within bounds: where all hands reach it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from casadi_ik.files.arrays import Array, spread_points
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.model.pose import Free
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.solution import BatchSolution, Solution
from casadi_ik.solve.status import Status

LOTS = (1, 15, 240)
"""Poses that are tried at once, as long as none is solved; but the first by one round each."""


def poses_within(free: Free, count: int) -> Array:
    """(count, 4, 4) poses, evenly spread; the first one is in the middle."""
    lower, upper = np.asarray(free.lower), np.asarray(free.upper)
    spread = spread_points(count, 6)
    spread[0] = 0.5
    values = lower + spread * (upper - lower)
    return np.array([frame_matrix(Frame(tuple(row[:3]), tuple(row[3:]))) for row in values])


def placed(targets: TargetBatch, poses: Array) -> TargetBatch:
    """One target of the object's frame, placed with the object at poses (k, 4, 4)."""
    turn = np.swapaxes(poses[:, :3, :3], 1, 2)
    return replace(
        targets,
        points=targets.points[0] @ turn + poses[:, None, :3, 3],
        normals=targets.normals[0] @ turn,
        more={name: array[0] @ turn for name, array in targets.more.items()},
        object_pose=poses if targets.object else None,
    )


def solve_with_object(
    solve: Callable[[TargetBatch, bool], BatchSolution],
    glance: Callable[[TargetBatch], BatchSolution],
    targets: TargetBatch,
    free: Free,
    start: Array,
    ranges: Array,
) -> Solution:
    """The answer at the pose of the object that is nearest, of those that are tried.

    Args:
        solve: Solves targets; whether with a diagnosis.
        glance: Solves them, and soon gives up what it does not.
        targets: One target, in the object's frame.
        free: Where the object may be.
        start: (n,) where the robot is.
        ranges: (n,) of the motors.

    Returns:
        Of those that are solved the one nearest to `start` if that is preferred, else the one
        nearest to the middle of the bounds; of none the one in the middle, with its diagnosis.
    """
    every, first = poses_within(free, sum(LOTS)), 0
    span = np.maximum(np.asarray(free.upper) - np.asarray(free.lower), 1e-12)
    middle, steps = every[0], spread_points(sum(LOTS), 6) - 0.5
    for count in LOTS:
        rows = np.arange(first, first + count)
        some = placed(targets, every[rows])
        found = glance(some) if first else solve(some, False)
        solved = np.flatnonzero(found.status == Status.SOLVED)
        if len(solved):
            if targets.prefer == "q0":
                away = np.abs((found.q[solved] - start) / ranges).max(axis=1)
            else:
                away = np.linalg.norm(steps[rows[solved]] * (span > 1e-9), axis=1)
            best = int(solved[np.argmin(away)])
            return replace(found.solution(best), object_pose=every[rows[best]])
        first += count
        if free.lower == free.upper:
            break
    return replace(solve(placed(targets, middle[None]), True).solution(0), object_pose=middle)
