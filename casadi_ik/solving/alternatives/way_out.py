"""What else would do where every answer touches something: the object elsewhere, a finger fewer.

Whatever is said to help was solved: there is a free answer for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.answers.solution import BatchSolution, SuggestedFix
from casadi_ik.arrays import Array
from casadi_ik.collision.distances import gaps
from casadi_ik.collision.scene import Item, Scene
from casadi_ik.problem.clearance import SceneCheck
from casadi_ik.problem.targets import TargetBatch

STEPS = (0.01, 0.02, 0.04, 0.08, 0.16)
"""How far the object is moved [m], until it helps."""

HALVINGS = 4
"""By which the shortest way is found once one helps."""

WAYS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z],
    dtype=float,
)
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)
"""(26, 3) unit vectors to the faces, edges and corners of a cube."""

ROUNDING = 1e-9
"""By which a moved object may be nearer to something than it stands [m]."""

Free = Callable[[TargetBatch], NDArray[np.bool_]]
"""Of k targets, which have a free answer."""


def with_way_out(
    free: Free, check: SceneCheck, targets: TargetBatch, batch: BatchSolution
) -> BatchSolution:
    """The answer to one target that touches something, with what else would do in its report.

    Args:
        free: Solves targets.
        check: The scene about the robot.
        targets: The target.
        batch: The answer.
    """
    (report,) = batch.collisions
    if report is None:
        return batch
    scene, known = check.scene, targets
    if targets.object_pose is None and scene.grasped in scene.items:
        known = targets.holding(scene.grasped or "", scene.items[scene.grasped or ""].pose)
    moved = _moved(known, _standing(check, known), free)
    found = SuggestedFix(moved, STEPS[-1], _fewer(known, check.robot.fingers, free))
    return replace(batch, collisions=(replace(report, way_out=found),))


def _standing(check: SceneCheck, targets: TargetBatch) -> Callable[[Array], NDArray[np.bool_]]:
    """Which shifts (k, 3) let what is grasped stand as free as it stands now."""
    scene: Scene = check.scene
    name, pose = targets.object or scene.grasped or "", targets.object_pose
    if name and pose is not None:
        scene = scene.holding(name, pose[0])
    item = scene.items.get(name)
    others: list[Item] = [one for key, one in scene.items.items() if key != name]

    def stands(shifts: Array) -> NDArray[np.bool_]:
        if item is None or not others:
            return np.ones(len(shifts), dtype=bool)
        poses = np.repeat(item.pose[None], 1 + len(shifts), axis=0)
        poses[1:, :3, 3] += shifts
        every = gaps(item, others, poses)
        return every[1:] >= min(float(every[0]), 0.0) - ROUNDING

    return stands


def _moved(
    targets: TargetBatch, stands: Callable[[Array], NDArray[np.bool_]], free: Free
) -> tuple[float, float, float] | None:
    """The shortest shift that helps."""

    def helps(shifts: Array) -> NDArray[np.bool_]:
        good = stands(shifts)
        if good.any():
            good[good] = free(_shifted(targets, shifts[good]))
        return good

    before = 0.0
    for step in STEPS:
        ways = WAYS[helps(step * WAYS)]
        if len(ways):
            low, high = np.full(len(ways), before), np.full(len(ways), step)
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                good = helps(middle[:, None] * ways)
                low, high = np.where(good, low, middle), np.where(good, middle, high)
                # The shortest is wanted: what is longer than another way already is left out.
                some = low < high.min()
                low, high, ways = low[some], high[some], ways[some]
            x, y, z = (high[:, None] * ways)[int(high.argmin())].tolist()
            return x, y, z
        before = step
    return None


def _shifted(targets: TargetBatch, shifts: Array) -> TargetBatch:
    """One target at as many places."""
    asked = targets.rows(np.zeros(len(shifts), dtype=np.intp))
    pose = asked.object_pose
    if pose is not None:
        pose = pose.copy()
        pose[:, :3, 3] += shifts
    return replace(
        asked, points=asked.points + shifts[:, None], object_pose=pose, picked=None, first_row=0
    )


def _fewer(targets: TargetBatch, fingers: Sequence[str], free: Free) -> tuple[str, ...]:
    """Fingers without whose contact there is a free answer."""
    placed = ~np.isnan(targets.points[0]).all(axis=1)
    facing = ~np.isnan(targets.normals[0]).all(axis=1)
    named = np.flatnonzero(placed | facing)
    # A finger with more than a point and a normal would make it a target of other kinds.
    plain = [
        i for i in named.tolist() if all(np.isnan(v[0, i]).all() for v in targets.more.values())
    ]
    if len(named) < 2:
        return ()
    return tuple(fingers[i] for i in plain if free(_without(targets, i))[0])


def _without(targets: TargetBatch, finger: int) -> TargetBatch:
    """One target with a finger free."""
    points, normals = targets.points.copy(), targets.normals.copy()
    points[:, finger], normals[:, finger] = np.nan, np.nan
    return replace(targets, points=points, normals=normals)
