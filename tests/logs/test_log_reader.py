"""Questions to a log: filters, several files as one, dataframes, files that others have written."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from made_up_solves import FORMAT, JOINTS, LAYOUT, changed, make_block
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

import casadi_ik as ik
from casadi_ik.errors import LogError, MissingExtraError, UnknownNameError
from casadi_ik.logs import EventKind, Keep, Log

Write = Callable[..., Path]


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every solve ends a chunk."""
    monkeypatch.setattr("casadi_ik.logs.writer.CHUNK_SIZE", 1)


def ids(log: Log, **filters: object) -> list[int]:
    return log.solves(**filters).solve_id.tolist()  # type: ignore[arg-type]


def test_filters_of_solves(write: Write) -> None:
    log = ik.logs.open(write(make_block(40, 2, 1, 30)))
    assert ids(log) == [0, 1, 2, 3]
    assert ids(log, solve=2) == [2]
    assert ids(log, solve=range(1, 3)) == ids(log, solve=[2, 1, 1]) == [1, 2]
    assert ids(log, status="STALLED") == [1, 3]
    assert ids(log, status=["STALLED", "SOLVED"], solve=[0, 3]) == [0, 3]
    assert ids(log, event="PHASE_CHANGE") == ids(log, event=EventKind.PHASE_CHANGE) == [0, 1, 3]
    assert ids(log, event=["PHASE_CHANGE"], status="STALLED") == [1, 3]
    assert ids(log, phase="refinement") == [0, 3], "one or two iterations do not get so far"
    assert ids(log, solve=[]) == ids(log, solve=77) == []


def test_filters_of_iterations_and_events(write: Write) -> None:
    block = make_block(40, 2, 1, 30)
    log = ik.logs.open(write(block))
    stalled = log.iterations(status="STALLED")
    assert stalled.rows.tobytes() == np.concatenate([block.rows[40:42], block.rows[43:]]).tobytes()
    refined = log.iterations(phase="refinement")
    assert refined.rows.tobytes() == block.rows[block.rows["phase"] == 2].tobytes()
    assert len(log.iterations(event="STALL")) == 0
    two = log.iterations(fields=["phase", "cost"], solve=3)
    assert two.rows.dtype.names == ("cost", "phase"), "in the order of the log"
    np.testing.assert_array_equal(two.rows["cost"], block.rows["cost"][43:])
    some = log.iterations(fields=["cost"], phase="refinement")
    np.testing.assert_array_equal(some.rows["cost"], refined.rows["cost"])
    events = log.events(event="PHASE_CHANGE", solve=[0, 1])
    assert {record["kind"] for record in events.records()} == {"PHASE_CHANGE"}
    assert set(events.solve_id) == {0, 1}
    assert set(log.events(phase="hand alignment").rows["phase"]) == {1}


@pytest.mark.usefixtures("small_chunks")
def test_only_the_chunks_asked_for_are_read(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    log = ik.logs.open(write(make_block(*[10] * 20)))
    assert log.info().chunks == 20
    read: list[int] = []
    from casadi_ik.logs import shards as unpacking

    whole = unpacking.read_chunk
    monkeypatch.setattr(
        unpacking, "read_chunk", lambda stream, chunk: (read.append(1), whole(stream, chunk))[1]
    )
    assert len(log.iterations(solve=[3, 11])) == 20
    assert len(read) == 2
    assert len(log.iterations(solve=30)) == 0
    assert len(read) == 2


@pytest.mark.parametrize(
    ("question", "reason"),
    [
        ({"method": "ipopt"}, r"no method 'ipopt'; the log holds: enhanced-dls"),
        ({"status": "solved"}, r"no status 'solved'; there are: .*SOLVED"),
        ({"event": "CRASH"}, r"no event 'CRASH'; there are: NEAR_SINGULAR"),
        ({"phase": ["refinement", "dinner"]}, r"no phase 'dinner'; there are: thumb reaching"),
    ],
)
def test_names_that_are_not_there(write: Write, question: dict[str, str], reason: str) -> None:
    log = ik.logs.open(write(make_block(30)))
    for ask in (log.solves, log.iterations, log.events):
        with pytest.raises(UnknownNameError, match=reason):
            ask(**question)  # type: ignore[arg-type]


def test_a_field_that_is_not_there(write: Write) -> None:
    with pytest.raises(UnknownNameError, match="no field 'costs'; there are: q, palm, cost"):
        ik.logs.open(write(make_block(3))).iterations(fields=["costs"])


def test_several_files_are_one_log(write: Write, tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    blocks = [make_block(5, 6, first=10), make_block(7, first=3), make_block(4, first=20)]
    paths = [
        write(blocks[0], name="a/0.mcap"),
        write(blocks[1], make_block(2, method="hand-first"), name="a/1.mcap"),
        write(blocks[2], name="a/b/2.mcap", compression="none"),
    ]
    for log in (ik.logs.open(paths), ik.logs.open(tmp_path / "a"), ik.logs.open(str(tmp_path))):
        assert log.methods == ("enhanced-dls", "hand-first")
        assert ids(log, method="enhanced-dls") == [3, 10, 11, 20]
        found = log.iterations(method="enhanced-dls")
        assert found.solve_id.tolist() == [3] * 7 + [10] * 5 + [11] * 6 + [20] * 4
        expected = np.concatenate([blocks[1].rows, blocks[0].rows, blocks[2].rows])
        assert found.rows.tobytes() == expected.tobytes()
        info = log.info()
        assert info.counts["enhanced-dls"]["iteration"] == 22
        assert info.paths == tuple(paths)
        assert info.size == sum(path.stat().st_size for path in paths)


def test_files_that_do_not_belong_together(write: Write, tmp_path: Path) -> None:
    first = write(make_block(5, 6), name="0.mcap")
    copy = tmp_path / "1.mcap"
    copy.write_bytes(first.read_bytes())
    with pytest.raises(LogError, match=r"1\.mcap: solve 0 of enhanced-dls is in .*0\.mcap too"):
        ik.logs.open([first, copy]).solves()
    other = write(make_block(6, first=2), name="2.mcap", robot_name="ar10")
    with pytest.raises(LogError, match=r"2\.mcap: robot 'ar10', but .*0\.mcap has 'made_up'"):
        ik.logs.open([first, other])
    form = dataclasses.replace(FORMAT, labels={**FORMAT.labels, "q": JOINTS[::-1]})
    third = write(make_block(6, first=2, form=form), name="3.mcap")
    with pytest.raises(LogError, match=r"3\.mcap: method 'enhanced-dls' has other fields or names"):
        ik.logs.open([first, third]).iterations()
    with pytest.raises(LogError, match="no log was named"):
        ik.logs.open([])


def test_a_policy_keeps_what_it_says(write: Write) -> None:
    """Totals of all; iterations and events of failed, of singular ones and of a seeded sample."""
    block = make_block(*[20] * 400)
    rows = block.rows.copy()
    rows["sigma_closed_chain"] = 1.0
    rows["sigma_closed_chain"][20 * 6 + 3] = 1e-4  # in solve 6, which is solved
    block = changed(block, rows=rows)
    whole = ik.logs.open(write(block, name="whole.mcap"))
    sample = Keep(failed=False, singular=False, sample=0.25, seed=5)
    log = ik.logs.open(write(block, keep=sample, name="sample.mcap"))
    kept = np.flatnonzero(log.solves().rows["kept"])
    assert 60 < len(kept) < 140
    assert set(log.iterations().solve_id) == set(log.events().solve_id) == set(kept)
    assert log.iterations().rows.tobytes() == whole.iterations(solve=kept).rows.tobytes()
    assert log.events().rows.tobytes() == whole.events(solve=kept).rows.tobytes()
    for name in (name for name in log.solves().names if name != "kept"):
        np.testing.assert_array_equal(log.solves().rows[name], whole.solves().rows[name])

    parts = [
        changed(make_block(*[20] * 100, first=i), rows=rows[20 * i : 20 * i + 2000])
        for i in range(0, 400, 100)
    ]
    again = ik.logs.open(write(*parts, keep=sample, name="parts.mcap"))
    np.testing.assert_array_equal(np.flatnonzero(again.solves().rows["kept"]), kept)

    log = ik.logs.open(write(block, keep=Keep(sample=0.0), name="failed.mcap"))
    solved = block.batch.success
    assert set(np.flatnonzero(log.solves().rows["kept"])) == {*np.flatnonzero(~solved), 6}
    assert whole.solves().rows["kept"].all()


def test_frames(write: Write, tmp_path: Path) -> None:
    block = make_block(40, 2)
    log = ik.logs.open(write(block, make_block(3, first=5, method="hand-first")))
    frame = log.iterations().frame()
    assert frame.height == 45
    assert frame.columns[:4] == ["method", "solve_id", "iteration", "q.joint_0"]
    assert {"position_error.thumb", "palm.0.3", "cost", "limit_mask", "phase"} <= set(frame.columns)
    ours = frame.filter(pl.col("method") == "enhanced-dls")
    np.testing.assert_array_equal(ours["q.joint_3"], block.rows["q"][:, 3])
    np.testing.assert_array_equal(ours["palm.1.2"], block.rows["palm"][:, 1, 2])
    phases = [FORMAT.labels["phase"][code] for code in block.rows["phase"]]
    assert ours["phase"].to_list() == phases
    solves = log.solves().frame()
    assert solves["status"].to_list() == ["SOLVED", "STALLED", "STALLED"]
    np.testing.assert_array_equal(
        solves["target_points.finger_2.y"][:2], block.problems.points[:, 1, 1]
    )
    assert solves["phase_iterations.hand alignment"].to_list() == [13, 1, 1]
    events = log.events().frame()
    assert {"kind", "subject", "jacobian", "joints", "value", "threshold"} <= set(events.columns)
    path = tmp_path / "iterations.parquet"
    log.iterations().write_parquet(path)
    assert pl.read_parquet(path).equals(frame, null_equal=True)
    with pytest.raises(LogError, match="nowhere"):
        log.iterations().write_parquet(tmp_path / "nowhere" / "a.parquet")


def test_arrays(write: Write) -> None:
    block = make_block(4, 2)
    log = ik.logs.open(write(block))
    array = log.iterations().array()
    assert array.dtype.names == ("solve_id", "iteration", *LAYOUT.names)
    assert array["solve_id"].tolist() == [0, 0, 0, 0, 1, 1]
    assert array["iteration"].tolist() == [0, 1, 2, 3, 0, 1]
    np.testing.assert_array_equal(array["palm"], block.rows["palm"])
    assert log.solves().array().dtype == log.solves().rows.dtype


def test_without_polars(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "polars", None)
    table = ik.logs.open(write(make_block(4))).iterations()
    assert len(table.array()) == 4
    with pytest.raises(MissingExtraError, match=r"casadi-ik\[dataframes\]"):
        table.frame()


def rewritten(path: Path, **options: object) -> Path:
    """The same messages by mcap's own writer, in the order of their times."""
    copy = path.with_name("copy.mcap")
    with path.open("rb") as source, copy.open("wb") as target:
        reader = make_reader(source, validate_crcs=True)
        writer = Writer(target, chunk_size=20_000, **options)  # type: ignore[arg-type]
        writer.start("ros2")
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            times = message.log_time, message.data, message.publish_time
            writer.add_message(channels[channel.id], *times, message.sequence)
        writer.finish()
    return copy


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "index_types": IndexType.CHUNK | IndexType.METADATA},
        {"enable_crcs": False},
    ],
)
def test_a_log_that_other_tools_have_rearranged(write: Write, options: dict[str, object]) -> None:
    """Messages of all topics mixed, in other chunks, perhaps without their index."""
    path = write(make_block(30, 80, 3))
    ours, theirs = ik.logs.open(path), ik.logs.open(rewritten(path, **options))
    for one, other in (
        (ours.iterations(), theirs.iterations()),
        (ours.solves(), theirs.solves()),
        (ours.events(), theirs.events()),
        (ours.iterations(solve=1), theirs.iterations(solve=1)),
    ):
        assert one.rows.tobytes() == other.rows.tobytes()
        np.testing.assert_array_equal(one.solve_id, other.solve_id)


def test_messages_outside_chunks_are_refused(write: Write) -> None:
    path = rewritten(write(make_block(5)), use_chunking=False)
    with pytest.raises(LogError, match=r"copy\.mcap: the messages are not in chunks"):
        ik.logs.open(path)
