"""The end of an MCAP file: where its data section ends, what is in it, and where to find that."""

from __future__ import annotations

import zlib
from collections.abc import Iterable

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, McapRecord, SummaryOffset
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

FOOTER_CHECKED = 4
"""Bytes at the end of the footer that its checksum does not cover: the checksum."""


def closing_bytes(summary: Summary, position: int) -> bytes:
    """DataEnd, summary section, footer and magic.

    Args:
        summary: What the data section holds.
        position: Where the data section ends and these bytes begin.
    """
    builder = RecordBuilder()
    DataEnd(data_section_crc=0).write(builder)
    data_end = builder.end()
    start = position + len(data_end)
    groups: tuple[tuple[Opcode, Iterable[McapRecord]], ...] = (
        (Opcode.SCHEMA, summary.schemas.values()),
        (Opcode.CHANNEL, summary.channels.values()),
        (Opcode.STATISTICS, [] if summary.statistics is None else [summary.statistics]),
        (Opcode.CHUNK_INDEX, summary.chunk_indexes),
        (Opcode.ATTACHMENT_INDEX, summary.attachment_indexes),
        (Opcode.METADATA_INDEX, summary.metadata_indexes),
    )
    offsets: list[SummaryOffset] = []
    for opcode, records in groups:
        begin = builder.count
        for record in records:
            record.write(builder)
        if builder.count > begin:
            offsets.append(SummaryOffset(opcode, start + begin, builder.count - begin))
    offset_start = start + builder.count
    for offset in offsets:
        offset.write(builder)
    section = builder.end()
    checksum = zlib.crc32(_footer(start, offset_start, 0)[:-FOOTER_CHECKED], zlib.crc32(section))
    return data_end + section + _footer(start, offset_start, checksum) + MCAP0_MAGIC


def _footer(start: int, offset_start: int, checksum: int) -> bytes:
    builder = RecordBuilder()
    Footer(start, offset_start, checksum).write(builder)
    return builder.end()
