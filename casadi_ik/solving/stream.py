"""Targets that come block by block: any number of them in the memory that one block takes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, RowError
from casadi_ik.grasps import Tolerance
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.solution import BatchSolution
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.run import Run

Block = tuple[ArrayLike, ArrayLike]
"""Points and normals (k, f, 3) of some targets."""


@dataclass(frozen=True, eq=False)
class SolvedBlock:
    """What became of a block.

    Attributes:
        first_row: Number of its first target among all.
        solution: A row per target; those with a fault are INVALID, with NaN for q and errors.
        faults: What is wrong with a target, by its number among all.
    """

    first_row: int
    solution: BatchSolution
    faults: Mapping[int, str]


@dataclass(frozen=True, eq=False)
class Stream:
    """How blocks are solved.

    Attributes:
        engine: Who solves.
        ask: Points, normals and the number of the first target as a checked question.
        tolerances: When a contact counts as reached, by finger.
        run: How targets are solved; one start (n,) for all of them.
    """

    engine: Engine
    ask: Callable[[np.ndarray, np.ndarray, int], Problems]
    tolerances: tuple[Tolerance, ...]
    run: Run

    def solve(self, blocks: Iterable[Block]) -> Iterator[SolvedBlock]:
        """Solve one block after the other; a target's numbers do not depend on the blocks.

        Raises:
            InputError: Bad q0, or a block of the wrong shape.
        """
        if self.run.start(self.engine.robot).ndim != 1:
            raise InputError("q0: found several, expected one start for all targets")
        first_row = 0
        for points, normals in blocks:
            block = self._block(np.asanyarray(points), np.asanyarray(normals), first_row)
            yield block
            first_row += len(block.solution)

    def _block(self, points: np.ndarray, normals: np.ndarray, first_row: int) -> SolvedBlock:
        """Solve what can be asked: a row with a fault parts those before it from those after it."""
        if len(points) != len(normals):
            raise InputError(
                f"points and normals: found {len(points)} and {len(normals)} rows, expected as many"
            )
        engine = self.engine
        parts: dict[int, BatchSolution] = {}
        faults: dict[int, str] = {}
        waiting = [(0, len(points))]
        while waiting:
            start, stop = waiting.pop()
            rows = slice(start, stop)
            try:
                parts[start] = self._solved(points[rows], normals[rows], first_row + start)
            except RowError as error:
                row = error.row - first_row
                faults[error.row] = str(error)
                parts[row] = BatchSolution.invalid(
                    1, engine.method.name, engine.robot, self.tolerances, self.run.diagnose
                )
                waiting += [part for part in ((row + 1, stop), (start, row)) if part[0] < part[1]]
        solution = BatchSolution.joined([parts[start] for start in sorted(parts)])
        return SolvedBlock(first_row, solution, dict(sorted(faults.items())))

    def _solved(self, points: np.ndarray, normals: np.ndarray, first_row: int) -> BatchSolution:
        problems = self.ask(points, normals, first_row)
        return self.engine.solve(problems, self.run)
