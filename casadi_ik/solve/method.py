"""The interface between the engine and the methods: `Method`, `HandSearch`, and their outcomes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.layout import Layout, split_rows
from casadi_ik.compile.loop import LoopResult, Stepper
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.contacts import Kinds
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.trace import TraceFormat


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a method for a batch of k targets, before the verdict.

    Attributes:
        q: (k, n) final configurations [rad or m].
        status: (k,) codes of `Status`.
        iterations: (k,) iterations over all phases and restarts.
        restarts: (k,) number of restarts.
        time: (k,) seconds per solve.
        phases: (k,) iterations by phase name, in the order of the phases.
        rows: (sum of iterations,) records of all iterations, ordered by solve; None without a
            trace.
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
        """Rows of each solve as views into `rows`; empty without a trace."""
        return () if self.rows is None else split_rows(self.rows, self.iterations)

    def continued(
        self,
        rows: NDArray[np.intp],
        q: Array,
        improved: NDArray[np.bool_],
        second: Outcome,
        trace: Sequence[NDArray[Any]] | None,
    ) -> Outcome:
        """Return the outcome after a second search for some of its targets.

        Args:
            rows: (m,) the targets.
            q: (m, n) configurations reached by the second search.
            improved: (m,) True where they replace those of the first search.
            second: The second search; its iterations, restarts and seconds are added.
            trace: Its records by target, as records of this outcome; None if no trace is kept.
        """
        all_q = self.q.copy()
        all_q[rows[improved]] = q[improved]

        def total(counts: NDArray[Any], second_counts: NDArray[Any]) -> NDArray[Any]:
            sums = counts.copy()
            sums[rows] += second_counts
            return sums

        records = None
        if trace is not None and self.rows is not None:
            parts = [[part] for part in self.trace]
            for row, second_part in zip(rows.tolist(), trace, strict=True):
                parts[row].append(second_part)
            records = np.concatenate([part for target_parts in parts for part in target_parts])
        phases = {
            name: total(count, second.phases[name]) if name in second.phases else count
            for name, count in self.phases.items()
        }
        return replace(
            self,
            q=all_q,
            iterations=total(self.iterations, second.iterations),
            restarts=total(self.restarts, second.restarts),
            time=total(self.time, second.time),
            phases=phases,
            rows=records,
        )

    def with_rows(self, rows: NDArray[np.intp], replacement: Outcome) -> Outcome:
        """Return the outcome with the results (m,) of another run for some of its targets."""
        is_unchanged = np.ones(len(self.q), dtype=bool)
        is_unchanged[rows] = False
        unchanged_rows = np.flatnonzero(is_unchanged)
        if not len(unchanged_rows):
            return replacement
        trace = self.trace
        unchanged = Outcome(
            q=self.q[unchanged_rows],
            status=self.status[unchanged_rows],
            iterations=self.iterations[unchanged_rows],
            restarts=self.restarts[unchanged_rows],
            time=self.time[unchanged_rows],
            phases={name: count[unchanged_rows] for name, count in self.phases.items()},
            rows=np.concatenate([trace[row] for row in unchanged_rows]) if trace else None,
        )
        return Outcome.interleaved([unchanged_rows, rows], [unchanged, replacement])

    @classmethod
    def interleaved(
        cls, indices: Sequence[NDArray[np.intp]], outcomes: Sequence[Outcome]
    ) -> Outcome:
        """Merge the outcomes of disjoint subsets of a batch.

        Args:
            indices: For each outcome the rows of the batch that it belongs to; together all rows.
            outcomes: At least one outcome.
        """
        order = np.argsort(np.concatenate(list(indices)))

        def merge(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
            return np.concatenate(list(arrays))[order]

        names = dict.fromkeys(name for outcome in outcomes for name in outcome.phases)
        rows = None
        if all(outcome.rows is not None for outcome in outcomes):
            traces = [trace for outcome in outcomes for trace in outcome.trace]
            rows = np.concatenate([traces[i] for i in order])
        return cls(
            q=merge([outcome.q for outcome in outcomes]),
            status=merge([outcome.status for outcome in outcomes]),
            iterations=merge([outcome.iterations for outcome in outcomes]),
            restarts=merge([outcome.restarts for outcome in outcomes]),
            time=merge([outcome.time for outcome in outcomes]),
            phases={
                name: merge(
                    [
                        outcome.phases.get(name, np.zeros_like(outcome.status))
                        for outcome in outcomes
                    ]
                )
                for name in names
            },
            rows=rows,
        )


@dataclass(slots=True, eq=False)
class SingleOutcome:
    """Result of a method for one target, after the verdict; counts as in `Outcome`.

    Attributes:
        q: (n,) final configuration [rad or m].
        status: Code of `Status`; SOLVED if the verdict agrees.
        position_error: Distance of each fingertip [m], NaN where free.
        angle_error: Angle of each fingertip [rad], NaN where free.
        limits_ok: Whether every actuator and joint is within its limits.
    """

    q: Array
    status: int
    iterations: int
    restarts: int
    phases: Mapping[str, int]
    position_error: list[float]
    angle_error: list[float]
    limits_ok: bool

    def outcome(self, seconds: float) -> Outcome:
        """Return the outcome as a batch of one target that took this many seconds."""
        return Outcome(
            q=self.q[None],
            status=np.array([self.status]),
            iterations=np.array([self.iterations]),
            restarts=np.array([self.restarts]),
            time=np.array([seconds]),
            phases={name: np.array([count]) for name, count in self.phases.items()},
        )


class Method(Protocol):
    """A named solver, built for one robot and one combination of contact kinds.

    A class that subclasses this protocol explicitly inherits the defaults of `preferences` and
    `hand_search`.

    Attributes:
        name: Name of the method, as in the registry.
    """

    name: str

    @property
    def preferences(self) -> tuple[str, ...]:
        """Values of `PREFERENCES` that the method supports.

        Empty if the method returns the first solution it finds. A method reads "q0" from
        `TargetBatch.prefer`; "limits" is its default order.
        """
        return ()

    @property
    def hand_search(self) -> HandSearch | None:
        """The method as a search over hand postures, or None if it is a black box.

        The engine needs it for alternatives, collision-free search, palm targets, `fast` and
        interim solutions. Diagnoses of other methods build a separate hand-first search.
        """
        return None

    @property
    def trace_format(self) -> TraceFormat:
        """Layout and labels of the rows of a trace."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameters of the method by name, for the log."""
        ...

    def prepare(self) -> None:
        """Build and compile what `run` needs; afterwards threads may call `run` concurrently."""
        ...

    def for_kinds(self, kinds: Kinds) -> Method:
        """Return the method for other contact kinds.

        A method that supports a single combination of kinds returns itself, and refuses other
        targets in `run`.
        """
        ...

    def stepper(self, targets: TargetBatch) -> Stepper:
        """Return a stepper that solves one target iteration by iteration.

        Args:
            targets: One target.

        Raises:
            RowError: The method does not support the target (for example a free finger).
            UnsupportedError: The method cannot be stepped; the message says why.
        """
        ...

    def run(self, targets: TargetBatch, trace: bool = False) -> Outcome:
        """Solve a batch of targets of the method's contact kinds.

        Args:
            targets: The targets. A target gets the same random numbers in any batch.
            trace: Whether to record every iteration.

        Raises:
            RowError: The method does not support a target (for example a free finger).
        """
        ...


class SearchLayouts(Protocol):
    """Layouts of the compiled loop of a `HandSearch`."""

    @cached_property
    def state(self) -> Layout:
        """Layout of the state."""
        ...

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the parameters."""
        ...


class SearchStep(Protocol):
    """The iteration of a `HandSearch`."""

    @property
    def layouts(self) -> SearchLayouts:
        """Layouts of state and parameters."""
        ...

    @property
    def arm(self) -> ArmFamily | None:
        """Closed form of the arm; None for an arm without one, and without an arm."""
        ...


class SearchSettings(Protocol):
    """Parameters of a `HandSearch` that its callers read."""

    @property
    def candidates(self) -> int:
        """Number of seeds of a restart."""
        ...

    @property
    def rounds(self) -> int:
        """Number of restarts whose seeds resemble the target."""
        ...


class SingleSearch(Protocol):
    """Preallocated memory of one search; used by one thread at a time.

    Attributes:
        points: (f, 3) contact points [m], NaN where free; an input.
        normals: (f, 3) pad normals, NaN where free; an input.
        q0: (n,) start configuration [rad or m]; an input.
        settings: Settings that targets share, as `HandSearch.settings` returns them; an input.
        q: (n,) result [rad or m]; overwritten by each call, like the errors.
        position_error: (f,) distances [m].
        angle_error: (f,) angles [rad].
    """

    points: Array
    normals: Array
    q0: Array
    settings: Array
    q: Array
    position_error: Array
    angle_error: Array

    def __call__(self, rounds: int) -> int | None:
        """Solve with at most this many restarts; return the status, None for malformed input."""
        ...


class HandSearch(Method, Protocol):
    """A method whose seeds, loop states and runs are accessible one by one.

    Hand-first implements it. Alternatives, the collision-free search, diagnoses, `fast` and
    interim solutions are built on these members.
    """

    @property
    def robot(self) -> RobotDescription:
        """Robot that the method is built for."""
        ...

    @property
    def options(self) -> SearchSettings:
        """Parameters of the method."""
        ...

    @property
    def step(self) -> SearchStep:
        """Iteration of the method."""
        ...

    @property
    def rounds(self) -> int:
        """Maximum number of restarts."""
        ...

    def prepare(self, batches: bool = False) -> None:
        """Build and compile the kernels of a single target.

        Args:
            batches: Whether to also compile the kernels of batches.
        """
        ...

    def in_virtual_machine(self) -> HandSearch:
        """Return the method evaluated by CasADi's virtual machine."""
        ...

    def run(self, targets: TargetBatch, trace: bool = False, rounds: int | None = None) -> Outcome:
        """Solve a batch with at most `rounds` restarts; see `Method.run`."""
        ...

    def solve_single(self, targets: TargetBatch, rounds: int | None = None) -> SingleOutcome | None:
        """Solve one target with less overhead than `run`; None if it cannot."""
        ...

    def new_search(self, enforce_limits: bool) -> SingleSearch | None:
        """Return memory for successive searches; None without a compiler."""
        ...

    def settings(self, targets: TargetBatch) -> Array:
        """Return the settings that targets share: tolerances, bounds, preference."""
        ...

    def postures(self, targets: TargetBatch, number: int) -> Array:
        """Return the seeds of a restart, (k, candidates, hand) hand postures."""
        ...

    def rows(
        self, targets: TargetBatch, postures: Array, skip_q0: bool = False
    ) -> tuple[Array, Array]:
        """Return initial states and parameters of the loop for `run_rows`.

        Args:
            targets: k targets.
            postures: (k, candidates, hand) seeds, or (k, 1, hand).
            skip_q0: Whether to skip the search for a solution near q0.
        """
        ...

    def run_rows(self, states: Array, parameters: Array) -> LoopResult:
        """Run the loop from states and parameters made by `rows`."""
        ...
