"""Shards become one log: nothing is recompressed, nothing lost, nothing doubled."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from made_up_solves import LABELS, T0, Field, Layout, SolveBlock, TraceFormat, make_block, make_rows
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from casadi_ik import errors, logs

Write = Callable[..., Path]


def one(number: int, method: str = "enhanced-dls") -> SolveBlock:
    """A block of one solve of 50 iterations."""
    return make_block(50, first=number, method=method)


def test_shards_are_joined(write: Write, tmp_path: Path) -> None:
    shards = [
        write(*(one(i) for i in numbers), name=f"{numbers[0]}.mcap", urdf="<robot/>")
        for numbers in ((1, 3, 5), (0, 4), (2,))
    ]
    target = tmp_path / "all.mcap"
    merged = logs.merge_logs(shards, target)
    assert merged.solves == {"enhanced-dls": 6}
    assert merged.size == target.stat().st_size
    log = logs.open(target)
    assert log.solves().solve_id.tolist() == list(range(6))
    iterations = log.iterations()
    for i in range(6):
        rows = iterations.rows[iterations.solve_id == i]
        assert rows.tobytes() == make_rows(i, 50).tobytes()
        assert log.iterations(solve=i).rows.tobytes() == rows.tobytes()
    assert len(log.events()) == sum(len(logs.open(shard).events()) for shard in shards)
    assert log.attachment("robot.urdf") == b"<robot/>"


def test_chunks_are_copied_as_they_are_and_others_can_read_the_result(
    write: Write, tmp_path: Path
) -> None:
    shards = [write(one(i), name=f"{i}.mcap") for i in range(3)]
    target = tmp_path / "all.mcap"
    merged = logs.merge_logs(shards, target)
    data = target.read_bytes()
    messages = 0
    for shard in shards:
        with shard.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        whole = shard.read_bytes()
        for chunk in summary.chunk_indexes:
            begin = chunk.chunk_start_offset
            length = chunk.chunk_length + chunk.message_index_length
            assert whole[begin : begin + length] in data
    with target.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        messages = len(list(reader.iter_messages()))
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert messages == merged.messages == summary.statistics.message_count
    with AnyReader([target]) as reader:
        assert reader.message_count == messages
        assert sum(1 for _ in reader.messages()) == messages


def test_one_solve_in_two_shards_is_refused(write: Write, tmp_path: Path) -> None:
    first = write(one(0), one(1), name="a.mcap")
    second = write(one(1), one(2), one(0), name="b.mcap")
    target = tmp_path / "all.mcap"
    for shards, number in (([first, second], 2), ([first, first], 2)):
        with pytest.raises(errors.LogError) as caught:
            logs.merge_logs(shards, target)
        assert str(caught.value) == (
            f"{shards[1]}: solve 1 of enhanced-dls is in {first} too ({number} such solves)"
        )
    assert not target.exists()


def test_shards_that_contradict_are_refused(write: Write, tmp_path: Path) -> None:
    first = write(one(0), name="first.mcap", urdf="<robot/>")
    layout = Layout.record(Field("q", (3,)), Field("phase", dtype="u1"))
    other = TraceFormat(layout, LABELS)
    clock = logs.LogClock(T0 + 10**9)
    cases = {
        f"t0_ns: found {T0 + 10**9}, expected {T0}": write(one(1), name="late.mcap", clock=clock),
        "robot: found ar10, expected made_up": write(one(1), name="robot.mcap", robot_name="ar10"),
        "seed: found 5, expected 0": write(one(1), name="seed.mcap", seed=5),
        "method 'enhanced-dls' has other fields or names than in": write(
            make_block(50, first=1, form=other), name="layout.mcap", urdf="<robot/>"
        ),
        "the attachment 'robot.urdf' is not the same": write(
            one(1), name="urdf.mcap", urdf="<other/>"
        ),
    }
    before = sorted(tmp_path.iterdir())
    for reason, shard in cases.items():
        with pytest.raises(errors.LogError) as caught:
            logs.merge_logs([first, shard], tmp_path / "all.mcap")
        assert reason in str(caught.value)
        assert str(shard) in str(caught.value)
        assert str(first) in str(caught.value)
    assert sorted(tmp_path.iterdir()) == before


def test_shards_that_cannot_be_read(write: Write, tmp_path: Path) -> None:
    good = write(one(0))
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(write(one(1), name="1.mcap").read_bytes()[:-30])
    (tmp_path / "text").write_text("robot: ar10 and some more\n")
    (tmp_path / "nothing").mkdir()
    cases = {
        torn: "truncated or damaged .*log finish",
        tmp_path / "missing": "cannot read the log: No such file",
        tmp_path / "nothing": "no log in this folder",
        tmp_path / "text": "not an MCAP file",
    }
    for shard, reason in cases.items():
        with pytest.raises(errors.LogError, match=reason) as caught:
            logs.merge_logs([good, shard], tmp_path / "all.mcap")
        assert str(caught.value).startswith(f"{shard}: ")
    with pytest.raises(errors.LogError, match="found no shards"):
        logs.merge_logs([], tmp_path / "all.mcap")
    with pytest.raises(errors.LogError, match="cannot write the merged log: No such file"):
        logs.merge_logs([good], tmp_path / "nowhere" / "all.mcap")
    assert not (tmp_path / "all.mcap").exists()
