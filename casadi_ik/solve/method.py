"""What a method has to offer, and what it gives back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.layout import split_rows
from casadi_ik.compile.loop import Stepper
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import Kinds
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.trace import TraceFormat


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a method made of a batch of k targets.

    Attributes:
        q: (k, n) configurations reached.
        status: (k,) codes of `Status`.
        iterations: (k,) iterations over all phases and restarts.
        restarts: (k,) how often it began anew.
        time: (k,) seconds per solve.
        phases: (k,) iterations by phase name, in the order of the phases.
        rows: The records of all iterations, one solve after the other, (sum of iterations,); None
            if no trace was asked for.
    """

    q: Array
    status: NDArray[np.int64]
    iterations: NDArray[np.int64]
    restarts: NDArray[np.int64]
    time: Array
    phases: Mapping[str, NDArray[np.int64]]
    rows: NDArray[Any] | None = None

    @property
    def trace(self) -> tuple[NDArray[Any], ...]:
        """The rows of each solve, views into `rows`; empty if no trace was asked for."""
        return () if self.rows is None else split_rows(self.rows, self.iterations)

    def continued(
        self,
        rows: NDArray[np.intp],
        q: Array,
        improved: NDArray[np.bool_],
        other: Outcome,
        trace: Sequence[NDArray[Any]] | None,
    ) -> Outcome:
        """Return the outcome after a second search for some of its targets.

        Args:
            rows: (m,) the targets.
            q: (m, n) configurations reached by the second search.
            improved: (m,) True where they replace those of the first search.
            other: The second search; its iterations, restarts and seconds are added.
            trace: Its records by target, as records of this outcome; None if no trace is kept.
        """
        every = self.q.copy()
        every[rows[improved]] = q[improved]

        def total(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
            added = first.copy()
            added[rows] += second
            return added

        records = None
        if trace is not None and self.rows is not None:
            parts = [[part] for part in self.trace]
            for row, second in zip(rows.tolist(), trace, strict=True):
                parts[row].append(second)
            records = np.concatenate([part for both in parts for part in both])
        phases = {
            name: total(count, other.phases[name]) if name in other.phases else count
            for name, count in self.phases.items()
        }
        return replace(
            self,
            q=every,
            iterations=total(self.iterations, other.iterations),
            restarts=total(self.restarts, other.restarts),
            time=total(self.time, other.time),
            phases=phases,
            rows=records,
        )

    @classmethod
    def interleaved(
        cls, places: Sequence[NDArray[np.intp]], outcomes: Sequence[Outcome]
    ) -> Outcome:
        """Put the outcomes of some targets each together.

        Args:
            places: Which rows of the whole the targets of an outcome are; together all of them.
            outcomes: At least one.
        """
        order = np.argsort(np.concatenate(list(places)))

        def whole(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
            return np.concatenate(list(parts))[order]

        names = dict.fromkeys(name for one in outcomes for name in one.phases)
        rows = None
        if all(one.rows is not None for one in outcomes):
            traces = [trace for one in outcomes for trace in one.trace]
            rows = np.concatenate([traces[i] for i in order])
        return cls(
            q=whole([one.q for one in outcomes]),
            status=whole([one.status for one in outcomes]),
            iterations=whole([one.iterations for one in outcomes]),
            restarts=whole([one.restarts for one in outcomes]),
            time=whole([one.time for one in outcomes]),
            phases={
                name: whole([one.phases.get(name, np.zeros_like(one.status)) for one in outcomes])
                for name in names
            },
            rows=rows,
        )


@dataclass(frozen=True, eq=False)
class Quick:
    """What a method made of one target; fields as in `Outcome`.

    Attributes:
        errors: As the verdict measures them, if it was asked: distances [m] and angles [rad] by
            finger, NaN where free; by how much the worst actuator or joint is beyond its limits.
    """

    q: Array
    status: int
    iterations: int
    restarts: int
    phases: Mapping[str, int]
    errors: tuple[list[float], list[float], float] | None = None

    def outcome(self, seconds: float) -> Outcome:
        """The same as a batch of one that took some seconds."""
        return Outcome(
            q=self.q[None],
            status=np.array([self.status]),
            iterations=np.array([self.iterations]),
            restarts=np.array([self.restarts]),
            time=np.array([seconds]),
            phases={name: np.array([count]) for name, count in self.phases.items()},
        )


class Method(Protocol):
    """A named way to solve, built for one robot and kinds of contact.

    One that can prefer one of several solutions has `preferences`, too: those of `PREFERENCES` it
    knows. "q0" it follows itself where a `TargetBatch` says so, "limits" is what it does else.
    """

    name: str

    @property
    def trace_format(self) -> TraceFormat:
        """How its traces are to be read."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Every number and choice it works with, for the log."""
        ...

    def prepare(self) -> None:
        """Build and compile what `run` needs; afterwards `run` may be called by several threads."""
        ...

    def for_kinds(self, kinds: Kinds) -> Method:
        """The same method for contacts of other kinds; itself for its own, and if it has only one.

        What it cannot take, it refuses in `run`, target by target.
        """
        ...

    def stepper(self, targets: TargetBatch, q0: Array) -> Stepper:
        """Solve one target by hand, one iteration at a time.

        Args:
            targets: One target.
            q0: (n,) configuration to start from.

        Raises:
            RowError: The method cannot take the target (for example a free finger).
            UnsupportedError: The method cannot be stepped; the message says why.
        """
        ...

    def run(self, targets: TargetBatch, q0: Array, seed: int, trace: bool) -> Outcome:
        """Solve a batch of targets of its kinds.

        Args:
            targets: The targets.
            q0: (k, n) configurations to start from.
            seed: Of all random numbers; row i of a batch gets the same numbers in any batch.
            trace: Whether to keep every iteration.

        Raises:
            RowError: The method cannot take a target (for example a free finger).
        """
        ...
