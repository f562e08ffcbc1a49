"""Made-up solves with a known course."""

from __future__ import annotations

from typing import Any

import numpy as np

from casadi_ik.compile.layout import Field, Layout
from casadi_ik.logs import LoggedTarget
from casadi_ik.logs.events import Event, describe
from casadi_ik.logs.solve import SolveRecord
from casadi_ik.model.targets import Tolerance

__all__ = ["Event", "Field", "Layout", "SolveRecord", "describe"]

FINGERS = ("thumb", "finger_2")
JOINTS = ("joint_a", "joint_b", "joint_c")
LAYOUT = Layout.record(
    Field("q", (3,), "f8", "rad"),
    Field("position_error", (2,), "f4", "m"),
    Field("angle_error", (2,), "f4", "rad"),
    Field("sigma_closed_chain", (), "f4"),
    Field("limit_mask", (), "u4"),
    Field("phase", (), "u1"),
)
LABELS = {
    "q": JOINTS,
    "limit_mask": JOINTS,
    "position_error": FINGERS,
    "angle_error": FINGERS,
    "phase": ("", "thumb-reaching", "hand-alignment"),
}


def make_rows(count: int = 40) -> np.ndarray[Any, np.dtype[Any]]:
    """Return 20 iterations of thumb reaching and of hand alignment, all out of tolerance."""
    rows = np.zeros(count, LAYOUT.dtype)
    rows["position_error"] = 0.1
    rows["angle_error"] = 0.2
    rows["sigma_closed_chain"] = 0.5
    rows["phase"] = np.where(np.arange(count) < 20, 1, 2)
    return rows


def make_one(rows: np.ndarray[Any, np.dtype[Any]], **changes: Any) -> SolveRecord:
    """Return a solve with a trace; its result follows from the last row."""
    position, angle = (
        rows["position_error"][-1].astype(float),
        rows["angle_error"][-1].astype(float),
    )
    ok = ~(position > 5e-3) & ~(angle > np.deg2rad(3))
    values: dict[str, Any] = {
        "method": "enhanced-dls",
        "robot": "made_up",
        "solve_id": 7,
        "started": 1_700_000_000_000_000_000,
        "time": 0.012,
        "status": "SOLVED" if ok.all() else "STALLED",
        "success": bool(ok.all()),
        "restarts": 0,
        "iterations": len(rows),
        "fingers": FINGERS,
        "position_error": position,
        "angle_error": angle,
        "ok": ok,
        "target_points": np.zeros((2, 3)),
        "target_normals": np.tile([0.0, 0.0, 1.0], (2, 1)),
        "layout": LAYOUT,
        "labels": LABELS,
        "rows": rows,
        "events": (),
        "parameters": {},
        "target": LoggedTarget((Tolerance(5e-3, float(np.deg2rad(3))),) * len(FINGERS)),
    }
    return SolveRecord(**(values | changes))


def event(iteration: int, kind: str, value: float = 0.0, **changes: Any) -> Event:
    """Return an event with neutral values except for the given ones."""
    values: dict[str, Any] = {"jacobian": "", "joints": (), "phase": "", "threshold": 0.0}
    return Event(iteration, kind, value=value, **(values | changes))
