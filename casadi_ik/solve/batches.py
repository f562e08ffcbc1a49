"""Division of a batch into parts, and the check, recording and concurrency of parts."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.compile.cancellation import cancellable, stop_if_cancelled
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.recorder import Recorder, SolveBlock
from casadi_ik.solve.solution import BatchSolution
from casadi_ik.solve.status import Status
from casadi_ik.solve.trace import TraceFormat
from casadi_ik.solve.verdict import judge


@dataclass(frozen=True, eq=False)
class SolvedPart:
    """A solved part of a batch.

    Attributes:
        targets: Targets of the part.
        started: Start time [ns since the Unix epoch].
        outcome: Result of the method.
        batch: Solutions after the verdict.
        query: Collision query of the targets; None: collisions were not checked.
    """

    targets: TargetBatch
    started: int
    outcome: Outcome
    batch: BatchSolution
    query: CollisionQuery | None = None

    def record(self, recorder: Recorder, trace_format: TraceFormat) -> None:
        """Pass the part to a recorder if its iterations were traced."""
        if self.outcome.rows is None:
            return
        batch = self.batch
        elapsed = np.concatenate([[0.0], np.cumsum(batch.time)[:-1]])[: len(batch)]
        block = SolveBlock(
            format=trace_format,
            first=self.targets.first_row,
            targets=self.targets,
            batch=batch,
            rows=self.outcome.rows,
            started=self.started + (elapsed * 1e9).astype(np.int64),
            query=self.query,
        )
        recorder.record(block)


def judge_outcome(
    robot: ArmHand,
    method: str,
    targets: TargetBatch,
    outcome: Outcome,
    query: CollisionQuery | None = None,
) -> BatchSolution:
    """Check an outcome against its targets; the verdict decides on success.

    Args:
        robot: The robot.
        method: Name of the method.
        targets: The targets.
        outcome: Result of the method.
        query: Collision query of the targets; None: collisions are not checked.
    """
    verdict = judge(robot, targets, outcome.q)
    success, palm = verdict.solved(targets.enforce_limits), verdict.palm
    clearances = None if query is None else query.check(outcome.q)
    in_collision = None if clearances is None else success & ~clearances.free
    if clearances is not None:
        success = success & clearances.free
    status, claimed = outcome.status, outcome.status == Status.SOLVED
    if (claimed != success).any():
        # A method's SOLVED that fails the check becomes STALLED.
        status = np.where(claimed, int(Status.STALLED), status)
        status[success] = Status.SOLVED
        if in_collision is not None:
            status[in_collision] = Status.COLLISION
    return BatchSolution(
        success=success,
        status=status,
        q=outcome.q,
        iterations=outcome.iterations,
        restarts=outcome.restarts,
        time=outcome.time,
        position_error=verdict.position_error,
        angle_error=verdict.angle_error,
        ok=verdict.ok,
        limits_ok=verdict.limits_ok,
        phases=outcome.phases,
        tolerances=targets.tolerances,
        fingers=robot.fingers,
        method=method,
        robot=robot.name,
        actuators=robot.actuators,
        clearance=None if clearances is None else clearances.distance,
        closest=() if clearances is None else tuple(map(clearances.pair, range(len(outcome.q)))),
        collisions=() if clearances is None else (None,) * len(outcome.q),
        palm_position_error=None if palm is None else palm.position_error,
        palm_angle_error=None if palm is None else palm.angle_error,
        palm_ok=None if palm is None else palm.ok,
        arm_hand=robot,
    )


MAX_PART_BYTES = 2**24
"""Approximate maximum size of the trace of a part [bytes]. A killed process loses the parts that it
has not recorded."""

MAX_CACHED_BYTES = 2**22
"""Maximum size of the trace of a part of at least `MIN_PART_SOLVES` solves [bytes].

The next part then finds its data in the caches. Source: a logged study of hand-first takes 10 %
longer with parts of 16 MiB."""

MIN_PART_SOLVES = 256
"""Number of solves that keep the vector lanes busy; the last solves of a part run alone."""

FIRST_PART_SOLVES = 64
"""Number of solves of the first parts of a traced batch, from which the part size is adapted."""


class BatchParts:
    """The parts of a batch in order; the part size adapts while the parts are solved."""

    def __init__(self, count: int, jobs: int, trace: bool, show_progress: bool = False) -> None:
        """Divide a batch.

        Args:
            count: Number of targets.
            jobs: Number of threads.
            trace: Whether all iterations are recorded.
            show_progress: Whether a progress bar is shown.
        """
        self._count = count
        self._trace, self._show_progress = trace, show_progress
        self._max_size = max(1, -(-count // jobs))
        is_adaptive = trace or show_progress
        self._size = min(FIRST_PART_SOLVES, self._max_size) if is_adaptive else self._max_size

    def __iter__(self) -> Iterator[slice]:
        """Yield the rows of each part; a single empty part if there are no targets.

        A part is recorded while the next one is solved. The last parts of a traced batch shrink,
        so that little remains to be recorded after the last solve.
        """
        start = 0
        while True:
            remaining = self._count - start
            size = min(self._size, max(remaining // 2, MIN_PART_SOLVES))
            stop = min(start + (size if self._trace else self._size), self._count)
            yield slice(start, stop)
            start = stop
            if start == self._count:
                return

    def adapt_to_time(self, seconds: float) -> None:
        """Enlarge the parts of a batch with a progress bar to about a quarter of a second.

        Args:
            seconds: Duration of a part [s].
        """
        if self._show_progress and not self._trace and seconds < 0.25:
            self._size = min(4 * self._size, self._max_size)

    def adapt_to_memory(self, solves: int, size: int) -> None:
        """Adapt the part size to the size of the trace.

        Args:
            solves: Number of solves of a part.
            size: Size of their trace [bytes].
        """
        cached, fitting = (
            bound * solves // max(size, 1) for bound in (MAX_CACHED_BYTES, MAX_PART_BYTES)
        )
        self._size = max(1, min(max(cached, min(MIN_PART_SOLVES, fitting)), self._max_size))


Item = TypeVar("Item")
Result = TypeVar("Result")


def map_ordered(
    task: Callable[[Item], Result], items: Iterable[Item], jobs: int
) -> Iterator[Result]:
    """Yield the results of a task on items, in order, computed by several threads.

    If the consumer ends by an exception (Ctrl-C), the threads are cancelled.

    Args:
        task: Function of an item.
        items: The items; at most `jobs` + 1 are taken ahead of the results.
        jobs: Number of threads.

    Yields:
        The result of each item.
    """
    if jobs == 1:
        yield from map(task, items)
        return
    cancelled, pool = threading.Event(), ThreadPoolExecutor(jobs)
    pending = deque[Future[Result]]()

    def run(item: Item) -> Result:
        with cancellable(cancelled):
            stop_if_cancelled()
            return task(item)

    try:
        for item in items:
            pending.append(pool.submit(run, item))
            if len(pending) > jobs:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    except BaseException:
        cancelled.set()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
