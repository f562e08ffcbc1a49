"""Targets of any kinds of contact: each is solved by the method built for its kinds."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Generic, TypeVar

from casadi_ik.arrays import Array
from casadi_ik.problem.contacts import Kinds, by_kinds
from casadi_ik.problem.method import Method, Outcome
from casadi_ik.problem.targets import TargetBatch

T = TypeVar("T")


class PerKinds(Generic[T]):
    """Something for each of the kinds that were asked for, made once; threads may share it."""

    def __init__(self, make: Callable[[Kinds], T]) -> None:
        """Take what makes it."""
        self._make = make
        self._made: dict[Kinds, T] = {}
        self._lock = Lock()

    def of(self, kinds: Kinds) -> T:
        """That for some kinds."""
        with self._lock:
            if kinds not in self._made:
                self._made[kinds] = self._make(kinds)
            return self._made[kinds]


def run(
    method: Callable[[Kinds], Method], targets: TargetBatch, starts: Array, seed: int, trace: bool
) -> Outcome:
    """Solve a batch; see `Method.run`.

    Args:
        method: Gives the method for some kinds.
        targets: k targets.
        starts: (k, n).
        seed: Of all random numbers.
        trace: Whether to keep every iteration.
    """
    groups, outcomes = [], []
    for kinds, rows, some in by_kinds(targets):
        if rows is None:
            return method(kinds).run(some, starts, seed, trace)
        groups.append(rows)
        outcomes.append(method(kinds).run(some, starts[rows], seed, trace))
    return Outcome.interleaved(groups, outcomes)
