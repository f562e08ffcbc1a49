"""What there is to know of a Jacobian whose singular values a step records."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class RecordedJacobian:
    """A Jacobian, and when its measures call it singular.

    Attributes:
        joints: Actuators whose motion it maps.
        singular: Smallest singular value below which it counts as near singular, in the unit of
            its field ``sigma_<name>``.
        condition: Condition number above which it counts as ill-conditioned, for its field
            ``condition_<name>``.
    """

    joints: tuple[str, ...] = ()
    singular: float = 0.0
    condition: float = math.inf
