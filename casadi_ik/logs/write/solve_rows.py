"""What is kept of a solve apart from its iterations: a row of fixed size."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.answers.recorder import SolveBlock
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.kernels.rows import opaque
from casadi_ik.logs.events.kinds import EventKind, jacobian_names
from casadi_ik.logs.events.traces import as_matrix, words_of
from casadi_ik.problem.contacts.arrays import NAMES
from casadi_ik.problem.preference import NO_PREFERENCE, PREFERENCES
from casadi_ik.problem.status import Status
from casadi_ik.problem.trace import TraceFormat

STATUSES = (*Status.labels(), Status.INVALID.name)
"""Names of the codes of a solve's status: those of `Status`, the last for its -1."""


PAIR = ("closest_first", "closest_second")

MOST_NAMES = 256
"""Codes of one byte."""

CHECKED = (
    Field("clearance", (), "f8", "m", "of the answer, as `Solution.clearance`"),
    *(Field(name, (), "u1", "", "of the pair that is nearest to being too near") for name in PAIR),
)
"""What is known where there is a scene."""


def solve_format(block: SolveBlock) -> TraceFormat:
    """Layout and labels of the solves of a method."""
    n, f = block.batch.q.shape[1], len(block.fingers)
    names, words = jacobian_names(block.format), -(-n // 32)
    phases = tuple(block.batch.phases)
    measured = (
        (Field("lowest_sigma", (len(names),), "f4", "", "smallest of each Jacobian's sigma"),)
        if names
        else ()
    )
    checked = block.batch.clearance is not None
    layout = Layout.record(
        Field("started", (), "f8", "s", "since the Unix epoch"),
        Field("time", (), "f8", "s"),
        Field("q", (n,), "f8", "rad or m", "coordinates reached"),
        Field("start", (n,), "f8", "rad or m", "coordinates begun from"),
        Field("position_error", (f,), "f8", "m", "NaN if free"),
        Field("angle_error", (f,), "f8", "rad", "NaN if free"),
        Field("position_tolerance", (f,), "f8", "m"),
        Field("angle_tolerance", (f,), "f8", "rad"),
        Field("seed", (), "f8", "", "of random numbers; exact below 2**53"),
        Field("target_points", (f, 3), "f8", "m", "base frame; NaN if free"),
        Field("target_normals", (f, 3), "f8", "", "base frame; NaN if free"),
        *(Field(f"target_{name}", (f, 3), "f8", "", "base frame; NaN if free") for name in NAMES),
        *measured,
        *(CHECKED if checked else ()),
        Field("solve_id", (), "u4"),
        Field("iterations", (), "u4", "", "over all phases and restarts"),
        Field("restarts", (), "u4"),
        Field("phase_iterations", (len(phases),), "u4", "", "iterations by phase"),
        Field("events", (len(EventKind),), "u4", "", "events by kind"),
        Field("fixed_mask", () if words == 1 else (words,), "u4", "", "bit i: held where it began"),
        Field("status", (), "u1"),
        Field("success", (), "u1", "", "1: solved"),
        Field("limits_ok", (), "u1", "", "1: every actuator and joint within its limits"),
        Field("limits_enforced", (), "u1", "", "1: being solved included the limits"),
        Field("prefer", (), "u1", "", "which of several solutions was wanted"),
        Field("ok", (f,), "u1", "", "1: contact within tolerance"),
        Field("kept", (), "u1", "", "1: every iteration and event is in the log"),
    )
    of_fingers = (
        *("position_error", "angle_error", "position_tolerance", "angle_tolerance"),
        *("target_points", "target_normals", *(f"target_{name}" for name in NAMES), "ok"),
    )
    labels = {
        **dict.fromkeys(("q", "start", "fixed_mask"), block.format.labels.get("q", ())),
        **dict.fromkeys(of_fingers, block.fingers),
        "lowest_sigma": names,
        "phase_iterations": phases,
        "events": tuple(kind.name for kind in EventKind),
        "status": STATUSES,
        "prefer": (NO_PREFERENCE, *PREFERENCES),
    }
    if checked:
        labels |= dict.fromkeys(PAIR, _pair_names(block))
    return TraceFormat(layout, labels)


def solve_rows(block: SolveBlock, events: NDArray[np.int64], form: TraceFormat) -> NDArray[Any]:
    """The rows (k,) of a block; which solves are kept is left open.

    Args:
        block: The solves.
        events: (k, kinds) events by kind.
        form: Of `solve_format`.
    """
    batch, problems, layout = block.batch, block.problems, form.layout
    rows = _alike(block, layout)
    rows["started"] = block.started * 1e-9
    rows["solve_id"] = block.first + np.arange(len(block))
    rows["status"] = batch.status % len(STATUSES)
    rows["phase_iterations"] = np.stack(list(batch.phases.values()), axis=1)
    rows["events"] = events
    rows["target_points"], rows["target_normals"] = problems.points, problems.normals
    for name, vectors in problems.more.items():
        rows[f"target_{name}"] = vectors
    rows["start"] = block.starts
    if problems.fixed is not None:
        held = ~np.isnan(problems.fixed)
        rows["start"] = np.where(held, problems.fixed, block.starts)
        padded = np.pad(held, (0, -len(held) % 32))
        rows["fixed_mask"] = words_of(padded[None]).reshape(rows["fixed_mask"].shape[1:])
    for name in ("position_tolerance", "angle_tolerance"):
        rows[name] = getattr(problems, name)
    for name in (
        *("time", "q", "position_error", "angle_error", "iterations", "restarts"),
        *("success", "limits_ok", "ok"),
    ):
        rows[name] = getattr(batch, name)
    if "lowest_sigma" in layout.names:
        rows["lowest_sigma"] = _lowest(block)
    if batch.clearance is not None:
        rows["clearance"] = batch.clearance
        known = {name: code for code, name in enumerate(form.labels[PAIR[0]])}
        none = (form.labels[PAIR[0]][0],) * 2
        pairs = [none if pair is None else pair for pair in batch.closest]
        for i, field in enumerate(PAIR):
            rows[field] = [known.get(pair[i], len(known) - 1) for pair in pairs]
    return rows


def _pair_names(block: SolveBlock) -> tuple[str, ...]:
    """What the closest pair may be called; the last stands for what is not among them."""
    pairs = () if block.around is None else block.around.table.names
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    return ("none", *names[: MOST_NAMES - 2], "other")


def _alike(block: SolveBlock, layout: Layout) -> NDArray[Any]:
    """Rows (k,) with what all solves of a block have in common; numpy copies whole rows at once."""
    one = np.zeros(1, layout.dtype)
    for name in NAMES:
        one[f"target_{name}"] = np.nan
    one["seed"] = block.seed
    one["limits_enforced"] = block.problems.enforce_limits
    one["prefer"] = (NO_PREFERENCE, *PREFERENCES).index(block.problems.prefer)
    rows = np.empty(len(block), layout.dtype)
    rows.view(opaque(one).dtype)[:] = opaque(one)
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
            for column, value in zip(columns, values.T, strict=True):
                lowest[some, column] = np.fmin.reduceat(np.ascontiguousarray(value), starts)
    return lowest
