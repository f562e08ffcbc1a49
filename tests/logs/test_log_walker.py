"""The walker: whatever reads a file stops at the first record that is not as it was written."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from made_up_solves import make_block
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, Metadata, Schema

import casadi_ik as ik
from casadi_ik.errors import LogError
from casadi_ik.logs import finish_log, merge_logs
from casadi_ik.logs.chunks import RECORD, RECORD_LIMIT, unpack
from casadi_ik.logs.container import Record, parsed, read_contents, record_at, records

Write = Callable[..., Path]

GIGABYTES = 3 * 10**9


def metadata_bytes(**entries: str) -> bytes:
    builder = RecordBuilder()
    Metadata("a", entries).write(builder)
    return builder.end()


def test_records_come_with_their_offsets_up_to_the_first_that_is_torn() -> None:
    one, two = metadata_bytes(a="b"), metadata_bytes(c="ddd")
    data = b"head" + one + two
    found = list(records(io.BytesIO(data), 4, len(data)))
    assert [(record.offset, record.offset + record.length) for record in found] == [
        (4, 4 + len(one)),
        (4 + len(one), len(data)),
    ]
    assert parsed(Metadata, found[1]).metadata == {"c": "ddd"}
    for length in range(4 + len(one), len(data)):
        assert len(list(records(io.BytesIO(data[:length]), 4, length))) == 1
    with pytest.raises(LogError, match="no record of 5 bytes at byte 4"):
        record_at(io.BytesIO(data), 4, 5)


def test_a_record_that_contradicts_itself_is_refused() -> None:
    body = metadata_bytes(a="b")[RECORD.size :]
    with pytest.raises(LogError, match="Schema at byte 7: "):
        parsed(Schema, Record(Opcode.METADATA, 7, body))
    for i in range(len(body)):
        flipped = bytearray(body)
        flipped[i] ^= 0x80
        try:
            found = parsed(Metadata, Record(Opcode.METADATA, 0, bytes(flipped)))
        except LogError:
            continue
        assert found != Metadata("a", {"a": "b"})
    with pytest.raises(LogError, match="contradicts its own kind, length"):
        parsed(Metadata, Record(Opcode.METADATA, 0, body + b"x"))


def test_a_record_beyond_the_limit_is_refused_before_it_is_read() -> None:
    class Sparse(io.BytesIO):
        """A stream that would give as much as it is asked for."""

        def read(self, size: int | None = -1) -> bytes:
            assert size == RECORD.size, "nothing but the head may be read"
            return RECORD.pack(Opcode.ATTACHMENT, GIGABYTES)

    with pytest.raises(LogError, match=f"holds {GIGABYTES} bytes, more than the {RECORD_LIMIT}"):
        next(records(Sparse(), 0, 2 * GIGABYTES))


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("said", [GIGABYTES, 1000])
def test_a_chunk_that_unpacks_to_too_much_is_refused(compression: str, said: int) -> None:
    """Whether it says so or not, and whether the compressed data say so or not."""
    zeros = bytes(RECORD_LIMIT // 16)
    packed = {
        "zstd": lambda: zstandard.ZstdCompressor(write_content_size=said != 1000).compress(zeros),
        "lz4": lambda: lz4.frame.compress(zeros),
    }[compression]()
    assert len(packed) < len(zeros) // 100
    with pytest.raises(LogError, match=r"the chunk at byte 0 (holds|cannot be unpacked)"):
        unpack(Chunk(compression, packed, 0, 0, 0, said), "the chunk at byte 0")


def test_what_does_not_belong_into_a_chunk_is_refused() -> None:
    short = RECORD.pack(Opcode.MESSAGE, 4) + bytes(4)
    for data, reason in (
        (RECORD.pack(Opcode.ATTACHMENT, 1) + b"a", r"does not belong there \(9\)"),
        (short, r"does not belong there \(5\)"),
        (RECORD.pack(Opcode.MESSAGE, 100) + bytes(50), "reaches beyond it"),
        (RECORD.pack(Opcode.MESSAGE, 22)[:5], "ends within a record"),
        (RECORD.pack(Opcode.MESSAGE, 22) + struct.pack("<HIQQ", 1, 0, 9, 0), "of other times"),
    ):
        chunk = Chunk("", data, 2, 1, zlib.crc32(data), len(data))
        with pytest.raises(LogError, match=reason):
            unpack(chunk, "the chunk")


def huge(path: Path) -> Path:
    """A log whose first chunk says that it unpacks to 3 GB, summary and all."""
    contents = read_contents(path)
    size = contents.chunks[0].uncompressed_size
    data = path.read_bytes().replace(struct.pack("<Q", size), struct.pack("<Q", GIGABYTES))
    magic, start = len(b"\x89MCAP0\r\n"), data.rindex(RECORD.pack(Opcode.FOOTER, 20))
    (summary,) = struct.unpack_from("<Q", data, start + RECORD.size)
    checksum = zlib.crc32(data[summary : -magic - 4])
    path.write_bytes(data[: -magic - 4] + struct.pack("<I", checksum) + data[-magic:])
    return path


def test_reading_repair_and_merging_refuse_the_same(write: Write, tmp_path: Path) -> None:
    path = huge(write(make_block(300), compression="zstd"))
    merged = tmp_path / "all.mcap"
    for ask in (
        lambda: ik.logs.open(path).solves(),
        lambda: ik.logs.open(path).iterations(solve=0),
        lambda: finish_log(path),
        lambda: merge_logs([path], merged),
    ):
        with pytest.raises(LogError, match=rf"^{path}: .*holds {GIGABYTES} bytes") as caught:
            ask()
        assert "\n" not in str(caught.value)
    assert not merged.exists()
