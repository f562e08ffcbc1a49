"""Recording a part of a batch while the next one is solved."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self


class WriteBehind:
    """One thread that does jobs in their order, at most one behind.

    To check, compress and write a log takes as long as to solve what it holds; both run in
    compiled code that holds no lock of the interpreter. The thread is made with the second job, so
    that a single solve does without.
    """

    def __init__(self) -> None:
        self._first = True
        self._pool: ThreadPoolExecutor | None = None
        self._pending: Future[None] | None = None

    def do(self, job: Callable[[], None]) -> None:
        """Have a job done; raises what the one before has raised."""
        if self._first:
            self._first = False
            job()
            return
        self._wait()
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "casadi_ik_log")
        self._pending = self._pool.submit(job)

    def _wait(self) -> None:
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Wait for the last job; what it raises counts unless something else has been raised."""
        try:
            if error is None:
                self._wait()
        finally:
            if self._pool is not None:
                self._pool.shutdown()
