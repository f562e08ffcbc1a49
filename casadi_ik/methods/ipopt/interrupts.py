"""Ctrl-C around calls that would swallow it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupt_afterwards() -> Iterator[None]:
    """Let Ctrl-C wait for the end of the block.

    Inside an evaluation for Ipopt CasADi takes a KeyboardInterrupt for a number that could not be
    computed, and Ipopt tries another one.

    Raises:
        KeyboardInterrupt: After the block, if Ctrl-C was pressed in it.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    pressed: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        before(signal.SIGINT, None)
