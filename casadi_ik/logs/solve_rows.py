"""What is kept of a solve besides its iterations: a row of fixed size."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs.event_kinds import EventKind, jacobian_names
from casadi_ik.logs.traces import as_matrix
from casadi_ik.solvers.method import TraceFormat
from casadi_ik.solvers.recorder import SolveBlock
from casadi_ik.steps.status import Status

STATUSES = (*Status.labels(), Status.INVALID.name)
"""Names of the codes of a solve's status: those of `Status`, the last for its -1."""


def solve_format(block: SolveBlock) -> TraceFormat:
    """Layout and labels of the solves of a method."""
    n, f = block.batch.q.shape[1], len(block.fingers)
    names = jacobian_names(block.format)
    phases = tuple(block.batch.phases)
    measured = (
        (Field("lowest_sigma", (len(names),), "f4", "", "smallest of each Jacobian's sigma"),)
        if names
        else ()
    )
    layout = Layout.record(
        Field("started", (), "f8", "s", "since the Unix epoch"),
        Field("time", (), "f8", "s"),
        Field("q", (n,), "f8", "rad or m", "coordinates reached"),
        Field("position_error", (f,), "f8", "m", "NaN if free"),
        Field("angle_error", (f,), "f8", "rad", "NaN if free"),
        Field("target_points", (f, 3), "f8", "m", "base frame; NaN if free"),
        Field("target_normals", (f, 3), "f8", "", "base frame; NaN if free"),
        *measured,
        Field("solve_id", (), "u4"),
        Field("iterations", (), "u4", "", "over all phases and restarts"),
        Field("restarts", (), "u4"),
        Field("phase_iterations", (len(phases),), "u4", "", "iterations by phase"),
        Field("events", (len(EventKind),), "u4", "", "events by kind"),
        Field("status", (), "u1"),
        Field("success", (), "u1", "", "1: solved"),
        Field("limits_ok", (), "u1", "", "1: every actuator and joint within its limits"),
        Field("ok", (f,), "u1", "", "1: contact within tolerance"),
        Field("kept", (), "u1", "", "1: every iteration and event is in the log"),
    )
    labels = {
        "q": block.format.labels.get("q", ()),
        **dict.fromkeys(
            ("position_error", "angle_error", "target_points", "target_normals", "ok"),
            block.fingers,
        ),
        "lowest_sigma": names,
        "phase_iterations": phases,
        "events": tuple(kind.name for kind in EventKind),
        "status": STATUSES,
    }
    return TraceFormat(layout, labels)


def solve_rows(block: SolveBlock, events: NDArray[np.int64], layout: Layout) -> NDArray[Any]:
    """The rows (k,) of a block; which solves are kept is left open.

    Args:
        block: The solves.
        events: (k, kinds) events by kind.
        layout: Of `solve_format`.
    """
    batch = block.batch
    rows = np.zeros(len(block), layout.dtype)
    rows["started"] = block.started * 1e-9
    rows["solve_id"] = block.first + np.arange(len(block))
    rows["status"] = batch.status % len(STATUSES)
    rows["phase_iterations"] = np.stack(list(batch.phases.values()), axis=1)
    rows["events"] = events
    rows["target_points"] = block.problems.points
    rows["target_normals"] = block.problems.normals
    for name in (
        *("time", "q", "position_error", "angle_error", "iterations", "restarts"),
        *("success", "limits_ok", "ok"),
    ):
        rows[name] = getattr(batch, name)
    if "lowest_sigma" in layout.names:
        rows["lowest_sigma"] = _lowest(block)
    return rows


def _lowest(block: SolveBlock) -> NDArray[np.float32]:
    """(k, Jacobians) smallest singular value over each solve; NaN where there is none."""
    names, counts = jacobian_names(block.format), block.batch.iterations
    lowest = np.full((len(block), len(names)), np.nan, dtype=np.float32)
    some = counts > 0
    starts = (np.cumsum(counts) - counts)[some]
    for item in block.format.layout:
        if item.name.startswith("sigma_") and len(starts):
            one = TraceFormat(Layout((item,)), block.format.labels)
            columns = [names.index(name) for name in jacobian_names(one)]
            values = as_matrix(block.rows[item.name])
            lowest[np.flatnonzero(some)[:, None], columns] = np.fmin.reduceat(
                values, starts, axis=0
            )
    return lowest
