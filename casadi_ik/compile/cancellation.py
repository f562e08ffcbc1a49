"""How work is told to stop, and what a fork must not take along.

Ctrl-C and SIGTERM reach the main thread, which tells the others; compiled code returns to Python a
few times a second to be told.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from functools import cached_property
from types import TracebackType
from typing import Any


class CancelledError(BaseException):
    """The work of this thread is no longer wanted; not for those who handle exceptions."""


class _Local(threading.local):
    wanted: threading.Event | None = None
    cached_only: bool = False
    virtual: bool = False


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
def cached_only() -> Iterator[None]:
    """Have this thread take compiled libraries that are there, and build none."""
    before, _local.cached_only = _local.cached_only, True
    try:
        yield
    finally:
        _local.cached_only = before


def is_cached_only() -> bool:
    """Whether this thread may build no library."""
    return _local.cached_only


@contextmanager
def virtual_machine() -> Iterator[None]:
    """Have this thread make functions that run in CasADi's virtual machine."""
    before, _local.virtual = _local.virtual, True
    try:
        yield
    finally:
        _local.virtual = before


def is_virtual() -> bool:
    """Whether functions that this thread makes run in CasADi's virtual machine."""
    return _local.virtual


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


SLICE = 0.2
"""Seconds after which a driver returns to Python, so that Ctrl-C works; then it is called again."""


class DriverCode(IntEnum):
    """Return values of the drivers (runtime/common.c)."""

    DONE = 0
    SLICE_OVER = 1
    ROWS_FULL = 2
    GOES_ON = 3
    FEW_LEFT = 4
    NO_MEMORY = -1


def drive(name: str, entry: Any, job: ctypes.Structure) -> None:
    """Call a driver until its job is done.

    Raises:
        MemoryError: No work memory.
        CancelledError: This thread has been told to stop.
    """
    while (code := entry(ctypes.byref(job))) != DriverCode.DONE:
        check(name, code)


def check(name: str, code: int) -> None:
    """Raise unless the driver can be called again.

    Raises:
        MemoryError: No work memory.
        CancelledError: This thread has been told to stop.
    """
    stop_if_cancelled()
    if code == DriverCode.NO_MEMORY:
        raise MemoryError(f"{name}: no work memory")


class ForkSafeLock:
    """A lock that is free in a forked child."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        _locks.add(self)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._lock.release()

    def renew(self) -> None:
        """Be free, whoever holds it."""
        self._lock = threading.Lock()


_locks: weakref.WeakSet[ForkSafeLock] = weakref.WeakSet()


def _after_fork() -> None:
    for lock in list(_locks):
        lock.renew()
    if sys.version_info >= (3, 12):
        return
    # Up to Python 3.11 every cached property has a lock, held while its value is made.
    for name, module in list(sys.modules.items()):
        if not name.startswith("casadi_ik"):
            continue
        for kind in list(vars(module).values()):
            for member in list(vars(kind).values()) if isinstance(kind, type) else []:
                if isinstance(member, cached_property):
                    unlocked: Any = member
                    unlocked.lock = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
