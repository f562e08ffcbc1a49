"""What keeps a follower clear of what it may hit.

Two things do. The goal keeps away softly, as far as the contacts leave it free: clearances below
`NEAR` are rows of its least squares. And a step is made only if the robot can come to rest after it
without being too near to anything; else the motors brake. Since the step before was made under the
same condition, braking is safe: by induction the robot never comes nearer than the margin to what
stands still.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.asked import Asked
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.motion.stopping import stopping_path, stopping_way
from casadi_ik.problem.clearance import Clearances, Surroundings
from casadi_ik.problem.problems import Problems

OBSTACLES = 4
"""Clearances that the goal minds at once."""

NEAR = 0.01
"""Clearance beyond the margin from which on the goal keeps away [m]."""

NUDGE = 1e-4
"""Part of a motor's unit by which slopes of clearances are measured [rad or m]."""

PLACES = 9
"""Places on the way to rest that are looked at."""

SHARES = (1.0, 0.5)
"""Parts of the wanted step, between it and braking, that are tried in turn."""


class Guard:
    """The scene about a follower."""

    def __init__(self, plan: FollowPlan) -> None:
        """Take the scene, every finger in contact."""
        assert plan.check is not None
        self._check, self._plan = plan.check, plan
        fingers = len(plan.robot.fingers)
        anywhere = np.zeros((1, fingers, 3))
        self._around = self._at(plan.questions.of_arrays(anywhere, anywhere + 1.0, None))
        self._n = len(plan.robot.actuators)
        self._change = plan.rates.steps(plan.period)[1]

    def surround(self, problem: Problems) -> None:
        """Mind one target: which fingers touch, and where the object is."""
        self._around = self._at(problem)

    def _at(self, problem: Problems) -> Surroundings:
        return self._check.around(problem).rows(np.zeros(1, dtype=np.intp))

    def clearance(self, q: Array) -> Clearances:
        """Of a configuration (n,)."""
        return self._around.check(q[None])

    def step(self, asked: Asked) -> tuple[Array, bool]:
        """One step of the graph, or less of it.

        Returns:
            The state, and whether the motors had to brake.
        """
        n, run = self._n, asked.run
        before = run.state.copy()
        self._keep_away(asked, before[2 * n : 3 * n])
        after = run.step()
        q, moved = before[:n], after[n : 2 * n].copy()
        braked = np.sign(before[n : 2 * n]) * np.maximum(
            np.abs(before[n : 2 * n]) - self._change, 0.0
        )
        for share in SHARES:
            step = braked + share * (moved - braked)
            if self._can_rest(q + step, step):
                break
        else:
            share, step = 0.0, braked
            if not moved.any() or self._gets_free(q, moved):
                share, step = 1.0, moved
        if share < 1.0:
            after[:n], after[n : 2 * n] = q + step, step
            # A goal that runs ahead where nobody can follow would be reached through the obstacle.
            after[2 * n : 3 * n] = q + step + stopping_way(step, self._change)
            after[3 * n] = 0.0
        return after, share < 1.0

    def _can_rest(self, q: Array, moved: Array) -> bool:
        path = stopping_path(q, moved, self._change, PLACES)
        return bool(self._around.free(path).all())

    def _gets_free(self, q: Array, moved: Array) -> bool:
        """Whether a robot that is too near already gets away."""
        room = self._around.check(np.stack([q, q + moved])).room
        return bool(room[0] < 0 and room[1] > room[0])

    def _keep_away(self, asked: Asked, goal: Array) -> None:
        around = self._around
        rooms, slopes = asked.views["rooms"], asked.views["slopes"]
        rooms[...] = 0.0
        most = around.margin + NEAR
        least, _ = around.kernel.least(goal[None], around.poses, around.table, most)
        if least[0] >= most:
            return
        nudged = goal + np.concatenate([np.zeros((1, self._n)), NUDGE * np.eye(self._n)])
        every = around.kernel.every(nudged, around.poses, around.table)
        nearest = np.argsort(every[0])[: len(rooms)]
        count = len(nearest)
        rooms[:count] = np.maximum(most - every[0, nearest], 0.0)
        slopes[:count] = ((every[1:, nearest] - every[0, nearest]) / NUDGE).T
