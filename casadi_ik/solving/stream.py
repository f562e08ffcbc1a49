"""Targets that come block by block: any number of them in the memory that one block takes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.answers.solution import BatchSolution
from casadi_ik.errors import InputError, RowError
from casadi_ik.grasps import Tolerance
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.solving.engine import Engine, Run

REQUIRED = ("points", "normals")
"""What every target is told by."""

Block = tuple[ArrayLike, ArrayLike] | Mapping[str, ArrayLike]
"""Points and normals (k, f, 3) of some targets; or these and more by name."""


@dataclass(frozen=True, eq=False)
class SolvedBlock:
    """The answers to a block.

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
        engine: Solves.
        ask: Arrays by name and the number of the first target as a checked question.
        tolerances: When a contact counts as reached, by finger.
        run: How targets are solved; one start (n,) for all of them.
    """

    engine: Engine
    ask: Callable[[Mapping[str, np.ndarray], int], TargetBatch]
    tolerances: tuple[Tolerance, ...]
    run: Run

    def solve(self, blocks: Iterable[Block], first_row: int = 0) -> Iterator[SolvedBlock]:
        """Solve one block after the other; a target's numbers do not depend on the blocks.

        Args:
            blocks: Arrays of targets.
            first_row: Number of the first target.

        Raises:
            InputError: Bad q0, or a block of the wrong shape.
        """
        if self.engine.robot.start(self.run.q0).ndim != 1:
            raise InputError("q0: found several, expected one start for all targets")
        for given in blocks:
            named = given if isinstance(given, Mapping) else dict(zip(REQUIRED, given, strict=True))
            arrays = {name: np.asanyarray(array) for name, array in named.items()}
            block = self._block(arrays, first_row)
            yield block
            first_row += len(block.solution)

    def _block(self, arrays: Mapping[str, np.ndarray], first_row: int) -> SolvedBlock:
        """Solve what can be asked: a row with a fault parts those before it from those after it."""
        count = len(arrays[REQUIRED[0]])
        for name, array in arrays.items():
            if len(array) != count:
                raise InputError(
                    f"{REQUIRED[0]} and {name}: found {count} and {len(array)} rows, expected as "
                    "many"
                )
        engine = self.engine
        parts: dict[int, BatchSolution] = {}
        faults: dict[int, str] = {}
        waiting = [(0, count)]
        while waiting:
            start, stop = waiting.pop()
            rows = slice(start, stop)
            try:
                parts[start] = self._solved(
                    {name: array[rows] for name, array in arrays.items()}, first_row + start
                )
            except RowError as error:
                row = error.row - first_row
                faults[error.row] = str(error)
                parts[row] = BatchSolution.invalid(
                    1,
                    engine.method.name,
                    engine.robot,
                    self.tolerances,
                    self.run.diagnose,
                    engine.check is not None,
                )
                waiting += [part for part in ((row + 1, stop), (start, row)) if part[0] < part[1]]
        solution = BatchSolution.joined([parts[start] for start in sorted(parts)])
        return SolvedBlock(first_row, solution, dict(sorted(faults.items())))

    def _solved(self, arrays: Mapping[str, np.ndarray], first_row: int) -> BatchSolution:
        return self.engine.solve(self.ask(arrays, first_row), self.run)
