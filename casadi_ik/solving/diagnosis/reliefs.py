"""Limits that block: lifted one by one and in groups, then drawn back as far as possible."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.answers.diagnosis import Relief
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.problem.problems import Problems
from casadi_ik.solving.trials import Bounds, Descent, Trials

HALVINGS = 8
"""How often what a limit has to give is halved, while a solution remains."""

NOTHING = 1e-9
"""What counts as not beyond a limit [rad or m]."""


@dataclass(frozen=True)
class Lift:
    """Limits that are lifted together.

    Attributes:
        name: An actuator, or "arm", "hand" or "all".
        columns: Positions in q.
    """

    name: str
    columns: tuple[int, ...]

    def widen(self, robot: ArmHand, bounds: Bounds, row: int) -> None:
        """Move the bounds of a row outwards: by half a turn, or by the range of a slider."""
        for i in self.columns:
            turning = robot.description.actuators[i].unit == "rad"
            far = np.pi if turning else float(robot.upper[i] - robot.lower[i])
            bounds.lower[row, i] -= far
            bounds.upper[row, i] += far


def lifts(
    robot: ArmHand, movable: NDArray[np.bool_], pressed: NDArray[np.bool_], hand_only: bool
) -> list[Lift]:
    """All lifts worth trying.

    Args:
        robot: The robot.
        movable: (n,) whether an actuator may move at all.
        pressed: (n,) whether its limit alone may be what blocks.
        hand_only: Whether the arm cannot help, because the hand does not fit.
    """
    every = tuple(map(int, np.flatnonzero(movable)))
    arm = tuple(i for i in every if i in robot.description.arm_actuators)
    hand = tuple(i for i in every if i in robot.description.hand_actuators)
    asked = [i for i in (hand if hand_only else every) if pressed[i]]
    single = [Lift(robot.actuators[i], (i,)) for i in asked]
    groups = {"hand": hand} if hand_only else {"arm": arm, "hand": hand, "all": every}
    return single + [Lift(name, columns) for name, columns in groups.items() if columns]


def relieve(
    trials: Trials, problems: Problems, limits: Bounds, solved: list[tuple[Lift, Array]], q: Array
) -> Iterator[Relief]:
    """Draw lifted limits back towards where they are, as long as there is a solution.

    Args:
        trials: The loop.
        problems: One target.
        limits: The true limits.
        solved: Lifts with a solution (n,) each.
        q: (n,) the nearest configuration within the true limits, a second start.
    """
    if not solved:
        return
    count, robot = len(solved), trials.robot
    best = np.stack([solution for _, solution in solved])
    descent, rows = Descent(trials, problems), np.zeros(2 * count, dtype=np.intp)
    # What is given lies between two configurations: one within the limits, one that solves it.
    least, most = np.zeros((count, 1)), np.ones((count, 1))
    beyond = limits.beyond(best)
    for _ in range(HALVINGS):
        share = (least + most) / 2
        bounds = Bounds(
            limits.lower + np.minimum(beyond, 0) * share,
            limits.upper + np.maximum(beyond, 0) * share,
        )
        twice = Bounds(np.tile(bounds.lower, (2, 1)), np.tile(bounds.upper, (2, 1)))
        starts = np.concatenate([best, np.tile(q, (count, 1))])
        reached = descent.run(rows, starts, twice)
        ok = trials.solved(problems, reached, limits=False).reshape(2, count)
        reached = reached.reshape(2, count, -1)
        new = np.where(ok[0][:, None], reached[0], reached[1])
        either = np.logical_or(ok[0], ok[1])[:, None]
        best = np.where(either, new, best)
        most, least = np.where(either, share, most), np.where(either, least, share)
    units = {actuator.name: actuator.unit for actuator in robot.description.actuators}
    for (lift, _), solution in zip(solved, best, strict=True):
        over = limits.beyond(solution)
        far = {
            name: float(value)
            for name, value in zip(robot.actuators, over, strict=True)
            if abs(value) > NOTHING
        }
        yield Relief(lift.name, far, units, solution)
