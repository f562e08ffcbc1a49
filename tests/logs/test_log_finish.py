"""A log whose writer was killed is made whole; a whole one stays; what is no log is refused."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from made_up_solves import make_block
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from casadi_ik.errors import LogError
from casadi_ik.logs import McapRecorder, finish_log

Write = Callable[..., Path]

FIRST_RECORD = 9
"""Bytes in front of the content of a record."""


def read_messages(path: Path) -> list[tuple[str, int, bytes]]:
    """What an independent reader finds, every checksum verified."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        assert summary.statistics.message_count == len(found)
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        assert len(list(reader.iter_metadata())) == summary.statistics.metadata_count
        assert len(list(reader.iter_attachments())) == summary.statistics.attachment_count
    return found


def many_chunks(path: Path, compression: CompressionType) -> list[int]:
    """A file of 12 chunks with an attachment in between; gives where each chunk is whole."""
    rng = np.random.default_rng(3)
    whole: list[int] = []
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1, compression=compression)
        writer.start("ros2", "a test")
        writer.add_metadata("casadi_ik", {"robot": "made_up"})
        schema = writer.register_schema("x", "ros2msg", b"float64 x\n")
        channels = [writer.register_channel(f"/{i}", "cdr", schema) for i in range(3)]
        for i in range(12):
            if i == 5:
                writer.add_attachment(1, 2, "robot.urdf", "application/xml", b"<robot/>" * 20)
            for channel in channels:
                data = rng.bytes(int(rng.integers(10, 300)))
                writer.add_message(channel, 1000 * i + channel, data, 0)
            whole.append(stream.tell())
        writer.finish()
    return whole


@pytest.mark.parametrize("compression", list(CompressionType))
def test_random_truncations_are_readable_afterwards(
    tmp_path: Path, compression: CompressionType
) -> None:
    original = tmp_path / "whole.mcap"
    many_chunks(original, compression)
    data, messages = original.read_bytes(), read_messages(original)
    first = len(MCAP0_MAGIC) + FIRST_RECORD + int.from_bytes(data[9:17], "little")
    path = tmp_path / "torn.mcap"
    rng = np.random.default_rng(7)
    kept: list[int] = []
    for length in sorted(rng.integers(first, len(data), 60).tolist()):
        path.write_bytes(data[:length])
        done = finish_log(path)
        found = read_messages(path)
        assert found == messages[: len(found)]
        assert (done.changed, done.messages) == (True, len(found))
        kept.append(len(found))
        again = path.read_bytes()
        assert not finish_log(path).changed
        assert path.read_bytes() == again
    assert kept == sorted(kept)
    assert kept[0] == 0
    assert kept[-1] == len(messages)
    assert len(set(kept)) > 10


def test_every_chunk_that_was_written_is_kept(tmp_path: Path) -> None:
    """Cut anywhere behind a chunk but before the next one is whole: all up to it is there."""
    original = tmp_path / "whole.mcap"
    many_chunks(original, CompressionType.ZSTD)
    data, messages = original.read_bytes(), read_messages(original)
    with original.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunks = summary.chunk_indexes
    path = tmp_path / "torn.mcap"
    for chunk, following in pairwise(chunks):
        behind = chunk.chunk_start_offset + chunk.chunk_length
        expected = [m for m in messages if m[1] <= chunk.message_end_time]
        last = following.chunk_start_offset + following.chunk_length - 1
        for length in {behind, behind + 1, behind + chunk.message_index_length, last}:
            path.write_bytes(data[:length])
            finish_log(path)
            assert read_messages(path) == expected


def test_a_finished_log_is_a_log(write: Write) -> None:
    path = write(make_block(50, 50))
    data, messages = path.read_bytes(), read_messages(path)
    assert not finish_log(path).changed
    assert path.read_bytes() == data
    path.write_bytes(data[:-40])
    done = finish_log(path)
    assert done.changed
    assert read_messages(path) == messages


def test_a_log_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with McapRecorder(path, robot_name="made_up", compression="none") as recorder:
        for first in range(40):
            recorder.record(make_block(1000, first=first))
        while not path.stat().st_size:
            time.sleep(0.01)
        with pytest.raises(LogError, match="its writer is still at it"):
            finish_log(path)
    assert not finish_log(path).changed
    assert len(read_messages(path)) > 40_000


def test_a_damaged_summary_is_written_anew(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    many_chunks(path, CompressionType.NONE)
    messages = read_messages(path)
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    assert finish_log(path).changed
    assert read_messages(path) == messages


@pytest.mark.parametrize("closed", [True, False])
def test_damage_in_the_middle_is_refused_and_nothing_changed(tmp_path: Path, closed: bool) -> None:
    path = tmp_path / "log.mcap"
    many_chunks(path, CompressionType.ZSTD)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[4]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 10] ^= 4
    path.write_bytes(data if closed else data[:-50])
    before = path.read_bytes()
    with pytest.raises(
        LogError, match=rf"damaged in its middle: .* byte {chunk.chunk_start_offset}"
    ):
        finish_log(path)
    assert path.read_bytes() == before


def test_random_bit_flips_never_pass_as_something_else(tmp_path: Path) -> None:
    """After finish a flipped file is refused, or holds nothing that was not written."""
    path = tmp_path / "log.mcap"
    many_chunks(path, CompressionType.ZSTD)
    data, written = path.read_bytes(), {m[2] for m in read_messages(path)}
    rng = np.random.default_rng(11)
    refused = 0
    for position in rng.integers(0, len(data), 150).tolist():
        flipped = bytearray(data)
        flipped[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            finish_log(path)
        except LogError:
            refused += 1
        else:
            assert {m[2] for m in read_messages(path)} <= written
    assert refused > 50


def test_what_is_no_log(tmp_path: Path, write: Write) -> None:
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "text").write_text("robot: ar10\n")
    (tmp_path / "magic").write_bytes(MCAP0_MAGIC)
    (tmp_path / "zeros").write_bytes(MCAP0_MAGIC + bytes(5000))
    (tmp_path / "folder").mkdir()
    cases = {
        "missing": "cannot finish the log: No such file",
        "folder": "cannot finish the log: Is a directory",
        "empty": "not an MCAP file: it is empty",
        "text": "not an MCAP file: it begins with b'robot: a'",
        "magic": "none of its 8 bytes is a whole record",
        "zeros": "none of its 5008 bytes is a whole record",
    }
    for name, reason in cases.items():
        with pytest.raises(LogError, match=reason) as caught:
            finish_log(tmp_path / name)
        assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert (tmp_path / "text").read_text() == "robot: ar10\n"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    many_chunks(path, CompressionType.NONE)
    path.chmod(0o400)
    assert not finish_log(path).changed
    path.chmod(0o600)
    path.write_bytes(path.read_bytes()[:-1])
    path.chmod(0o400)
    with pytest.raises(LogError, match="Permission denied"):
        finish_log(path)
