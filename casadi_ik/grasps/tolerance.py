"""When a contact counts as reached."""

from __future__ import annotations

import math
from dataclasses import dataclass

from casadi_ik.errors import InputError


@dataclass(frozen=True)
class Tolerance:
    """When a contact counts as reached.

    Attributes:
        position: Distance of the contact point [m].
        angle: Angle of the pad normal [rad].

    Raises:
        InputError: Not a positive finite number.

    Example:
        >>> ik.Tolerance(position=1e-3, angle=np.deg2rad(1)).position
        0.001
    """

    position: float = 5e-3
    angle: float = math.radians(3.0)

    def __post_init__(self) -> None:
        for name, value in (("position", self.position), ("angle", self.angle)):
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0):
                raise InputError(f"tolerance.{name}: found {value!r}, expected a number > 0")
