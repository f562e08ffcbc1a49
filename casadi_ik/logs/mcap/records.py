"""The walker: the records of an MCAP file one after the other, with their offsets.

Whoever reads a file here (a log's reader, its repair, a merge) reads it through `records` and
`parsed`: no record reaches beyond its stretch, none is larger than `RECORD_LIMIT`, and a record
whose lengths or checksum contradict each other is refused.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any, TypeVar, cast

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

from casadi_ik.errors import LogError

__all__ = ["HEAD", "MAGIC", "RECORD_LIMIT", "Record", "parsed", "record_at", "records"]

HEAD = struct.Struct("<BQ")
"""Opcode and length in front of every record."""

RECORD_LIMIT = 2**28
"""No record is larger, nor what a chunk unpacks to: 256 MiB. A chunk of ours holds 2 MiB and the
rest of one solve; a file that announces more is refused before memory is taken for it [bytes]."""

Kind = TypeVar("Kind", bound=McapRecord)

_OPCODES: dict[type[McapRecord], Opcode] = {
    Attachment: Opcode.ATTACHMENT,
    AttachmentIndex: Opcode.ATTACHMENT_INDEX,
    Channel: Opcode.CHANNEL,
    ChunkIndex: Opcode.CHUNK_INDEX,
    DataEnd: Opcode.DATA_END,
    Footer: Opcode.FOOTER,
    Header: Opcode.HEADER,
    Metadata: Opcode.METADATA,
    MetadataIndex: Opcode.METADATA_INDEX,
    Schema: Opcode.SCHEMA,
    Statistics: Opcode.STATISTICS,
    SummaryOffset: Opcode.SUMMARY_OFFSET,
}

_WRONG = (McapError, struct.error, ValueError, MemoryError, OverflowError)
"""What taking a record apart raises if its bytes are wrong."""


@dataclass(frozen=True, eq=False)
class Record:
    """One record.

    Attributes:
        opcode: What it is.
        offset: Where it begins, in the file or in its chunk.
        body: What stands behind opcode and length.
    """

    opcode: int
    offset: int
    body: bytes

    @property
    def end(self) -> int:
        """Where the next one begins."""
        return self.offset + HEAD.size + len(self.body)


def records(stream: IO[bytes], start: int, end: int) -> Iterator[Record]:
    """The records of a stretch of a file, to its end or to the first that is not whole.

    Args:
        stream: The file.
        start: Where the first begins.
        end: Where the stretch ends.

    Raises:
        LogError: A record is larger than `RECORD_LIMIT`.
    """
    position = start
    while position + HEAD.size <= end:
        stream.seek(position)
        head = stream.read(HEAD.size)
        if len(head) < HEAD.size:
            return
        opcode, length = HEAD.unpack(head)
        if opcode == 0 or position + HEAD.size + length > end:
            return
        check_size(f"the record at byte {position}", length)
        body = stream.read(length)
        if len(body) < length:
            return
        record = Record(opcode, position, body)
        yield record
        position = record.end


def record_at(stream: IO[bytes], start: int, end: int) -> Record:
    """The one record that fills a stretch of a file.

    Raises:
        LogError: Something else stands there.
    """
    record = next(records(stream, start, end), None)
    if record is None or record.end != end:
        raise LogError(f"the log is damaged: no record of {end - start} bytes at byte {start}")
    return record


def check_size(what: str, size: int) -> None:
    """See to it that something is not too large.

    Raises:
        LogError: It is larger than `RECORD_LIMIT`.
    """
    if size > RECORD_LIMIT:
        raise LogError(f"{what} holds {size} bytes, more than the {RECORD_LIMIT} that are read")


def parsed(kind: type[Kind], record: Record) -> Kind:
    """A record taken apart: written again it is the very same, so its lengths and checksum hold.

    Raises:
        LogError: It is of another kind, or contradicts itself.
    """
    try:
        if record.opcode != _OPCODES[kind]:
            raise ValueError(f"its opcode is {record.opcode}")
        # Every kind that has an opcode here can be read; their base does not say so.
        found: Kind = cast(Any, kind).read(ReadDataStream(io.BytesIO(record.body)))
        builder = RecordBuilder()
        found.write(builder)
        if builder.end()[HEAD.size :] != record.body:
            raise ValueError("it contradicts its own length or checksum")
    except _WRONG as error:
        reason = str(error) or type(error).__name__
        raise LogError(
            f"the log is damaged: {kind.__name__} at byte {record.offset}: {reason}"
        ) from error
    return found
