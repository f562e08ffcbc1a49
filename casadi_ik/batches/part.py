"""One part of a batch, solved: what a worker does."""

from __future__ import annotations

import io
import pickle
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.batches.columns import columns
from casadi_ik.batches.sources import Part


@dataclass(frozen=True)
class Asked:
    """What is asked of all parts alike, as `Solver.solve_blocks` takes it.

    Attributes:
        q0: Start (n,); None: home.
        seed: Of all random numbers.
        diagnose: Whether to find out why what is not solved is not.
        fixed: Actuators that are not to move.
        prefer: Which of several solutions.
        log: Whether every iteration is logged.
    """

    q0: list[float] | None = None
    seed: int = 0
    diagnose: bool = False
    fixed: dict[str, float] | None = None
    prefer: str | None = None
    log: bool = False


@dataclass(frozen=True)
class SolvedPart:
    """A part, solved; bytes, so that a worker needs no folder in common with who asked.

    Attributes:
        number: Of the part.
        count: Targets of it.
        answers: An npz of the arrays of `columns`, and `row`, each target's number among all.
        log: An MCAP log, if one was asked for; solves are numbered as among all targets.
        faults: What is wrong with a target, by its number among all.
    """

    number: int
    count: int
    answers: bytes
    log: bytes | None
    faults: dict[int, str]


def solve_part(solver: bytes, asked: Asked, part: Part) -> SolvedPart:
    """Solve a part.

    Args:
        solver: A pickled `Solver`; what it is made to is kept for the next part.
        asked: How.
        part: Its targets.
    """
    with tempfile.TemporaryDirectory(prefix="casadi_ik-part-") as place:
        path = Path(place) / "part.mcap" if asked.log else None
        (block,) = _solver(solver).solve_blocks(
            [part.arrays],
            asked.q0,
            asked.seed,
            log=path,
            diagnose=asked.diagnose,
            fixed=asked.fixed,
            prefer=asked.prefer,
            first_row=part.first_row,
        )
        log = None if path is None else path.read_bytes()
    answers = io.BytesIO()
    count = len(block.solution)
    numbers = part.first_row + np.arange(count)
    np.savez(answers, allow_pickle=False, row=numbers, **columns(block.solution))
    return SolvedPart(part.number, count, answers.getvalue(), log, dict(block.faults))


@lru_cache(maxsize=2)
def _solver(pickled: bytes) -> Solver:
    solver = pickle.loads(pickled)
    assert isinstance(solver, Solver)
    return solver
