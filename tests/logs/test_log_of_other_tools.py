"""Logs that other MCAP tools have rewritten, and other MCAP files."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_up_solves import (
    LABELS,
    LAYOUT,
    Field,
    Layout,
    TraceFormat,
    main,
    make_block,
    rewritten,
    write_bag,
)
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, MessageIndex, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType

from casadi_ik import errors, logs

Write = Callable[..., Path]


@pytest.fixture
def log(write: Write) -> Path:
    return write(make_block(30, 20), make_block(10, 5, method="hand-first"), urdf="<robot/>")


def rows_of(path: Path) -> list[bytes]:
    opened = logs.open(path)
    tables = opened.solves(), opened.iterations(), opened.events()
    return [part.rows.tobytes() for table in tables for part in table.parts]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"index_types": IndexType.ALL & ~IndexType.METADATA},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK | IndexType.MESSAGE},
        {"use_statistics": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_statistics": False, "use_summary_offsets": False, "index_types": IndexType.NONE},
        {"enable_crcs": False, "compression": CompressionType.LZ4},
        {"chunk_size": 20_000, "compression": CompressionType.NONE},
    ],
)
def test_the_summary_and_its_parts_are_optional(log: Path, options: dict[str, Any]) -> None:
    """A rewritten log has the same rows, whichever parts the writer leaves out."""
    copy = rewritten(log, **options)
    assert rows_of(copy) == rows_of(log)
    assert logs.open(copy).metadata["robot"] == "made_up"
    finished = logs.finish_log(copy)
    assert finished.cut == 0
    assert rows_of(copy) == rows_of(log)
    assert not logs.finish_log(copy).changed


@pytest.mark.parametrize("kind", ["iteration", "solve", "event"])
@pytest.mark.parametrize(
    "options", [{"chunk_size": 1, "compression": CompressionType.NONE}, {"use_chunking": False}]
)
def test_a_rewritten_log_is_cut_before_the_first_message_of_a_kind(
    write: Write, kind: str, options: dict[str, Any], tmp_path: Path
) -> None:
    """Writers of other programs define a channel just before its first message."""
    copy = rewritten(write(make_block(6, 20), robot_name="cut"), **options)
    data = copy.read_bytes()
    # The text of a topic also names its channel; the cut is just before this definition.
    copy.write_bytes(data[: data.index(f"/ik/enhanced-dls/{kind}".encode())])
    log = logs.open(copy)
    assert log.info().unfinished == (copy,)
    tables = {
        "iteration": log.iterations(phase="refinement"),
        "solve": log.solves(status="SOLVED"),
        "event": log.events(),
    }
    assert len(tables[kind]) == 0
    recorded = [number for part in tables["solve"].parts for number in part.solve_id.tolist()]
    complete = write(make_block(4, 20), robot_name="cut", name="complete.mcap")
    both = logs.open([copy, complete])
    assert len(both.solves()) == 2 + len(recorded)
    assert len(both.iterations()) == 24 + len(log.iterations(solve=recorded))
    assert [main(["log", name, str(copy)]) for name in ("info", "solves", "events")] == [0, 0, 0]
    finished = logs.finish_log(copy)
    assert finished.changed
    assert len(logs.open(copy).iterations()) == len(log.iterations())
    merged = logs.merge_logs([copy], tmp_path / "merged.mcap")
    assert sum(merged.solves.values()) == len(recorded)


def without_summary(path: Path) -> Path:
    """Copy a log up to the end of its data, with an empty footer and no summary."""
    end = path.read_bytes().rindex(bytes([0x0F]) + (4).to_bytes(8, "little") + bytes(4))
    builder = RecordBuilder()
    builder.write(path.read_bytes()[:end])
    builder.write(bytes([0x0F]) + (4).to_bytes(8, "little") + bytes(4))
    builder.write(bytes([0x02]) + (20).to_bytes(8, "little") + bytes(20))
    builder.write(MCAP0_MAGIC)
    copy = path.with_name("no_summary.mcap")
    copy.write_bytes(builder.end())
    return copy


def test_a_log_without_summary_is_complete(log: Path) -> None:
    copy = without_summary(log)
    assert rows_of(copy) == rows_of(log)
    assert logs.open(copy).info().unfinished == ()
    finished = logs.finish_log(copy)
    assert (finished.changed, finished.cut) == (True, 0)
    with copy.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None
    assert rows_of(copy) == rows_of(log)


def test_message_indexes_in_any_order_are_kept(log: Path) -> None:
    """An incomplete log with message indexes in another order loses none of them."""
    builder, indexes = RecordBuilder(), list[MessageIndex]()
    builder.write(MCAP0_MAGIC)
    with log.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, MessageIndex):
                indexes.insert(0, MessageIndex(record.channel_id, record.records[::-1]))
                continue
            for index in indexes:
                index.write(builder)
            indexes.clear()
            if not isinstance(record, Chunk | Metadata) and builder.count > 10_000:
                break
            record.write(builder)
    data = builder.end()
    torn = log.with_name("torn.mcap")
    torn.write_bytes(data + b"\x06\xff\xff")
    expected = rows_of(log)
    assert rows_of(torn) == expected
    finished = logs.finish_log(torn)
    assert (finished.changed, finished.cut) == (True, 3)
    assert rows_of(torn) == expected
    with torn.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        counted = logs.open(torn).info().counts["hand-first"]["iteration"]
        assert len(list(reader.iter_messages("/ik/hand-first/iteration"))) == counted


@pytest.fixture
def small_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read messages without chunks in several sections."""
    monkeypatch.setattr("casadi_ik.logs.container.SECTION_SIZE", 4096)


@pytest.mark.usefixtures("small_sections")
@pytest.mark.parametrize("closed", [True, False])
def test_messages_without_chunks_are_read(log: Path, closed: bool, tmp_path: Path) -> None:
    """A copy without chunks, as rosbag2 writes with its preset fastwrite, holds the same rows."""
    expected = rows_of(log)
    copy = rewritten(log, use_chunking=False)
    if not closed:
        copy.write_bytes(copy.read_bytes()[:-30])
    assert rows_of(copy) == expected
    ours, theirs = logs.open(log), logs.open(copy)
    fields = {"method": "enhanced-dls", "solve": 1}
    assert theirs.iterations(**fields).rows.tobytes() == ours.iterations(**fields).rows.tobytes()
    assert theirs.info().counts == ours.info().counts
    assert theirs.info().chunks == 0
    finished = logs.finish_log(copy)
    assert (finished.changed, finished.chunks) == (not closed, 0)
    assert not logs.finish_log(copy).changed
    assert rows_of(copy) == expected
    with copy.open("rb") as stream:
        read = sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
        assert read == finished.messages
    logs.merge_logs([copy], tmp_path / "merged.mcap")
    assert rows_of(tmp_path / "merged.mcap") == expected


@pytest.mark.parametrize("closed", [True, False])
def test_a_bag_without_chunks_is_not_a_log(
    log: Path, closed: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    path = log.with_name("bag.mcap")
    write_bag(path, use_chunking=False)
    if not closed:
        path.write_bytes(path.read_bytes()[:-30])
    data_before = path.read_bytes()
    with pytest.raises(errors.LogError) as caught:
        logs.open(path)
    assert str(caught.value).startswith(f"{path}: ")
    for words in (("info",), ("solves",)):
        assert main(["log", *words, str(path)]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert path.read_bytes() == data_before


def test_a_folder_with_logs_of_other_objects_and_a_bag(
    tmp_path: Path, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    """Logs with other fields (names of fingers, no Jacobian) are read together."""
    folder = tmp_path / "study"
    (folder / "bags").mkdir(parents=True)
    names = {**LABELS, "position_error": ("thumb", "index", "middle")}
    lean = Layout.record(Field("q", (14,)), Field("phase", dtype="u1"))
    first = write(make_block(5, 6), name="study/apple.mcap")
    write(make_block(7, form=TraceFormat(LAYOUT, names)), name="study/cup.mcap")
    write(make_block(8, form=TraceFormat(lean, LABELS)), name="study/mug.mcap")
    write_bag(folder / "bags" / "ride.mcap")
    (folder / "._apple.mcap").write_bytes(b"\0\x05\x16\x07\0\x02")  # of macOS, on foreign disks
    log = logs.open(folder)
    assert len(log.solves()) == 4
    assert sorted(log.solves().frame()["iterations"].to_list()) == [5, 6, 7, 8]
    assert log.iterations().frame().height == 5 + 6 + 7 + 8
    numbers = [number for part in log.solves().parts for number in part.solve_id.tolist()]
    assert sorted(numbers) == [0, 1, 2, 3]
    for number in numbers:
        solve = logs.one_solve(log, number)
        assert len(solve.rows) == solve.iterations == 5 + number
    for words in (["info"], ["solves"], ["events"], ["compare"], ["why", "3"], ["finish"]):
        code = main(["log", words[0], str(folder), *words[1:]])
        assert code == (2 if words == ["compare"] else 0), words  # which has one method only
        capsys.readouterr()
    # A bag is refused when it is named or alone in a folder.
    for path in (
        folder / "bags",
        folder / "bags" / "ride.mcap",
        [first, folder / "bags/ride.mcap"],
    ):
        with pytest.raises(errors.LogError, match="not a log"):
            logs.open(path)


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks(
    write: Write, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_: object) -> None:
        raise OSError(code, "not here")

    monkeypatch.setattr(fcntl, "flock", refuse)
    path = write(make_block(30, 20))
    assert len(logs.open(path).solves()) == 2
    path.write_bytes(path.read_bytes()[:-30])
    assert logs.finish_log(path).changed
