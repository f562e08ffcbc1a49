"""One file of a log."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from casadi_ik.errors import LogError, UnknownNameError
from casadi_ik.kernels.layout import Layout
from casadi_ik.kernels.rows import opaque
from casadi_ik.logs.clock import LogClock
from casadi_ik.logs.mcap import bulk
from casadi_ik.logs.mcap.cdr import NUMPY_TYPES, Codec
from casadi_ik.logs.mcap.contents import read_attachment, read_contents, reading
from casadi_ik.logs.mcap.schema import parse_layout, topic
from casadi_ik.logs.provenance import CHECKSUM, METADATA_NAME, checksum
from casadi_ik.logs.read.table import Part

_PARSED = ("packages", "machine", "parameters", "keep")


class Shard:
    """One file. It is opened anew for each question.

    Attributes:
        path: The file.
        contents: Where in it what is.
        metadata: Where it comes from.
        robot: Name of the robot.
        methods: What methods it holds.
        clock: Rule of its log times.
    """

    def __init__(self, path: Path) -> None:
        """Look into the file.

        Raises:
            LogError: It is missing, no MCAP file, damaged, or no log of casadi_ik.
        """
        self.path = path
        self.contents = read_contents(path)
        records = self.contents.metadata
        with reading(path):
            if METADATA_NAME not in records:
                raise LogError(
                    f"not a log of casadi_ik: no metadata {METADATA_NAME!r} (found: "
                    f"{', '.join(sorted(records)) or 'none'})"
                )
            record = records[METADATA_NAME]
            if record.get(CHECKSUM) != checksum(record):
                raise LogError("the log is damaged: its metadata fail their checksum")
            if not self.contents.chunks and any(self.contents.counts.values()):
                raise LogError("the messages are not in chunks, which casadi_ik does not read")
            self.metadata: Mapping[str, Any] = {
                key: json.loads(text) if key in _PARSED else text for key, text in record.items()
            }
            self.robot: str = self.metadata["robot"]
            self.clock = LogClock(int(self.metadata["t0_ns"]), int(self.metadata["slot_ns"]))
            self._channels: dict[str, Channel] = {
                channel.topic: channel for channel in self.contents.channels.values()
            }
            self.methods: tuple[str, ...] = tuple(
                channel.metadata["method"]
                for name, channel in self._channels.items()
                if name.endswith("/iteration") and "method" in channel.metadata
            )

    def count(self, method: str, kind: str) -> int:
        """How many messages of a kind a method has; 0 if it is not in this file."""
        channel = self._channels.get(topic(method, kind))
        return 0 if channel is None else self.contents.counts.get(channel.id, 0)

    def attachment(self, name: str) -> bytes:
        """An attached file.

        Raises:
            UnknownNameError: Nothing of that name is attached.
            LogError: It is damaged.
        """
        for item in self.contents.attachments:
            if item.name == name:
                with reading(self.path) as stream:
                    return read_attachment(stream, item)
        names = ", ".join(item.name for item in self.contents.attachments) or "none"
        raise UnknownNameError(f"{self.path}: no attachment {name!r}; attached: {names}")

    def read(
        self,
        method: str,
        kind: str,
        solves: NDArray[np.int64] | None = None,
        fields: Sequence[str] | None = None,
    ) -> Part:
        """Rows in the order of the file.

        Args:
            method: One of `methods`.
            kind: "solve", "iteration" or "event".
            solves: Numbers of the solves wanted, sorted; None: all.
            fields: Names of the fields wanted; None: all.

        Raises:
            UnknownNameError: No such field.
            LogError: The file is damaged.
        """
        with reading(self.path) as stream:
            name = topic(method, kind)
            if name not in self._channels:
                raise LogError(f"no topic {name}")
            channel = self._channels[name]
            schema = self.contents.schemas[channel.schema_id]
            labels = json.loads(channel.metadata.get("labels", "{}"))
            layout = fixed_layout(schema)
            wanted = self._wanted(channel.id, solves)
            if layout is None:
                times, rows = self._decoded(stream, wanted, schema)
                if fields is not None:
                    rows = rows[_known(fields, rows.dtype.names or ())]
            else:
                times, rows = self._fixed(stream, wanted, layout, fields)
            if solves is None and len(times) != self.contents.counts.get(channel.id, 0):
                raise LogError(f"{len(times)} messages on {name}, but the summary counts others")
        return Part(
            method,
            rows,
            *self.clock.locate(times),
            {key: tuple(names) for key, names in labels.items()},
            {} if layout is None else {item.name: item.unit for item in layout},
        )

    def _fixed(
        self,
        stream: IO[bytes],
        wanted: bulk.Wanted,
        layout: Layout,
        fields: Sequence[str] | None,
    ) -> tuple[NDArray[np.uint64], NDArray[Any]]:
        """Log times and rows of a channel whose messages are of fixed size."""
        dtype = layout.dtype
        chosen = dtype
        if fields is not None:
            known = _known(fields, layout.names)
            chosen = np.dtype(
                [(item.name, "<" + item.dtype, item.shape) for item in layout if item.name in known]
            )
        times, parts = [np.zeros(0, np.uint64)], [np.zeros(0, chosen)]
        for log_times, rows in bulk.rows(stream, self.contents, wanted, dtype):
            times.append(log_times)
            if fields is None:
                parts.append(rows)
                continue
            part = np.empty(len(rows), chosen)
            for name in chosen.names or ():
                part[name] = rows[name]
            parts.append(part)
        return np.concatenate(times), np.concatenate(list(map(opaque, parts))).view(chosen)

    def _decoded(
        self, stream: IO[bytes], wanted: bulk.Wanted, schema: Schema
    ) -> tuple[NDArray[np.uint64], NDArray[Any]]:
        """The same of a channel with another layout, message by message."""
        codec = Codec(schema.data.decode())
        found = list(bulk.decoded(stream, self.contents, wanted, codec))
        rows = np.empty(len(found), [_column(member) for member in codec.members])
        for i, (_, values) in enumerate(found):
            for name, value in values.items():
                rows[name][i] = value
        return np.array([time for time, _ in found], np.uint64), rows

    def _wanted(self, channel: int, solves: NDArray[np.int64] | None) -> bulk.Wanted:
        if solves is None:
            return bulk.Wanted(channel)

        def chunk(first: int, last: int) -> bool:
            low, high = self.clock.locate(np.array([first, last], np.uint64))[0]
            return bool(np.searchsorted(solves, low) < np.searchsorted(solves, high, "right"))

        return bulk.Wanted(
            channel, chunk, lambda times: in_solves(self.clock.locate(times)[0], solves)
        )


def in_solves(numbers: NDArray[np.int64], solves: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which numbers (k,) are among sorted ones."""
    if not len(solves):
        return np.zeros(len(numbers), dtype=bool)
    place = np.minimum(np.searchsorted(solves, numbers), len(solves) - 1)
    return solves[place] == numbers


def fixed_layout(schema: Schema) -> Layout | None:
    """The layout of messages of fixed size without padding; None if the schema has another."""
    try:
        layout = parse_layout(schema.data.decode())
    except LogError:
        return None
    widths = [np.dtype(item.dtype).itemsize for item in layout]
    return layout if widths == sorted(widths, reverse=True) else None


def _known(fields: Sequence[str], names: Sequence[str]) -> list[str]:
    for name in fields:
        if name not in names:
            raise UnknownNameError(f"no field {name!r}; there are: {', '.join(names)}")
    return list(fields)


def _column(member: Any) -> tuple[Any, ...]:
    """How a message member is kept: as numbers if their count is fixed, else as objects."""
    if member.type == "string" or member.length == -1:
        return member.name, object
    shape = () if member.length is None else (member.length,)
    return member.name, NUMPY_TYPES[member.type], shape
