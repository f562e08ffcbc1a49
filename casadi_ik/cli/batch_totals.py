"""What the report on a batch needs to know, gathered block by block."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

ROWS_SHOWN = 12
"""How many unsolved rows are kept by number."""

FAULTS_SHOWN = 10
"""How many malformed rows are kept by what is wrong."""


@dataclass
class BatchTotals:
    """Totals over all targets so far.

    Attributes:
        count: Targets.
        solved: Of those, solved.
        statuses: How many of each status, by name.
        reasons: How many of each reason of a diagnosis, by name.
        iterations: In all.
        most_iterations: Of one target.
        restarts: In all.
        most_restarts: Of one target.
        missed: Numbers of the first targets that are not solved.
        faults: How many targets are malformed.
        first_faults: What is wrong with the first of them.
    """

    count: int = 0
    solved: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    iterations: int = 0
    most_iterations: int = 0
    restarts: int = 0
    most_restarts: int = 0
    missed: list[int] = field(default_factory=list)
    faults: int = 0
    first_faults: list[str] = field(default_factory=list)
    _times: list[np.ndarray] = field(default_factory=list)

    def add(self, arrays: Mapping[str, np.ndarray], first_row: int) -> None:
        """Count answers in.

        Args:
            arrays: Those of `batches.columns`.
            first_row: Number of the first target.
        """
        count, success = len(arrays["status"]), arrays["success"]
        self.count += count
        self.solved += int(success.sum())
        self.statuses.update(arrays["status"].tolist())
        reasons = arrays.get("reason", np.zeros(0, "<U1"))
        self.reasons.update(reasons[reasons != ""].tolist())
        for name in ("iterations", "restarts"):
            values, most = arrays[name], f"most_{name}"
            setattr(self, name, getattr(self, name) + int(values.sum()))
            setattr(self, most, max(getattr(self, most), int(values.max())))
        rows = first_row + np.flatnonzero(~success)
        self.missed += rows[: ROWS_SHOWN - len(self.missed)].tolist()
        self._times.append(arrays["time"].astype(np.float32))

    def note_faults(self, faults: Mapping[int, str]) -> None:
        """Take note of malformed targets, what is wrong by number."""
        self.faults += len(faults)
        texts = [text for _, text in sorted(faults.items())]
        self.first_faults += texts[: FAULTS_SHOWN - len(self.first_faults)]

    @property
    def times(self) -> np.ndarray:
        """(count,) seconds of every target; four bytes each are the only thing that grows."""
        return np.concatenate(self._times)
