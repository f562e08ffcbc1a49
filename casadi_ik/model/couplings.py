"""Couplings as data: the map from an actuator or joint to the position of another joint.

A coupling is a class in this module, with its numbers, their checks, its stroke and its map in
NumPy, and an entry in `casadi_ik.kinematics.couplings` with its graphs and bounds. No other module
names a coupling. The ranges of motors follow from couplings and joint limits.
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
"""Smallest value of the two slacks of a lead screw's triangle, relative to b c."""

MIN_SINE = 1e-9
"""Smallest sine of a four-bar's transmission angle."""


class CouplingKind(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """Base class of couplings.

    Attributes:
        of: Name of the actuator or joint that determines the position.
        source_unit: Unit of the source, the position of `of`; "" for any.
        lengths: Names of the fields that are lengths [m].
        angles: Names of the fields that are angles [rad]. Calibration estimates lengths and angles.
        monotone: True if the joint position is a monotone function of the source.
        periodic: True if the joint position is periodic in the angle of the source.
    """

    of: str

    source_unit: ClassVar[str] = ""
    lengths: ClassVar[tuple[str, ...]] = ()
    angles: ClassVar[tuple[str, ...]] = ()
    monotone: ClassVar[bool] = True
    periodic: ClassVar[bool] = False

    def check(self, location: str) -> None:
        """Check that the numbers describe a mechanism.

        Args:
            location: File, joint and key, for the message.

        Raises:
            DescriptionError: The numbers describe no mechanism.
        """

    def check_stroke(self, name: str, lower: float, upper: float, location: str) -> None:
        """Check that the mechanism stays assembled over a motor's stroke.

        Args:
            name: Name of the motor.
            lower: Lower limit of the motor.
            upper: Upper limit of the motor.
            location: File, joint and key, for the message.

        Raises:
            DescriptionError: The motor leaves the stroke of the mechanism.
        """
        low, high = self.stroke
        if not low <= lower < upper <= high:
            raise DescriptionError(
                f"{location}: the range of {name!r} is {lower:.6g} to {upper:.6g} "
                f"{self.source_unit}, expected within {self.stroke_text}"
            )

    @property
    def stroke(self) -> tuple[float, float]:
        """Limits of the source due to the mechanism; infinite if there are none."""
        return -math.inf, math.inf

    @property
    def stroke_text(self) -> str:
        """Limits of the stroke as text."""
        return "{:.6g} and {:.6g}".format(*self.stroke)

    @property
    def slope(self) -> tuple[float, float] | None:
        """Ratio and offset of a linear coupling; None for any other."""
        return None

    def joint_position(self, source: Array) -> Array:
        """Return positions (k,) of the joint [rad or m] for positions of the source.

        The NumPy version of the graph of the coupling, for checks before any graph is built.
        """
        raise NotImplementedError(type(self).__name__)


class Linear(CouplingKind, frozen=True, tag="linear"):
    """A shared or mimicking joint: ``theta = ratio * source + offset``.

    Attributes:
        ratio: Ratio [rad or m per unit of the source].
        offset: Offset [rad or m].
    """

    ratio: PureNumber = 1.0
    offset: AnyValue = 0.0

    def check(self, location: str) -> None:
        """Check that the joint moves."""
        if self.ratio == 0:
            raise DescriptionError(f"{location}.ratio: is zero; expected a joint that moves")

    @property
    def slope(self) -> tuple[float, float]:
        """Ratio and offset."""
        return self.ratio, self.offset

    def joint_position(self, source: Array) -> Array:
        """Return positions (k,) of the joint."""
        return self.ratio * source + self.offset


class LeadScrew(CouplingKind, frozen=True, tag="lead-screw"):
    """A slider that closes a triangle: ``s^2 = b^2 + c^2 - 2 b c cos(theta_0 + theta)``.

    Chandra et al. 2019, eq. (8). It follows an actuator in metres.

    Attributes:
        b: Fixed side of the triangle [m].
        c: Crank side of the triangle [m].
        theta_0: Angle of the triangle at joint position zero [rad].
    """

    b: Size
    c: Size
    theta_0: Angle = 0.0

    source_unit: ClassVar[str] = "m"
    lengths: ClassVar[tuple[str, ...]] = ("b", "c")
    angles: ClassVar[tuple[str, ...]] = ("theta_0",)

    @property
    def stroke(self) -> tuple[float, float]:
        """Slider positions at which the triangle is flat [m]."""
        return abs(self.b - self.c), self.b + self.c

    @property
    def stroke_text(self) -> str:
        """Limits of the stroke as text."""
        low, high = self.stroke
        return f"|b - c| = {low:.6g} and b + c = {high:.6g} m"

    def joint_position(self, source: Array) -> Array:
        """Return positions (k,) of the joint; see `kinematics.mechanisms.angle_from_slider`."""
        short, long, flat = self.b - self.c, self.b + self.c, FLAT * self.b * self.c
        low = np.maximum((source - short) * (source + short), flat)
        high = np.maximum((long - source) * (long + source), flat)
        return 2 * np.arctan(np.sqrt(low / high)) - self.theta_0


class FourBar(CouplingKind, frozen=True, tag="four-bar"):
    """A planar four-bar between two joints; Chandra et al. 2019, eqs. (9) to (11).

    With ``phi = phi_0 + source`` the joint position is ``theta_3(phi) - theta_3_0``. The linkage
    closes in two ways; the one of the pose (phi_0, theta_3_0) is used.

    Attributes:
        p: Input crank [m].
        q: Output crank (rod) [m].
        g: Ground link [m].
        h: Coupler [m].
        phi_0: Crank angle at source position zero [rad].
        theta_3_0: Angle theta_3 at joint position zero [rad]; a measured one may close the loop
            only approximately.
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

    def check(self, location: str) -> None:
        """Check that the linkage closes in its reference pose."""
        # The rod and the coupler span the distance from the crank's pin to the rod's pivot.
        p, q, g, h = self.p, self.q, self.g, self.h
        span = math.sqrt(max(p * p + g * g - 2 * p * g * math.cos(self.phi_0), 0.0))
        if not abs(q - h) < span < q + h:
            raise DescriptionError(
                f"{location}.phi_0: at {self.phi_0:.6g} rad q and h cannot span {span:.6g} m; "
                f"expected a pose in which the linkage closes, neither stretched nor folded"
            )

    def joint_position(self, source: Array) -> Array:
        """Return positions (k,) of the joint, on the branch of the reference pose."""
        reference = np.array([self.phi_0])
        branch = min(
            (-1, 1),
            key=lambda sign: abs(self._theta3(reference, sign)[0] - self.theta_3_0),
        )
        return self._theta3(self.phi_0 + source, branch) - self.theta_3_0

    def _theta3(self, phi: Array, branch: int) -> Array:
        """Return theta_3 (eq. (9)) within pi of `theta_3_0`; see `kinematics.mechanisms.theta3`."""
        p, q, g, h = self.p, self.q, self.g, self.h
        cosine, sine = np.cos(phi), np.sin(phi)
        a, b = 2 * q * (p * cosine - g), 2 * p * q * sine
        c = g * g + p * p + q * q - h * h - 2 * p * g * cosine
        floor = 2 * q * h * MIN_SINE
        signed = branch * np.sqrt(np.maximum(a * a + b * b - c * c, floor * floor))
        scale = 1 / np.sqrt((a * a + b * b) * (c * c + signed * signed))
        x = g + q * scale * (a * c - signed * b) - p * cosine
        y = q * scale * (b * c + signed * a) - p * sine
        offset = phi + self.theta_3_0
        ct, st = np.cos(offset), np.sin(offset)
        return self.theta_3_0 + np.arctan2(y * ct - x * st, x * ct + y * st)


class Polynomial(CouplingKind, frozen=True, tag="polynomial"):
    """A joint driven by a cam or a cable: ``theta = sum of coefficients[i] * source^i``.

    Attributes:
        coefficients: Coefficients, the constant first [rad or m per power of the source's unit].
    """

    coefficients: tuple[PureNumber, ...]

    monotone: ClassVar[bool] = False

    def check(self, location: str) -> None:
        """Check that the joint moves."""
        if not any(self.coefficients[1:]):
            raise DescriptionError(
                f"{location}.coefficients: all but the first are zero; expected a joint that moves"
            )

    def joint_position(self, source: Array) -> Array:
        """Return positions (k,) of the joint."""
        value = np.polynomial.polynomial.polyval(source, self.coefficients)
        return np.asarray(value, dtype=np.float64)


Coupling = Linear | LeadScrew | FourBar | Polynomial
"""Any coupling."""
