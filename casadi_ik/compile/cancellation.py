"""Cancellation of work in threads and compiled code, and locks that survive a fork.

Ctrl-C and SIGTERM reach the main thread, which cancels the others; compiled code returns to Python
a few times a second to check.
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
    """The work of this thread is cancelled; a BaseException, so that handlers do not catch it."""


class _ThreadState(threading.local):
    event: threading.Event | None = None
    cached_only: bool = False
    virtual: bool = False


_local = _ThreadState()


@contextmanager
def cancellable(cancelled: threading.Event) -> Iterator[None]:
    """Make the work of this thread stop soon after the event is set."""
    _local.event = cancelled
    try:
        yield
    finally:
        _local.event = None


def is_cancelled() -> bool:
    """Return True if the work of this thread is cancelled."""
    return _local.event is not None and _local.event.is_set()


def stop_if_cancelled() -> None:
    """Raise if the work of this thread is cancelled; long work calls it several times a second.

    Raises:
        CancelledError: The work of this thread is cancelled.
    """
    if is_cancelled():
        raise CancelledError


@contextmanager
def cached_only() -> Iterator[None]:
    """Make this thread use existing compiled libraries and build none."""
    previous, _local.cached_only = _local.cached_only, True
    try:
        yield
    finally:
        _local.cached_only = previous


def is_cached_only() -> bool:
    """Return True if this thread may not build libraries."""
    return _local.cached_only


@contextmanager
def virtual_machine() -> Iterator[None]:
    """Make this thread create functions that run in CasADi's virtual machine."""
    previous, _local.virtual = _local.virtual, True
    try:
        yield
    finally:
        _local.virtual = previous


def is_virtual() -> bool:
    """Return True if functions of this thread run in CasADi's virtual machine."""
    return _local.virtual


@contextmanager
def interrupt_afterwards() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the block, which calls CasADi.

    CasADi swallows a KeyboardInterrupt while it converts arguments, and takes one inside an
    evaluation for Ipopt as a failed evaluation.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed in the block; a handler of the calling program may
            raise another exception. Only the first delayed signal is raised again.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if threading.current_thread() is not threading.main_thread():
        handlers = {}
    signals: list[int] = []
    for number, handler in handlers.items():
        if callable(handler):
            signal.signal(number, lambda number, _: signals.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if callable(handler):
                signal.signal(number, handler)
    for number in signals[:1]:
        signal.raise_signal(number)


SLICE = 0.2
"""Time after which runtime code returns to Python to handle signals [s]; then it is resumed."""


class DriverCode(IntEnum):
    """Return values of runtime code (runtime/common.c).

    Attributes:
        DONE: The job is done.
        SLICE_OVER: `SLICE` is over; call again.
        ROWS_FULL: The memory for logged rows is full; fetch the rows and call again.
        CONTINUES: A further start of the solve is written.
        FEW_LEFT: Too few solves remain to fill the lanes.
        NO_MEMORY: Work memory could not be allocated.
    """

    DONE = 0
    SLICE_OVER = 1
    ROWS_FULL = 2
    CONTINUES = 3
    FEW_LEFT = 4
    NO_MEMORY = -1


def run_cancellable(name: str, entry: Any, job: ctypes.Structure) -> None:
    """Call a runtime entry point until its job is done.

    Raises:
        MemoryError: Work memory could not be allocated.
        CancelledError: The work of this thread is cancelled.
    """
    while (code := entry(ctypes.byref(job))) != DriverCode.DONE:
        check(name, code)


def check(name: str, code: int) -> None:
    """Raise unless the entry point can be called again.

    Raises:
        MemoryError: Work memory could not be allocated.
        CancelledError: The work of this thread is cancelled.
    """
    stop_if_cancelled()
    if code == DriverCode.NO_MEMORY:
        raise MemoryError(f"{name}: work memory could not be allocated")


class ForkSafeLock:
    """A lock that is released in a forked child."""

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
        """Release the lock, whoever holds it."""
        self._lock = threading.Lock()


_locks: weakref.WeakSet[ForkSafeLock] = weakref.WeakSet()


def _after_fork() -> None:
    for lock in list(_locks):
        lock.renew()
    if sys.version_info >= (3, 12):
        return
    # Up to Python 3.11 a cached property holds a lock while its value is computed.
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
