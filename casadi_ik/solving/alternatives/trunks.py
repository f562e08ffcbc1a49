"""Other answers of a body with the hands that it has: other trunks, and other arms for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.problem.status import Phase
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.robots.poses import link_poses
from casadi_ik.solving.trials import Subproblems
from casadi_ik.symbolic.even_spread import evenly

LAST = 1e6
"""Trunks tried: none follows the one that a row begins from."""

AT_ENDS = 2.0
"""Of every second trunk the even spread is stretched by this about its middle, up to the ends."""


def other_trunks(
    trials: Subproblems,
    targets: TargetBatch,
    q: Array,
    owner: NDArray[np.intp],
    first: int,
    count: int,
) -> tuple[Array, NDArray[np.intp]]:
    """Configurations with the same hands and palms, from several trunks each.

    By turns the arms are placed at the trunk in closed form, or trunk and arms move from anywhere.

    Args:
        trials: The loop.
        targets: k targets.
        q: (m, n) answers.
        owner: (m,) the target of each.
        first: Number of the first trunk.
        count: How many.

    Returns:
        (m count, n) where the loop ended, and the target of each.
    """
    robot, body = trials.robot, trials.robot.description
    mine = np.repeat(owner, count)
    starts = np.repeat(q, count, axis=0)
    hands = starts[:, list(body.hand_actuators)]
    states, parameters = trials.posture_rows(targets.rows(mine), starts, hands)
    moving = [*body.trunk_actuators, *(place for arm, _ in body.side_actuators for place in arm)]
    spread = evenly(first + count, len(moving))[first:]
    spread[1::2] = np.clip((spread[1::2] - 0.5) * AT_ENDS + 0.5, 0.0, 1.0)
    limits = trials.limits(targets).of(mine)
    lower, upper = (np.broadcast_to(ends, starts.shape) for ends in (limits.lower, limits.upper))
    begun = starts.copy()
    steps = np.tile(spread, (len(q), 1))
    begun[:, moving] = lower[:, moving] + steps * (upper - lower)[:, moving]
    values: dict[str, Array] = {name: np.asarray(at) for name, at in robot.joints(q).items()}
    poses = link_poses(body.root, body.joints, values)
    placed = np.tile(np.arange(first, first + count) % 4 != 3, len(q))
    wanted: dict[str, Array | float] = {
        "q": begun,
        "best_q": starts,
        "phase": np.where(placed, float(Phase.ARM_PLACEMENT), float(Phase.TRUNK)),
        "side": len(body.sides),
        "first": LAST,
        "farthest": LAST,
        "fits": 1.0,
        "fitted": 1.0,
        "tried": LAST,
        "again": 1.0,
    }
    for place, side in enumerate(body.sides):
        palm = np.broadcast_to(poses[side.palm_link] @ side.palm_placement, (len(q), 4, 4))
        rotation = palm[:, :3, :3].reshape(len(q), 9)
        wanted[f"palm_rotation_{place}"] = np.repeat(rotation, count, axis=0)
        wanted[f"palm_origin_{place}"] = np.repeat(palm[:, :3, 3], count, axis=0)
    for name, value in wanted.items():
        there = trials.state.slice(name)
        numbers = np.asarray(value, dtype=float)
        states[:, there] = numbers[:, None] if numbers.ndim == 1 else numbers
    return trials.run(states, parameters), mine
