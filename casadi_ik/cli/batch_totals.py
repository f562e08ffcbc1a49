"""What the report on a batch needs to know, gathered block by block."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from casadi_ik.solving.stream import SolvedBlock

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

    def add(self, block: SolvedBlock) -> None:
        """Count a block in."""
        batch = block.solution
        self.count += len(batch)
        self.solved += int(batch.success.sum())
        self.statuses.update(batch.status_names.tolist())
        self.reasons.update(found.reason.name for found in batch.diagnoses if found is not None)
        self.iterations += int(batch.iterations.sum())
        self.most_iterations = max(self.most_iterations, int(batch.iterations.max()))
        self.restarts += int(batch.restarts.sum())
        self.most_restarts = max(self.most_restarts, int(batch.restarts.max()))
        rows = block.first_row + np.flatnonzero(~batch.success)
        self.missed += rows[: ROWS_SHOWN - len(self.missed)].tolist()
        self.faults += len(block.faults)
        self.first_faults += list(block.faults.values())[: FAULTS_SHOWN - len(self.first_faults)]
        self._times.append(batch.time.astype(np.float32))

    @property
    def times(self) -> np.ndarray:
        """(count,) seconds of every target; four bytes each are the only thing that grows."""
        return np.concatenate(self._times)
