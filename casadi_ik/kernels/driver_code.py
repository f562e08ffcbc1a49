"""What a C driver reports back, and how long it may run before it does."""

from __future__ import annotations

from enum import IntEnum

from casadi_ik.kernels.cancellation import stop_if_cancelled

SLICE = 0.2
"""Seconds after which a driver returns to Python, so that Ctrl-C works; then it is called again."""


class DriverCode(IntEnum):
    """Return values of the drivers (drivers/common.c)."""

    DONE = 0
    SLICE_OVER = 1
    ROWS_FULL = 2
    GOES_ON = 3
    FEW_LEFT = 4
    NO_MEMORY = -1


def check(name: str, code: int) -> None:
    """Raise unless the driver can be called again.

    Raises:
        MemoryError: No work memory.
        CancelledError: This thread has been told to stop.
    """
    stop_if_cancelled()
    if code == DriverCode.NO_MEMORY:
        raise MemoryError(f"{name}: no work memory")
