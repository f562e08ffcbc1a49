"""What stands at the end of an MCAP file: what is in it, and where."""

from __future__ import annotations

import os
import zlib
from collections.abc import Sequence
from typing import IO

from mcap.data_stream import RecordBuilder
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

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.records import (
    HEAD,
    MAGIC,
    Record,
    check_size,
    parsed,
    record_at,
    records,
)

_FOOTER_SIZE = HEAD.size + 20

_UNCHECKED = 4
"""Bytes at the footer's end that its checksum does not cover: the checksum."""


class Summary:
    """What is in an MCAP file, collected while it grows or read from its end.

    Attributes:
        schemas: By id.
        channels: By id.
        counts: Messages by channel id.
        chunks: Index records.
        attachments: Index records.
        metadata: Index records.
    """

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        self.chunks: list[ChunkIndex] = []
        self.attachments: list[AttachmentIndex] = []
        self.metadata: list[MetadataIndex] = []

    def beginning(
        self, profile: str, library: str, metadata: Metadata, attachments: Sequence[Attachment]
    ) -> bytes:
        """The first bytes of a file, up to the first chunk.

        Raises:
            LogError: A record is larger than what is read.
        """
        builder = RecordBuilder()
        builder.write(MAGIC)
        Header(profile, library).write(builder)
        offset = builder.count
        metadata.write(builder)
        check_size("the metadata", builder.count - offset)
        self.metadata.append(MetadataIndex(offset, builder.count - offset, metadata.name))
        for item in attachments:
            offset = builder.count
            item.write(builder)
            check_size(f"attachment {item.name!r}", builder.count - offset)
            self.attachments.append(attachment_index(item, offset, builder.count - offset))
        return builder.end()

    def ending(self, position: int) -> bytes:
        """The last bytes of a file, from the end of the data on.

        Args:
            position: Where in the file they will stand.
        """
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        data_end = builder.end()
        start = position + len(data_end)
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.ATTACHMENT_INDEX, self.attachments),
            (Opcode.METADATA_INDEX, self.metadata),
        ]
        offsets = []
        for opcode, group in groups:
            offset = builder.count
            for record in group:
                record.write(builder)
            if group:
                offsets.append(SummaryOffset(opcode, start + offset, builder.count - offset))
        offset_start = start + builder.count
        for item in offsets:
            item.write(builder)
        summary = builder.end()
        # The checksum covers the footer up to itself.
        Footer(start, offset_start, 0).write(builder)
        footer = builder.end()
        Footer(start, offset_start, zlib.crc32(summary + footer[:-4])).write(builder)
        return data_end + summary + builder.end() + MAGIC

    def declare(self, record: Schema | Channel) -> None:
        """Note a schema or channel.

        Raises:
            LogError: Its number already stands for another.
        """
        kind = type(record).__name__
        if isinstance(record, Schema):
            known = self.schemas.setdefault(record.id, record)
        else:
            known = self.channels.setdefault(record.id, record)
        if known != record:
            raise LogError(f"the log is damaged: {kind} {record.id} is defined twice")

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self.chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self.chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


def attachment_index(item: Attachment, offset: int, length: int) -> AttachmentIndex:
    """The index of an attachment that stands at an offset, so many bytes long."""
    return AttachmentIndex(
        offset=offset,
        length=length,
        log_time=item.log_time,
        create_time=item.create_time,
        data_size=len(item.data),
        name=item.name,
        media_type=item.media_type,
    )


def read_summary(stream: IO[bytes]) -> tuple[Summary, int]:
    """The summary of a file that ends as it should.

    Args:
        stream: An MCAP file that ends with its magic bytes.

    Returns:
        The summary, and where in the file it begins.

    Raises:
        LogError: It is damaged, or there is none.
    """
    footer_at = stream.seek(0, os.SEEK_END) - len(MAGIC) - _FOOTER_SIZE
    if footer_at < len(MAGIC):
        raise LogError("the log is damaged: it is shorter than its end")
    footer = parsed(Footer, record_at(stream, footer_at, footer_at + _FOOTER_SIZE))
    start = footer.summary_start or footer_at
    if not len(MAGIC) < start <= footer_at:
        raise LogError("the log is damaged: its summary is said to be outside of it")
    check_size("the summary", footer_at - start)
    stream.seek(start)
    checked = stream.read(footer_at + _FOOTER_SIZE - _UNCHECKED - start)
    if footer.summary_crc and zlib.crc32(checked) != footer.summary_crc:
        raise LogError("the log is damaged: the summary does not match its checksum")
    summary, statistics, end = Summary(), None, start
    for record in records(stream, start, footer_at):
        end = record.end
        if record.opcode == Opcode.STATISTICS:
            statistics = parsed(Statistics, record)
        else:
            _take(summary, record)
    if end != footer_at:
        raise LogError(f"the log is damaged: the record at byte {end} of its summary is not whole")
    if statistics is None:
        raise LogError("the file has no summary")
    summary.counts = statistics.channel_message_counts
    return summary, start


def _take(summary: Summary, record: Record) -> None:
    """Note a record of a summary; what only says where others stand is left."""
    if record.opcode == Opcode.SCHEMA:
        summary.declare(parsed(Schema, record))
    elif record.opcode == Opcode.CHANNEL:
        summary.declare(parsed(Channel, record))
    elif record.opcode == Opcode.CHUNK_INDEX:
        summary.chunks.append(parsed(ChunkIndex, record))
    elif record.opcode == Opcode.ATTACHMENT_INDEX:
        summary.attachments.append(parsed(AttachmentIndex, record))
    elif record.opcode == Opcode.METADATA_INDEX:
        summary.metadata.append(parsed(MetadataIndex, record))
    elif record.opcode != Opcode.SUMMARY_OFFSET:
        raise LogError(
            f"the log is damaged: a record that does not belong into a summary ({record.opcode})"
            f" at byte {record.offset}"
        )
