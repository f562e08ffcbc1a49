"""What one MCAP file holds: by its summary, or by going through it if it has none."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, ChunkIndex, DataEnd, Metadata

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.data_section import check_magic, scan
from casadi_ik.logs.mcap.records import HEAD, parsed, record_at
from casadi_ik.logs.mcap.summary import Summary, read_summary

_DATA_END_SIZE = HEAD.size + 4


@dataclass(eq=False)
class Contents:
    """What one file holds.

    Attributes:
        path: The file.
        size: Its size [bytes].
        summary: What is in it, and where.
        records: Its metadata records.
        complete: False if the file has no end: its writer was killed or the disk was full, or it
            is still being written. Then every complete chunk is here, each verified.
        readable: Bytes up to the end of the last complete record.
    """

    path: Path
    size: int
    summary: Summary
    records: list[Metadata] = field(default_factory=list)
    complete: bool = True
    readable: int = 0

    @property
    def chunks(self) -> list[ChunkIndex]:
        """Where the chunks are."""
        return self.summary.chunks

    @property
    def attachments(self) -> list[AttachmentIndex]:
        """Where the attachments are."""
        return self.summary.attachments


@contextlib.contextmanager
def reading(path: Path) -> Iterator[IO[bytes]]:
    """The open file; whatever is wrong with it becomes one `LogError` that names it."""
    try:
        with path.open("rb") as stream:
            yield stream
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogError(f"{path}: cannot read the log: {reason}") from error
    except LogError as error:
        text = str(error)
        raise (error if str(path) in text else type(error)(f"{path}: {text}")) from error
    except MemoryError as error:
        raise LogError(f"{path}: cannot read the log: it does not fit into memory") from error


def read_contents(path: Path) -> Contents:
    """Find out what a file holds.

    Raises:
        NothingWrittenError: It is empty or torn before its first record was whole.
        LogError: It is missing, is no MCAP file or is damaged.
    """
    with reading(path) as stream:
        size, complete = check_magic(stream)
        return _by_summary(stream, path, size) if complete else _gone_through(stream, path)


def read_attachment(stream: IO[bytes], index: AttachmentIndex) -> Attachment:
    """An attachment, its checksum verified.

    Raises:
        LogError: It is damaged, or not what its index says.
    """
    record = record_at(stream, index.offset, index.offset + index.length)
    found = parsed(Attachment, record)
    if (found.name, len(found.data)) != (index.name, index.data_size):
        raise LogError(f"the log is damaged: attachment {index.name!r} is not what its index says")
    return found


def _by_summary(stream: IO[bytes], path: Path, size: int) -> Contents:
    summary, start = read_summary(stream)
    end = record_at(stream, start - _DATA_END_SIZE, start)
    if end.opcode != Opcode.DATA_END:
        raise LogError("the log is damaged: its summary does not stand behind its data")
    parsed(DataEnd, end)
    contents = Contents(path, size, summary, readable=size)
    for index in summary.metadata:
        record = record_at(stream, index.offset, index.offset + index.length)
        found = parsed(Metadata, record)
        if found.name != index.name:
            raise LogError(
                f"the log is damaged: metadata {index.name!r} are not where they are said to be"
            )
        contents.records.append(found)
    return contents


def _gone_through(stream: IO[bytes], path: Path) -> Contents:
    section = scan(stream)
    if section.owed:
        # Its indexes are torn: which channels it holds is to be looked up in it.
        section.summary.chunks[-1].message_index_offsets = {}
    return Contents(path, section.size, section.summary, section.records, False, section.end)
