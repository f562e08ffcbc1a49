"""Damaged, truncated and crafted files give the truth or one error line, for all readers."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import polars as pl
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_up_solves import chunks_of, main, make_block, rewritten, write_bag
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, DataEnd, Footer, Header, MessageIndex
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType
from processes import NOT_ROOT, POSIX

from casadi_ik import errors, logs

Write = Callable[..., Path]

WRITER = """
import sys
sys.path.insert(0, sys.argv[2])
from made_up_solves import make_block
from casadi_ik import logs
with logs.McapRecorder(sys.argv[1], robot_name="made_up") as recorder:
    for first in range(0, 1_000_000, 20):
        recorder.record(make_block(*[400] * 20, first=first))
        print(first, flush=True)
"""


@pytest.mark.slow
@POSIX
@pytest.mark.parametrize("after", [0.0, 0.2])
def test_a_killed_writer(tmp_path: Path, after: float) -> None:
    """Only the chunk being filled and the one being written are lost."""
    path = tmp_path / "killed.mcap"
    command = [sys.executable, "-c", WRITER, str(path), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for line in writer.stdout:
            if int(line) >= 200:
                break
        time.sleep(after)
        os.kill(writer.pid, signal.SIGKILL)
        recorded = int((line, *writer.stdout.read().split())[-1]) + 20
    log = logs.open(path)
    assert log.info().unfinished == (path,)
    solves = log.solves().solve_id
    np.testing.assert_array_equal(solves, np.arange(len(solves)))
    bytes_per_solve = log.info().uncompressed / len(solves)
    bytes_per_chunk = log.info().uncompressed / log.info().chunks
    assert (recorded - len(solves)) * bytes_per_solve < 2.5 * (bytes_per_chunk + bytes_per_solve)
    assert len(solves) <= recorded + 20
    assert len(log.iterations()) == 400 * len(solves)
    assert log.iterations(solve=41).rows.tobytes() == make_block(400, first=41).rows.tobytes()
    # The lock ended with the writer.
    with logs.McapRecorder(path, robot_name="made_up"):
        pass


HEAD = 9
"""Bytes in front of the content of a record."""


def read_messages(path: Path) -> list[tuple[str, int, bytes]]:
    """Return the messages that an independent reader finds, with all checksums verified."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        messages = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        assert summary.statistics.message_count == len(messages)
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        assert len(list(reader.iter_metadata())) == summary.statistics.metadata_count
        assert len(list(reader.iter_attachments())) == summary.statistics.attachment_count
    return messages


def iterations_of(path: Path) -> bytes:
    """Return the rows of the iterations of one method of a log."""
    return logs.open(path).iterations(method="enhanced-dls").rows.tobytes()


@pytest.mark.parametrize("compression", [*CompressionType, None])
def test_cut_log_keeps_its_complete_records(
    write: Write, compression: CompressionType | None
) -> None:
    """Cut anywhere, a log is read and repaired up to its last complete chunk (None: message).

    An independent reader verifies the repaired file; a second repair changes nothing.
    """
    options = {"chunk_size": 2**14, "compression": compression}
    path = rewritten(
        write(make_block(*[20] * 9), urdf="<robot/>"),
        **(options if compression is not None else {"use_chunking": False}),
    )
    data, messages, truth = path.read_bytes(), read_messages(path), iterations_of(path)
    chunks = chunks_of(path)
    ends = [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]
    lengths = {*np.random.default_rng(7).integers(len(data) // 5, len(data), 25).tolist()}
    lengths = {length for length in lengths if length >= min(ends, default=0)}
    for end, chunk in zip(ends, chunks, strict=True):
        lengths |= {max(end - 1, ends[0]), end, end + 1, end + chunk.message_index_length}
    row_counts = []
    for length in sorted(lengths):
        path.write_bytes(data[:length])
        assert logs.open(path).info().unfinished == (path,)
        rows = iterations_of(path)
        assert rows == truth[: len(rows)]
        row_counts.append(len(rows))
        finished = logs.finish_log(path)
        repaired = read_messages(path)
        assert repaired == messages[: len(repaired)]
        assert (finished.changed, finished.messages) == (True, len(repaired))
        assert finished.chunks == sum(end <= length for end in ends)
        assert iterations_of(path) == rows
        assert not logs.finish_log(path).changed
    assert row_counts == sorted(row_counts)
    assert 0 < row_counts[0] < row_counts[-1] == len(truth)


def test_log_in_use_is_left_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with logs.McapRecorder(path, robot_name="made_up", compression="none") as recorder:
        for first in range(40):
            recorder.record(make_block(1000, first=first))
        while not path.stat().st_size:
            time.sleep(0.01)
        with pytest.raises(errors.LogError, match="locked"):
            logs.finish_log(path)
    assert not logs.finish_log(path).changed
    assert len(read_messages(path)) > 40_000


@pytest.mark.parametrize("closed", [True, False])
def test_damage_inside_a_log_is_refused_without_change(write: Write, closed: bool) -> None:
    path = rewritten(write(make_block(60, 60)), chunk_size=2**12)
    chunk = chunks_of(path)[4]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 10] ^= 4
    path.write_bytes(data if closed else data[:-50])
    data_before = path.read_bytes()
    with pytest.raises(errors.LogError, match=rf"middle:.*{chunk.chunk_start_offset}"):
        logs.finish_log(path)
    assert path.read_bytes() == data_before


def test_other_files_are_not_logs(tmp_path: Path, small: bytes) -> None:
    """A log in use is neither opened nor finished nor merged."""
    files = {"empty": b"", "text": b"robot: ar10\n", "magic": MCAP0_MAGIC}
    files |= {"zeros": MCAP0_MAGIC + bytes(5000)}
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "folder").mkdir()
    write_bag(tmp_path / "foreign", metadata="somebody")

    good = tmp_path / "good.mcap"
    good.write_bytes(small)

    def merge(path: Path) -> None:
        logs.merge_logs([good, path], tmp_path / "all.mcap")

    cases = (
        *(("missing", ask, "No such file") for ask in (logs.finish_log, logs.open, merge)),
        ("folder", logs.finish_log, "Is a directory"),
        *(("folder", ask, "") for ask in (logs.open, merge)),
        ("foreign", logs.open, "'casadi_ik'.*somebody"),
        *(("empty", ask, "empty") for ask in (logs.finish_log, logs.open)),
        *(("text", ask, "b'robot: a'") for ask in (logs.finish_log, logs.open, merge)),
        ("magic", logs.finish_log, " 8 bytes"),
        ("zeros", logs.finish_log, " 5008 bytes"),
    )
    for name, ask, reason in cases:
        with pytest.raises(errors.LogError, match=reason or None) as caught:
            ask(tmp_path / name)
        assert str(caught.value).startswith(f"{tmp_path / name}: ")
    with pytest.raises(errors.LogError):
        logs.merge_logs([], tmp_path / "all.mcap")
    with pytest.raises(errors.LogError, match="No such file"):
        logs.merge_logs([good], tmp_path / "nowhere" / "all.mcap")
    assert (tmp_path / "text").read_bytes() == files["text"]
    assert not (tmp_path / "all.mcap").exists()


@NOT_ROOT
def test_a_read_only_log(write: Write) -> None:
    path = write(make_block(5))
    path.chmod(0o400)
    assert not logs.finish_log(path).changed
    path.chmod(0o600)
    path.write_bytes(path.read_bytes()[:-1])
    path.chmod(0o400)
    with pytest.raises(errors.LogError, match="Permission denied"):
        logs.finish_log(path)


BOUNDED = settings(
    max_examples=25,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)


def said_by(path: Path) -> Any:
    """Return the complete contents of a log."""
    log = logs.open(path)
    tables = log.solves(), log.iterations(), log.events()
    return (
        [
            (part.method, part.labels, part.solve_id.tolist(), part.rows.tobytes())
            for table in tables
            for part in table.parts
        ],
        log.metadata["parameters"],
        log.metadata["seed"],
        log.attachment("robot.urdf"),
    )


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Bytes of a log of two methods with an attachment."""
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    with logs.McapRecorder(path, robot_name="made_up", urdf="<robot/>", seed=3) as recorder:
        recorder.record(make_block(30, 20))
        recorder.record(make_block(10, 5, method="hand-first"))
    return path.read_bytes()


def places(data: bytes, path: Path) -> list[int]:
    """Return the bytes to flip: ends of every kind of record and header, and some between."""
    path.write_bytes(data)
    rng, positions = np.random.default_rng(4), {0, len(data) - 1}
    kinds: dict[type, int] = {}
    with path.open("rb") as stream:
        start = stream.seek(len(MCAP0_MAGIC))
        for record in StreamReader(stream, skip_magic=True, emit_chunks=True).records:
            end = stream.tell() - len(MCAP0_MAGIC) * isinstance(record, Footer)
            kinds[type(record)] = kinds.get(type(record), 0) + 1
            if kinds[type(record)] <= 2:
                positions |= {start, start + 1, end - 1, *rng.integers(start, end, 4).tolist()}
            start = end
    assert len(kinds) >= 11, "every kind of record but a message outside of chunks"
    return sorted(positions)


def test_a_flipped_bit_anywhere(small: bytes, tmp_path: Path) -> None:
    """All operations refuse the file by name or give the same content."""
    path, merged, table = (tmp_path / name for name in ("log.mcap", "all.mcap", "all.parquet"))
    offsets = places(small, path)
    truth, rng, refused = said_by(path), np.random.default_rng(5), 0

    def export() -> Any:
        logs.open(path).iterations().write_parquet(table)
        return len(pl.read_parquet(table))

    def finished() -> Any:
        logs.finish_log(path)
        return said_by(path)

    data_before: list[tuple[Callable[[], Any], Any]] = [
        (lambda: said_by(path), truth),
        (lambda: said_by(logs.merge_logs([path], merged).path), truth),
        (export, 65),
        (finished, truth),
    ]
    for offset in offsets:
        data = bytearray(small)
        data[offset] ^= 1 << int(rng.integers(8))
        for ask, expected in data_before:
            path.write_bytes(data)
            try:
                result = ask()
            except errors.LogError as error:
                refused += 1
                result = re.fullmatch(rf"{path}: [^\n]+", str(error)) and expected
            assert result == expected, offset
    assert refused > len(offsets)


def crafted(data: bytes, path: Path, *changes: Any) -> Path:
    """Return the log with other contents and right checksums; see `rewritten`."""
    path.write_bytes(data)
    return rewritten(path, *changes).replace(path)


def ask_everything(path: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Run every command of `casadi-ik log`, and return the refusals, each of one line."""
    refusals = []
    for words in (
        ("info", path),
        ("solves", path),
        ("events", path),
        ("why", path, 1, "--method", "enhanced-dls"),
        ("merge", path, "--out", path.with_name("all.mcap")),
        ("export", path, "--what", "events", "--out", path.with_name("a.csv")),
    ):
        exit_code = main(["log", *map(str, words)])
        output_text = capsys.readouterr()
        assert exit_code in (0, 2)
        for text in (output_text.out, output_text.err):
            assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e]", text), words
        if exit_code:
            assert output_text.err.count("\n") == 1
            assert len(output_text.err) < 1000
            refusals.append(output_text.err)
    return refusals


DEEP = "[" * 5000 + "]" * 5000
ESCAPE = "\x1b]0;owned\x07\x1b[31mred\u202e"


METADATA = [
    ({"format": "99"}, "format: .*'99'.*'2'"),
    ({"format": "2" * 10_000}, "format: .*'2222"),
    *(({"t0_ns": value}, "metadata: t0_ns: ") for value in ("soon", "9" * 5000)),
    ({"slot_ns": "0"}, "metadata: .*t0_ns"),
    ({"slot_ns": "-1"}, "metadata: slot_ns: "),
    ({"iteration_ns": "5"}, "metadata: iteration_ns: .*5"),
    *(({"robot": value}, "metadata: robot: ") for value in ("", "r" * 10**6)),
    *(
        ({"parameters": value}, "metadata: parameters: ")
        for value in ("7", DEEP, '{"a": ' * 40 + "1" + "}" * 40, "{")
    ),
    ({"machine": "[]"}, "metadata: machine: "),
    ({"packages": '{"numpy": 5}'}, "metadata: packages"),
    ({"keep": "null"}, "metadata: keep: "),
    *(({"shards": v}, "metadata: shards: ") for v in ('{"a": 1}', '[{"file": "a", "first": -5}]')),
    ({"shards": '[{"file": "a", "differs": {"t0_ns": "x"}}]'}, "metadata: t0_ns: "),
]
LABELS = [
    *((value, "labels: ") for value in ("5", '{"status": 5}', '{"status": [5]}', DEEP)),
    ('{"status": ["a"], "position_error": []}', "labels of position_error: .*0.*3"),
    ("{}", "labels of "),
    *((json.dumps({"q": v}), "labels of 'q': ") for v in (["j" * 1000], ["j"] * 10_000)),
]


SCHEMAS = [
    ("float64", "float32"),
    ("uint8 status", "uint8 state"),
    ("float64[3] position_error", "float64[4] position_error"),
    ("[14]", "[999999999]"),
    ("\n", "\nstring name # []\n"),
    ("\n", ""),
    ("uint8", "\x1b[31m"),
]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        *(((entries,), reason) for entries, reason in METADATA),
        *(((None, {"labels": text}), f"'/ik/.*': {reason}") for text, reason in LABELS),
        *(((None, None, lambda text, pair=pair: text.replace(*pair)), "") for pair in SCHEMAS),
    ],
)
def test_crafted_contents_are_refused(
    small: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: Any, reason: str
) -> None:
    """Metadata, labels or a schema that contradict the format are refused in one line."""
    path = crafted(small, tmp_path / "log.mcap", *changes)
    refusals = ask_everything(path, capsys)
    assert len(refusals) == 6 or not reason
    for line in refusals:
        assert re.match(f"casadi-ik: error: {path}: {reason}", line), line


def test_terminal_escapes_are_escaped(
    small: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with logs.McapRecorder(
        tmp_path / f"{ESCAPE.replace('/', '')}.mcap", robot_name=ESCAPE, parameters={ESCAPE: ESCAPE}
    ) as recorder:
        recorder.record(make_block(5, method=f"m{ESCAPE}"))
    ask_everything(recorder.path, capsys)
    main(["log", "info", str(recorder.path)])
    assert r"\x1b[31mred" in capsys.readouterr().out
    assert errors.printable("a\x1b[0mb\nc\u202e ä→", 0) == "a\\x1b[0mb\nc\\u202e ä→"
    assert errors.printable("x" * 50, 10) == "xxxxxxxxxx... (50 characters)"


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=30),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)
texts = st.text(max_size=200) | values.map(json.dumps)
KEYS = ("robot", "seed", "keep", "t0_ns", "slot_ns", "machine", "packages", "parameters")
KEYS = (*KEYS, "shards", "created", "compression", "code_version", "format", "iteration_ns")
FIELDS = ("status", "events", "kind", "phase", "q", "position_error", "jacobian", "joint_mask")


@BOUNDED
@given(
    entries=st.dictionaries(st.sampled_from(KEYS), texts, max_size=2),
    labels=st.none() | texts | st.dictionaries(st.sampled_from(FIELDS), values).map(json.dumps),
)
def test_any_metadata_and_labels(
    small: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    entries: dict[str, str],
    labels: str | None,
) -> None:
    channel = None if labels is None else {"labels": labels}
    ask_everything(crafted(small, tmp_path / "log.mcap", entries, channel), capsys)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("seed", range(12))
def test_any_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int) -> None:
    """Rows of one kind of messages may contain any bytes behind their numbers and times."""
    rng, path = np.random.default_rng(seed), tmp_path / "any.mcap"
    with logs.McapRecorder(path, robot_name="made_up", compression="none") as recorder:
        recorder.record(make_block(30, 20))
    data = bytearray(path.read_bytes())
    (chunk,) = chunks_of(path)
    with path.open("rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True).records)
    indexes = [record for record in records if isinstance(record, MessageIndex)]
    begin = chunk.chunk_start_offset + chunk.chunk_length - chunk.uncompressed_size
    for _, start in indexes[seed % len(indexes)].records:
        size = HEAD + int.from_bytes(data[begin + start + 1 : begin + start + HEAD], "little")
        for place in rng.integers(HEAD + 26, size, 12).tolist():
            data[begin + start + place] = int(rng.choice([0, 127, 240, 255]))
    crc = zlib.crc32(data[begin : begin + chunk.uncompressed_size])
    struct.pack_into("<I", data, chunk.chunk_start_offset + HEAD + 24, crc)
    path.write_bytes(data)
    ask_everything(path, capsys)


GIGABYTES = 3 * 10**9


def with_chunk(folder: Path, chunk: Chunk) -> Path:
    """Write a closed file with a single chunk."""
    builder = RecordBuilder()
    builder.write(MCAP0_MAGIC)
    for record in (Header("ros2", "a test"), chunk, DataEnd(0), Footer(0, 0, 0)):
        record.write(builder)
    builder.write(MCAP0_MAGIC)
    path = folder / "chunk.mcap"
    path.write_bytes(builder.end())
    return path


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("expected_words", [GIGABYTES, 1000])
def test_oversized_chunk_is_refused(tmp_path: Path, compression: str, expected_words: int) -> None:
    """The size may be stated in the header, in the compressed data, or nowhere."""
    zeros = bytes(2**24)
    packed = {
        "zstd": lambda: zstandard.ZstdCompressor(
            write_content_size=expected_words != 1000
        ).compress(zeros),
        "lz4": lambda: lz4.frame.compress(zeros),
    }[compression]()
    assert len(packed) < len(zeros) // 100
    with pytest.raises(errors.LogError, match=r"the chunk at byte \d+ (holds|cannot be unpacked)"):
        logs.finish_log(with_chunk(tmp_path, Chunk(compression, packed, 0, 0, 0, expected_words)))


def test_foreign_records_in_chunks_are_refused(tmp_path: Path) -> None:
    def record(opcode: Opcode, length: int) -> bytes:
        return struct.pack("<BQ", opcode, length)

    for data, reason in (
        (record(Opcode.ATTACHMENT, 1) + b"a", "opcode 9"),
        (record(Opcode.MESSAGE, 4) + bytes(4), "opcode 5"),
        (record(Opcode.MESSAGE, 100) + bytes(50), "is cut off"),
        (record(Opcode.MESSAGE, 22)[:5], "is cut off"),
        (record(Opcode.MESSAGE, 22) + struct.pack("<HIQQ", 1, 0, 9, 0), "time range"),
    ):
        chunk = Chunk("", data, 2, 1, zlib.crc32(data), len(data))
        with pytest.raises(errors.LogError, match=reason):
            logs.finish_log(with_chunk(tmp_path, chunk))


def huge(path: Path) -> Path:
    """Return a log whose first chunk claims to unpack to 3 GB, with a matching summary."""
    size = chunks_of(path)[0].uncompressed_size
    data = path.read_bytes().replace(struct.pack("<Q", size), struct.pack("<Q", GIGABYTES))
    magic, start = len(b"\x89MCAP0\r\n"), data.rindex(struct.pack("<BQ", Opcode.FOOTER, 20))
    (summary,) = struct.unpack_from("<Q", data, start + HEAD)
    checksum = zlib.crc32(data[summary : -magic - 4])
    path.write_bytes(data[: -magic - 4] + struct.pack("<I", checksum) + data[-magic:])
    return path


def test_reading_repair_and_merging_refuse_the_same_files(write: Write, tmp_path: Path) -> None:
    path = huge(write(make_block(300), compression="zstd"))
    merged = tmp_path / "all.mcap"
    for ask in (
        lambda: logs.open(path).solves(),
        lambda: logs.open(path).iterations(solve=0),
        lambda: logs.finish_log(path),
        lambda: logs.merge_logs([path], merged),
    ):
        with pytest.raises(errors.LogError, match=rf"^{path}: .*holds {GIGABYTES} bytes") as caught:
            ask()
        assert "\n" not in str(caught.value)
    assert not merged.exists()
