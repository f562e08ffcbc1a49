"""Rows of a log: iterations with what a log measures of them, and one row per solve."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.layout import Field, Layout, opaque
from casadi_ik.kinematics.contacts import EXTRA_ARRAY_NAMES
from casadi_ik.logs.events import EventKind, as_matrix, jacobian_names, measured_jacobians, words_of
from casadi_ik.solve.recorder import SolveBlock
from casadi_ik.solve.request import NO_PREFERENCE, PREFERENCES
from casadi_ik.solve.status import Status
from casadi_ik.solve.trace import CLEARANCE, TraceFormat

STATUSES = (*Status.labels(), Status.INVALID.name)
"""Names of the codes of a solve's status: those of `Status`, the last for its -1."""

PAIR = ("closest_first", "closest_second")
"""Fields that name the pair that is nearest to being too near."""

CLEAR = Field(
    CLEARANCE,
    (),
    "f4",
    "m",
    "of the pair nearest to being too near; what one has to keep beyond the margin is taken off",
)
"""The field that is added to an iteration where there is a scene."""


def measured_format(form: TraceFormat, checked: bool = False) -> TraceFormat:
    """The format of iterations with what is measured of them.

    Args:
        form: The format of the rows.
        checked: Whether they were checked against a scene.

    Raises:
        InputError: A measured field has the name of one that the method records.
    """
    added = _added(form, checked)
    if not added:
        return form
    known = {} if form.measures is None else form.measures.jacobians
    layout = Layout.record(*form.layout, *added)
    return replace(form, layout=layout, jacobians={**known, **form.jacobians})


def measured_rows(block: SolveBlock) -> NDArray[Any]:
    """Rows (m,) of a block as rows of its `measured_format`."""
    form, rows, query = block.format, block.rows, block.query
    added = _added(form, query is not None)
    if not added:
        return rows
    dtype = measured_format(form, query is not None).layout.dtype
    wide = np.empty(len(rows), dtype)
    # The new fields stand together, behind the others of their width: three pieces of bytes.
    places: Any = dtype.fields
    start = min(places[field.name][1] for field in added)
    end = start + dtype.itemsize - rows.dtype.itemsize
    solve = np.repeat(np.arange(len(block)), block.batch.iterations)
    # So many rows at once that what is made of them stays in the cache.
    for first in range(0, len(rows), 2048):
        part = np.ascontiguousarray(rows[first : first + 2048])
        values = [] if form.measures is None else [form.measures(part)]
        if query is not None:
            there = query.rows(solve[first : first + 2048])
            surplus = there.check(np.ascontiguousarray(part["q"])).surplus
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


def _added(form: TraceFormat, checked: bool) -> tuple[Field, ...]:
    fields = () if form.measures is None else form.measures.fields
    return (*fields, CLEAR) if checked else fields


def solve_layout(n: int, f: int, phases: int, kinds: int, jacobians: int, checked: bool) -> Layout:
    """Fields of a solve.

    Args:
        n: Number of actuators.
        f: Number of fingers.
        phases: Number of phases.
        kinds: Number of kinds of events.
        jacobians: Number of Jacobians whose singular values are logged.
        checked: Whether there is a scene.
    """
    words = -(-n // 32)
    clearance = (
        Field("clearance", (), "f8", "m", "of the answer, as `Solution.clearance`"),
        *(
            Field(name, (), "u1", "", "of the pair that is nearest to being too near")
            for name in PAIR
        ),
    )
    lowest = Field("lowest_sigma", (jacobians,), "f4", "", "smallest of each Jacobian's sigma")
    return Layout.record(
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
        *(
            Field(f"target_{name}", (f, 3), "f8", "", "base frame; NaN if free")
            for name in EXTRA_ARRAY_NAMES
        ),
        *((lowest,) if jacobians else ()),
        *(clearance if checked else ()),
        Field("solve_id", (), "u4"),
        Field("iterations", (), "u4", "", "over all phases and restarts"),
        Field("restarts", (), "u4"),
        Field("phase_iterations", (phases,), "u4", "", "iterations by phase"),
        Field("events", (kinds,), "u4", "", "events by kind"),
        Field("fixed_mask", () if words == 1 else (words,), "u4", "", "bit i: held where it began"),
        Field("status", (), "u1"),
        Field("success", (), "u1", "", "1: solved"),
        Field("limits_ok", (), "u1", "", "1: every actuator and joint within its limits"),
        Field("limits_enforced", (), "u1", "", "1: being solved included the limits"),
        Field("prefer", (), "u1", "", "which of several solutions was wanted"),
        Field("ok", (f,), "u1", "", "1: contact within tolerance"),
        Field("kept", (), "u1", "", "1: every iteration and event is in the log"),
    )


def solve_format(block: SolveBlock) -> TraceFormat:
    """Layout and labels of the solves of a method."""
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
        known = list(dict.fromkeys(name for pair in pairs for name in pair))
        # Codes of one byte; the last stands for what is not among them.
        labels |= dict.fromkeys(PAIR, ("none", *known[:254], "other"))
    return TraceFormat(layout, labels)


def solve_rows(block: SolveBlock, events: NDArray[np.int64], form: TraceFormat) -> NDArray[Any]:
    """The rows (k,) of a block; which solves are kept is left open.

    Args:
        block: The solves.
        events: (k, kinds) events by kind.
        form: Of `solve_format`.
    """
    batch, targets, layout = block.batch, block.targets, form.layout
    rows = _common(block, layout)
    rows["started"] = block.started * 1e-9
    rows["solve_id"] = block.first + np.arange(len(block))
    rows["status"] = batch.status % len(STATUSES)
    rows["phase_iterations"] = np.stack(list(batch.phases.values()), axis=1)
    rows["events"] = events
    rows["target_points"], rows["target_normals"] = targets.points, targets.normals
    for name, vectors in targets.extra_vectors.items():
        rows[f"target_{name}"] = vectors
    rows["start"] = block.starts
    if targets.fixed is not None:
        held = ~np.isnan(targets.fixed)
        rows["start"] = np.where(held, targets.fixed, block.starts)
        padded = np.pad(held, (0, -len(held) % 32))
        rows["fixed_mask"] = words_of(padded[None]).reshape(rows["fixed_mask"].shape[1:])
    for name in ("position_tolerance", "angle_tolerance"):
        rows[name] = getattr(targets, name)
    for name in (
        *("time", "q", "position_error", "angle_error", "iterations", "restarts"),
        *("success", "limits_ok", "ok"),
    ):
        rows[name] = getattr(batch, name)
    if "lowest_sigma" in layout.names:
        rows["lowest_sigma"] = _lowest(block)
    if batch.clearance is not None:
        rows["clearance"] = batch.clearance
        names = form.labels[PAIR[0]]
        codes = {name: code for code, name in enumerate(names)}
        pairs = [pair or ("none", "none") for pair in batch.closest]
        for i, name in enumerate(PAIR):
            rows[name] = [codes.get(pair[i], len(names) - 1) for pair in pairs]
    return rows


def _common(block: SolveBlock, layout: Layout) -> NDArray[Any]:
    """Rows (k,) with what all solves of a block have in common; numpy copies whole rows at once."""
    one = np.zeros(1, layout.dtype)
    for name in EXTRA_ARRAY_NAMES:
        one[f"target_{name}"] = np.nan
    one["seed"] = block.seed
    one["limits_enforced"] = block.targets.enforce_limits
    one["prefer"] = (NO_PREFERENCE, *PREFERENCES).index(block.targets.prefer)
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
            columns = measured_jacobians(block.format, item)
            for name, value in zip(columns, as_matrix(block.rows[item.name]).T, strict=True):
                column = np.fmin.reduceat(np.ascontiguousarray(value), starts)
                lowest[some, names.index(name)] = column
    return lowest
