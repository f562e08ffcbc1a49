"""Options of the nearest configuration of a target that is not solved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

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
        minimax: True to minimise the largest weighted error instead of the sum of squares. The
            result is the local minimum that is reached from the configuration with the least sum.
        local: True for the local minimum that is reached from the start, so that a robot that
            follows a moving target does not jump.
        posture: (n,) configuration to which the result is nearest among equally near ones, such as
            one with a preferred elbow [rad or m]; None: q0. Not with `local`.

    Raises:
        InputError: A weight is negative or not a number, all weights of a finger are zero, an
            option is not a bool, or the posture is not an array of finite numbers or given with
            `local`.

    Example:
        >>> by_position = ik.BestEffort(weights={"finger_2": (200.0, 0.5)})
        >>> solution = solver.solve(grasp, best_effort=by_position)
        >>> solution.success  # options do not change solved grasps
        True
    """

    weights: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    minimax: bool = False
    local: bool = False
    posture: ArrayLike | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.weights, Mapping):
            raise InputError(
                f"weights: found {self.weights!r}, expected two numbers by name of a finger"
            )
        for name in ("minimax", "local"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"{name}: found {getattr(self, name)!r}, expected True or False")
        if self.posture is not None and self.local:
            raise InputError("posture: is given with local=True, expected only one of them")
        if self.posture is not None:
            # A tuple, so that options can be compared.
            object.__setattr__(self, "posture", _checked_posture(self.posture))
        for finger, pair in self.weights.items():
            expected = "expected two finite numbers >= 0 that are not both 0"
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

    def check(self, fingers: Sequence[str], motors: int) -> None:
        """Check that a robot has the fingers with weights, and the motors of the posture.

        Args:
            fingers: Names of the fingers of the robot.
            motors: Number of its motors.

        Raises:
            UnknownNameError: The robot does not have one of the fingers.
            InputError: The posture has another number of motors.
        """
        if self.posture is not None and np.size(self.posture) != motors:
            raise InputError(
                f"posture: found {np.size(self.posture)} numbers, expected {motors}, one per motor"
            )
        for finger in self.weights:
            if finger not in fingers:
                raise UnknownNameError(
                    f"weights: the robot has no finger {finger!r}; expected one of "
                    f"{', '.join(fingers)}"
                )

    def start(self, targets: TargetBatch) -> TargetBatch:
        """Return the targets with the posture as their start configuration, if there is one."""
        return targets if self.posture is None else targets.starting_at(np.array(self.posture))

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


def _checked_posture(posture: object) -> tuple[float, ...]:
    """Return a posture as a tuple.

    Raises:
        InputError: It is not a vector of finite numbers.
    """
    try:
        array = np.asarray(posture, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(())
    if array.ndim != 1 or not np.isfinite(array).all():
        raise InputError(f"posture: found {posture!r}, expected a finite number per motor")
    return tuple(float(position) for position in array)
