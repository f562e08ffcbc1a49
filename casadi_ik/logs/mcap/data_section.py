"""What the data section of an MCAP file really holds, record by record, every checksum verified."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass, field
from typing import IO

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, MessageIndex, Metadata, MetadataIndex, Schema
from numpy.typing import NDArray

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.records import HEAD, MAGIC, Record, parsed, records
from casadi_ik.logs.mcap.summary import Summary, attachment_index
from casadi_ik.logs.mcap.unpacking import unpacked

_INDEX_HEAD = struct.Struct("<HI")
"""Channel and size of the entries: how the content of a MessageIndex begins."""

_ENTRY = 16
"""Bytes of a log time and an offset."""

Entries = dict[int, NDArray[np.uint64]]
"""Log time and offset of every message in a chunk, (k, 2), by channel."""


class NothingWrittenError(LogError):
    """A log whose writer ended before anything was whole: nothing can be lost with it."""


@dataclass
class DataSection:
    """The data section as far as it is whole.

    Attributes:
        summary: What is in it.
        records: Its metadata records.
        end: Where it ends: behind the last whole record [bytes].
        closed: Whether a DataEnd record stands there.
        owed: Entries of the last chunk whose MessageIndex records are not all there.
        size: Size of the file when it was read [bytes].
    """

    summary: Summary
    records: list[Metadata] = field(default_factory=list)
    end: int = len(MAGIC)
    closed: bool = False
    owed: Entries = field(default_factory=dict)
    size: int = 0

    def owed_indexes(self) -> bytes:
        """The missing MessageIndex records, to be written at `end`; now they count as there."""
        builder = RecordBuilder()
        for channel, entries in self.owed.items():
            index = self.summary.chunks[-1]
            index.message_index_offsets[channel] = self.end + builder.count
            before = builder.count
            MessageIndex(channel, [(int(t), int(o)) for t, o in entries]).write(builder)
            index.message_index_length += builder.count - before
        self.owed = {}
        return builder.end()


def check_magic(stream: IO[bytes]) -> tuple[int, bool]:
    """See to it that a file begins as MCAP files do.

    Returns:
        Its size [bytes], and whether it ends as a complete one does.

    Raises:
        NothingWrittenError: It is empty, or less than those bytes.
        LogError: It is no MCAP file.
    """
    stream.seek(0)
    found = stream.read(len(MAGIC))
    if found != MAGIC:
        kind = NothingWrittenError if MAGIC.startswith(found) else LogError
        raise kind(f"not an MCAP file: {f'it begins with {found!r}' if found else 'it is empty'}")
    size = stream.seek(0, os.SEEK_END)
    stream.seek(size - len(MAGIC))
    return size, size > len(MAGIC) and stream.read() == MAGIC


def scan(stream: IO[bytes]) -> DataSection:
    """Read the data section from its beginning to its end or to where it is torn.

    Args:
        stream: An MCAP file.

    Raises:
        NothingWrittenError: Torn before its first record was whole.
        LogError: Not an MCAP file, or damaged where it cannot be torn: in a file that was closed,
            or in front of a chunk that is whole.
    """
    size, was_closed = check_magic(stream)
    found, wrong = _Scan(), "it is cut off"
    section = found.section
    section.size = size
    for record in records(stream, section.end, size):
        if record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
            section.closed = True
            return section
        try:
            found.take(record)
        except LogError as error:
            wrong = str(error)
            break
    if was_closed or _chunk_follows(stream, section.end, size):
        raise LogError(
            f"the log is damaged in its middle: the record at byte {section.end} is not as it was"
            f" written: {wrong}"
        )
    if section.end == len(MAGIC):
        raise NothingWrittenError(
            f"the log is truncated: none of its {size} bytes is a whole record"
        )
    return section


def _chunk_follows(stream: IO[bytes], start: int, size: int) -> bool:
    """Whether a whole chunk stands behind the record at `start`."""
    for record in records(stream, start, size):
        if record.opcode == Opcode.CHUNK and record.offset > start:
            try:
                unpacked(record)
            except LogError:
                continue
            return True
    return False


class _Scan:
    """Takes one record after the other."""

    def __init__(self) -> None:
        self.section = DataSection(Summary())

    def take(self, record: Record) -> None:
        """Account for one record.

        Raises:
            LogError: It is damaged or does not belong there; then nothing has changed.
        """
        section = self.section
        if record.opcode == Opcode.CHUNK:
            self._chunk(record)
        elif record.opcode == Opcode.MESSAGE_INDEX:
            self._message_index(record)
        elif record.opcode == Opcode.ATTACHMENT:
            attachment, length = parsed(Attachment, record), record.end - record.offset
            index = attachment_index(attachment, record.offset, length)
            section.summary.attachments.append(index)
        elif record.opcode == Opcode.METADATA:
            metadata = parsed(Metadata, record)
            length = record.end - record.offset
            section.summary.metadata.append(MetadataIndex(record.offset, length, metadata.name))
            section.records.append(metadata)
        elif record.opcode == Opcode.HEADER and record.offset == len(MAGIC):
            parsed(Header, record)
        elif record.opcode == Opcode.MESSAGE:
            raise LogError("the messages are not in chunks, which casadi_ik does not read")
        else:
            self._declare(record)
        section.end = record.end

    def _chunk(self, record: Record) -> None:
        chunk = unpacked(record)
        for definition in chunk.definitions:
            self._declare(definition)
        entries, counts = chunk.entries(), self.section.summary.counts
        for channel, found in entries.items():
            counts[channel] = counts.get(channel, 0) + len(found)
        self.section.owed = entries
        self.section.summary.chunks.append(chunk.index)

    def _message_index(self, record: Record) -> None:
        """An index must say what the chunk before it holds."""
        if len(record.body) < _INDEX_HEAD.size or len(record.body) % _ENTRY != _INDEX_HEAD.size:
            raise LogError(f"no message index at byte {record.offset}")
        channel, size = _INDEX_HEAD.unpack_from(record.body)
        found = np.frombuffer(record.body, "<u8", offset=_INDEX_HEAD.size).reshape(-1, 2)
        expected = self.section.owed.get(channel)
        in_order = found[np.argsort(found[:, 1], kind="stable")]
        if expected is None or size != found.nbytes or not np.array_equal(in_order, expected):
            raise LogError(f"the message index of channel {channel} is wrong")
        del self.section.owed[channel]
        chunk = self.section.summary.chunks[-1]
        chunk.message_index_offsets[channel] = record.offset
        chunk.message_index_length += HEAD.size + len(record.body)

    def _declare(self, record: Record) -> None:
        if record.opcode == Opcode.SCHEMA:
            self.section.summary.declare(parsed(Schema, record))
        else:
            self.section.summary.declare(parsed(Channel, record))
