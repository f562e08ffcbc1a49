"""What a solver hands over to a recorder of its solves: plain arrays and one protocol.

The solvers own this contract and know nothing of files; the logs implement it.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.files.arrays import Array
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.solution import BatchSolution
from casadi_ik.solve.trace import TraceFormat


@dataclass(frozen=True, eq=False)
class SolveBlock:
    """k solves of one method, numbered one after the other, with everything that is kept of them.

    Attributes:
        format: How the rows are to be read.
        first: Number of the first solve; solves are unique per method in one log.
        targets: The targets.
        starts: Where each solve began, (k, n).
        seed: Of the random numbers.
        batch: The answers; it names method, robot and fingers.
        rows: The iterations of all solves, one solve after the other, (sum of
            `BatchSolution.iterations`,) of the format's layout.
        started: When each solve began, (k,) [ns since the Unix epoch].
        query: What they were checked against; None: nothing.
    """

    format: TraceFormat
    first: int
    targets: TargetBatch
    starts: Array
    seed: int
    batch: BatchSolution
    rows: NDArray[Any]
    started: NDArray[np.int64]
    query: CollisionQuery | None = None

    def __len__(self) -> int:
        return len(self.batch)

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.batch.method

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self.batch.robot

    @property
    def fingers(self) -> tuple[str, ...]:
        """Names of the fingers."""
        return self.batch.fingers


class Recorder(Protocol):
    """Keeps the iterations of solves."""

    def record(self, block: SolveBlock) -> None:
        """Take finished solves; the caller leaves the arrays alone from then on."""
        ...

    def close(self) -> None:
        """Nothing more will come; what was taken is now kept for good."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...
