"""Couplings as data: how a joint's position follows from an actuator or another joint.

A kind of coupling is a class here, which knows its numbers and their checks, the stroke of what it
follows and its map in plain numbers; and a row in `casadi_ik.kinematics.couplings`, its graphs and
bounds. Everything else asks these two and names no kind. From couplings and the limits of joints
follow the ranges of motors.
"""

from __future__ import annotations

import math
from typing import ClassVar

import msgspec
import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.units import Angle, AnyValue, PureNumber, Size

FLAT = 1e-16
"""A triangle's two slacks are kept above FLAT b c [m^2]."""

MIN_SINE = 1e-9
"""The sine of a four-bar's transmission angle is kept above it."""


class CouplingKind(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """What every kind of coupling says of itself.

    Attributes:
        of: Name of the actuator or joint that is followed.
        source_unit: Unit that it must have; "" any.
        lengths: Names of the numbers that are lengths [m].
        angles: Names of the numbers that are angles [rad]. Calibration estimates lengths and
            angles.
        monotone: Whether the joint moves to one side only while what it follows does.
        periodic: Whether the joint does the same again with each turn of what it follows.
    """

    of: str

    source_unit: ClassVar[str] = ""
    lengths: ClassVar[tuple[str, ...]] = ()
    angles: ClassVar[tuple[str, ...]] = ()
    monotone: ClassVar[bool] = True
    periodic: ClassVar[bool] = False

    def check(self, where: str) -> None:
        """Whether the numbers describe a mechanism.

        Args:
            where: File, joint and key, for the message.

        Raises:
            DescriptionError: They do not.
        """

    def check_stroke(self, name: str, lower: float, upper: float, where: str) -> None:
        """Whether the mechanism stays together over a motor's stroke.

        Args:
            name: Of the motor.
            lower: Its lower limit.
            upper: Its upper limit.
            where: File, joint and key, for the message.

        Raises:
            DescriptionError: It does not.
        """
        low, high = self.stroke
        if not low <= lower < upper <= high:
            raise DescriptionError(
                f"{where}: {name!r} goes from {lower:.6g} to {upper:.6g} "
                f"{self.source_unit}, expected within {self.stroke_text}"
            )

    @property
    def stroke(self) -> tuple[float, float]:
        """Ends that the mechanism sets to what it follows; infinite if it sets none."""
        return -math.inf, math.inf

    @property
    def stroke_text(self) -> str:
        """The ends in words."""
        return "{:.6g} and {:.6g}".format(*self.stroke)

    @property
    def slope(self) -> tuple[float, float] | None:
        """Ratio and offset, if the joint follows linearly."""
        return None

    def followed(self, source: Array) -> Array:
        """Positions (k,) of the joint [rad or m] from those of what it follows (k,).

        The same map as in the symbolic row, for what has to be known of a description before any
        graph is built.
        """
        raise NotImplementedError(type(self).__name__)


class Linear(CouplingKind, frozen=True, tag="linear"):
    """A shared or mimicking joint: ``theta = ratio * source + offset``.

    Attributes:
        ratio: [rad or m per unit of the source].
        offset: [rad] or [m].
    """

    ratio: PureNumber = 1.0
    offset: AnyValue = 0.0

    def check(self, where: str) -> None:
        """Whether the joint moves at all."""
        if self.ratio == 0:
            raise DescriptionError(f"{where}.ratio: is zero, so the joint would not move")

    @property
    def slope(self) -> tuple[float, float]:
        """Ratio and offset."""
        return self.ratio, self.offset

    def followed(self, source: Array) -> Array:
        """Positions (k,) of the joint."""
        return self.ratio * source + self.offset


class LeadScrew(CouplingKind, frozen=True, tag="lead-screw"):
    """A slider that closes a triangle: ``s^2 = b^2 + c^2 - 2 b c cos(theta_0 + theta)``.

    Chandra et al. 2019, eq. (8). It follows an actuator in metres.

    Attributes:
        b: Fixed side of the triangle [m].
        c: Crank side of the triangle [m].
        theta_0: Triangle angle at which the joint reads zero [rad].
    """

    b: Size
    c: Size
    theta_0: Angle = 0.0

    source_unit: ClassVar[str] = "m"
    lengths: ClassVar[tuple[str, ...]] = ("b", "c")
    angles: ClassVar[tuple[str, ...]] = ("theta_0",)

    @property
    def stroke(self) -> tuple[float, float]:
        """Where the triangle is flat."""
        return abs(self.b - self.c), self.b + self.c

    @property
    def stroke_text(self) -> str:
        """The ends in words."""
        low, high = self.stroke
        return f"|b - c| = {low:.6g} and b + c = {high:.6g} m"

    def followed(self, source: Array) -> Array:
        """Positions (k,) of the joint; see `kinematics.mechanisms.angle_from_slider`."""
        short, long, flat = self.b - self.c, self.b + self.c, FLAT * self.b * self.c
        low = np.maximum((source - short) * (source + short), flat)
        high = np.maximum((long - source) * (long + source), flat)
        return 2 * np.arctan(np.sqrt(low / high)) - self.theta_0


class FourBar(CouplingKind, frozen=True, tag="four-bar"):
    """A planar four-bar between two joints; Chandra et al. 2019, eqs. (9) to (11).

    With ``phi = phi_0 + source`` the joint reads ``theta_3(phi) - theta_3_0``. The linkage closes
    in two ways; it is taken to be assembled as in the pose (phi_0, theta_3_0), and to stay so.

    Attributes:
        p: Input crank [m].
        q: Output crank (rod) [m].
        g: Ground link [m].
        h: Coupler [m].
        phi_0: Crank angle at which the source reads zero [rad].
        theta_3_0: Angle theta_3 at which this joint reads zero [rad]; a measured one need not close
            the loop to the last digit.
    """

    p: Size
    q: Size
    g: Size
    h: Size
    phi_0: Angle
    theta_3_0: Angle

    source_unit: ClassVar[str] = "rad"
    lengths: ClassVar[tuple[str, ...]] = ("p", "q", "g", "h")
    angles: ClassVar[tuple[str, ...]] = ("phi_0", "theta_3_0")
    monotone: ClassVar[bool] = False
    periodic: ClassVar[bool] = True

    def check(self, where: str) -> None:
        """Whether the linkage closes in its known pose."""
        # Rod and coupler have to span the distance from the crank's pin to the rod's pivot.
        p, q, g, h = self.p, self.q, self.g, self.h
        span = math.sqrt(max(p * p + g * g - 2 * p * g * math.cos(self.phi_0), 0.0))
        if not abs(q - h) < span < q + h:
            raise DescriptionError(
                f"{where}.phi_0: at {self.phi_0:.6g} rad q and h cannot span {span:.6g} m, "
                f"expected a pose in which the linkage closes, not stretched or folded"
            )

    def followed(self, source: Array) -> Array:
        """Positions (k,) of the joint, on the branch of the known pose."""
        reference = np.array([self.phi_0])
        branch = min(
            (-1, 1),
            key=lambda sign: abs(self._theta3(reference, sign)[0] - self.theta_3_0),
        )
        return self._theta3(self.phi_0 + source, branch) - self.theta_3_0

    def _theta3(self, phi: Array, branch: int) -> Array:
        """Eq. (9), within pi of `theta_3_0`; see `kinematics.mechanisms.theta3`."""
        p, q, g, h = self.p, self.q, self.g, self.h
        cosine, sine = np.cos(phi), np.sin(phi)
        a, b = 2 * q * (p * cosine - g), 2 * p * q * sine
        c = g * g + p * p + q * q - h * h - 2 * p * g * cosine
        floor = 2 * q * h * MIN_SINE
        signed = branch * np.sqrt(np.maximum(a * a + b * b - c * c, floor * floor))
        scale = 1 / np.sqrt((a * a + b * b) * (c * c + signed * signed))
        x = g + q * scale * (a * c - signed * b) - p * cosine
        y = q * scale * (b * c + signed * a) - p * sine
        turn = phi + self.theta_3_0
        ct, st = np.cos(turn), np.sin(turn)
        return self.theta_3_0 + np.arctan2(y * ct - x * st, x * ct + y * st)


class Polynomial(CouplingKind, frozen=True, tag="polynomial"):
    """A joint bent by a cam or a cable: ``theta = sum of coefficients[i] * source^i``.

    Attributes:
        coefficients: The constant first [rad or m per power of the source's unit].
    """

    coefficients: tuple[PureNumber, ...]

    monotone: ClassVar[bool] = False

    def check(self, where: str) -> None:
        """Whether the joint moves at all."""
        if not any(self.coefficients[1:]):
            raise DescriptionError(
                f"{where}.coefficients: all but the first are zero, so the joint would not move"
            )

    def followed(self, source: Array) -> Array:
        """Positions (k,) of the joint."""
        value = np.polynomial.polynomial.polyval(source, self.coefficients)
        return np.asarray(value, dtype=np.float64)


Coupling = Linear | LeadScrew | FourBar | Polynomial
"""What a joint may follow."""
