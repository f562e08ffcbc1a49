"""Options of the nearest configuration of a target that is not solved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.subproblems import residual_tolerances

LOCAL = "local"
"""Value of `best_effort` for the local minimum that is reached from the start."""


@dataclass(frozen=True)
class BestEffort:
    """Options of the nearest configuration of a target that is not solved.

    Attributes:
        weights: Weights of the position error [1/m] and the angle error [1/rad] of a contact, by
            finger; inverse tolerances for other fingers. An error with the weight 0 is ignored.
        minimax: True to minimise the largest weighted error, near the configuration with the
            smallest sum of squares, instead of this sum.
        local: True for the local minimum that is reached from the start, so that a robot that
            follows a moving target does not jump.

    Raises:
        InputError: A weight is negative or not a number, or all weights of a finger are zero.

    Example:
        >>> by_position = ik.BestEffort(weights={"finger_2": (200.0, 0.5)})
        >>> solution = solver.solve(grasp, best_effort=by_position)
        >>> solution.success  # options do not change solved grasps
        True
    """

    weights: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    minimax: bool = False
    local: bool = False

    def __post_init__(self) -> None:
        for finger, pair in self.weights.items():
            expected = "expected two numbers >= 0 that are not both 0"
            try:
                position, angle = map(float, pair)
            except (TypeError, ValueError):
                raise InputError(f"weights: {finger!r} has {pair!r}; {expected}") from None
            if not (min(position, angle) >= 0 and 0 < position + angle < math.inf):
                raise InputError(f"weights: {finger!r} has {pair!r}; {expected}")

    @classmethod
    def from_argument(cls, value: object) -> BestEffort | None:
        """Return the options of a value of `best_effort`; None for False.

        Raises:
            InputError: The value is not True, False, `LOCAL` or a `BestEffort`.
        """
        if isinstance(value, BestEffort):
            return value
        if isinstance(value, bool):
            return cls() if value else None
        if value == LOCAL:
            return cls(local=True)
        raise InputError(
            f"best_effort: found {value!r}, expected True, False, {LOCAL!r} or a BestEffort"
        )

    def check(self, fingers: Sequence[str]) -> None:
        """Check that a robot has the fingers with weights.

        Raises:
            UnknownNameError: It does not have one of them.
        """
        for finger in self.weights:
            if finger not in fingers:
                raise UnknownNameError(
                    f"weights: the robot has no finger {finger!r}; expected one of "
                    f"{', '.join(fingers)}"
                )

    def tolerances(self, targets: TargetBatch, fingers: Sequence[str]) -> Array:
        """Return (k, f, 2) residuals with a weighted error of 1; 0 where free or ignored.

        Args:
            targets: k targets.
            fingers: Names of the f fingers.
        """
        tolerances = residual_tolerances(targets)
        for finger, (position, angle) in self.weights.items():
            unit_errors = [
                1 / (position * LENGTH) if position else 0.0,
                1 / angle if angle else 0.0,
            ]
            column = tolerances[:, list(fingers).index(finger)]
            np.copyto(column, unit_errors, where=column > 0)
        return tolerances
