"""Reads a log back: what is in it, its solves, its iterations as one array, its events."""

from __future__ import annotations

import contextlib
import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import IO, Any, TypeVar

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from casadi_ik.errors import LogError, UnknownNameError
from casadi_ik.kernels.layout import Layout
from casadi_ik.logs import bulk
from casadi_ik.logs.cdr import Codec
from casadi_ik.logs.clock import LogClock
from casadi_ik.logs.contents import Iterations, LoggedEvent, LogInfo
from casadi_ik.logs.provenance import METADATA_NAME
from casadi_ik.logs.schema import parse_layout, topic
from casadi_ik.solvers.recorder import Event, EventKind, SolveSummary

T = TypeVar("T")

_FOOTER = struct.Struct("<QQI")
"""Summary start, summary offset start, checksum: the contents of the Footer record."""

_UNREADABLE = (
    OSError,
    McapError,
    struct.error,
    ValueError,
    EOFError,
    RuntimeError,
    MemoryError,
    OverflowError,
    LookupError,
    ZstdError,
)
"""What reading a damaged file was seen to raise (RuntimeError is lz4's)."""


def open_log(path: str | os.PathLike[str]) -> LogFile:
    """Open a log.

    Raises:
        LogError: The file is missing, is no MCAP file, is truncated or damaged, or is not a log
            of casadi_ik.
    """
    return LogFile(Path(path))


class LogFile:
    """One log file. It is opened anew for each question, so there is nothing to close."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._reading() as stream:
            _check_ends(stream)
            reader = SeekingReader(stream, validate_crcs=True)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise LogError("the file has no summary")
            self._summary: Summary = summary
            self._statistics = summary.statistics
            records = {record.name: record.metadata for record in reader.iter_metadata()}
            if METADATA_NAME not in records:
                raise LogError(
                    f"not a log of casadi_ik: no metadata {METADATA_NAME!r} (found: "
                    f"{', '.join(sorted(records)) or 'none'})"
                )
            self.metadata: Mapping[str, Any] = _parse_metadata(records[METADATA_NAME])
            self.clock = LogClock(int(self.metadata["t0_ns"]), int(self.metadata["slot_ns"]))
            self._channels: dict[str, Channel] = {
                channel.topic: channel for channel in summary.channels.values()
            }
            self.methods: tuple[str, ...] = tuple(
                channel.metadata["method"]
                for name, channel in self._channels.items()
                if name.endswith("/iteration") and "method" in channel.metadata
            )

    @cached_property
    def info(self) -> LogInfo:
        """What is in the file."""
        statistics = self._statistics
        counts = {
            method: {
                kind: statistics.channel_message_counts.get(self._channel(method, kind).id, 0)
                for kind in ("iteration", "solve", "event")
            }
            for method in self.methods
        }
        chunks = self._summary.chunk_indexes
        with self._reading() as stream:
            size = os.fstat(stream.fileno()).st_size
        return LogInfo(
            path=self.path,
            size=size,
            robot=self.metadata["robot"],
            counts=counts,
            start=statistics.message_start_time,
            end=statistics.message_end_time,
            compression=self.metadata["compression"],
            chunks=len(chunks),
            uncompressed=sum(chunk.uncompressed_size for chunk in chunks),
            compressed=sum(chunk.compressed_size for chunk in chunks),
            metadata=self.metadata,
            attachments={item.name: item.data_size for item in self._summary.attachment_indexes},
        )

    def attachment(self, name: str) -> bytes:
        """An attached file, e.g. "robot.urdf".

        Raises:
            UnknownNameError: Nothing of that name is attached.
            LogError: It cannot be read.
        """
        with self._reading() as stream:
            for item in SeekingReader(stream).iter_attachments():
                if item.name == name:
                    return item.data
        names = ", ".join(self.info.attachments) or "none"
        raise UnknownNameError(f"{self.path}: no attachment {name!r}; attached: {names}")

    def layout(self, method: str | None = None) -> Layout:
        """Fields of the method's iterations, from the schema in the file.

        Raises:
            UnknownNameError: No such method in the log, or none given and there are several.
            LogError: The schema is none of ours.
        """
        channel = self._channel(self._method(method), "iteration")
        schema = self._summary.schemas[channel.schema_id]
        with self._reading():
            return parse_layout(schema.data.decode())

    def labels(self, method: str | None = None) -> Mapping[str, tuple[str, ...]]:
        """Names of phases, mask bits and elements, by field.

        Raises:
            UnknownNameError: No such method in the log, or none given and there are several.
        """
        channel = self._channel(self._method(method), "iteration")
        with self._reading():
            labels = json.loads(channel.metadata.get("labels", "{}"))
            return {name: tuple(names) for name, names in labels.items()}

    def iterations(self, method: str | None = None, solve_id: int | None = None) -> Iterations:
        """The iterations of a method: all, or those of one solve.

        Args:
            method: May be left out if the log holds one method only.
            solve_id: None for all; a solve that is not in the log gives no rows.

        Raises:
            UnknownNameError: No such method in the log, or none given and there are several.
            LogError: The file is damaged.
        """
        method = self._method(method)
        layout = self.layout(method)
        wanted = self._slice(method, "iteration", solve_id)
        with self._reading() as stream:
            times, rows = bulk.rows(stream, self._summary, wanted, layout.dtype)
        return Iterations(method, layout, self.labels(method), rows, *self.clock.locate(times))

    def solves(self, method: str | None = None, solve_id: int | None = None) -> list[SolveSummary]:
        """The solves of one method, or of all: one method after the other, each by solve.

        Raises:
            UnknownNameError: No such method in the log.
            LogError: The file is damaged.
        """
        return self._decoded("solve", method, solve_id, _solve)

    def events(self, method: str | None = None, solve_id: int | None = None) -> list[LoggedEvent]:
        """The events of one method, or of all: one method after the other, each by time.

        Raises:
            UnknownNameError: No such method in the log.
            LogError: The file is damaged.
        """
        return self._decoded("event", method, solve_id, _event)

    def _decoded(
        self,
        kind: str,
        method: str | None,
        solve_id: int | None,
        build: Callable[[str, Mapping[str, Any]], T],
    ) -> list[T]:
        """The messages of one kind as objects, built from the method and the decoded fields."""
        found: list[T] = []
        with self._reading() as stream:
            for name in self.methods if method is None else (self._method(method),):
                schema = self._summary.schemas[self._channel(name, kind).schema_id]
                codec = Codec(schema.data.decode())
                wanted = self._slice(name, kind, solve_id)
                for payload in bulk.payloads(stream, self._summary, wanted):
                    found.append(build(name, codec.decode(payload)))
        return found

    def _slice(self, method: str, kind: str, solve_id: int | None) -> bulk.Slice:
        channel = self._channel(method, kind).id
        if solve_id is None:
            return bulk.Slice(channel)
        return bulk.Slice(channel, self.clock.start(solve_id), self.clock.start(solve_id + 1))

    def _method(self, method: str | None) -> str:
        known = ", ".join(self.methods) or "none"
        if method is None:
            if len(self.methods) != 1:
                raise UnknownNameError(f"{self.path}: which method? The log holds: {known}")
            return self.methods[0]
        if method not in self.methods:
            raise UnknownNameError(f"{self.path}: no method {method!r}; the log holds: {known}")
        return method

    def _channel(self, method: str, kind: str) -> Channel:
        name = topic(method, kind)
        if name not in self._channels:
            raise LogError(f"{self.path}: no topic {name}")
        return self._channels[name]

    @contextlib.contextmanager
    def _reading(self) -> Iterator[IO[bytes]]:
        """The open file; whatever is wrong with it becomes one `LogError` naming it."""
        try:
            with self.path.open("rb") as stream:
                yield stream
        except OSError as error:
            reason = error.strerror or str(error)
            raise LogError(f"{self.path}: cannot read the log: {reason}") from error
        except LogError as error:
            text = str(error)
            raise LogError(text if str(self.path) in text else f"{self.path}: {text}") from error
        except _UNREADABLE as error:
            raise LogError(
                f"{self.path}: the log is damaged: {error or type(error).__name__}"
            ) from error


def _check_ends(stream: IO[bytes]) -> None:
    """Both ends of an MCAP file are its magic; the summary before the last has a checksum."""
    magic = len(MCAP0_MAGIC)
    head = stream.read(magic)
    if head != MCAP0_MAGIC:
        found = f"it begins with {head!r}" if head else "it is empty"
        raise LogError(f"not an MCAP file: {found}")
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(size - magic, magic))
    if stream.read() != MCAP0_MAGIC:
        raise LogError(f"the log is truncated: it stops after {size} bytes without a footer")
    stream.seek(size - magic - _FOOTER.size)
    start, _, checksum = _FOOTER.unpack(stream.read(_FOOTER.size))
    if start and checksum:
        stream.seek(start)
        if zlib.crc32(stream.read(size - magic - 4 - start)) != checksum:
            raise LogError("the log is damaged: the summary does not match its checksum")
    stream.seek(0)


def _parse_metadata(record: Mapping[str, str]) -> dict[str, Any]:
    parsed = ("packages", "machine", "parameters")
    return {key: json.loads(text) if key in parsed else text for key, text in record.items()}


def _solve(method: str, values: Mapping[str, Any]) -> SolveSummary:
    arrays = {name: values[name].reshape(-1, 3) for name in ("target_points", "target_normals")}
    phases = dict(zip(values["phases"], values["phase_iterations"].tolist(), strict=True))
    known = {
        **values,
        **arrays,
        "method": method,
        "fingers": tuple(values["fingers"]),
        "phase_iterations": phases,
    }
    return SolveSummary(**{name: known[name] for name in SolveSummary.__dataclass_fields__})


def _event(method: str, values: Mapping[str, Any]) -> LoggedEvent:
    known = {**values, "kind": EventKind(values["kind"])}
    event = Event(**{name: known[name] for name in Event.__dataclass_fields__})
    return LoggedEvent(method, values["solve_id"], event)
