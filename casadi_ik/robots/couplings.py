"""Couplings as data: how a joint's position follows from an actuator or another joint.

Only the numbers live here; the graphs of these maps are in `casadi_ik.symbolic.couplings`.
"""

from __future__ import annotations

import msgspec

from casadi_ik.files.units import AnyValue, Length, Pure, Turn


class Linear(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="linear", tag_field="kind"
):
    """A shared or mimicking joint: ``theta = ratio * source + offset``.

    Attributes:
        of: Name of the actuator or joint that is followed.
        ratio: [rad or m per unit of the source].
        offset: [rad] or [m].
    """

    of: str
    ratio: Pure = 1.0
    offset: AnyValue = 0.0


class LeadScrew(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="lead-screw", tag_field="kind"
):
    """A slider that closes a triangle: ``s^2 = b^2 + c^2 - 2 b c cos(theta_0 + theta)``.

    Chandra et al. 2019, eq. (8).

    Attributes:
        of: Name of the slider (an actuator in metres).
        b: Fixed side of the triangle [m].
        c: Crank side of the triangle [m].
        theta_0: Triangle angle at which the joint reads zero [rad].
    """

    of: str
    b: Length
    c: Length
    theta_0: Turn = 0.0


class FourBar(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="four-bar", tag_field="kind"
):
    """A planar four-bar between two joints; Chandra et al. 2019, eqs. (9) to (11).

    With ``phi = phi_0 + source`` the joint reads ``theta_3(phi) - theta_3_0``. The linkage closes
    in two ways; it is taken to be assembled as in the pose (phi_0, theta_3_0), and to stay so.

    Attributes:
        of: Name of the joint that drives the crank.
        p: Input crank [m].
        q: Output crank (rod) [m].
        g: Ground link [m].
        h: Coupler [m].
        phi_0: Crank angle at which the source reads zero [rad].
        theta_3_0: Angle theta_3 at which this joint reads zero [rad]; a measured one need not close
            the loop to the last digit.
    """

    of: str
    p: Length
    q: Length
    g: Length
    h: Length
    phi_0: Turn
    theta_3_0: Turn


Coupling = Linear | LeadScrew | FourBar
"""What a joint may follow."""
