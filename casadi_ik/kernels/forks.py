"""Locks that a fork does not take along: in the child the thread that held one does not exist.

A process that is forked while another of its threads builds a kernel would wait for ever.
"""

from __future__ import annotations

import os
import sys
import threading
import weakref
from functools import cached_property
from types import TracebackType
from typing import Any


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
