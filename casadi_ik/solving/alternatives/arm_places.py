"""Where the arms that hold a hand are looked at: swivels, swept joints, and where wrists stand."""

from __future__ import annotations

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.kernels.swing_kernel import ArmPlaces
from casadi_ik.methods.common.arm_branches import SIDES, rows_of
from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.methods.common.even_spread import evenly
from casadi_ik.symbolic.closed_arms.held import HeldArm
from casadi_ik.symbolic.closed_arms.recognise import ArmForm
from casadi_ik.symbolic.srs_arm import SrsArm

SWIVELS = 12
"""Swivels looked at all around, for every branch."""

HELD = 5
"""Angles of each joint that is held while the others are solved for."""

HELD_SWEPT = 3
"""As many where another is swept as well."""

BETWEEN = 1
"""So many more between each two of them, where nothing is found."""

CLOSER = 13
"""Swivels looked at around the one that was taken."""

TURN = 2 * np.pi


def arm_places(robot: ArmHand, arm: ArmForm | HeldArm) -> ArmPlaces:
    """Where the arms of a robot are looked at."""
    columns = list(robot.description.arm_actuators)
    if isinstance(arm, HeldArm):
        return _held_places(robot, arm)
    sides, first, last = len(SIDES), 0.0, TURN
    swept = True
    if not isinstance(arm, SrsArm):
        sides, swept = rows_of(arm), arm.swept_joint is not None
        if arm.swept_joint is not None:
            first, last = _swept(robot, columns[arm.swept_joint])
    step = (last - first) / SWIVELS
    middles = first + step * (np.arange(SWIVELS) + 0.5)
    between = np.arange(1, BETWEEN + 1) / (BETWEEN + 1)
    levels = [middles, (middles[:, None] + step * between).ravel()]
    if not swept:
        levels = [np.zeros(1), np.zeros(0)]
    placed = [level[:, None] for level in levels]
    if isinstance(arm, SrsArm):
        placed = [
            np.vstack([np.insert(one, 0, sign, axis=1) for sign in (1, -1)]) for one in placed
        ]
    closer = step * np.linspace(-1, 1, CLOSER + 2)[1:-1] if swept else np.zeros(0)
    return ArmPlaces(
        np.array(columns, dtype=np.int64),
        robot.lower[columns],
        robot.upper[columns],
        sides,
        (placed[0], placed[1]),
        closer,
        ALLOWED,
    )


def _swept(robot: ArmHand, column: int) -> tuple[float, float]:
    """What of a joint's range is looked at: a whole turn at most."""
    low, high = float(robot.lower[column]), float(robot.upper[column])
    middle, half = (low + high) / 2, min((high - low) / 2, np.pi)
    return middle - half, middle + half


def _held_places(robot: ArmHand, arm: HeldArm) -> ArmPlaces:
    """Grids of the held joints, and of the swept one; between them evenly spread places."""
    columns = list(robot.description.arm_actuators)
    varied = [columns[joint] for joint in arm.held]
    counts = [HELD] * len(varied)
    if arm.form.swept_joint is not None:
        varied.append(columns[arm.solved[arm.form.swept_joint]])
        counts.append(SWIVELS)
        counts[:-1] = [HELD_SWEPT] * len(arm.held)
    ends = np.array([_swept(robot, column) for column in varied])
    low, width = ends[:, 0], ends[:, 1] - ends[:, 0]
    grids = [(np.arange(count) + 0.5) / count for count in counts]
    grid = np.stack([axis.ravel() for axis in np.meshgrid(*grids, indexing="ij")], axis=1)
    spread = evenly(2 * len(grid), len(varied))
    step = width[-1] / counts[-1]
    return ArmPlaces(
        np.array(columns, dtype=np.int64),
        robot.lower[columns],
        robot.upper[columns],
        rows_of(arm),
        (low + width * grid, low + width * spread),
        step * np.linspace(-1, 1, CLOSER + 2)[1:-1],
        ALLOWED,
    )
