"""From actuators to joints: the map theta = c(q), its Jacobian and its bounds, by kind of coupling.

Each kind is a row of `ROWS`. What a joint can do while its source is within an interval is there
twice, by arithmetics that share nothing: `interval` as a graph, for the search for proofs that a
target is unreachable, and `bounds` in numpy, for the check of these proofs. Both hold every
position, rounding included; where an end is not needed to be sharp it may be further out.
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

OUTWARDS = 1e-12
"""By how much the ends of an interval are moved outwards [rad or m], and as a part of the sizes
that are added up: more than the rounding errors of a coupling."""

AT_TOGGLE = 1e-6
"""A four-bar within this of a toggle (of the square of a length, relative) counts as there; angles
of its turning points are widened by as much [rad]."""

Bounds = tuple[Array, Array]
"""Lower and upper ends (k,)."""


@dataclass(frozen=True, eq=False)
class Interval:
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
        return ca.fmax((self.upper - self.lower) / 2, 0.0) + OUTWARDS


@dataclass(frozen=True, eq=False)
class CouplingRow:
    """A kind of coupling.

    `follow`, `rate` and `toggle` take the coupling's numbers (anything with their names as
    attributes: the data, or symbols where a calibration estimates them), the position of what is
    followed [rad or m] and the data as described, from which branches are taken.

    Attributes:
        follow: Position of the joint [rad or m].
        rate: Its derivative by the position of what it follows.
        interval: ``(coupling, source) ->`` an `Interval` that holds the joint while what it follows
            is within an `Interval`.
        bounds: ``(coupling, lower, upper) ->`` the same in numpy, of k intervals, by formulas of
            its own.
        toggle: Squared sine of the transmission angle, see `toggle_margins`; None if the kind has
            no singular position.
    """

    follow: Callable[[Any, Expr, Any], Expr]
    rate: Callable[[Any, Expr, Any], Expr]
    interval: Callable[[Any, Interval], Interval]
    bounds: Callable[[Any, Array, Array], Bounds]
    toggle: Callable[[Any, Expr, Any], Expr] | None = None


def linkage(numbers: Any, known: FourBar) -> mechanisms.Linkage:
    """A four-bar with the branch of the known pose (phi_0, theta_3_0) of its description."""
    described = mechanisms.Linkage(known.p, known.q, known.g, known.h)
    branch = mechanisms.branch_from_pose(described, known.phi_0, known.theta_3_0)
    return mechanisms.Linkage(numbers.p, numbers.q, numbers.g, numbers.h, branch)


def _bent(numbers: Any, source: Expr, known: FourBar) -> Expr:
    # Continuous about the known pose, whatever the estimate of its angle.
    bar, phi = linkage(numbers, known), numbers.phi_0 + source
    return mechanisms.theta3(phi, bar, known.theta_3_0) - numbers.theta_3_0


def _horner(coefficients: Sequence[float], source: Expr) -> Expr:
    """A polynomial, its constant first."""
    value: Expr = ca.DM(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * source + coefficient
    return value


def _slopes(coefficients: Sequence[float]) -> list[float]:
    """The coefficients of a polynomial's derivative."""
    return [power * value for power, value in enumerate(coefficients)][1:]


def polynomial_interval(coefficients: Sequence[float], source: Interval) -> Interval:
    """Where a polynomial is over an interval, by its Taylor series about the middle.

    Args:
        coefficients: The constant first.
        source: [rad or m].
    """
    middle, half = source.middle, source.half
    slopes, factorial, power = list(coefficients), 1.0, half
    value = lower = upper = _horner(slopes, middle)
    for order in range(1, len(coefficients)):
        slopes, factorial = _slopes(slopes), factorial * order
        part = _horner(slopes, middle) / factorial * power
        # An odd power of what is left has either sign, an even one none.
        least, most = (-ca.fabs(part), ca.fabs(part)) if order % 2 else (part, part)
        lower, upper = lower + ca.fmin(least, 0.0), upper + ca.fmax(most, 0.0)
        power = power * half
    far = ca.fabs(middle) + half
    slack = OUTWARDS * (1 + ca.fabs(value) + _horner([abs(c) for c in coefficients], far))
    return Interval(lower - slack, upper + slack)


def polynomial_bounds(coefficients: Sequence[float], lower: Array, upper: Array) -> Bounds:
    """Where a polynomial is over k intervals: between its least and largest Bernstein coefficient.

    Args:
        coefficients: The constant first.
        lower: (k,) ends [rad or m].
        upper: (k,).
    """
    n, width = len(coefficients) - 1, upper - lower
    # sum a_i t^i over t in [0, 1], as lower + t width is put into the polynomial.
    a = np.zeros((n + 1, len(lower)))
    for coefficient in reversed(coefficients):
        a[1:] = a[1:] * lower + a[:-1] * width
        a[0] = a[0] * lower + coefficient
    bernstein = [
        sum(math.comb(j, i) / math.comb(n, i) * a[i] for i in range(j + 1)) for j in range(n + 1)
    ]
    slack = 1e-11 * (1 + np.abs(a).sum(axis=0))
    return np.min(bernstein, axis=0) - slack, np.max(bernstein, axis=0) + slack


def _screwed_interval(screw: LeadScrew, source: Interval) -> Interval:
    """A triangle is monotone in the slider's length, whose sign it does not know."""
    a, b = ca.fabs(source.lower), ca.fabs(source.upper)
    around = ca.logic_and(source.lower < 0, source.upper > 0)
    lengths = ca.if_else(around, 0.0, ca.fmin(a, b)), ca.fmax(a, b)
    least, most = (ROWS[LeadScrew].follow(screw, length, screw) for length in lengths)
    return Interval(ca.fmin(least, most) - OUTWARDS, ca.fmax(least, most) + OUTWARDS)


def _screwed_bounds(screw: LeadScrew, lower: Array, upper: Array) -> Bounds:
    least = np.where((lower < 0) & (upper > 0), 0.0, np.minimum(abs(lower), abs(upper)))
    return _triangle(screw, least), _triangle(screw, np.maximum(abs(lower), abs(upper)))


def _triangle(screw: LeadScrew, s: Array) -> Array:
    """The angle opposite the slider, by the law of cosines, rounding at flat triangles included."""
    cosine = (screw.b**2 + screw.c**2 - s**2) / (2 * screw.b * screw.c)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    flat = np.sqrt(np.maximum(1 - cosine**2, 0.0)) < 1e-4
    # Near a flat triangle the cosine's rounding is worth up to 1e-7 rad either way.
    return np.where(flat, np.where(cosine > 0, angle - 1e-7, angle + 1e-7), angle) - screw.theta_0


def _bent_interval(bar: FourBar, source: Interval) -> Interval:
    """A four-bar: its ends, and in between the poses in which rod and ground align.

    Where the interval may hold a toggle the joint may be anywhere on its turn.
    """

    def follow_(angle: Expr) -> Expr:
        return ROWS[FourBar].follow(bar, angle, bar)

    phi = Interval(source.lower + bar.phi_0, source.upper + bar.phi_0)
    ends = follow_(source.lower), follow_(source.upper)
    lower, upper = ca.fmin(*ends), ca.fmax(*ends)
    for turn in _turning_points(bar):
        value, inside = follow_(ca.SX(turn - bar.phi_0)), _holds(phi, turn)
        lower = ca.if_else(inside, ca.fmin(lower, value), lower)
        upper = ca.if_else(inside, ca.fmax(upper, value), upper)
    anywhere = _may_toggle(bar, phi)
    for wrap in _wraps(bar):
        anywhere = ca.logic_or(anywhere, _holds(phi, wrap))
    return Interval(
        ca.if_else(anywhere, -np.pi, lower) - OUTWARDS,
        ca.if_else(anywhere, np.pi, upper) + OUTWARDS,
    )


def _may_toggle(bar: FourBar, phi: Interval) -> Expr:
    """Whether |PC|^2 may leave ((q - h)^2, (q + h)^2), between which rod and coupler bend."""
    cosines = ca.cos(phi.lower), ca.cos(phi.upper)
    highest = ca.if_else(_holds(phi, 0.0), 1.0, ca.fmax(*cosines))
    lowest = ca.if_else(_holds(phi, np.pi), -1.0, ca.fmin(*cosines))
    size = bar.p**2 + bar.g**2
    least, most = size - 2 * bar.p * bar.g * highest, size - 2 * bar.p * bar.g * lowest
    margin = AT_TOGGLE * (bar.q + bar.h) ** 2
    short, long = (bar.q - bar.h) ** 2 + margin, (bar.q + bar.h) ** 2 - margin
    return ca.logic_or(least < short, most > long)


def _turning_points(bar: FourBar) -> list[float]:
    """Crank angles [rad] at which rod and ground align, so that the joint turns back."""
    found = []
    for reach in (bar.g + bar.q, bar.g - bar.q):
        if abs(reach) > 0:
            cosine = (bar.p**2 + reach**2 - bar.h**2) / (2 * bar.p * reach)
            if abs(cosine) <= 1 + AT_TOGGLE:
                angle = float(np.arccos(np.clip(cosine, -1, 1)))
                found += [angle, -angle]
    return found


def _wraps(bar: FourBar) -> list[float]:
    """Crank angles [rad] at which the joint is half a turn from its zero, where its value jumps."""
    arm = bar.p + bar.h * np.exp(1j * (bar.theta_3_0 + np.pi))
    size = abs(arm)
    if size < AT_TOGGLE * bar.p:
        return [0.0, np.pi]
    cosine = (size**2 + bar.g**2 - bar.q**2) / (2 * bar.g * size)
    if abs(cosine) > 1 + AT_TOGGLE:
        return []
    angle = float(np.arccos(np.clip(cosine, -1, 1)))
    return [angle - float(np.angle(arm)), -angle - float(np.angle(arm))]


def _holds(interval: Interval, angle: float) -> Expr:
    """Whether an interval may hold an angle, by whole turns."""
    last = (interval.upper + AT_TOGGLE - angle) / (2 * np.pi)
    first = (interval.lower - AT_TOGGLE - angle) / (2 * np.pi)
    return ca.floor(last) >= ca.ceil(first)


def _bent_bounds(bar: FourBar, lower: Array, upper: Array, samples: int = 17) -> Bounds:
    """Samples, and between them the largest slope g / (h sin) of the coupler's angle."""
    part = np.linspace(0.0, 1.0, samples)
    phi = bar.phi_0 + lower[:, None] + (upper - lower)[:, None] * part
    step = (upper - lower) / (samples - 1)
    crank = bar.p * np.exp(1j * phi)
    # |PC|^2 moves by no more than 2 p g between samples a step of the crank apart.
    squares, reach = abs(crank - bar.g) ** 2, bar.p * bar.g * step
    inner, outer = (bar.q - bar.h) ** 2, (bar.q + bar.h) ** 2
    least, most = squares.min(axis=1) - reach, squares.max(axis=1) + reach
    sine = np.minimum((least - inner) * (outer - least), (most - inner) * (outer - most))
    loose = sine <= 1e-9 * (bar.q * bar.h) ** 2
    sine = np.sqrt(np.where(loose, 1.0, sine)) / (2 * bar.q * bar.h)
    values = _coupler(bar, phi)
    gap = bar.g / (bar.h * sine) * step / 2
    low, high = values.min(axis=1) - gap, values.max(axis=1) + gap
    loose |= (low < -3.0) | (high > 3.0)
    return np.where(loose, -np.pi, low), np.where(loose, np.pi, high)


def _coupler(bar: FourBar, phi: Array) -> Array:
    """Angle of the coupler against the crank less its zero, within half a turn [rad]."""

    def angle(phi: Array, side: int) -> Array:
        p, c = bar.p * np.exp(1j * phi), bar.g
        line = c - p
        far = np.abs(line)
        # Q is h from P and q from C: along the line P C by a, across it by b.
        along = (bar.h**2 - bar.q**2 + far**2) / (2 * far)
        across = np.sqrt(np.maximum(bar.h**2 - along**2, 0.0))
        coupler = (along + 1j * side * across) * line / far
        return np.angle(coupler * np.exp(-1j * (phi + bar.theta_3_0)))

    sides = [abs(angle(np.array([bar.phi_0]), side)[0]) for side in (1, -1)]
    return angle(phi, 1 if sides[0] < sides[1] else -1)


ROWS: dict[type[Any], CouplingRow] = {
    Linear: CouplingRow(
        follow=lambda c, source, _: c.ratio * source + c.offset,
        rate=lambda c, _, __: ca.DM(c.ratio),
        interval=lambda c, source: polynomial_interval((c.offset, c.ratio), source),
        bounds=lambda c, lower, upper: polynomial_bounds((c.offset, c.ratio), lower, upper),
    ),
    LeadScrew: CouplingRow(
        follow=lambda c, s, _: mechanisms.angle_from_slider(s, c.b, c.c) - c.theta_0,
        rate=lambda c, s, _: mechanisms.angle_rate(s, c.b, c.c),
        interval=_screwed_interval,
        bounds=_screwed_bounds,
        toggle=lambda c, s, _: mechanisms.slider_toggle(s, c.b, c.c),
    ),
    Polynomial: CouplingRow(
        follow=lambda c, x, _: _horner(c.coefficients, x),
        rate=lambda c, x, _: _horner(_slopes(c.coefficients), x),
        interval=lambda c, source: polynomial_interval(c.coefficients, source),
        bounds=lambda c, lower, upper: polynomial_bounds(c.coefficients, lower, upper),
    ),
    FourBar: CouplingRow(
        follow=_bent,
        rate=lambda c, x, known: mechanisms.theta3_rate(c.phi_0 + x, linkage(c, known)),
        interval=_bent_interval,
        bounds=_bent_bounds,
        toggle=lambda c, x, known: mechanisms.linkage_toggle(c.phi_0 + x, linkage(c, known)),
    ),
}
"""The kinds of couplings."""


def coupling_row(coupling: Coupling) -> CouplingRow:
    """The row of a coupling's kind.

    Raises:
        UnsupportedError: There is none.
    """
    try:
        return ROWS[type(coupling)]
    except KeyError:
        kind = type(coupling).__name__
        raise UnsupportedError(f"coupling: no graphs for the kind {kind}") from None


def joint_positions(robot: RobotDescription, q: ca.SX) -> ca.SX:
    """Positions of all movable joints.

    Args:
        robot: The description; its couplings form chains that end at actuators.
        q: (n, 1) actuator positions [rad or m].

    Returns:
        theta (m, 1) in the order of `robot.joint_names`.
    """
    values = _positions(robot, q)
    return ca.vertcat(*(values[name] for name in robot.joint_names))


def toggle_margins(robot: RobotDescription, q: ca.SX) -> dict[str, ca.SX]:
    """How far every mechanism that has a singular (toggle) position is from it.

    Args:
        robot: The description.
        q: (n, 1) actuator positions [rad or m].

    Returns:
        By joint that follows such a coupling the squared sine of its transmission angle: 1 at
        best, 0 where the joint's rate over its source blows up, negative where the mechanism
        cannot be assembled. Smooth, never NaN.
    """
    values = _positions(robot, q)
    margins = {}
    for joint in robot.movable:
        coupling = joint.coupling
        if coupling is not None and (toggle := coupling_row(coupling).toggle) is not None:
            margins[joint.name] = toggle(coupling, values[coupling.of], coupling)
    return margins


def has_toggle(joint: Joint) -> bool:
    """Whether a joint follows through a mechanism that has a singular position."""
    return joint.coupling is not None and coupling_row(joint.coupling).toggle is not None


def _positions(robot: RobotDescription, q: ca.SX) -> dict[str, ca.SX]:
    """Positions of all actuators and movable joints by name."""
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
    """Position of a joint [rad or m] from the position of what it follows.

    Args:
        joint: The joint; one that follows nothing stands where the source does.
        source: [rad or m].
        numbers: Other numbers of the coupling, as attributes; None: those described.
    """
    coupling = joint.coupling
    if coupling is None:
        return source
    return coupling_row(coupling).follow(numbers or coupling, source, coupling)


def coupling_rate(joint: Joint, source: Expr) -> Expr:
    """Rate d theta / d source of a joint that follows something: eq. (10), for every coupling.

    Args:
        joint: The joint; one that follows nothing has rate 1.
        source: Position of what it follows [rad or m].

    Returns:
        For a four-bar f of eq. (11), for a lead screw the derivative of eq. (8) [rad/m].
    """
    coupling = joint.coupling
    if coupling is None:
        return ca.DM(1)
    return coupling_row(coupling).rate(coupling, source, coupling)


def joint_intervals(robot: RobotDescription, given: dict[str, Interval]) -> dict[str, Interval]:
    """Intervals of all joints that are given or follow what is given, by joint name.

    Args:
        robot: The description.
        given: By name of the actuator or joint.
    """
    joints = {joint.name: joint for joint in robot.movable}
    found = dict(given)

    def known(name: str) -> Interval | None:
        joint = joints.get(name)
        if name not in found and joint is not None and joint.coupling is not None:
            source = known(joint.coupling.of)
            if source is not None:
                found[name] = coupling_row(joint.coupling).interval(joint.coupling, source)
        return found.get(name)

    return {name: interval for name in joints if (interval := known(name)) is not None}


def joint_bounds(
    robot: RobotDescription,
    motors: Sequence[str],
    lower: Array,
    upper: Array,
    names: Sequence[str],
) -> dict[str, Bounds]:
    """Bounds (k,) of joints of the fingers, by name.

    Args:
        robot: The description.
        motors: Names of the actuators.
        lower: (k, h) ends of the motors.
        upper: (k, h).
        names: Of the joints wanted.
    """
    found = {name: (lower[:, i], upper[:, i]) for i, name in enumerate(motors)}
    joints = {joint.name: joint for joint in robot.movable}

    def bounds(name: str) -> Bounds:
        if name not in found:
            coupling = joints[name].coupling
            assert coupling is not None, f"joint {name!r} follows no motor of the hand"
            low, high = coupling_row(coupling).bounds(coupling, *bounds(coupling.of))
            found[name] = low - 1e-11, high + 1e-11
        return found[name]

    return {name: bounds(name) for name in names}
