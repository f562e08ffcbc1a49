"""Made-up robot of 14 coordinates and 3 fingers, its solves, and rewritten logs."""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import Writer

from casadi_ik.app.cli.main import main
from casadi_ik.compile.layout import STORAGE, Field, Layout
from casadi_ik.logs.events import event_format
from casadi_ik.logs.format import parse_layout, schema_name, schema_text
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.solve.recorder import SolveBlock
from casadi_ik.solve.solution import BatchSolution
from casadi_ik.solve.status import Status
from casadi_ik.solve.trace import (
    SINGULARITY_THRESHOLDS,
    JacobianMeasures,
    RecordedJacobian,
    TraceFormat,
)

__all__ = [
    "SINGULARITY_THRESHOLDS",
    "STORAGE",
    "Field",
    "JacobianMeasures",
    "Layout",
    "RecordedJacobian",
]
__all__ += ["SolveBlock", "TargetBatch", "TraceFormat", "changed", "chunks_of", "event_format"]
__all__ += ["main", "make_block", "make_rows", "parse_layout", "rewritten", "schema_name"]
__all__ += ["schema_text", "write_bag"]

FINGERS = ("thumb", "finger_2", "finger_3")
PHASES = ("thumb reaching", "hand alignment", "refinement")
JOINTS = tuple(f"joint_{i}" for i in range(14))
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
    Field("restart", dtype="u4"),
    Field("flags", (5,), "u1"),
)
LABELS = {"phase": PHASES, "q": JOINTS, "position_error": FINGERS}
FORMAT = TraceFormat(LAYOUT, LABELS, {"closed_chain": RecordedJacobian(JOINTS[:3], singular=1e-3)})


def make_rows(seed: int, count: int, layout: Layout = LAYOUT) -> np.ndarray:
    """Return a trace of one solve: random valid values, with NaN and infinities."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, layout.dtype)
    for item in layout:
        shape = (count, *item.shape)
        if item.dtype[0] == "f":
            rows[item.name] = rng.normal(size=shape) * 10.0 ** rng.integers(-9, 9, shape)
        else:
            limits = np.iinfo(item.dtype)
            rows[item.name] = rng.integers(limits.min, limits.max, shape, endpoint=True)
    for name in ("limit_mask", "restart"):
        if name in layout.names:
            rows[name] = rows[name][np.arange(count) // 25 * 25]
    if "cost" in layout.names and count > 3:
        rows["cost"][:4] = np.nan, np.inf, -np.inf, -0.0
    if "phase" in layout.names:
        rows["phase"] = np.minimum(np.arange(count) * 3 // max(count, 1), 2)
    return rows


def make_block(
    *counts: int, first: int = 0, method: str = "enhanced-dls", form: TraceFormat = FORMAT
) -> SolveBlock:
    """Return solves with these numbers of iterations; those of odd numbers stalled."""
    numbers = first + np.arange(len(counts))
    rng, k = np.random.default_rng(first), len(counts)
    normals = rng.normal(size=(k, 3, 3))
    normals[:, 1] = np.nan
    solved = numbers % 2 == 0
    iterations = np.array(counts, dtype=np.int64)
    batch = BatchSolution(
        success=solved,
        status=np.where(solved, Status.SOLVED, Status.STALLED).astype(np.int64),
        q=rng.normal(size=(k, 14)),
        iterations=iterations,
        restarts=np.full(k, 3),
        time=np.full(k, 0.25),
        position_error=rng.random((k, 3)),
        angle_error=rng.random((k, 3)),
        ok=np.tile([True, False, True], (k, 1)),
        limits_ok=np.ones(k, dtype=bool),
        tolerances=(Tolerance(),) * 3,
        fingers=FINGERS,
        method=method,
        robot="made_up",
        actuators=tuple(f"motor_{i}" for i in range(14)),
        phases={
            # As in `make_rows`: a third each, rounded up.
            phase: -(-iterations * (i + 1) // 3) - -(-iterations * i // 3)
            for i, phase in enumerate(PHASES)
        },
    )
    rows = [
        make_rows(number, count, form.layout) for number, count in zip(numbers, counts, strict=True)
    ]
    return SolveBlock(
        format=form,
        first=first,
        targets=TargetBatch(
            rng.normal(size=(k, 3, 3)),
            normals,
            Tolerance(),
            True,
            q0=rng.normal(size=(k, 14)),
            seed=7,
        ),
        batch=batch,
        rows=np.concatenate(rows),
        started=T0 + 123_456_789 * (1 + numbers),
    )


def changed(block: SolveBlock, **fields: object) -> SolveBlock:
    """Return the block with other fields, those of its batch included."""
    names = {item.name for item in dataclasses.fields(BatchSolution)}
    of_batch = {name: value for name, value in fields.items() if name in names}
    other_fields = {name: value for name, value in fields.items() if name not in names}
    batch = dataclasses.replace(block.batch, **of_batch)  # type: ignore[arg-type]
    return dataclasses.replace(block, batch=batch, **other_fields)  # type: ignore[arg-type]


def chunks_of(path: Path) -> list[ChunkIndex]:
    """Return the chunks of a complete file, read by an independent reader."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def rewritten(
    path: Path,
    metadata: Mapping[str, str] | None = None,
    channel: Mapping[str, str] | None = None,
    schema: Callable[[str], str] = str,
    **options: object,
) -> Path:
    """Rewrite a log by mcap's own writer in the order of times, optionally with other contents.

    All checksums are right.
    """
    copy = path.with_name("copy.mcap")
    with path.open("rb") as source, copy.open("wb") as target:
        reader = make_reader(source, validate_crcs=True)
        writer = Writer(target, **options)  # type: ignore[arg-type]
        writer.start("ros2")
        for record in reader.iter_metadata():
            entries = {**record.metadata, **(metadata or {})}
            pairs = sorted(pair for pair in entries.items() if pair[0] != "crc32")
            entries["crc32"] = f"{zlib.crc32(json.dumps(pairs).encode()):08x}"
            writer.add_metadata(record.name, entries)
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time,
                attachment.log_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )
        channels: dict[int, int] = {}
        for form, channel_schema, message in reader.iter_messages():
            assert form is not None
            if channel_schema.id not in channels:
                text, channel_metadata = (
                    schema(form.data.decode()),
                    {**channel_schema.metadata, **(channel or {})},
                )
                number = writer.register_schema(form.name, form.encoding, text.encode())
                channels[channel_schema.id] = writer.register_channel(
                    channel_schema.topic, "cdr", number, channel_metadata
                )
            times = message.log_time, message.data, message.publish_time
            writer.add_message(channels[channel_schema.id], *times, message.sequence)
        writer.finish()
    return copy


def write_bag(path: Path, metadata: str = "", **options: object) -> None:
    """Write an MCAP file of another program, perhaps with metadata of that name."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)  # type: ignore[arg-type]
        writer.start("ros2", "a recorder")
        if metadata:
            writer.add_metadata(metadata, {"robot": "made_up"})
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        channel = writer.register_channel("/x", "cdr", schema)
        for i in range(20):
            writer.add_message(channel, i, bytes(12), i)
        writer.finish()
