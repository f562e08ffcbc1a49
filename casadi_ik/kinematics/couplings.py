"""Couplings from actuators to joints: the map theta = c(q), its derivative and its bounds.

`COUPLING_ROWS` has one row per kind of coupling. The range of a joint over an interval of its
source is implemented twice, independently: `interval` as a graph for the search for proofs that a
target is unreachable, and `bounds` in numpy for the check of these proofs. Both enclose every
position, including rounding errors; the enclosures need not be tight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics import mechanisms
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.couplings import Coupling, FourBar, LeadScrew, Linear, Polynomial
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint

INTERVAL_MARGIN = 1e-12
"""Margin of an interval [rad or m], also relative to the terms of a sum; larger than the rounding
errors of a coupling."""

TOGGLE_MARGIN = 1e-6
"""Relative distance of a squared length from a toggle of a four-bar below which it counts as
toggled; also the margin of the angles of its extrema [rad]."""

Bounds = tuple[Array, Array]
"""Lower and upper bounds (k,)."""


@dataclass(frozen=True, eq=False)
class Interval:
    """An interval [rad or m] whose bounds are scalar graphs."""

    lower: Expr
    upper: Expr

    @property
    def middle(self) -> Expr:
        """Midpoint."""
        return (self.lower + self.upper) / 2

    @property
    def half_width(self) -> Expr:
        """Half of the width, rounded up, never negative."""
        return ca.fmax((self.upper - self.lower) / 2, 0.0) + INTERVAL_MARGIN


@dataclass(frozen=True, eq=False)
class CouplingRow:
    """Formulas of a kind of coupling.

    `follow`, `rate` and `toggle` take the parameters of the coupling (an object with their names
    as attributes: the description, or symbols that a calibration estimates), the position of the
    source [rad or m], and the description, which selects the branch.

    Attributes:
        follow: Position of the joint [rad or m].
        rate: Derivative of the joint position by the position of its source.
        interval: ``(coupling, source) ->`` an `Interval` that contains the joint position while
            the source is within an `Interval`.
        bounds: ``(coupling, lower, upper) ->`` such bounds in numpy for k intervals, from
            independent formulas.
        toggle: Squared sine of the transmission angle, see `toggle_margins`; None if the kind has
            no singular position.
    """

    follow: Callable[[Any, Expr, Any], Expr]
    rate: Callable[[Any, Expr, Any], Expr]
    interval: Callable[[Any, Interval], Interval]
    bounds: Callable[[Any, Array, Array], Bounds]
    toggle: Callable[[Any, Expr, Any], Expr] | None = None


def linkage_of(numbers: Any, description: FourBar) -> mechanisms.Linkage:
    """Return a four-bar on the branch of its reference pose (phi_0, theta_3_0)."""
    nominal = mechanisms.Linkage(description.p, description.q, description.g, description.h)
    branch = mechanisms.branch_from_pose(nominal, description.phi_0, description.theta_3_0)
    return mechanisms.Linkage(numbers.p, numbers.q, numbers.g, numbers.h, branch)


def _four_bar_angle(numbers: Any, source: Expr, description: FourBar) -> Expr:
    # The branch follows the described reference pose, so that the angle is continuous there for
    # every estimate of the parameters.
    bar, phi = linkage_of(numbers, description), numbers.phi_0 + source
    return mechanisms.theta3(phi, bar, description.theta_3_0) - numbers.theta_3_0


def _horner(coefficients: Sequence[float], source: Expr) -> Expr:
    """Return the value of a polynomial, coefficients from the constant upwards."""
    value: Expr = ca.DM(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * source + coefficient
    return value


def _derivative_coefficients(coefficients: Sequence[float]) -> list[float]:
    """Return the coefficients of the derivative of a polynomial."""
    return [power * value for power, value in enumerate(coefficients)][1:]


def polynomial_interval(coefficients: Sequence[float], source: Interval) -> Interval:
    """Return an interval that contains a polynomial, from its Taylor series at the midpoint.

    Args:
        coefficients: Coefficients from the constant upwards.
        source: Interval of the argument [rad or m].
    """
    middle, half_width = source.middle, source.half_width
    derivative, factorial, power = list(coefficients), 1.0, half_width
    value = lower = upper = _horner(derivative, middle)
    for order in range(1, len(coefficients)):
        derivative, factorial = _derivative_coefficients(derivative), factorial * order
        term = _horner(derivative, middle) / factorial * power
        # An odd power of the deviation has either sign, an even power is positive.
        smallest, largest = (-ca.fabs(term), ca.fabs(term)) if order % 2 else (term, term)
        lower, upper = lower + ca.fmin(smallest, 0.0), upper + ca.fmax(largest, 0.0)
        power = power * half_width
    largest_argument = ca.fabs(middle) + half_width
    margin = INTERVAL_MARGIN * (
        1 + ca.fabs(value) + _horner([abs(c) for c in coefficients], largest_argument)
    )
    return Interval(lower - margin, upper + margin)


def polynomial_bounds(coefficients: Sequence[float], lower: Array, upper: Array) -> Bounds:
    """Return bounds of a polynomial over k intervals, from its Bernstein coefficients.

    Args:
        coefficients: Coefficients from the constant upwards.
        lower: (k,) lower bounds of the argument [rad or m].
        upper: (k,) upper bounds of the argument [rad or m].
    """
    n, width = len(coefficients) - 1, upper - lower
    # Substituting lower + t width gives sum a_i t^i with t in [0, 1].
    a = np.zeros((n + 1, len(lower)))
    for coefficient in reversed(coefficients):
        a[1:] = a[1:] * lower + a[:-1] * width
        a[0] = a[0] * lower + coefficient
    bernstein = [
        sum(math.comb(j, i) / math.comb(n, i) * a[i] for i in range(j + 1)) for j in range(n + 1)
    ]
    margin = 1e-11 * (1 + np.abs(a).sum(axis=0))
    return np.min(bernstein, axis=0) - margin, np.max(bernstein, axis=0) + margin


def _lead_screw_interval(screw: LeadScrew, source: Interval) -> Interval:
    """Return the interval of the joint, which is monotone in the absolute length of the slider."""
    a, b = ca.fabs(source.lower), ca.fabs(source.upper)
    contains_zero = ca.logic_and(source.lower < 0, source.upper > 0)
    lengths = ca.if_else(contains_zero, 0.0, ca.fmin(a, b)), ca.fmax(a, b)
    angle_a, angle_b = (COUPLING_ROWS[LeadScrew].follow(screw, length, screw) for length in lengths)
    return Interval(
        ca.fmin(angle_a, angle_b) - INTERVAL_MARGIN, ca.fmax(angle_a, angle_b) + INTERVAL_MARGIN
    )


def _lead_screw_bounds(screw: LeadScrew, lower: Array, upper: Array) -> Bounds:
    shortest = np.where((lower < 0) & (upper > 0), 0.0, np.minimum(abs(lower), abs(upper)))
    return _triangle_angle(screw, shortest), _triangle_angle(
        screw, np.maximum(abs(lower), abs(upper))
    )


def _triangle_angle(screw: LeadScrew, s: Array) -> Array:
    """Return the joint angle by the law of cosines, with a margin at flat triangles."""
    cosine = (screw.b**2 + screw.c**2 - s**2) / (2 * screw.b * screw.c)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    is_flat = np.sqrt(np.maximum(1 - cosine**2, 0.0)) < 1e-4
    # At a flat triangle the rounding error of the cosine changes the angle by up to 1e-7 rad.
    return (
        np.where(is_flat, np.where(cosine > 0, angle - 1e-7, angle + 1e-7), angle) - screw.theta_0
    )


def _four_bar_interval(bar: FourBar, source: Interval) -> Interval:
    """Return the interval of a four-bar from its ends and the extrema between them.

    Extrema are the poses in which rod and ground align. If the source interval may contain a
    toggle the joint interval is the full circle.
    """

    def joint_angle(angle: Expr) -> Expr:
        return COUPLING_ROWS[FourBar].follow(bar, angle, bar)

    phi = Interval(source.lower + bar.phi_0, source.upper + bar.phi_0)
    end_angles = joint_angle(source.lower), joint_angle(source.upper)
    lower, upper = ca.fmin(*end_angles), ca.fmax(*end_angles)
    for extremum in _turning_points(bar):
        value, is_inside = joint_angle(ca.SX(extremum - bar.phi_0)), _may_contain(phi, extremum)
        lower = ca.if_else(is_inside, ca.fmin(lower, value), lower)
        upper = ca.if_else(is_inside, ca.fmax(upper, value), upper)
    is_unbounded = _may_toggle(bar, phi)
    for wrap in _wrap_angles(bar):
        is_unbounded = ca.logic_or(is_unbounded, _may_contain(phi, wrap))
    return Interval(
        ca.if_else(is_unbounded, -np.pi, lower) - INTERVAL_MARGIN,
        ca.if_else(is_unbounded, np.pi, upper) + INTERVAL_MARGIN,
    )


def _may_toggle(bar: FourBar, phi: Interval) -> Expr:
    """Return whether |PC|^2 may leave ((q - h)^2, (q + h)^2), where rod and coupler align."""
    cosines = ca.cos(phi.lower), ca.cos(phi.upper)
    highest = ca.if_else(_may_contain(phi, 0.0), 1.0, ca.fmax(*cosines))
    lowest = ca.if_else(_may_contain(phi, np.pi), -1.0, ca.fmin(*cosines))
    sum_of_squares = bar.p**2 + bar.g**2
    smallest, largest = (
        sum_of_squares - 2 * bar.p * bar.g * highest,
        sum_of_squares - 2 * bar.p * bar.g * lowest,
    )
    margin = TOGGLE_MARGIN * (bar.q + bar.h) ** 2
    lower_limit, upper_limit = (bar.q - bar.h) ** 2 + margin, (bar.q + bar.h) ** 2 - margin
    return ca.logic_or(smallest < lower_limit, largest > upper_limit)


def _turning_points(bar: FourBar) -> list[float]:
    """Return the crank angles [rad] at which rod and ground align: extrema of the joint angle."""
    angles = []
    for reach in (bar.g + bar.q, bar.g - bar.q):
        if abs(reach) > 0:
            cosine = (bar.p**2 + reach**2 - bar.h**2) / (2 * bar.p * reach)
            if abs(cosine) <= 1 + TOGGLE_MARGIN:
                angle = float(np.arccos(np.clip(cosine, -1, 1)))
                angles += [angle, -angle]
    return angles


def _wrap_angles(bar: FourBar) -> list[float]:
    """Return the crank angles [rad] at which the joint angle wraps from pi to -pi."""
    arm = bar.p + bar.h * np.exp(1j * (bar.theta_3_0 + np.pi))
    size = abs(arm)
    if size < TOGGLE_MARGIN * bar.p:
        return [0.0, np.pi]
    cosine = (size**2 + bar.g**2 - bar.q**2) / (2 * bar.g * size)
    if abs(cosine) > 1 + TOGGLE_MARGIN:
        return []
    angle = float(np.arccos(np.clip(cosine, -1, 1)))
    return [angle - float(np.angle(arm)), -angle - float(np.angle(arm))]


def _may_contain(interval: Interval, angle: float) -> Expr:
    """Return whether an interval may contain an angle modulo 2 pi."""
    last = (interval.upper + TOGGLE_MARGIN - angle) / (2 * np.pi)
    first = (interval.lower - TOGGLE_MARGIN - angle) / (2 * np.pi)
    return ca.floor(last) >= ca.ceil(first)


def _four_bar_bounds(bar: FourBar, lower: Array, upper: Array, samples: int = 17) -> Bounds:
    """Return bounds of a four-bar from samples and the largest slope g / (h sin) between them."""
    fractions = np.linspace(0.0, 1.0, samples)
    phi = bar.phi_0 + lower[:, None] + (upper - lower)[:, None] * fractions
    step = (upper - lower) / (samples - 1)
    crank = bar.p * np.exp(1j * phi)
    # |PC|^2 changes by at most 2 p g per radian of the crank; half a step to the nearest sample.
    squares, change = abs(crank - bar.g) ** 2, bar.p * bar.g * step
    inner, outer = (bar.q - bar.h) ** 2, (bar.q + bar.h) ** 2
    smallest, largest = squares.min(axis=1) - change, squares.max(axis=1) + change
    sine = np.minimum(
        (smallest - inner) * (outer - smallest), (largest - inner) * (outer - largest)
    )
    is_unbounded = sine <= 1e-9 * (bar.q * bar.h) ** 2
    sine = np.sqrt(np.where(is_unbounded, 1.0, sine)) / (2 * bar.q * bar.h)
    values = _coupler_angle(bar, phi)
    gap = bar.g / (bar.h * sine) * step / 2
    low, high = values.min(axis=1) - gap, values.max(axis=1) + gap
    is_unbounded |= (low < -3.0) | (high > 3.0)
    return np.where(is_unbounded, -np.pi, low), np.where(is_unbounded, np.pi, high)


def _coupler_angle(bar: FourBar, phi: Array) -> Array:
    """Return the angle of the coupler to the crank minus its zero, in (-pi, pi] [rad]."""

    def angle(phi: Array, side: int) -> Array:
        p, c = bar.p * np.exp(1j * phi), bar.g
        line = c - p
        distance = np.abs(line)
        # Q has the distance h from P and q from C: components parallel and perpendicular to PC.
        parallel = (bar.h**2 - bar.q**2 + distance**2) / (2 * distance)
        perpendicular = np.sqrt(np.maximum(bar.h**2 - parallel**2, 0.0))
        coupler = (parallel + 1j * side * perpendicular) * line / distance
        return np.angle(coupler * np.exp(-1j * (phi + bar.theta_3_0)))

    deviations = [abs(angle(np.array([bar.phi_0]), side)[0]) for side in (1, -1)]
    return angle(phi, 1 if deviations[0] < deviations[1] else -1)


COUPLING_ROWS: dict[type[Any], CouplingRow] = {
    Linear: CouplingRow(
        follow=lambda c, source, _: c.ratio * source + c.offset,
        rate=lambda c, _, __: ca.DM(c.ratio),
        interval=lambda c, source: polynomial_interval((c.offset, c.ratio), source),
        bounds=lambda c, lower, upper: polynomial_bounds((c.offset, c.ratio), lower, upper),
    ),
    LeadScrew: CouplingRow(
        follow=lambda c, s, _: mechanisms.angle_from_slider(s, c.b, c.c) - c.theta_0,
        rate=lambda c, s, _: mechanisms.angle_rate(s, c.b, c.c),
        interval=_lead_screw_interval,
        bounds=_lead_screw_bounds,
        toggle=lambda c, s, _: mechanisms.slider_toggle(s, c.b, c.c),
    ),
    Polynomial: CouplingRow(
        follow=lambda c, x, _: _horner(c.coefficients, x),
        rate=lambda c, x, _: _horner(_derivative_coefficients(c.coefficients), x),
        interval=lambda c, source: polynomial_interval(c.coefficients, source),
        bounds=lambda c, lower, upper: polynomial_bounds(c.coefficients, lower, upper),
    ),
    FourBar: CouplingRow(
        follow=_four_bar_angle,
        rate=lambda c, x, description: mechanisms.theta3_rate(
            c.phi_0 + x, linkage_of(c, description)
        ),
        interval=_four_bar_interval,
        bounds=_four_bar_bounds,
        toggle=lambda c, x, description: mechanisms.linkage_toggle(
            c.phi_0 + x, linkage_of(c, description)
        ),
    ),
}
"""Formulas by kind of coupling."""


def coupling_row(coupling: Coupling) -> CouplingRow:
    """Return the formulas of a coupling.

    Raises:
        UnsupportedError: The kind of coupling has no graphs.
    """
    try:
        return COUPLING_ROWS[type(coupling)]
    except KeyError:
        kind = type(coupling).__name__
        raise UnsupportedError(f"coupling: kind {kind} is not supported by graphs") from None


def joint_positions(robot: RobotDescription, q: ca.SX) -> ca.SX:
    """Return the positions of all movable joints.

    Args:
        robot: Description of the robot; its couplings form chains that end at actuators.
        q: (n, 1) actuator positions [rad or m].

    Returns:
        Joint positions theta (m, 1) in the order of `robot.joint_names` [rad or m].
    """
    values = _positions(robot, q)
    return ca.vertcat(*(values[name] for name in robot.joint_names))


def toggle_margins(robot: RobotDescription, q: ca.SX) -> dict[str, ca.SX]:
    """Return the distance of every mechanism from its singular (toggle) position.

    Args:
        robot: Description of the robot.
        q: (n, 1) actuator positions [rad or m].

    Returns:
        Squared sine of the transmission angle by name of the driven joint: 1 at best, 0 where the
        rate of the joint is unbounded, negative where the mechanism cannot be assembled. Smooth,
        never NaN.
    """
    values = _positions(robot, q)
    margins = {}
    for joint in robot.movable:
        coupling = joint.coupling
        if coupling is not None and (toggle := coupling_row(coupling).toggle) is not None:
            margins[joint.name] = toggle(coupling, values[coupling.of], coupling)
    return margins


def has_toggle(joint: Joint) -> bool:
    """Return whether a mechanism with a singular position drives a joint."""
    return joint.coupling is not None and coupling_row(joint.coupling).toggle is not None


def _positions(robot: RobotDescription, q: ca.SX) -> dict[str, ca.SX]:
    """Return the positions of all actuators and movable joints by name."""
    values = {name: q[i] for i, name in enumerate(robot.actuator_names)}
    joints = {joint.name: joint for joint in robot.movable}

    def value(name: str) -> ca.SX:
        if name not in values:
            values[name] = follow(joints[name], value(joints[name].coupling.of))  # type: ignore[union-attr]
        return values[name]

    for name in joints:
        value(name)
    return values


def follow(joint: Joint, source: Expr, numbers: Any = None) -> Expr:
    """Return the position of a joint [rad or m] from the position of its source.

    Args:
        joint: Driven joint; a joint without a coupling has the position of the source.
        source: Position of the actuator or joint that drives it [rad or m].
        numbers: Parameters of the coupling as attributes (default: those of the description).
    """
    coupling = joint.coupling
    if coupling is None:
        return source
    return coupling_row(coupling).follow(numbers or coupling, source, coupling)


def coupling_rate(joint: Joint, source: Expr) -> Expr:
    """Return the rate d theta / d source of a driven joint: eq. (10), for every coupling.

    Args:
        joint: Driven joint; a joint without a coupling has rate 1.
        source: Position of the actuator or joint that drives it [rad or m].

    Returns:
        For a four-bar f of eq. (11), for a lead screw the derivative of eq. (8) [rad/m].
    """
    coupling = joint.coupling
    if coupling is None:
        return ca.DM(1)
    return coupling_row(coupling).rate(coupling, source, coupling)


def joint_intervals(
    robot: RobotDescription, known_intervals: dict[str, Interval]
) -> dict[str, Interval]:
    """Return the intervals of all joints that depend on known intervals, by joint name.

    Args:
        robot: Description of the robot.
        known_intervals: Intervals by name of the actuator or joint.
    """
    joints = {joint.name: joint for joint in robot.movable}
    intervals = dict(known_intervals)

    def interval_of(name: str) -> Interval | None:
        joint = joints.get(name)
        if name not in intervals and joint is not None and joint.coupling is not None:
            source = interval_of(joint.coupling.of)
            if source is not None:
                intervals[name] = coupling_row(joint.coupling).interval(joint.coupling, source)
        return intervals.get(name)

    return {name: interval for name in joints if (interval := interval_of(name)) is not None}


def joint_bounds(
    robot: RobotDescription,
    motors: Sequence[str],
    lower: Array,
    upper: Array,
    names: Sequence[str],
) -> dict[str, Bounds]:
    """Return bounds (k,) of finger joints, by name.

    Args:
        robot: Description of the robot.
        motors: Names of the actuators.
        lower: (k, h) lower bounds of the motors.
        upper: (k, h) upper bounds of the motors.
        names: Names of the joints.
    """
    known_bounds = {name: (lower[:, i], upper[:, i]) for i, name in enumerate(motors)}
    joints = {joint.name: joint for joint in robot.movable}

    def bounds(name: str) -> Bounds:
        if name not in known_bounds:
            coupling = joints[name].coupling
            assert coupling is not None, f"joint {name!r} follows no motor of the hand"
            low, high = coupling_row(coupling).bounds(coupling, *bounds(coupling.of))
            known_bounds[name] = low - 1e-11, high + 1e-11
        return known_bounds[name]

    return {name: bounds(name) for name in names}
