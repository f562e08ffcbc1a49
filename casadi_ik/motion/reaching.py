"""From where a robot is to a grasp: the way there, the straight approach, the closing, in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.approaching import ApproachPlan, ReachStatus, approaches
from casadi_ik.motion.closing import LastPart
from casadi_ik.motion.free_space import free_way
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.rates import Rates
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
        clearance: Smallest distance on the way before the hand closes [m]; None without a scene.
        tried: Solutions of the grasp that were looked at.

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
        motion = _motion(asked, corners, last)
        part = motion.notes["part"]
        before = motion.q[part != PARTS[2]]
        if open_handed is not None and not open_handed.free(before).all():
            reasons.append((ReachStatus.NO_WAY, "the timed motion is not free between its points"))
            continue
        clearance = None
        if open_handed is not None:
            clearance = float(open_handed.check(before).distance.min())
        return Reach(ReachStatus.REACHED, f"way there: {how}", motion, one.q, clearance, one.number)
    # That which came farthest says most.
    status, reason = max(reasons, key=lambda one: one[0] is ReachStatus.NO_WAY)
    return Reach(status, reason, None, None, None, len(solutions))


def _motion(asked: ReachPlan, corners: Array, last: LastPart) -> Motion:
    """All parts in time, at rest between them."""
    robot = asked.approach.plan.robot
    straight = [corners[i : i + 2] for i in range(len(corners) - 1)]
    parts = [(PARTS[0], way) for way in straight] + [(PARTS[1], last.coming)]
    parts.append((PARTS[2], last.closing))
    done = [(name, timed(way, asked.rates, asked.period)) for name, way in parts]
    names, times, end = [PARTS[0]], [np.zeros(1)], 0.0
    for name, one in done:
        times.append(end + one.times[1:])
        end += float(one.times[-1])
        names += [name] * (len(one.times) - 1)
    still = np.zeros_like(corners[:1])
    return Motion(
        robot,
        np.concatenate(times),
        np.clip(
            np.concatenate([corners[:1], *(one.q[1:] for _, one in done)]),
            *asked.approach.plan.bounds,
        ),
        np.concatenate([still, *(one.velocity[1:] for _, one in done)]),
        np.concatenate([still, *(one.acceleration[1:] for _, one in done)]),
        {"part": np.array(names)},
    )
