"""What is in the hand after it closed: it moves with the palm, and must not touch either."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import gaps
from casadi_ik.grasps.pose import inverse
from casadi_ik.motion.clear_between import least_clearance
from casadi_ik.problem.clearance import SceneCheck, Surroundings
from casadi_ik.problem.problems import Problems

STEP = 1e-3
"""Motion of the palm [m] between two places where a carried object is compared with the scene."""

GIVING = 1e-3
"""By how much it may come nearer to what it stands on, or touches, while it is taken away [m]."""


class Carried:
    """A robot with what its hand holds; nothing where the scene does not know the object."""

    def __init__(self, check: SceneCheck, problem: Problems, q: Array) -> None:
        """Take the object.

        Args:
            check: The scene.
            problem: The grasp.
            q: (n,) the posture in which it is held first.
        """
        self._check, self._problem, self._robot = check, problem, check.robot
        self._name = problem.object or check.scene.grasped or ""
        pose = None if problem.object_pose is None else problem.object_pose[0]
        if pose is None and self._name in check.scene.items:
            pose = check.scene.items[self._name].pose
        self._in_palm = None if pose is None else inverse(self._robot.palm(q)) @ pose

    def blocked(self, q: Array) -> str:
        """What is in the way from each of k postures (k, n) straight to the next; "": nothing."""
        around = self._around(q)
        return least_clearance(around, q)[1] or self._comes_near(q)

    def _around(self, q: Array) -> Surroundings:
        every = self._problem.rows(np.zeros(len(q), dtype=np.intp))
        if self._in_palm is None:
            return self._check.around(every).rows(np.zeros(1, dtype=np.intp))
        poses = self._robot.palm(q) @ self._in_palm
        held = replace(every, object=self._name, object_pose=poses)
        return self._check.around(held, carried=True)

    def _comes_near(self, q: Array) -> str:
        """What in the scene the object comes too near to, as far as it is not there already."""
        scene = self._check.scene
        if self._in_palm is None:
            return ""
        held = scene.holding(self._name, np.eye(4)).items[self._name]
        poses = self._robot.palm(_finely(q, self._robot.palm(q)[:, :3, 3])) @ self._in_palm
        allowed = {frozenset(one.links) for one in scene.touching}
        for name, item in scene.items.items():
            pair = frozenset((name, self._name))
            if name == self._name or pair in allowed:
                continue
            usual = scene.margin if item.margin is None else item.margin
            apart = gaps(held, [item], poses)
            if apart.min() < min(scene.margins.get(pair, usual), float(apart[0]) - GIVING):
                return f"{self._name} and {name} touch"
        return ""


def _finely(q: Array, places: Array) -> Array:
    """Postures (m, n) on the straight ways from each of some (k, n) to the next.

    Args:
        q: (k, n).
        places: (k, 3) where the palm is there [m].
    """
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    counts = np.maximum(np.ceil(steps / STEP), 1).astype(int)
    at = [i + np.arange(count) / count for i, count in enumerate(counts)]
    along = np.append(np.concatenate([np.zeros(0), *at]), len(q) - 1)
    return np.array([np.interp(along, np.arange(len(q)), column) for column in q.T]).T
