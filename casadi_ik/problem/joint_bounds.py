"""Bounds of joints while motors are within boxes, in numpy: couplings for a check of proofs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.robots.couplings import Coupling, FourBar, LeadScrew, Linear
from casadi_ik.robots.description import RobotDescription

ROUNDING = 1e-11
"""What bounds are moved outwards by [rad or m]."""

SAMPLES = 17
"""Poses of a four-bar that are looked at within an interval; slopes bound what is in between."""

Bounds = tuple[Array, Array]


def joint_bounds(
    robot: RobotDescription,
    motors: Sequence[str],
    lower: Array,
    upper: Array,
    names: Sequence[str],
) -> dict[str, Bounds]:
    """Lower and upper bounds (k,) of joints of the fingers, by name.

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
            if coupling is None:
                raise AssertionError(f"joint {name!r} follows no motor of the hand")
            low, high = _followed(coupling, *bounds(coupling.of))
            found[name] = low - ROUNDING, high + ROUNDING
        return found[name]

    return {name: bounds(name) for name in names}


def _followed(coupling: Coupling, lower: Array, upper: Array) -> Bounds:
    try:
        return BOUNDS[type(coupling)](coupling, lower, upper)
    except KeyError:
        kind = type(coupling).__name__
        raise UnsupportedError(f"coupling: no guaranteed range for the kind {kind}") from None


def _linear(coupling: Linear, lower: Array, upper: Array) -> Bounds:
    ends = coupling.ratio * lower + coupling.offset, coupling.ratio * upper + coupling.offset
    return np.minimum(*ends), np.maximum(*ends)


def _lead_screw(screw: LeadScrew, lower: Array, upper: Array) -> Bounds:
    least = np.where((lower < 0) & (upper > 0), 0.0, np.minimum(abs(lower), abs(upper)))
    return _triangle(screw, least), _triangle(screw, np.maximum(abs(lower), abs(upper)))


def _triangle(screw: LeadScrew, s: Array) -> Array:
    """The angle opposite the slider, by the law of cosines, rounding at flat triangles included."""
    cosine = (screw.b**2 + screw.c**2 - s**2) / (2 * screw.b * screw.c)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    flat = np.sqrt(np.maximum(1 - cosine**2, 0.0)) < 1e-4
    # Near a flat triangle the cosine's rounding is worth up to 1e-7 rad either way.
    return np.where(flat, np.where(cosine > 0, angle - 1e-7, angle + 1e-7), angle) - screw.theta_0


def _four_bar(bar: FourBar, lower: Array, upper: Array) -> Bounds:
    """Samples, and between them the largest slope g / (h sin) of the coupler's angle."""
    part = np.linspace(0.0, 1.0, SAMPLES)
    phi = bar.phi_0 + lower[:, None] + (upper - lower)[:, None] * part
    step = (upper - lower) / (SAMPLES - 1)
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


BOUNDS: dict[type[Any], Callable[[Any, Array, Array], Bounds]] = {
    Linear: _linear,
    LeadScrew: _lead_screw,
    FourBar: _four_bar,
}
"""The kinds of couplings whose range over an interval is guaranteed."""
