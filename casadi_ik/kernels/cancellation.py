"""How work is told to stop: Ctrl-C and SIGTERM reach the main thread, which tells the others."""

from __future__ import annotations

import signal
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


@contextmanager
def interrupt_afterwards() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait for the end of the block, which calls CasADi.

    CasADi swallows a KeyboardInterrupt while it converts arguments, and inside an evaluation for
    Ipopt it takes one for a number that could not be computed.

    Raises:
        KeyboardInterrupt: After the block, if Ctrl-C was pressed in it; or what else a handler
            raises.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if threading.current_thread() is not threading.main_thread():
        handlers = {}
    came: list[int] = []
    for number, handler in handlers.items():
        if callable(handler):
            signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if callable(handler):
                signal.signal(number, handler)
    for number in came[:1]:
        signal.raise_signal(number)
