"""The interface between solvers and recorders: `SolveBlock` and `Recorder`.

Solvers know this interface but no files; `casadi_ik.logs` implements it.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.solution import BatchSolution
from casadi_ik.solve.trace import TraceFormat


@dataclass(frozen=True, eq=False)
class SolveBlock:
    """Records of k consecutive solves of one method.

    Attributes:
        format: Layout and labels of the rows.
        first: Number of the first solve; numbers are unique per method in a log.
        targets: The targets.
        batch: The solutions, which name method, robot and fingers.
        rows: (sum of `BatchSolution.iterations`,) iterations of all solves, ordered by solve.
        started: (k,) start times [ns since the Unix epoch].
        query: Collision query of the targets; None: collisions were not checked.
    """

    format: TraceFormat
    first: int
    targets: TargetBatch
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
    """A context manager that records the iterations of solves."""

    def record(self, block: SolveBlock) -> None:
        """Record finished solves; the caller must not modify the arrays afterwards."""
        ...

    def close(self) -> None:
        """Finish the record and make it durable."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...
