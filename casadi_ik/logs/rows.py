"""Rows of a log: iterations with measurements, and one row per solve."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.layout import Field, Layout, opaque
from casadi_ik.logs.events import EventKind
from casadi_ik.logs.traces import as_matrix, jacobian_names, measured_jacobians, words_of
from casadi_ik.model.targets import EXTRA_ARRAY_NAMES, NO_PREFERENCE, PREFERENCES
from casadi_ik.solve.recorder import SolveBlock
from casadi_ik.solve.status import Status
from casadi_ik.solve.trace import CLEARANCE, TraceFormat

STATUSES = (*Status.labels(), Status.INVALID.name)
"""Names of the codes of a solve's status; the last one is that of code -1."""

CLOSEST_PAIR = ("closest_first", "closest_second")
"""Fields of the pair of shapes with the smallest clearance beyond its required margin."""

CLEARANCE_FIELD = Field(
    CLEARANCE,
    (),
    "f4",
    "m",
    "smallest clearance of a pair minus its required clearance beyond the margin",
)
"""Field that is added to iterations of solves with a scene."""


def measured_format(form: TraceFormat, checked: bool = False) -> TraceFormat:
    """Return the format of iterations with the fields that the log adds.

    Args:
        form: Format of the rows that the method records.
        checked: True if the solves were checked for collisions.

    Raises:
        InputError: An added field has the name of a field of the method.
    """
    fields = _added_fields(form, checked)
    if not fields:
        return form
    jacobians = {} if form.measures is None else form.measures.jacobians
    layout = Layout.record(*form.layout, *fields)
    return replace(form, layout=layout, jacobians={**jacobians, **form.jacobians})


def measured_rows(block: SolveBlock) -> NDArray[Any]:
    """Return the rows (m,) of a block in its `measured_format`."""
    form, rows, query = block.format, block.rows, block.query
    fields = _added_fields(form, query is not None)
    if not fields:
        return rows
    dtype = measured_format(form, query is not None).layout.dtype
    wide = np.empty(len(rows), dtype)
    # The added fields are contiguous, after all others of their width, so that a row consists of
    # three blocks of bytes.
    offsets: Any = dtype.fields
    start = min(offsets[field.name][1] for field in fields)
    end = start + dtype.itemsize - rows.dtype.itemsize
    solve = np.repeat(np.arange(len(block)), block.batch.iterations)
    # The intermediate results of 2048 rows fit into the cache.
    for first in range(0, len(rows), 2048):
        part = np.ascontiguousarray(rows[first : first + 2048])
        values = [] if form.measures is None else [form.measures(part)]
        if query is not None:
            row_query = query.rows(solve[first : first + 2048])
            surplus = row_query.check(np.ascontiguousarray(part["q"])).surplus
            values.append((surplus + query.margin).astype(np.float32)[:, None])
        measured = np.ascontiguousarray(np.concatenate(values, axis=1), np.float32)
        source, target = (
            array.view(np.uint8).reshape(len(part), -1)
            for array in (part, wide[first : first + 2048])
        )
        target[:, :start] = source[:, :start]
        target[:, start:end] = measured.view(np.uint8)
        target[:, end:] = source[:, start:]
    return wide


def _added_fields(form: TraceFormat, checked: bool) -> tuple[Field, ...]:
    fields = () if form.measures is None else form.measures.fields
    return (*fields, CLEARANCE_FIELD) if checked else fields


def solve_layout(n: int, f: int, phases: int, kinds: int, jacobians: int, checked: bool) -> Layout:
    """Return the fields of a solve.

    Args:
        n: Number of actuators.
        f: Number of fingers.
        phases: Number of phases.
        kinds: Number of event kinds.
        jacobians: Number of Jacobians whose singular values are logged.
        checked: True if the solves were checked for collisions.
    """
    words = -(-n // 32)
    clearance = (
        Field("clearance", (), "f8", "m", "clearance of the solution, as `Solution.clearance`"),
        *(
            Field(
                name,
                (),
                "u1",
                "",
                "shape of the pair with the smallest clearance beyond its margin",
            )
            for name in CLOSEST_PAIR
        ),
    )
    lowest = Field(
        "lowest_sigma",
        (jacobians,),
        "f4",
        "",
        "smallest singular value of each Jacobian over all iterations",
    )
    return Layout.record(
        Field("started", (), "f8", "s", "start time since the Unix epoch"),
        Field("time", (), "f8", "s", "duration"),
        Field("q", (n,), "f8", "rad or m", "configuration of the solution"),
        Field("start", (n,), "f8", "rad or m", "start configuration"),
        Field("position_error", (f,), "f8", "m", "error of the contact; NaN if free"),
        Field("angle_error", (f,), "f8", "rad", "error of the contact; NaN if free"),
        Field("position_tolerance", (f,), "f8", "m"),
        Field("angle_tolerance", (f,), "f8", "rad"),
        Field("seed", (), "f8", "", "seed of the random numbers; exact below 2**53"),
        Field("target_points", (f, 3), "f8", "m", "in the base frame; NaN if free"),
        Field("target_normals", (f, 3), "f8", "", "in the base frame; NaN if free"),
        *(
            Field(f"target_{name}", (f, 3), "f8", "", "in the base frame; NaN if free")
            for name in EXTRA_ARRAY_NAMES
        ),
        *((lowest,) if jacobians else ()),
        *(clearance if checked else ()),
        Field("solve_id", (), "u4"),
        Field("iterations", (), "u4", "", "iterations of all phases and restarts"),
        Field("restarts", (), "u4"),
        Field("phase_iterations", (phases,), "u4", "", "iterations by phase"),
        Field("events", (kinds,), "u4", "", "events by kind"),
        Field(
            "fixed_mask",
            () if words == 1 else (words,),
            "u4",
            "",
            "bit i: actuator i is fixed at its start position",
        ),
        Field("status", (), "u1"),
        Field("success", (), "u1", "", "1: target is solved"),
        Field("limits_ok", (), "u1", "", "1: all actuators and joints are within their limits"),
        Field("limits_enforced", (), "u1", "", "1: a solved target requires the limits"),
        Field("prefer", (), "u1", "", "preference among solutions"),
        Field("ok", (f,), "u1", "", "1: contact is within tolerance"),
        Field("kept", (), "u1", "", "1: the log holds all iterations and events"),
    )


def solve_format(block: SolveBlock) -> TraceFormat:
    """Return layout and labels of the solves of a method."""
    batch, names = block.batch, jacobian_names(block.format)
    checked, n = batch.clearance is not None, batch.q.shape[1]
    sizes = n, len(block.fingers), len(batch.phases), len(EventKind), len(names)
    layout = solve_layout(*sizes, checked)
    labels = {
        **dict.fromkeys(("q", "start", "fixed_mask"), block.format.labels.get("q", ())),
        **{
            name: block.fingers
            for name in layout.names
            if name == "ok" or name.startswith(("position_", "angle_", "target_"))
        },
        "lowest_sigma": names,
        "phase_iterations": tuple(batch.phases),
        "events": tuple(kind.name for kind in EventKind),
        "status": STATUSES,
        "prefer": (NO_PREFERENCE, *PREFERENCES),
    }
    if checked:
        pairs = () if block.query is None else block.query.table.names
        shapes = list(dict.fromkeys(name for pair in pairs for name in pair))
        # Codes are single bytes; the last code represents all remaining shapes.
        labels |= dict.fromkeys(CLOSEST_PAIR, ("none", *shapes[:254], "other"))
    return TraceFormat(layout, labels)


def solve_rows(block: SolveBlock, events: NDArray[np.int64], form: TraceFormat) -> NDArray[Any]:
    """Return the rows (k,) of a block without their field "kept", which the caller sets.

    Args:
        block: The solves.
        events: (k, kinds) number of events by kind.
        form: Format of `solve_format`.
    """
    batch, targets, layout = block.batch, block.targets, form.layout
    rows = _shared_values(block, layout)
    rows["started"] = block.started * 1e-9
    rows["solve_id"] = block.first + np.arange(len(block))
    rows["status"] = batch.status % len(STATUSES)
    rows["phase_iterations"] = np.stack(list(batch.phases.values()), axis=1)
    rows["events"] = events
    rows["target_points"], rows["target_normals"] = targets.points, targets.normals
    for name, vectors in targets.extra_vectors.items():
        rows[f"target_{name}"] = vectors
    rows["start"] = np.nan if targets.q0 is None else targets.q0
    if targets.fixed is not None:
        is_fixed = ~np.isnan(targets.fixed)
        rows["start"] = np.where(is_fixed, targets.fixed, rows["start"])
        padded = np.pad(is_fixed, (0, -len(is_fixed) % 32))
        rows["fixed_mask"] = words_of(padded[None]).reshape(rows["fixed_mask"].shape[1:])
    for name in ("position_tolerance", "angle_tolerance"):
        rows[name] = getattr(targets, name)
    for name in (
        *("time", "q", "position_error", "angle_error", "iterations", "restarts"),
        *("success", "limits_ok", "ok"),
    ):
        rows[name] = getattr(batch, name)
    if "lowest_sigma" in layout.names:
        rows["lowest_sigma"] = _lowest_sigma(block)
    if batch.clearance is not None:
        rows["clearance"] = batch.clearance
        names = form.labels[CLOSEST_PAIR[0]]
        codes = {name: code for code, name in enumerate(names)}
        pairs = [pair or ("none", "none") for pair in batch.closest]
        for i, name in enumerate(CLOSEST_PAIR):
            rows[name] = [codes.get(pair[i], len(names) - 1) for pair in pairs]
    return rows


def _shared_values(block: SolveBlock, layout: Layout) -> NDArray[Any]:
    """Return rows (k,) with the values that all solves of a block share.

    The first row is copied as bytes, because NumPy copies records field by field.
    """
    row = np.zeros(1, layout.dtype)
    for name in EXTRA_ARRAY_NAMES:
        row[f"target_{name}"] = np.nan
    row["seed"] = block.targets.seed
    row["limits_enforced"] = block.targets.enforce_limits
    row["prefer"] = (NO_PREFERENCE, *PREFERENCES).index(block.targets.prefer)
    rows = np.empty(len(block), layout.dtype)
    rows.view(opaque(row).dtype)[:] = opaque(row)
    return rows


def _lowest_sigma(block: SolveBlock) -> NDArray[np.float32]:
    """Return the smallest singular value over each solve, (k, Jacobians); NaN if not measured."""
    names, counts = jacobian_names(block.format), block.batch.iterations
    lowest = np.full((len(block), len(names)), np.nan, dtype=np.float32)
    has_rows = counts > 0
    starts = (np.cumsum(counts) - counts)[has_rows]
    for item in block.format.layout:
        if item.name.startswith("sigma_") and len(starts):
            columns = measured_jacobians(block.format, item)
            for name, value in zip(columns, as_matrix(block.rows[item.name]).T, strict=True):
                column = np.fmin.reduceat(np.ascontiguousarray(value), starts)
                lowest[has_rows, names.index(name)] = column
    return lowest
