"""How many solves this machine makes side by side."""

from __future__ import annotations

import casadi as ca

from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.codegen import driver_text

SYMBOL = "casadi_ik_machine_lanes"


def machine_lanes() -> int:
    """Eight where registers hold eight doubles, else four; 0: one solve at a time.

    The compiled answer is asked on every machine anew, since several may share a cache.
    """
    x = ca.SX.sym("x")
    library = load_library(
        "machine_lanes",
        lambda: ca.Function("machine_lanes", [x], [x]),
        driver_text("registers") + driver_text("machine_lanes"),
        SYMBOL,
        "machine_lanes",
    )
    return 0 if library is None else int(library[SYMBOL]())
