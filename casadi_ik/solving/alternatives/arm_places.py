"""Where the arms that hold a hand are looked at: values of their redundancy."""

from __future__ import annotations

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arms.family import ArmFamily
from casadi_ik.arms.search import PARAMETERS
from casadi_ik.kernels.swing_kernel import ArmPlaces
from casadi_ik.symbolic.even_spread import evenly

SWIVELS = 12
"""Values of the last number of a redundancy looked at all around."""

LOCKED = (5, 3)
"""Angles of each locked joint, where these are all the redundancy and where they are not."""

CLOSER = 13
"""Values looked at around the one that was taken."""


def arm_places(robot: ArmHand, family: ArmFamily) -> ArmPlaces:
    """Where the arms of a robot are looked at: a grid, and places between where none is found."""
    columns = list(robot.description.arm_actuators)
    lower, upper = robot.lower[columns], robot.upper[columns]
    ends = np.array([one.bounds(lower, upper) for one in family.redundancy], dtype=float)
    ends = ends.reshape(-1, 2)
    locked = len(family.locked)
    counts = [LOCKED[len(ends) > locked]] * locked + [SWIVELS] * (len(ends) - locked)
    grids = [(np.arange(count) + 0.5) / count for count in counts]
    grid = (
        np.stack([axis.ravel() for axis in np.meshgrid(*grids, indexing="ij")], axis=1)
        if grids
        else np.zeros((1, 1))
    )
    if locked:
        between = evenly(2 * len(grid), len(ends))
    else:
        between = (grid + 0.5 / SWIVELS)[: len(grid) * len(ends)]
    closer = np.zeros(0)
    if counts:
        step = (ends[-1, 1] - ends[-1, 0]) / counts[-1]
        closer = step * np.linspace(-1, 1, CLOSER + 2)[1:-1]
        low, width = ends[:, 0], ends[:, 1] - ends[:, 0]
        grid, between = low + width * grid, low + width * between
    return ArmPlaces(
        np.array(columns, dtype=np.int64),
        lower,
        upper,
        family.rows,
        (grid, between),
        closer,
        PARAMETERS.allowed,
    )
