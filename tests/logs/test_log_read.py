"""Queries of logs: filters, several files, data frames, origins, merged logs."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from made_up_solves import (
    FORMAT,
    JOINTS,
    LABELS,
    LAYOUT,
    T0,
    Field,
    Layout,
    SolveBlock,
    TraceFormat,
    changed,
    chunks_of,
    main,
    make_block,
    rewritten,
)
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC as MAGIC

import casadi_ik as ik
from casadi_ik import errors, logs

Write = Callable[..., Path]


def ids(log: logs.Log, **filters: object) -> list[int]:
    return log.solves(**filters).solve_id.tolist()  # type: ignore[arg-type]


def test_filters_of_solves(write: Write) -> None:
    log = logs.open(write(make_block(40, 2, 1, 30)))
    assert ids(log) == [0, 1, 2, 3]
    assert ids(log, solve=2) == [2]
    assert ids(log, solve=range(1, 3)) == ids(log, solve=[2, 1, 1]) == [1, 2]
    assert ids(log, status="STALLED") == [1, 3]
    assert ids(log, status=["STALLED", "SOLVED"], solve=[0, 3]) == [0, 3]
    assert (
        ids(log, event="PHASE_CHANGE") == ids(log, event=logs.EventKind.PHASE_CHANGE) == [0, 1, 3]
    )
    assert ids(log, event=["PHASE_CHANGE"], status="STALLED") == [1, 3]
    assert ids(log, phase="refinement") == [0, 3], "one or two iterations do not get so far"
    assert ids(log, solve=[]) == ids(log, solve=77) == []


def test_filters_of_iterations_and_events(write: Write) -> None:
    block = make_block(40, 2, 1, 30)
    log = logs.open(write(block))
    stalled = log.iterations(status="STALLED")
    assert stalled.rows.tobytes() == np.concatenate([block.rows[40:42], block.rows[43:]]).tobytes()
    refined = log.iterations(phase="refinement")
    assert refined.rows.tobytes() == block.rows[block.rows["phase"] == 2].tobytes()
    assert len(log.iterations(event="STALL")) == 0
    two = log.iterations(fields=["phase", "cost"], solve=3)
    assert two.rows.dtype.names == ("cost", "phase"), "in the order of the log"
    np.testing.assert_array_equal(two.rows["cost"], block.rows["cost"][43:])
    selection = log.iterations(fields=["cost"], phase="refinement")
    np.testing.assert_array_equal(selection.rows["cost"], refined.rows["cost"])
    events = log.events(event="PHASE_CHANGE", solve=[0, 1])
    assert {record["kind"] for record in events.records()} == {"PHASE_CHANGE"}
    assert set(events.solve_id) == {0, 1}
    assert set(log.events(phase="hand alignment").rows["phase"]) == {1}


def test_only_requested_chunks_are_read(write: Write) -> None:
    """Damage of the chunks of other solves is not noticed."""
    path = rewritten(write(make_block(*[10] * 20)), chunk_size=2000)
    log, data = logs.open(path), bytearray(path.read_bytes())
    chunks, times = chunks_of(path), [logs.LogClock(T0).slot * i + T0 for i in (3, 11)]
    assert log.info().chunks == len(chunks) > 20
    for chunk in chunks:
        first, last = chunk.message_start_time, chunk.message_end_time
        is_read = any(first < time + 10**9 and time <= last for time in times)
        data[chunk.chunk_start_offset + chunk.chunk_length - 1] ^= not is_read
    path.write_bytes(data)
    assert len(log.iterations(solve=[3, 11])) == 20
    assert logs.one_solve(log, 3).iterations == len(log.solves(solve=11).rows) * 10
    assert len(log.iterations(solve=30)) == 0
    with pytest.raises(errors.LogError, match="chunk at byte"):
        log.iterations(solve=4)


@pytest.mark.parametrize(
    ("filters", "known_names"),
    [
        ({"method": "ipopt"}, "enhanced-dls"),
        ({"status": "solved"}, "SOLVED"),
        ({"event": "CRASH"}, "NEAR_SINGULAR"),
        ({"phase": ["refinement", "dinner"]}, "thumb reaching"),
        ({"fields": ["costs"]}, "q, palm, cost"),
        ({"stauts": "SOLVED"}, "method, solve, status"),
    ],
)
def test_unknown_names(write: Write, filters: dict[str, Any], known_names: str) -> None:
    """The error names the unknown filter, value or field, and the known ones."""
    log = logs.open(write(make_block(30)))
    ((name, value),) = filters.items()
    unknown = name if name == "stauts" else value if isinstance(value, str) else value[-1]
    expected = TypeError if name == "stauts" else errors.UnknownNameError
    for table in (
        (log.iterations,) if name == "fields" else (log.solves, log.iterations, log.events)
    ):
        with pytest.raises(expected, match=f"'{unknown}'.*{known_names}"):
            table(**filters)


def test_several_files_are_one_log(write: Write, tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    blocks = [make_block(5, 6, first=10), make_block(7, first=3), make_block(4, first=20)]
    paths = [
        write(blocks[0], name="a/0.mcap"),
        write(blocks[1], make_block(2, method="hand-first"), name="a/1.mcap"),
        write(blocks[2], name="a/b/2.mcap", compression="none"),
    ]
    for log in (logs.open(paths), logs.open(tmp_path / "a"), logs.open(str(tmp_path))):
        assert log.methods == ("enhanced-dls", "hand-first")
        assert ids(log, method="enhanced-dls") == [3, 10, 11, 20]
        iterations = log.iterations(method="enhanced-dls")
        assert iterations.solve_id.tolist() == [3] * 7 + [10] * 5 + [11] * 6 + [20] * 4
        expected = np.concatenate([blocks[1].rows, blocks[0].rows, blocks[2].rows])
        assert iterations.rows.tobytes() == expected.tobytes()
        info = log.info()
        assert info.counts["enhanced-dls"]["iteration"] == 22
        assert info.paths == tuple(paths)
        assert info.size == sum(path.stat().st_size for path in paths)


def test_files_that_do_not_belong_together(write: Write, tmp_path: Path) -> None:
    first = write(make_block(5, 6), name="0.mcap")
    copy = tmp_path / "1.mcap"
    copy.write_bytes(first.read_bytes())
    for ask in (lambda files: logs.open(files).solves(), lambda files: logs.merge_logs(files, "m")):
        with pytest.raises(errors.LogError) as caught:
            ask([first, copy])
        assert str(caught.value).startswith(f"{copy}: solve 1 of enhanced-dls ")
        assert str(first) in str(caught.value)
    other_log = write(make_block(6, first=2), name="2.mcap", robot_name="ar10")
    with pytest.raises(errors.LogError, match=r"2\.mcap:.*'ar10'.*'made_up'.*0\.mcap"):
        logs.open([first, other_log])
    form = dataclasses.replace(FORMAT, labels={**FORMAT.labels, "q": JOINTS[::-1]})
    third = write(make_block(6, first=2, form=form), name="3.mcap")
    with pytest.raises(errors.LogError, match="2 formats of rows"):
        _ = logs.open([first, third]).iterations().rows
    with pytest.raises(errors.LogError, match="log: found no path"):
        logs.open([])
    (tmp_path / "only").mkdir()
    for i, data in enumerate((b"", MAGIC[:3], MAGIC)):
        (tmp_path / "only" / f"{i}.mcap").write_bytes(data)
    with pytest.raises(errors.LogError, match=r"0\.mcap .*2"):
        logs.open(tmp_path / "only")


def test_policy_keeps_the_selected_solves(write: Write) -> None:
    """All solves keep totals; failed, singular and sampled ones keep iterations and events."""
    block = make_block(*[20] * 400)
    rows = block.rows.copy()
    rows["sigma_closed_chain"] = 1.0
    rows["sigma_closed_chain"][20 * 6 + 3] = 1e-4  # in solve 6, which is solved
    block = changed(block, rows=rows)
    full_log = logs.open(write(block, name="whole.mcap"))
    sample = logs.Keep(failed=False, singular=False, sample=0.25, seed=5)
    log = logs.open(write(block, keep=sample, name="sample.mcap"))
    kept_solves = np.flatnonzero(log.solves().rows["kept"])
    assert 60 < len(kept_solves) < 140
    assert set(log.iterations().solve_id) == set(log.events().solve_id) == set(kept_solves)
    assert log.iterations().rows.tobytes() == full_log.iterations(solve=kept_solves).rows.tobytes()
    assert log.events().rows.tobytes() == full_log.events(solve=kept_solves).rows.tobytes()
    for name in (name for name in log.solves().names if name != "kept"):
        np.testing.assert_array_equal(log.solves().rows[name], full_log.solves().rows[name])

    parts = [
        changed(make_block(*[20] * 100, first=i), rows=rows[20 * i : 20 * i + 2000])
        for i in range(0, 400, 100)
    ]
    log_in_parts = logs.open(write(*parts, keep=sample, name="parts.mcap"))
    np.testing.assert_array_equal(np.flatnonzero(log_in_parts.solves().rows["kept"]), kept_solves)

    log = logs.open(write(block, keep=logs.Keep(sample=0.0), name="failed.mcap"))
    solved = block.batch.success
    assert set(np.flatnonzero(log.solves().rows["kept"])) == {*np.flatnonzero(~solved), 6}
    assert full_log.solves().rows["kept"].all()


def test_frames(write: Write, tmp_path: Path) -> None:
    block = make_block(40, 2)
    log = logs.open(write(block, make_block(3, first=5, method="hand-first")))
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
        solves["target_points.finger_2.y"][:2], block.targets.points[:, 1, 1]
    )
    assert solves["phase_iterations.hand alignment"].to_list() == [13, 1, 1]
    events = log.events().frame()
    assert {"kind", "subject", "jacobian", "joints", "value", "threshold"} <= set(events.columns)
    path = tmp_path / "iterations.parquet"
    log.iterations().write_parquet(path)
    assert pl.read_parquet(path).equals(frame, null_equal=True)
    with pytest.raises(errors.LogError, match="nowhere"):
        log.iterations().write_parquet(tmp_path / "nowhere" / "a.parquet")


def test_arrays(write: Write) -> None:
    block = make_block(4, 2)
    log = logs.open(write(block))
    array = log.iterations().array()
    assert array.dtype.names == ("solve_id", "iteration", *LAYOUT.names)
    assert array["solve_id"].tolist() == [0, 0, 0, 0, 1, 1]
    assert array["iteration"].tolist() == [0, 1, 2, 3, 0, 1]
    np.testing.assert_array_equal(array["palm"], block.rows["palm"])
    assert log.solves().array().dtype == log.solves().rows.dtype


def test_without_polars(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "polars", None)
    table = logs.open(write(make_block(4))).iterations()
    assert len(table.array()) == 4
    with pytest.raises(errors.MissingExtraError, match="pip install polars"):
        table.frame()


COUNTS = ([40, 30], [20, 50, 10], [60])
ALL_COUNTS = [count for counts in COUNTS for count in counts]
NAMES = ("loose/cup/00000.mcap", "loose/cup/00001.mcap", "tight/cup/00000.mcap")


@pytest.fixture
def study(write: Write, tmp_path: Path) -> Path:
    """Three shards of two settings, each numbered from 0 and with a sample of its own."""
    folder = tmp_path / "study"
    for i, (name, counts) in enumerate(zip(NAMES, COUNTS, strict=True)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        block = make_block(*counts, first=100 * i)  # so that no two solves are the same
        tolerance = {"thumb": {"position": 1e-3 if "tight" in name else 5e-3}}
        numbered = make_block(*counts)
        numbered.batch.q[:] = block.batch.q
        write(
            numbered,
            name=f"study/{name}",
            keep=logs.Keep(sample=1.0, seed=i),
            parameters={"tolerance": tolerance},
            urdf="<robot/>",
        )
    return folder


def rows_by_solve(log: logs.Log) -> list[tuple[int, bytes]]:
    table = log.iterations()
    return [
        (number, table.rows[table.solve_id == number].tobytes())
        for number in np.unique(table.solve_id).tolist()
    ]


def test_solve_numbers_continue_across_shards(study: Path) -> None:
    log = logs.open(study)
    assert log.solves().solve_id.tolist() == [0, 1, 2, 3, 4, 5]
    assert log.solves().rows["solve_id"].tolist() == [0, 1, 2, 3, 4, 5]
    assert log.solves().rows["iterations"].tolist() == ALL_COUNTS
    assert [len(log.iterations(solve=i)) for i in range(6)] == ALL_COUNTS
    logs_of_shards = [logs.open(study / name) for name in NAMES]
    expected = [rows for log_of_shard in logs_of_shards for _, rows in rows_by_solve(log_of_shard)]
    assert [rows for _, rows in rows_by_solve(log)] == expected
    assert set(log.events(solve=4).rows["solve_id"]) <= {4}
    frame = log.solves(solve=[1, 2, 5]).frame()
    assert frame["shard"].to_list() == list(NAMES)
    assert "shard" not in logs_of_shards[0].solves().frame().columns
    assert [record["shard"] for record in log.solves(solve=5).records()] == [NAMES[2]]


def test_origin_of_a_solve(study: Path, tmp_path: Path) -> None:
    """The origin is the same in the folder, in a merged log, and in a log merged from that."""
    merged = logs.merge_logs([study], tmp_path / "all.mcap").path
    other_block = make_block(7, method="hand-first")
    with logs.McapRecorder(tmp_path / "b.mcap", robot_name="made_up", urdf="<robot/>") as recorder:
        recorder.record(other_block)
    for log in (logs.open(study), logs.open(merged)):
        for number, (name, shard_log) in enumerate(
            [
                (NAMES[0], 0),
                (NAMES[0], 1),
                (NAMES[1], 0),
                (NAMES[1], 1),
                (NAMES[1], 2),
                (NAMES[2], 0),
            ]
        ):
            solve = logs.one_solve(log, number)
            assert (solve.shard, solve.number, solve.solve_id) == (name, shard_log, number)
            position = 1e-3 if "tight" in name else 5e-3
            assert solve.parameters["tolerance"]["thumb"]["position"] == position
    keeps = logs.open(merged).info().differs["keep"]
    assert [keep["seed"] for keep in keeps] == [0, 1, 2]


def test_a_study_is_merged(study: Path, tmp_path: Path) -> None:
    path = tmp_path / "all.mcap"
    merged = logs.merge_logs(study, path)
    assert (merged.shards, merged.solves) == (3, {"enhanced-dls": 6})
    log, folder = logs.open(path), logs.open(study)
    assert rows_by_solve(log) == rows_by_solve(folder)
    for name in ("solves", "events"):
        ours, theirs = getattr(log, name)(), getattr(folder, name)()
        assert ours.rows.tobytes() == theirs.rows.tobytes()
        assert ours.solve_id.tolist() == theirs.solve_id.tolist()
    assert not logs.finish_log(path).changed, "every record of it is verified"
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        messages = [
            (m.log_time, m.sequence) for _, c, m in reader.iter_messages(["/ik/enhanced-dls/solve"])
        ]
    assert [sequence for _, sequence in messages] == list(range(6))
    assert messages == sorted(messages)


def test_unique_numbers_are_kept(write: Write, tmp_path: Path) -> None:
    write(make_block(5, first=3), make_block(5, first=9), name="a.mcap")
    write(make_block(6, first=5), name="b.mcap")
    for log in (
        logs.open(tmp_path),
        logs.open(logs.merge_logs(tmp_path, tmp_path / "all").path),
    ):
        assert log.solves().solve_id.tolist() == [3, 5, 9]
        assert [logs.one_solve(log, i).shard for i in (3, 5, 9)] == ["a.mcap", "b.mcap", "a.mcap"]
        assert logs.one_solve(log, 5).number == 5


def test_duplicate_solve_is_counted_once(study: Path) -> None:
    """A merged log beside its shards is detected, whatever its numbers are."""
    logs.merge_logs(study, study / "all.mcap")
    with pytest.raises(errors.LogError, match=r"00000\.mcap:.*1.*enhanced-dls.*all\.mcap"):
        logs.open(study).solves()


def test_shards_with_channels_in_another_order_are_merged(write: Write, tmp_path: Path) -> None:
    both = ("enhanced-dls", "hand-first")
    first = write(*(make_block(9, method=m) for m in both), name="a.mcap")
    second = write(*(make_block(8, first=1, method=m) for m in both[::-1]), name="b.mcap")
    third = write(make_block(7, first=2, method=both[1]), name="c.mcap")
    path = logs.merge_logs([first, second, third], tmp_path / "all.mcap").path
    assert not logs.finish_log(path).changed
    log = logs.open(path)
    for method, expected in zip(both, ([9, 8], [9, 8, 7]), strict=True):
        assert log.solves(method=method).rows["iterations"].tolist() == expected
        shards = logs.open([first, second, third])
        assert (
            log.iterations(method=method).rows.tobytes()
            == shards.iterations(method=method).rows.tobytes()
        )


@pytest.mark.parametrize("head", ["empty", "magic", "header", "metadata"])
def test_shard_without_complete_chunk_is_named_and_skipped(
    study: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, head: str
) -> None:
    data = (study / NAMES[0]).read_bytes()
    length = {"empty": 0, "magic": 5, "header": 20, "metadata": 100}[head]
    torn = study / "loose" / "cup" / "00002.mcap"
    torn.write_bytes(data[:length])
    log = logs.open(study)
    assert len(log.solves()) == 6
    assert log.info().left_out == (torn,)
    (line,) = caplog.messages
    assert line.startswith(f"{torn}: ")
    assert line.endswith("; skipped: no complete record")
    assert logs.merge_logs(study, tmp_path / "all.mcap").left_out == (torn,)
    with pytest.raises(errors.LogError, match=rf"^{torn}: "):
        logs.open(torn)


def test_partial_shard_is_read_or_repaired_first(study: Path, tmp_path: Path) -> None:
    shard = study / NAMES[1]
    shard.write_bytes(shard.read_bytes()[:-10])
    assert len(logs.open(study).solves()) == 6
    with pytest.raises(errors.LogError, match=rf"^{shard}: .*log finish"):
        logs.merge_logs(study, tmp_path / "all.mcap")
    assert main(["log", "finish", str(study)]) == 0
    assert logs.merge_logs(study, tmp_path / "all.mcap").solves == {"enhanced-dls": 6}


def test_command_line_names_the_shard(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (study / "empty.mcap").write_bytes(b"")
    (study / ".all.1234.part.mcap").write_bytes(b"the work of a merge that was killed")
    merged = tmp_path / "all.mcap"
    for words in (("info", study), ("solves", study), ("why", study, 3)):
        assert main(["log", *map(str, words)]) == 0
        assert NAMES[1] in "".join(capsys.readouterr().out.split())
    assert main(["log", "merge", str(study), "--out", str(merged)]) == 0
    assert "empty.mcap" in "".join(capsys.readouterr().out.split())
    assert main(["log", "why", str(merged), "3"]) == 0
    assert NAMES[1] in "".join(capsys.readouterr().out.split())


def test_motion_round_trips_or_is_refused(tmp_path: Path) -> None:
    robot, path = ik.load_robot("kuka_lwr_barrett"), tmp_path / "way.mcap"
    rng = np.random.default_rng(0)
    times, q = 0.1 * np.arange(5), robot.random(rng, 5)
    ik.motion.Motion(robot, times, q, 0 * q, 0 * q).write(path)
    motion = logs.read_motion(path)
    assert (motion.robot, motion.actuators) == (robot.name, robot.actuators)
    np.testing.assert_allclose(motion.times, times, atol=1e-9)
    np.testing.assert_array_equal(motion.q, q)
    np.testing.assert_array_equal(motion.ordered(robot.actuators[::-1]), q[:, ::-1])
    with pytest.raises(errors.LogError, match="lwr_joint_1, "):
        motion.ordered(("elbow",))
    stored_bytes, refused = path.read_bytes(), 0
    for i in range(100):
        data = bytearray(stored_bytes[: rng.integers(len(stored_bytes)) if i % 2 else None])
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        try:
            np.testing.assert_array_equal(logs.read_motion(path).q, q)
        except errors.LogError as error:
            refused += str(error).startswith(f"{path}: ")
    assert refused > 90
    solved = tmp_path / "log.mcap"
    ik.Solver(robot).solve(ik.load_grasp("cup"), log=solved)
    with pytest.raises(errors.LogError, match=r"log\.mcap:.*motion:.*/ik/hand-first"):
        logs.read_motion(solved)


def block_of(number: int) -> SolveBlock:
    """Return a block of one solve of 50 iterations."""
    return make_block(50, first=number)


def test_shards_that_contradict_are_refused(write: Write, tmp_path: Path) -> None:
    first = write(block_of(0), name="first.mcap", urdf="<robot/>")
    layout = Layout.record(Field("q", (3,)), Field("phase", dtype="u1"))
    other_format = TraceFormat(layout, LABELS)
    clock = logs.LogClock(T0 + 10**9)
    cases = {
        f"t0_ns: found {T0 + 10**9}, expected {T0}": write(
            block_of(1), name="late.mcap", clock=clock
        ),
        "robot: found ar10, expected made_up": write(
            block_of(1), name="robot.mcap", robot_name="ar10"
        ),
        "seed: found 5, expected 0": write(block_of(1), name="seed.mcap", seed=5),
        "method 'enhanced-dls' has other fields or names than in": write(
            make_block(50, first=1, form=other_format), name="layout.mcap", urdf="<robot/>"
        ),
        "the attachment 'robot.urdf' differs": write(
            block_of(1), name="urdf.mcap", urdf="<other/>"
        ),
    }
    files_before = sorted(tmp_path.iterdir())
    for reason, shard in cases.items():
        with pytest.raises(errors.LogError) as caught:
            logs.merge_logs([first, shard], tmp_path / "all.mcap")
        assert reason in str(caught.value)
        assert str(shard) in str(caught.value)
        assert str(first) in str(caught.value)
    assert sorted(tmp_path.iterdir()) == files_before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Asked", "LoggedTarget"),
        ("OneSolve", "SolveRecord"),
        ("matched", "match_targets"),
        ("side_by_side", "compare_solves"),
    ],
)
def test_deprecated_names_warn(old: str, new: str) -> None:
    with pytest.warns(DeprecationWarning, match=new):
        assert getattr(logs, old) is getattr(logs, new)
