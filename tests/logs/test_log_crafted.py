"""Logs from anybody: flipped bits and crafted contents give the truth or one plain line."""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_up_solves import make_block
from mcap.reader import make_reader
from mcap.writer import Writer

import casadi_ik as ik
from casadi_ik.cli.main import main
from casadi_ik.errors import CasadiIKError, LogError, printable
from casadi_ik.logs import McapRecorder, finish_log, merge_logs, one_solve
from casadi_ik.logs.chunks import RECORD as HEAD
from casadi_ik.logs.container import MAGIC, read_chunk, read_contents, records
from casadi_ik.logs.provenance import METADATA_NAME, signed

BOUNDED = settings(
    max_examples=60,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)


def said_by(path: Path) -> Any:
    """All that a log says."""
    log = ik.logs.open(path)
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
    """A log of two methods with an attachment."""
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    with McapRecorder(path, robot_name="made_up", urdf="<robot/>", seed=3) as recorder:
        recorder.record(make_block(30, 20))
        recorder.record(make_block(10, 5, method="hand-first"))
    return path.read_bytes()


def places(data: bytes, path: Path) -> list[int]:
    """Bytes to flip: first and last of every kind of record, of its head, and some between."""
    path.write_bytes(data)
    rng, found = np.random.default_rng(4), {0, len(data) - 1}
    kinds: dict[int, int] = {}
    with path.open("rb") as stream:
        for record in records(stream, len(MAGIC), len(data) - len(MAGIC)):
            kinds[record.opcode] = kinds.get(record.opcode, 0) + 1
            if kinds[record.opcode] <= 2:
                start, end = record.offset, record.offset + record.length
                found |= {start, start + 1, end - 1, *rng.integers(start, end, 4).tolist()}
    assert len(kinds) >= 12, "every kind of record but a message outside of chunks"
    return sorted(found)


def test_a_flipped_bit_anywhere(small: bytes, tmp_path: Path) -> None:
    """Reading, merging, finishing and a table: refused by name, or the same content."""
    path, merged, table = (tmp_path / name for name in ("log.mcap", "all.mcap", "all.parquet"))
    offsets = places(small, path)
    truth, rng, refused = said_by(path), np.random.default_rng(5), 0

    def export() -> Any:
        ik.logs.open(path).iterations().write_parquet(table)
        return len(pl.read_parquet(table))

    def finished() -> Any:
        finish_log(path)
        return said_by(path)

    asked: list[tuple[Callable[[], Any], Any]] = [
        (lambda: said_by(path), truth),
        (lambda: said_by(merge_logs([path], merged).path), truth),
        (export, 65),
        (finished, truth),
    ]
    for offset in offsets:
        data = bytearray(small)
        data[offset] ^= 1 << int(rng.integers(8))
        for ask, expected in asked:
            path.write_bytes(data)
            try:
                found = ask()
            except LogError as error:
                refused += 1
                found = re.fullmatch(rf"{path}: [^\n]+", str(error)) and expected
            assert found == expected, offset
    assert refused > len(offsets)


def crafted(
    data: bytes,
    path: Path,
    metadata: Mapping[str, str] | None = None,
    channel: Mapping[str, str] | None = None,
    schema: Callable[[str], str] = str,
) -> Path:
    """The log with other contents, every checksum right."""
    path.write_bytes(data)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        (record,) = (each.metadata for each in reader.iter_metadata())
        found = list(reader.iter_messages())
    entries = {**record, **(metadata or {})}
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        writer.add_metadata(METADATA_NAME, signed(entries))
        numbers: dict[int, int] = {}
        for form, own, message in found:
            assert form is not None
            if own.id not in numbers:
                text, about = schema(form.data.decode()), {**own.metadata, **(channel or {})}
                number = writer.register_schema(form.name, form.encoding, text.encode())
                numbers[own.id] = writer.register_channel(own.topic, "cdr", number, about)
            times = message.log_time, message.data, message.publish_time
            writer.add_message(numbers[own.id], *times, message.sequence)
        writer.finish()
    return path


def ask_everything(path: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Every question of the command line; gives its refusals, each a plain line."""
    refusals = []
    for words in (
        ("info", path),
        ("solves", path),
        ("events", path),
        ("why", path, 0, "--method", "enhanced-dls"),
        ("merge", path, "--out", path.with_name("all.mcap")),
        ("export", path, "--what", "events", "--out", path.with_name("a.csv")),
    ):
        exit_code = main(["log", *map(str, words)])
        said = capsys.readouterr()
        assert exit_code in (0, 2)
        for text in (said.out, said.err):
            assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e]", text), words
        if exit_code:
            assert said.err.count("\n") == 1
            assert len(said.err) < 1000
            refusals.append(said.err)
    return refusals


DEEP = "[" * 5000 + "]" * 5000
ESCAPE = "\x1b]0;owned\x07\x1b[31mred\u202e"


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"format": "99"}, "format: found '99', expected '2'"),
        ({"format": "2" * 10_000}, "format: found '2222"),
        ({"t0_ns": "soon"}, "metadata: t0_ns: "),
        ({"t0_ns": "9" * 5000}, "metadata: t0_ns: "),
        ({"slot_ns": "0"}, "metadata: found t0_ns"),
        ({"slot_ns": "-1"}, "metadata: slot_ns: "),
        ({"iteration_ns": "5"}, "metadata: iteration_ns: found 5"),
        ({"robot": ""}, "metadata: robot: "),
        ({"robot": "r" * 10**6}, "metadata: robot: "),
        ({"parameters": "7"}, "metadata: parameters: "),
        ({"parameters": DEEP}, "metadata: parameters: lists and mappings are nested"),
        ({"parameters": '{"a": ' * 40 + "1" + "}" * 40}, "metadata: parameters: lists and"),
        ({"parameters": "{"}, "metadata: parameters: not JSON"),
        ({"machine": "[]"}, "metadata: machine: "),
        ({"packages": '{"numpy": 5}'}, "metadata: packages"),
        ({"keep": "null"}, "metadata: keep: "),
        ({"shards": '{"a": 1}'}, "metadata: shards: "),
        ({"shards": '[{"file": "a", "first": -5}]'}, "metadata: shards: a number of a solve"),
        ({"shards": '[{"file": "a", "differs": {"t0_ns": "x"}}]'}, "metadata: t0_ns: "),
    ],
)
def test_crafted_metadata_are_refused(
    small: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    entries: dict[str, str],
    reason: str,
) -> None:
    path = crafted(small, tmp_path / "log.mcap", entries)
    refusals = ask_everything(path, capsys)
    assert len(refusals) == 6
    for line in refusals:
        assert line.startswith(f"casadi-ik: error: {path}: {reason}"), line


@pytest.mark.parametrize(
    ("labels", "reason"),
    [
        ("5", "labels: "),
        ('{"status": 5}', "labels: "),
        ('{"status": [5]}', "labels: "),
        ('{"status": ["a"], "position_error": []}', "labels of position_error: 0 names for 3"),
        ("{}", "labels of "),
        (DEEP, "labels: lists and mappings are nested"),
        (json.dumps({"q": ["j" * 1000]}), "labels of 'q': more than"),
        (json.dumps({"q": ["j"] * 10_000}), "labels of 'q': more than"),
    ],
)
def test_crafted_labels_are_refused(
    small: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str], labels: str, reason: str
) -> None:
    path = crafted(small, tmp_path / "log.mcap", channel={"labels": labels})
    refusals = ask_everything(path, capsys)
    assert len(refusals) == 6
    for line in refusals:
        assert re.match(rf"casadi-ik: error: {path}: '/ik/.*': {reason}", line), line


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("float64", "float32"),
        lambda text: text.replace("uint8 status", "uint8 state"),
        lambda text: text.replace("float64[3] position_error", "float64[4] position_error"),
        lambda text: text.replace("[14]", "[999999999]"),
        lambda text: text + "string name # []\n",
        lambda text: "",
        lambda text: "\x1b[31m",
    ],
)
def test_crafted_schemas_are_refused(
    small: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[str], str],
) -> None:
    path = crafted(small, tmp_path / "log.mcap", schema=change)
    for line in ask_everything(path, capsys):
        assert line.startswith(f"casadi-ik: error: {path}: ")


def test_terminal_escapes_in_names_are_shown_not_obeyed(
    small: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with McapRecorder(
        tmp_path / f"{ESCAPE.replace('/', '')}.mcap", robot_name=ESCAPE, parameters={ESCAPE: ESCAPE}
    ) as recorder:
        recorder.record(make_block(5, method=f"m{ESCAPE}"))
    ask_everything(recorder.path, capsys)
    main(["log", "info", str(recorder.path)])
    assert r"\x1b[31mred" in capsys.readouterr().out
    assert printable("a\x1b[0mb\nc\u202e ä→", 0) == "a\\x1b[0mb\nc\\u202e ä→"
    assert printable("x" * 50, 10) == "xxxxxxxxxx... (50 characters)"


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
@pytest.mark.parametrize("seed", range(24))
def test_any_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int) -> None:
    """Any bytes in the rows of a kind of messages, behind their numbers and times."""
    rng, path = np.random.default_rng(seed), tmp_path / "any.mcap"
    with McapRecorder(path, robot_name="made_up", compression="none") as recorder:
        recorder.record(make_block(30, 20))
    data = bytearray(path.read_bytes())
    (index,) = read_contents(path).chunks
    with path.open("rb") as stream:
        runs = read_chunk(stream, index).runs
    begin = index.chunk_start_offset + index.chunk_length - index.uncompressed_size
    run = runs[seed % len(runs)]
    for start in range(run.start, run.stop, run.size):
        for place in rng.integers(HEAD.size + 26, run.size, 12).tolist():
            data[begin + start + place] = int(rng.choice([0, 127, 240, 255]))
    crc = zlib.crc32(data[begin : begin + index.uncompressed_size])
    struct.pack_into("<I", data, index.chunk_start_offset + HEAD.size + 24, crc)
    path.write_bytes(data)
    ask_everything(path, capsys)


def test_a_question_in_python_is_refused_the_same(small: bytes, tmp_path: Path) -> None:
    path = crafted(small, tmp_path / "log.mcap", {"parameters": '{"tolerance": 5}'})
    assert len(ik.logs.open(path).solves()) == 4
    with pytest.raises(CasadiIKError):
        one_solve(ik.logs.open(path), 9)
