"""A made-up robot of 14 coordinates and 3 fingers, and solves of it."""

from __future__ import annotations

import numpy as np

from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.solvers.recorder import Event, EventKind, SolveRecord, SolveSummary

FINGERS = ("thumb", "finger_2", "finger_3")
PHASES = ("thumb reaching", "hand alignment", "refinement")
T0 = 1_700_000_000_000_000_000

LAYOUT = Layout.record(
    Field("phase", dtype="u1", doc="phase of the method"),
    Field("q", (14,), unit="rad", doc="actuated coordinates"),
    Field("palm", (3, 4), unit="m", doc="pose: [R p], row by row # as logged"),
    Field("position_error", (3,), "f4", "m", "distance to the target"),
    Field("angle_error", (3,), "f4", "rad"),
    Field("cost", unit="", doc="what is minimised"),
    Field("sigma_closed_chain", dtype="f4"),
    Field("limit_mask", dtype="u4", doc="coordinates on a limit"),
    Field("restart", dtype="i4"),
    Field("flags", (5,), "u1"),
)
LABELS = {
    "phase": PHASES,
    "q": tuple(f"joint_{i}" for i in range(14)),
    "position_error": FINGERS,
}


def make_solve(
    solve_id: int = 0, method: str = "enhanced-dls", rows: int = 50, layout: Layout = LAYOUT
) -> SolveRecord:
    """A solve whose trace is random bytes made valid: NaN, infinities and all."""
    rng = np.random.default_rng(solve_id)
    trace = np.zeros(rows, layout.dtype)
    for item in layout:
        shape = (rows, *item.shape)
        if item.dtype[0] == "f":
            trace[item.name] = rng.normal(size=shape) * 10.0 ** rng.integers(-9, 9, shape)
        else:
            limits = np.iinfo(item.dtype)
            trace[item.name] = rng.integers(limits.min, limits.max, shape, endpoint=True)
    for name in ("limit_mask", "restart"):
        if name in layout.names:
            trace[name] = trace[name][np.arange(rows) // 25 * 25]
    if "cost" in layout.names and rows > 3:
        trace["cost"][:4] = np.nan, np.inf, -np.inf, -0.0
    if "phase" in layout.names:
        trace["phase"] = np.minimum(np.arange(rows) * 3 // max(rows, 1), 2)
    normals = rng.normal(size=(3, 3))
    normals[1] = np.nan
    summary = SolveSummary(
        solve_id=solve_id,
        method=method,
        robot="made_up",
        seed=42,
        started=T0 + 123_456_789 * (solve_id + 1),
        time=0.25,
        status="SOLVED" if solve_id % 2 == 0 else "STALLED",
        success=solve_id % 2 == 0,
        iterations=rows,
        restarts=3,
        phase_iterations={"thumb reaching": 20, "hand alignment": 10, "refinement": 20},
        q=rng.normal(size=14),
        fingers=FINGERS,
        position_error=rng.random(3),
        angle_error=rng.random(3),
        ok=np.array([True, False, True]),
        target_points=rng.normal(size=(3, 3)),
        target_normals=normals,
    )
    events = (Event(2, EventKind.RESTART, "größer als π", 1.0, 0.0),) if rows > 2 else ()
    return SolveRecord(summary, layout, trace, LABELS, events)
