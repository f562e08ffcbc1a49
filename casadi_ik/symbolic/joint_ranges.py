"""Where joints can be while the motors they follow are within intervals: guaranteed, as graphs.

Every coupling is taken through the ends of its interval: shared, mimicking and lead-screw joints
are monotone. A four-bar is monotone but for the poses in which rod and ground align, which are
known in closed form; where an interval may hold a toggle the joint may be anywhere on its turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.robots.couplings import FourBar, LeadScrew
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.symbolic.couplings import follow
from casadi_ik.symbolic.smooth import Expr

ROUNDING = 1e-12
"""By how much a coupling's ends are moved outwards [rad or m]: more than its rounding errors."""

NEAR = 1e-6
"""A four-bar within this of a toggle (of the square of a length, relative) counts as there; angles
of its turning points are widened by as much [rad]."""


@dataclass(frozen=True, eq=False)
class Range:
    """An interval [rad or m]; both ends are scalar graphs."""

    lower: Expr
    upper: Expr

    @property
    def middle(self) -> Expr:
        """The middle."""
        return (self.lower + self.upper) / 2

    @property
    def half(self) -> Expr:
        """Half its width, rounded up, never negative."""
        return ca.fmax((self.upper - self.lower) / 2, 0.0) + ROUNDING

    def within(self, other: Range) -> Range:
        """What both have in common; ends that cross say that there is nothing."""
        return Range(ca.fmax(self.lower, other.lower), ca.fmin(self.upper, other.upper))


def joint_ranges(robot: RobotDescription, given: dict[str, Range]) -> dict[str, Range]:
    """Intervals of all joints that are given or follow what is given, by joint name.

    Args:
        robot: The description.
        given: By name of the actuator or joint.
    """
    joints = {joint.name: joint for joint in robot.movable}
    found = dict(given)

    def known(name: str) -> Range | None:
        joint = joints.get(name)
        if name not in found and joint is not None and joint.coupling is not None:
            source = known(joint.coupling.of)
            if source is not None:
                found[name] = _followed(joint, source)
        return found.get(name)

    return {name: range_ for name in joints if (range_ := known(name)) is not None}


def _followed(joint: Joint, source: Range) -> Range:
    coupling = joint.coupling
    if isinstance(coupling, FourBar):
        return _bent(joint, coupling, source)
    if isinstance(coupling, LeadScrew):
        # The triangle knows the length of the slider only, not its sign.
        a, b = ca.fabs(source.lower), ca.fabs(source.upper)
        around = ca.logic_and(source.lower < 0, source.upper > 0)
        source = Range(ca.if_else(around, 0.0, ca.fmin(a, b)), ca.fmax(a, b))
    ends = follow(joint, source.lower), follow(joint, source.upper)
    return Range(ca.fmin(*ends) - ROUNDING, ca.fmax(*ends) + ROUNDING)


def _bent(joint: Joint, bar: FourBar, source: Range) -> Range:
    """The joint of a four-bar: its ends, and the turning points in between."""
    phi = Range(source.lower + bar.phi_0, source.upper + bar.phi_0)
    ends = [follow(joint, source.lower), follow(joint, source.upper)]
    lower, upper = ca.fmin(*ends), ca.fmax(*ends)
    for turn in _turning_points(bar):
        value = follow(joint, ca.SX(turn - bar.phi_0))
        inside = _holds(phi, turn)
        lower = ca.if_else(inside, ca.fmin(lower, value), lower)
        upper = ca.if_else(inside, ca.fmax(upper, value), upper)
    anywhere = _may_toggle(bar, phi)
    for wrap in _wraps(bar):
        anywhere = ca.logic_or(anywhere, _holds(phi, wrap))
    return Range(
        ca.if_else(anywhere, -np.pi, lower) - ROUNDING,
        ca.if_else(anywhere, np.pi, upper) + ROUNDING,
    )


def _may_toggle(bar: FourBar, phi: Range) -> Expr:
    """Whether |PC|^2 may leave ((q - h)^2, (q + h)^2), between which rod and coupler bend."""
    cosines = ca.cos(phi.lower), ca.cos(phi.upper)
    highest = ca.if_else(_holds(phi, 0.0), 1.0, ca.fmax(*cosines))
    lowest = ca.if_else(_holds(phi, np.pi), -1.0, ca.fmin(*cosines))
    size = bar.p**2 + bar.g**2
    least, most = size - 2 * bar.p * bar.g * highest, size - 2 * bar.p * bar.g * lowest
    margin = NEAR * (bar.q + bar.h) ** 2
    short, long = (bar.q - bar.h) ** 2 + margin, (bar.q + bar.h) ** 2 - margin
    return ca.logic_or(least < short, most > long)


def _turning_points(bar: FourBar) -> list[float]:
    """Crank angles [rad] at which rod and ground align, so that the joint turns back."""
    found = []
    for reach in (bar.g + bar.q, bar.g - bar.q):
        if abs(reach) > 0:
            cosine = (bar.p**2 + reach**2 - bar.h**2) / (2 * bar.p * reach)
            if abs(cosine) <= 1 + NEAR:
                angle = float(np.arccos(np.clip(cosine, -1, 1)))
                found += [angle, -angle]
    return found


def _wraps(bar: FourBar) -> list[float]:
    """Crank angles [rad] at which the joint is half a turn from its zero, where its value jumps."""
    arm = bar.p + bar.h * np.exp(1j * (bar.theta_3_0 + np.pi))
    size = abs(arm)
    if size < NEAR * bar.p:
        return [0.0, np.pi]
    cosine = (size**2 + bar.g**2 - bar.q**2) / (2 * bar.g * size)
    if abs(cosine) > 1 + NEAR:
        return []
    angle = float(np.arccos(np.clip(cosine, -1, 1)))
    return [angle - float(np.angle(arm)), -angle - float(np.angle(arm))]


def _holds(range_: Range, angle: float) -> Expr:
    """Whether an interval may hold an angle, by whole turns."""
    turns = (range_.upper + NEAR - angle) / (2 * np.pi), (range_.lower - NEAR - angle) / (2 * np.pi)
    return ca.floor(turns[0]) >= ca.ceil(turns[1])
