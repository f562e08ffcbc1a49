"""From where a robot is to a grasp: the way there, the straight approach, the closing, in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.approaching import ApproachPlan, ReachStatus, approaches
from casadi_ik.motion.clear_between import least_clearance
from casadi_ik.motion.free_space import free_way
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.rates import Rates, shares
from casadi_ik.motion.timing import timed

PARTS = ("going", "coming", "closing")
"""Of a motion: to the pre-grasp, straight to the object, around it."""


@dataclass(frozen=True, eq=False)
class Reach:
    """The way to a grasp.

    Attributes:
        status: How it went.
        reason: In words.
        motion: From q0 at rest to the grasp at rest; its note "part" says which of `PARTS` each
            time belongs to. None if there is none.
        q: (n,) the solution of the grasp that it ends with; None likewise.
        clearance: Smallest distance on the way before the hand closes [m], as `Clearances` counts
            it, between samples too: it is nowhere less by more than 0.1 mm. None without a scene.
        tried: Solutions of the grasp that were looked at.
        velocity_share: Largest part of a motor's velocity limit that the samples take, by their
            first differences; 0 without a motion.
        acceleration_share: Likewise of the acceleration, by second differences.

    Example:
        >>> found = solver.reach(grasp)
        >>> found.success, bool(np.allclose(found.motion.q[-1], found.q))
        (True, True)
    """

    status: ReachStatus
    reason: str
    motion: Motion | None
    q: Array | None
    clearance: float | None
    tried: int
    velocity_share: float = 0.0
    acceleration_share: float = 0.0

    @property
    def success(self) -> bool:
        """Whether there is a motion."""
        return self.status is ReachStatus.REACHED


@dataclass(frozen=True, eq=False)
class ReachPlan:
    """What a way to a grasp has to keep to.

    Attributes:
        approach: What its last part has to keep to.
        rates: Limits of the motion.
        period: Time between two samples [s].
        seed: Of a planner.
    """

    approach: ApproachPlan
    rates: Rates
    period: float
    seed: int


def reach(asked: ReachPlan, q0: Array, solutions: Sequence[Array]) -> Reach:
    """The way to the first of some solutions to which there is one.

    Args:
        asked: What to keep to.
        q0: (n,) where the robot is.
        solutions: (n,) each, of the grasp, best first.
    """
    if not solutions:
        return Reach(ReachStatus.NOT_SOLVED, "the grasp has no solution", None, None, None, 0)
    reasons: list[tuple[ReachStatus, str]] = []
    for one in approaches(asked.approach, solutions):
        last, open_handed = one.last, one.open_handed
        if last is None:
            reasons.append((ReachStatus.NO_APPROACH, one.reason))
            continue
        corners, how = free_way(
            asked.approach.plan.robot, q0, last.coming[0], open_handed, asked.seed
        )
        if corners is None:
            reasons.append((ReachStatus.NO_WAY, how))
            continue
        going = [(PARTS[0], np.stack(ends)) for ends in pairwise(corners)]
        motion = _in_time(asked, [*going, (PARTS[1], last.coming), (PARTS[2], last.closing)])
        part = motion.notes["part"]
        open_part, closing = motion.q[part != PARTS[2]], motion.q[part == PARTS[2]]
        clearance, reason = None, ""
        if open_handed is not None and one.holding is not None:
            clearance, reason = least_clearance(open_handed, open_part)
            shut = np.concatenate([open_part[-1:], closing])
            reason = reason or least_clearance(one.holding, shut)[1]
        if reason:
            reasons.append((ReachStatus.NO_WAY, f"the timed motion is not free: {reason}"))
            continue
        return Reach(
            ReachStatus.REACHED,
            f"way there: {how}",
            motion,
            one.q,
            clearance,
            one.number,
            *shares(motion.q, asked.period, asked.rates),
        )
    # That which came farthest says most.
    status, reason = max(reasons, key=lambda one: one[0] is ReachStatus.NO_WAY)
    return Reach(status, reason, None, None, None, len(solutions))


def _in_time(asked: ReachPlan, ways: Sequence[tuple[str, Array]]) -> Motion:
    """Ways (k, n), each from where the last one ends, in time, at rest between them."""
    plan = asked.approach.plan
    q, names = [ways[0][1][:1]], [ways[0][0]]
    for name, way in ways:
        samples = timed(way, asked.rates, asked.period)[1:]
        q.append(samples)
        names += [name] * len(samples)
    every = np.concatenate(q)
    return Motion.of_samples(plan.robot, asked.period, every, {"part": np.array(names)})
