"""How a cycle of a follower went."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from casadi_ik.answers.solution import Pair
from casadi_ik.arrays import Array


class FollowStatus(Enum):
    """How a cycle went.

    Example:
        >>> ik.FollowStatus.LATE.name
        'LATE'
    """

    FOLLOWING = "following"
    """Every contact is within tolerance."""
    LATE = "late"
    """The motors are under way: velocities and accelerations permit no more."""
    MISSED = "missed"
    """No posture was found on this branch that meets the contacts: out of reach, or behind a
    limit."""
    BLOCKED = "blocked"
    """Going on would touch something: the motors stop short."""
    HOLDING = "holding"
    """The frame was none: the motors come to rest and wait."""


@dataclass(frozen=True, eq=False)
class FollowState:
    """How the last cycle went.

    Attributes:
        status: In one word.
        reason: What was wrong with the frame, "" if nothing was.
        q: (n,) where the motors are told to be [rad or m].
        velocity: (n,) how fast they go there [rad/s or m/s].
        position_error: (f,) how far the fingertips are from their contacts then [m], NaN where
            free.
        angle_error: (f,) likewise [rad].
        goal: (n,) the posture they are on their way to.
        goal_position_error: (f,) how far off the contacts that is [m], NaN where free.
        goal_angle_error: (f,) likewise [rad].
        clearance: Distance of the pair nearest to being too near [m]; None without a scene.
        closest: That pair.
        cycles: How many there were.

    Example:
        >>> follower = solver.follow(q0=solution.q)
        >>> q = follower(grasp)
        >>> state = follower.state
        >>> bool(state.position_error.max() < 5e-3), state.cycles
        (True, 1)
    """

    status: FollowStatus
    reason: str
    q: Array
    velocity: Array
    position_error: Array
    angle_error: Array
    goal: Array
    goal_position_error: Array
    goal_angle_error: Array
    clearance: float | None
    closest: Pair | None
    cycles: int
