"""How a batch is cut into parts, and a part solved: judged, and as it is recorded."""

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
from casadi_ik.files.arrays import Array
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
    """A part of a batch, solved.

    Attributes:
        targets: Its targets.
        starts: (k, n) where they were begun.
        started: When it was begun, since the Unix epoch [ns].
        outcome: What the method came to.
        batch: The same, judged.
        query: What the answers were checked against; None: nothing.
    """

    targets: TargetBatch
    starts: Array
    started: int
    outcome: Outcome
    batch: BatchSolution
    query: CollisionQuery | None = None

    def record(self, recorder: Recorder, form: TraceFormat, seed: int) -> None:
        """Hand it on with its iterations, if they were kept."""
        if self.outcome.rows is None:
            return
        batch = self.batch
        before = np.concatenate([[0.0], np.cumsum(batch.time)[:-1]])[: len(batch)]
        block = SolveBlock(
            format=form,
            first=self.targets.first_row,
            targets=self.targets,
            starts=self.starts,
            seed=seed,
            batch=batch,
            rows=self.outcome.rows,
            started=self.started + (before * 1e9).astype(np.int64),
            query=self.query,
        )
        recorder.record(block)


def judged(
    robot: ArmHand,
    method: str,
    targets: TargetBatch,
    outcome: Outcome,
    query: CollisionQuery | None = None,
) -> BatchSolution:
    """An outcome with the verdict on it, which has the last word on what is solved.

    Args:
        robot: The robot.
        method: Name of the method.
        targets: The targets.
        outcome: What the method came to.
        query: What the answers must not touch; None: nothing is checked.
    """
    verdict = judge(robot, targets, outcome.q)
    success, palm = verdict.solved(targets.enforce_limits), verdict.palm
    clear = None if query is None else query.check(outcome.q)
    touching = None if clear is None else success & ~clear.free
    if clear is not None:
        success = success & clear.free
    status, content = outcome.status, outcome.status == Status.SOLVED
    if (content != success).any():
        # A method that is content with what the verdict refuses has come to a standstill.
        status = np.where(content, int(Status.STALLED), status)
        status[success] = Status.SOLVED
        if touching is not None:
            status[touching] = Status.COLLISION
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
        clearance=None if clear is None else clear.distance,
        closest=() if clear is None else tuple(map(clear.pair, range(len(outcome.q)))),
        collisions=() if clear is None else (None,) * len(outcome.q),
        palm_position_error=None if palm is None else palm.position_error,
        palm_angle_error=None if palm is None else palm.angle_error,
        palm_ok=None if palm is None else palm.ok,
        arm_hand=robot,
    )


PART_BYTES = 2**24
"""About how many bytes of iterations a part may have if they are to be kept; what it has made is
lost if the process is killed before it goes to the log."""

CACHED_BYTES = 2**22
"""A part of `ENOUGH` solves has no more than this: what the next one needs is then at hand, in the
caches and in the process. Parts of 16 MiB make a study of hand-first with a log a tenth slower."""

ENOUGH = 256
"""Solves of a part that keep the vectors busy: its last ones have them to themselves."""

FIRST_PART = 64
"""Solves of the first parts of a traced batch, from which the others' size is learned."""


class BatchParts:
    """The parts of a batch in order; iterating may go on while finished parts are learned from."""

    def __init__(self, count: int, jobs: int, trace: bool, watched: bool = False) -> None:
        """Cut.

        Args:
            count: Targets.
            jobs: Threads.
            trace: Whether all iterations are kept.
            watched: Whether someone wants to see how far it is.
        """
        self._count = count
        self._trace, self._watched = trace, watched
        self._largest = max(1, -(-count // jobs))
        self._size = min(FIRST_PART, self._largest) if trace or watched else self._largest

    def __iter__(self) -> Iterator[slice]:
        """The parts; a single empty one if there are no targets.

        A part is recorded while the next is solved. The last parts of a traced batch grow smaller,
        so that little is left to record when all are solved.
        """
        start = 0
        while True:
            left = self._count - start
            size = min(self._size, max(left // 2, ENOUGH)) if self._trace else self._size
            stop = min(start + size, self._count)
            yield slice(start, stop)
            start = stop
            if start == self._count:
                return

    def pace(self, seconds: float) -> None:
        """Take note of how long a part took: those that someone watches take a quarter second."""
        if self._watched and not self._trace and seconds < 0.25:
            self._size = min(4 * self._size, self._largest)

    def learn(self, solves: int, size: int) -> None:
        """Take note of how many bytes of iterations so many solves had."""
        cached, fitting = (bound * solves // max(size, 1) for bound in (CACHED_BYTES, PART_BYTES))
        self._size = max(1, min(max(cached, min(ENOUGH, fitting)), self._largest))


Item = TypeVar("Item")
Done = TypeVar("Done")


def in_order(task: Callable[[Item], Done], items: Iterable[Item], jobs: int) -> Iterator[Done]:
    """What becomes of items, in order, done by so many threads.

    If what takes the results ends by an exception (Ctrl-C), the threads are told to stop.
    """
    if jobs == 1:
        yield from map(task, items)
        return
    cancelled, pool, ahead = threading.Event(), ThreadPoolExecutor(jobs), deque[Future[Done]]()

    def work(item: Item) -> Done:
        with cancellable(cancelled):
            stop_if_cancelled()
            return task(item)

    try:
        for item in items:
            ahead.append(pool.submit(work, item))
            if len(ahead) > jobs:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    except BaseException:
        cancelled.set()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
