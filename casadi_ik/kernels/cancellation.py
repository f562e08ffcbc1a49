"""How work in a thread is told to stop: Ctrl-C reaches the main thread only."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class CancelledError(BaseException):
    """The work of this thread is no longer wanted; not for those who handle exceptions."""


class _Local(threading.local):
    wanted: threading.Event | None = None


_local = _Local()


@contextmanager
def cancellable(cancelled: threading.Event) -> Iterator[None]:
    """Have the work of this thread stop soon after the event is set."""
    _local.wanted = cancelled
    try:
        yield
    finally:
        _local.wanted = None


def is_cancelled() -> bool:
    """Whether this thread has been told to stop."""
    return _local.wanted is not None and _local.wanted.is_set()


def stop_if_cancelled() -> None:
    """To be called by whatever runs for long, several times a second.

    Raises:
        CancelledError: This thread has been told to stop.
    """
    if is_cancelled():
        raise CancelledError
