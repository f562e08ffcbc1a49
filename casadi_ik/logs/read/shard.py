"""One file of a log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import LogError, UnknownNameError
from casadi_ik.kernels.layout import Layout
from casadi_ik.kernels.rows import opaque
from casadi_ik.logs.mcap import rows as messages
from casadi_ik.logs.mcap.contents import Contents, read_attachment, read_contents, reading
from casadi_ik.logs.mcap.data_section import NothingWrittenError
from casadi_ik.logs.mcap.metadata import clock_of, own_record, values_of
from casadi_ik.logs.mcap.schema import KINDS, topic
from casadi_ik.logs.read.fields import NAME_LIMIT, Labels, described
from casadi_ik.logs.read.table import MethodRows


@dataclass(frozen=True, eq=False)
class Topic:
    """Messages of one kind of one method.

    Attributes:
        channel: Channel id.
        layout: Fields of a row.
        labels: Names that make a field readable.
    """

    channel: int
    layout: Layout
    labels: Labels


class Shard:
    """One file. It is opened anew for each question.

    Attributes:
        path: The file.
        name: What it is called among the files of its log.
        contents: Where in it what is.
        record: Where it comes from, as it stands in the file.
        metadata: The same, structured values as what they say.
        robot: Name of the robot.
        methods: What methods it holds.
        clock: Rule of its log times.
    """

    def __init__(self, path: Path, name: str = "") -> None:
        """Look into the file.

        Raises:
            NothingWrittenError: Its writer was killed before anything was whole.
            LogError: It is missing, no MCAP file, damaged, or no log of casadi_ik.
        """
        self.path = path
        self.name = name or path.name
        self.contents: Contents = read_contents(path)
        with naming(path):
            contents = self.contents
            if not (contents.complete or contents.chunks or contents.records):
                raise NothingWrittenError("the log is truncated before its metadata")
            self.record: Mapping[str, str] = own_record(contents.records)
            self.metadata: Mapping[str, Any] = values_of(self.record)
            self.robot: str = self.metadata["robot"]
            self.clock = clock_of(self.metadata)
            if not contents.chunks and any(contents.summary.counts.values()):
                raise LogError("the messages are not in chunks, which casadi_ik does not read")
            self._topics = self._described()
            self.methods: tuple[str, ...] = tuple(dict.fromkeys(name for name, _ in self._topics))

    def topic(self, method: str, kind: str) -> Topic:
        """The messages of a kind of one of the `methods`."""
        return self._topics[method, kind]

    def count(self, method: str, kind: str) -> int:
        """How many messages of a kind a method has; 0 if it is not in this file."""
        found = self._topics.get((method, kind))
        return 0 if found is None else self.contents.summary.counts.get(found.channel, 0)

    def attachment(self, name: str) -> bytes:
        """An attached file.

        Raises:
            UnknownNameError: Nothing of that name is attached.
            LogError: It is damaged.
        """
        for item in self.contents.attachments:
            if item.name == name:
                with reading(self.path) as stream:
                    return read_attachment(stream, item).data
        names = ", ".join(item.name for item in self.contents.attachments) or "none"
        raise UnknownNameError(f"{self.path}: no attachment {name!r}; attached: {names}")

    def read(
        self,
        method: str,
        kind: str,
        solves: NDArray[np.int64] | None = None,
        fields: Sequence[str] | None = None,
    ) -> MethodRows:
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
        found = self._topics[method, kind]
        with reading(self.path) as stream:
            times, rows = self._rows(stream, found, solves, fields)
            if solves is None and len(times) != self.count(method, kind):
                raise LogError(
                    f"{len(times)} messages on {topic(method, kind)!r}, but the summary counts"
                    f" {self.count(method, kind)}"
                )
            solve_id, iteration = self.clock.locate(times)
            if len(solve_id) and (solve_id.min() < 0 or solve_id.max() >= 2**32):
                raise LogError(f"{topic(method, kind)!r}: a message before the log began, or late")
            if "solve_id" in (rows.dtype.names or ()) and np.any(rows["solve_id"] != solve_id):
                raise LogError(f"{topic(method, kind)!r}: a solve's number is not that of its time")
        units = {item.name: item.unit for item in found.layout}
        return MethodRows(method, rows, solve_id, iteration, found.labels, units)

    def _described(self) -> dict[tuple[str, str], Topic]:
        """The topics by method and kind.

        Raises:
            LogError: One is missing, or is not such as a log of ours has.
        """
        summary = self.contents.summary
        by_name = {channel.topic: channel for channel in summary.channels.values()}
        found: dict[tuple[str, str], Topic] = {}
        for channel in summary.channels.values():
            method = channel.metadata.get("method")
            if method is None or channel.topic != topic(method, KINDS[0]):
                continue
            if not (0 < len(method) <= NAME_LIMIT):
                raise LogError(f"a method's name has {len(method)} characters")
            for kind in KINDS:
                own = by_name.get(topic(method, kind))
                if own is None or own.schema_id not in summary.schemas:
                    raise LogError(f"no topic {topic(method, kind)!r}, or no schema of it")
                layout, labels = described(kind, own, summary.schemas[own.schema_id])
                found[method, kind] = Topic(own.id, layout, labels)
        return found

    def _rows(
        self,
        stream: IO[bytes],
        found: Topic,
        solves: NDArray[np.int64] | None,
        fields: Sequence[str] | None,
    ) -> tuple[NDArray[np.uint64], NDArray[Any]]:
        """Log times and rows."""
        dtype = chosen = found.layout.dtype
        if fields is not None:
            known = _known(fields, found.layout.names)
            chosen = np.dtype(_columns(found.layout, known))
        times, parts = [np.zeros(0, np.uint64)], [np.zeros(0, chosen)]
        wanted = self._wanted(found.channel, solves)
        for log_times, rows in messages.rows(stream, self.contents.chunks, wanted, dtype):
            times.append(log_times)
            if fields is None:
                parts.append(rows)
                continue
            part = np.empty(len(rows), chosen)
            for name in chosen.names or ():
                part[name] = rows[name]
            parts.append(part)
        return np.concatenate(times), np.concatenate(list(map(opaque, parts))).view(chosen)

    def _wanted(self, channel: int, solves: NDArray[np.int64] | None) -> messages.Wanted:
        if solves is None:
            return messages.Wanted(channel)

        def chunk(first: int, last: int) -> bool:
            low, high = self.clock.locate(np.array([first, last], np.uint64))[0]
            return bool(np.searchsorted(solves, low) < np.searchsorted(solves, high, "right"))

        return messages.Wanted(
            channel, chunk, lambda times: in_solves(self.clock.locate(times)[0], solves)
        )


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the file's name before what is wrong with it."""
    try:
        yield
    except LogError as error:
        raise type(error)(f"{path}: {error}") from error


def in_solves(numbers: NDArray[np.int64], solves: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which numbers (k,) are among sorted ones."""
    if not len(solves):
        return np.zeros(len(numbers), dtype=bool)
    place = np.minimum(np.searchsorted(solves, numbers), len(solves) - 1)
    return solves[place] == numbers


def _known(fields: Sequence[str], names: Sequence[str]) -> list[str]:
    for name in fields:
        if name not in names:
            raise UnknownNameError(f"no field {name!r}; there are: {', '.join(names)}")
    return list(fields)


def _columns(layout: Layout, names: Sequence[str]) -> list[tuple[str, str, tuple[int, ...]]]:
    """The chosen fields as numpy describes them, in the order of the log."""
    return [(item.name, "<" + item.dtype, item.shape) for item in layout if item.name in names]
