"""What a follower keeps to all the time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.motion.rates import Rates
from casadi_ik.problem.clearance import SceneCheck
from casadi_ik.problem.questions import Questions

FADING = 0.05
"""Seconds in which an error of the contacts fades."""


@dataclass(frozen=True, eq=False)
class FollowPlan:
    """What a follower keeps to all the time.

    Attributes:
        questions: Robot and tolerances.
        check: The scene about the robot; None: collisions are not checked.
        compiled: Whether in compiled code.
        q0: (n,) where the robot is [rad or m].
        bounds: (n,) lower and upper, what is held included.
        period: Time from cycle to cycle [s].
        rates: Limits of the motors' motion.
        posture: (n,) where motions lead that the contacts leave free.
        settling: Time in which they come there [s]; infinite: they do not.
        pull: See `Cycle`.
    """

    questions: Questions
    check: SceneCheck | None
    compiled: bool
    q0: Array
    bounds: tuple[Array, Array]
    period: float
    rates: Rates
    posture: Array
    settling: float
    pull: float

    @property
    def robot(self) -> ArmHand:
        """The robot."""
        return self.questions.robot

    @property
    def habits(self) -> dict[str, float]:
        """How free motions and errors fade from cycle to cycle, as parameters of a cycle.

        A free motion is that of a critically damped spring between the motors and their posture.
        """
        if math.isinf(self.settling):
            return {"pull": self.pull, "keep": 0.0, "drift": 0.0, "patience": 0.0}
        kept = math.exp(-self.period / self.settling)
        return {
            "pull": self.pull,
            "keep": kept**2,
            "drift": (1 - kept) ** 2,
            "patience": math.exp(-self.period / FADING),
        }
