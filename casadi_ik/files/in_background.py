"""Work that goes on in the background: written in order while the next is made."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self


class InBackground:
    """One thread that does jobs in their order, at most one behind.

    To check, compress and write a log takes as long as to solve what it holds; all of it runs in
    compiled code that holds no lock of the interpreter. The thread is made with the second job, so
    that a single solve, or a log of one chunk, does without.
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
        self.wait()
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "casadi_ik_log")
        self._pending = self._pool.submit(job)

    def wait(self) -> None:
        """Wait until nothing is left to do; raises what the last job has raised."""
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
                self.wait()
        finally:
            self.end()

    def end(self) -> None:
        """Wait for the last job, whatever becomes of it, and end the thread."""
        self._pending = None
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
