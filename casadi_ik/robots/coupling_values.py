"""Couplings in plain numbers: where a joint stands when what it follows stands somewhere.

The same maps as the graphs of `casadi_ik.symbolic.couplings`, for what has to be known of a
description before any graph is built.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.robots.couplings import Coupling, FourBar, LeadScrew

Array = NDArray[np.float64]

FLAT = 1e-16
"""A triangle's two slacks are kept above FLAT b c [m^2]."""

MIN_SINE = 1e-9
"""The sine of a four-bar's transmission angle is kept above it."""


def followed(coupling: Coupling, source: Array) -> Array:
    """Positions of a coupled joint [rad or m].

    Args:
        coupling: How it follows.
        source: (k,) positions of what it follows [rad or m].
    """
    if isinstance(coupling, LeadScrew):
        return _triangle(coupling, source)
    if isinstance(coupling, FourBar):
        branch = min((-1, 1), key=lambda sign: _off_reference(coupling, sign))
        return _theta3(coupling, coupling.phi_0 + source, branch) - coupling.theta_3_0
    return coupling.ratio * source + coupling.offset


def _triangle(screw: LeadScrew, s: Array) -> Array:
    """Chandra et al. 2019, eq. (8), as `symbolic.lead_screw.angle_from_slider` has it."""
    short, long, flat = screw.b - screw.c, screw.b + screw.c, FLAT * screw.b * screw.c
    low = np.maximum((s - short) * (s + short), flat)
    high = np.maximum((long - s) * (long + s), flat)
    return 2 * np.arctan(np.sqrt(low / high)) - screw.theta_0


def _off_reference(bar: FourBar, branch: int) -> float:
    """How far a branch is from the pose the linkage is known to stand in."""
    return float(np.abs(_theta3(bar, np.array([bar.phi_0]), branch)[0] - bar.theta_3_0))


def _theta3(bar: FourBar, phi: Array, branch: int) -> Array:
    """Chandra et al. 2019, eq. (9), within pi of `theta_3_0`; see `symbolic.four_bar.theta3`."""
    p, q, g, h = bar.p, bar.q, bar.g, bar.h
    cosine, sine = np.cos(phi), np.sin(phi)
    a, b = 2 * q * (p * cosine - g), 2 * p * q * sine
    c = g * g + p * p + q * q - h * h - 2 * p * g * cosine
    floor = 2 * q * h * MIN_SINE
    signed = branch * np.sqrt(np.maximum(a * a + b * b - c * c, floor * floor))
    scale = 1 / np.sqrt((a * a + b * b) * (c * c + signed * signed))
    x = g + q * scale * (a * c - signed * b) - p * cosine
    y = q * scale * (b * c + signed * a) - p * sine
    turn = phi + bar.theta_3_0
    ct, st = np.cos(turn), np.sin(turn)
    return bar.theta_3_0 + np.arctan2(y * ct - x * st, x * ct + y * st)
