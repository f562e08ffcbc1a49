"""The last part of the way to a grasp: the open hand comes straight, then it closes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.asked import ANY, Asked
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.problem.contacts import usual
from casadi_ik.problem.problems import Problems

POSTURES = 40
"""Of each of both parts."""

CYCLES = 3
"""Cycles that each is given."""

STRAY = 2e-3
"""How far the palm may be from its straight way [m]."""


@dataclass(frozen=True, eq=False)
class LastPart:
    """Postures on the way to a grasp.

    Attributes:
        coming: (k, n) the open hand comes straight to where it will close.
        closing: (k, n) it closes, the last posture is the grasp.
    """

    coming: Array
    closing: Array


class Closer:
    """Finds the last part of the way on one robot, backwards: the hand opens, and goes."""

    def __init__(self, plan: FollowPlan) -> None:
        """Compile what is not compiled yet; the plan has no limits of velocity."""
        self._robot = plan.robot
        self._asked = Asked(plan, usual(len(plan.robot.fingers)), 0)

    def find(
        self,
        problem: Problems,
        q: Array,
        opening: float,
        distance: float,
        direction: Array | None = None,
    ) -> LastPart | None:
        """The last part of the way to a solution; None if there is none.

        Args:
            problem: The grasp.
            q: (n,) its solution.
            opening: How far the fingertips are from their contacts while the hand is open [m].
            distance: How far it comes straight [m].
            direction: (3,) the way it comes, base frame; None: from the palm to the contacts.
        """
        robot = self._robot
        palm, (points, normals) = robot.palm(q), robot.contacts(q)
        given = ~np.isnan(problem.points[0, :, 0])
        share = np.linspace(0.0, 1.0, POSTURES)[:, None, None]
        opened = points - opening * share * normals
        opening_way = self._walk(q, opened, np.repeat(palm[None], POSTURES, axis=0), given)
        there = opening_way[-1]
        if not self._asked.cycle.palm:
            return LastPart(there[None], opening_way[::-1])
        here: Array = robot.contacts(there)[0][given].mean(axis=0) - palm[:3, 3]
        way = here if direction is None else direction
        back = -distance * way / max(float(np.linalg.norm(way)), 1e-9)
        coming = self.straight(there, back)
        return None if coming is None else LastPart(coming[::-1], opening_way[::-1])

    def straight(self, q: Array, shift: Array) -> Array | None:
        """(k, n) postures from q on with palm and fingertips moved by (3,) [m]; None: it strays."""
        robot, share = self._robot, np.linspace(0.0, 1.0, POSTURES)[:, None]
        tips = robot.contacts(q)[0]
        palms = np.repeat(robot.palm(q)[None], POSTURES, axis=0)
        palms[:, :3, 3] += share * shift
        every = np.ones(len(tips), dtype=bool)
        found = self._walk(q, tips + share[:, None] * shift, palms, every)
        off = np.linalg.norm(robot.palm(found)[:, :3, 3] - palms[:, :3, 3], axis=1)
        return None if off.max() > STRAY else found

    def _walk(self, q: Array, tips: Array, palms: Array, given: Array) -> Array:
        """(k, n) postures from q on with fingertips (k, f, 3) and palm (k, 4, 4) there."""
        asked, count = self._asked, len(tips)
        layout = asked.cycle.parameters
        every = np.repeat(asked.run.parameters[None], count, axis=0)
        f = len(given)
        values = {
            "points": tips,
            "normals": np.tile(ANY, (count, f, 1)),
            "weights": np.tile(np.stack([given, 0 * given], axis=1), (count, 1, 1)),
            "position_tolerance": np.ones((count, f)),
            "angle_tolerance": np.ones((count, f)),
        }
        if asked.cycle.palm:
            values |= {
                "palm_point": palms[:, :3, 3],
                "palm_axes": palms[:, :3, :3],
                "palm_weight": np.ones((count, 2)),
            }
        for name, array in values.items():
            every[:, layout.slice(name)] = array.reshape(count, -1)
        rows = np.repeat(every, CYCLES, axis=0)
        states, _ = asked.run.run(asked.state_at(q), rows)
        found = states[CYCLES - 1 :: CYCLES, : len(q)]
        found[0] = q
        return found
