"""Which solves of a study keep their iterations, where all would be too many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputError


@dataclass(frozen=True)
class Keep:
    """Which solves keep every iteration and event; of the others the totals are kept.

    Stands in the log's metadata, so that no reader takes the sample for the whole.

    Attributes:
        failed: All that were not solved.
        singular: All in which a Jacobian was near singular or ill-conditioned.
        sample: Share of all solves, whatever became of them, from 0 to 1.
        seed: Of the sample; with the solve's number it decides, whatever else is in the log.

    Example:
        >>> keep = ik.logs.Keep(sample=0.01)  # all that fail, and one in a hundred of the others
        >>> keep.failed, keep.sample
        (True, 0.01)
    """

    failed: bool = True
    singular: bool = True
    sample: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (isinstance(self.sample, (int, float)) and 0 <= self.sample <= 1):
            raise InputError(f"keep.sample: found {self.sample!r}, expected a number from 0 to 1")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError(f"keep.seed: found {self.seed!r}, expected an integer >= 0")

    def __call__(
        self, first: int, success: NDArray[np.bool_], singular: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Which of k solves to keep.

        Args:
            first: Number of the first; the others follow.
            success: (k,) whether it was solved.
            singular: (k,) whether a Jacobian was near singular or ill-conditioned.
        """
        if self.sample >= 1:
            return np.ones(len(success), dtype=bool)
        numbers = np.random.Generator(np.random.PCG64(self.seed).advance(first))
        kept = numbers.random(len(success)) < self.sample
        if self.failed:
            kept |= ~success
        if self.singular:
            kept |= singular
        return kept
