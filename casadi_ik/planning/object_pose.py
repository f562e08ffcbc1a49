"""Search for an object pose within bounds at which the robot can reach the grasp."""

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

POSE_BATCHES = (1, 15, 240)
"""Numbers of poses per batch, until one is solved; all but the first get a single restart."""


def poses_within(free: Free, count: int) -> Array:
    """Return (count, 4, 4) poses spread evenly within the bounds, the central one first."""
    lower, upper = np.asarray(free.lower), np.asarray(free.upper)
    fractions = spread_points(count, 6)
    fractions[0] = 0.5
    values = lower + fractions * (upper - lower)
    return np.array([frame_matrix(Frame(tuple(row[:3]), tuple(row[3:]))) for row in values])


def place_targets(targets: TargetBatch, poses: Array) -> TargetBatch:
    """Return a target in the object frame as k targets at object poses (k, 4, 4)."""
    rotation = np.swapaxes(poses[:, :3, :3], 1, 2)
    return replace(
        targets,
        points=targets.points[0] @ rotation + poses[:, None, :3, 3],
        normals=targets.normals[0] @ rotation,
        extra_vectors={name: array[0] @ rotation for name, array in targets.extra_vectors.items()},
        object_pose=poses if targets.object else None,
    )


def solve_with_object(
    solve: Callable[[TargetBatch, bool], BatchSolution],
    screen: Callable[[TargetBatch], BatchSolution],
    targets: TargetBatch,
    free: Free,
    start: Array,
    ranges: Array,
) -> Solution:
    """Solve a grasp at the preferred object pose of those that are tried.

    Args:
        solve: Solves targets; the flag enables the diagnosis.
        screen: Solves targets with a single restart.
        targets: One target, in the object frame.
        free: Bounds of the object pose.
        start: (n,) initial configuration.
        ranges: (n,) ranges of the motors.

    Returns:
        Of the solved poses the one nearest to `start` if that is preferred, else the one nearest
        to the center of the bounds; if none is solved, the central pose with its diagnosis.
    """
    poses, first = poses_within(free, sum(POSE_BATCHES)), 0
    span = np.maximum(np.asarray(free.upper) - np.asarray(free.lower), 1e-12)
    center, offsets = poses[0], spread_points(sum(POSE_BATCHES), 6) - 0.5
    for count in POSE_BATCHES:
        rows = np.arange(first, first + count)
        batch_targets = place_targets(targets, poses[rows])
        batch = screen(batch_targets) if first else solve(batch_targets, False)
        solved = np.flatnonzero(batch.status == Status.SOLVED)
        if len(solved):
            if targets.prefer == "q0":
                distance = np.abs((batch.q[solved] - start) / ranges).max(axis=1)
            else:
                distance = np.linalg.norm(offsets[rows[solved]] * (span > 1e-9), axis=1)
            best = int(solved[np.argmin(distance)])
            return replace(batch.solution(best), object_pose=poses[rows[best]])
        first += count
        if free.lower == free.upper:
            break
    solution = solve(place_targets(targets, center[None]), True).solution(0)
    return replace(solution, object_pose=center)
