"""Threads that stop when whoever waits for them does."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from casadi_ik.kernels.cancellation import cancellable, stop_if_cancelled

P = ParamSpec("P")
T = TypeVar("T")


class Workers:
    """Threads for tasks, inside `workers`."""

    def __init__(self, pool: ThreadPoolExecutor, cancelled: threading.Event) -> None:
        self._pool, self._cancelled = pool, cancelled

    def submit(self, task: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> Future[T]:
        """Have a task done as soon as a thread is free."""

        def work() -> T:
            with cancellable(self._cancelled):
                stop_if_cancelled()
                return task(*arguments, **named)

        return self._pool.submit(work)


@contextmanager
def workers(count: int) -> Iterator[Workers]:
    """So many threads; if the block ends by an exception (Ctrl-C), they are told to stop."""
    cancelled = threading.Event()
    pool = ThreadPoolExecutor(count)
    try:
        yield Workers(pool, cancelled)
    except BaseException:
        cancelled.set()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
