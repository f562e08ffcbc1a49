"""What was written is what is read: by our reader and by three others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_up_solves import FINGERS, LABELS, LAYOUT, T0, make_solve
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader

from casadi_ik.errors import UnknownNameError
from casadi_ik.logs import LogClock, open_log
from casadi_ik.solvers.recorder import EventKind, SolveSummary

Write = Callable[..., Path]


def assert_row(message: object, row: np.void) -> None:
    """Every number of a decoded ROS message is that of the row, NaN included."""
    for item in LAYOUT:
        found = getattr(message, item.name)
        if isinstance(found, bytes):
            found = np.frombuffer(found, np.uint8)
        found = np.asarray(found).astype(item.dtype).reshape(item.shape)
        np.testing.assert_array_equal(found, row[item.name], err_msg=item.name)


def assert_summary(found: SolveSummary, expected: SolveSummary) -> None:
    for item in dataclasses.fields(SolveSummary):
        value, wanted = getattr(found, item.name), getattr(expected, item.name)
        if isinstance(wanted, np.ndarray):
            assert value.dtype == wanted.dtype, item.name
            np.testing.assert_array_equal(value, wanted, err_msg=item.name)
        else:
            assert value == wanted, item.name
            assert type(value) is type(wanted), item.name


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_own_reader_gives_the_same_bits(write: Write, compression: str) -> None:
    solves = [make_solve(0), make_solve(1, rows=1), make_solve(7, rows=400)]
    log = open_log(write(*solves, compression=compression))
    found = log.iterations()
    assert found.method == "enhanced-dls"
    assert found.layout.dtype == LAYOUT.dtype
    assert [(f.name, f.shape, f.dtype, f.unit, f.doc) for f in found.layout] == [
        (f.name, f.shape, f.dtype, f.unit, f.doc) for f in LAYOUT
    ]
    assert found.rows.dtype == LAYOUT.dtype
    assert found.rows.tobytes() == b"".join(solve.trace.tobytes() for solve in solves)
    assert found.labels == LABELS
    counts = [len(solve.trace) for solve in solves]
    np.testing.assert_array_equal(found.solve_id, np.repeat([0, 1, 7], counts))
    np.testing.assert_array_equal(found.iteration, np.concatenate([np.arange(c) for c in counts]))
    for solve in solves:
        one = log.iterations(solve_id=solve.summary.solve_id)
        assert one.rows.tobytes() == solve.trace.tobytes()
    assert len(log.iterations(solve_id=3).rows) == 0
    for read, solve in zip(log.solves(), solves, strict=True):
        assert_summary(read, solve.summary)
    assert_summary(log.solves(solve_id=7)[0], solves[2].summary)


def test_many_chunks(write: Write) -> None:
    solves = [make_solve(i, rows=1000) for i in range(8)]
    path = write(*solves)
    log = open_log(path)
    assert log.info.chunks > 2
    assert log.iterations().rows.tobytes() == b"".join(s.trace.tobytes() for s in solves)
    assert log.iterations(solve_id=5).rows.tobytes() == solves[5].trace.tobytes()
    assert [s.solve_id for s in log.solves()] == list(range(8))


def test_solves_out_of_order_come_back_in_order(write: Write) -> None:
    solves = [make_solve(i, rows=20) for i in (3, 0, 2)]
    log = open_log(write(*solves))
    assert [s.solve_id for s in log.solves()] == [0, 2, 3]
    assert list(np.unique(log.iterations().solve_id)) == [0, 2, 3]
    assert log.iterations().rows[:20].tobytes() == solves[1].trace.tobytes()


def test_two_methods_share_a_log(write: Write) -> None:
    log = open_log(write(make_solve(0), make_solve(0, "hand-first", rows=7)))
    assert log.methods == ("enhanced-dls", "hand-first")
    with pytest.raises(UnknownNameError, match="which method"):
        log.iterations()
    with pytest.raises(UnknownNameError, match=r"no method 'ipopt'.*enhanced-dls, hand-first"):
        log.iterations("ipopt")
    assert len(log.iterations("hand-first").rows) == 7
    assert [s.method for s in log.solves()] == ["enhanced-dls", "hand-first"]
    assert {e.method for e in log.events("hand-first")} == {"hand-first"}
    assert log.info.counts["hand-first"]["iteration"] == 7
    assert log.info.counts["enhanced-dls"]["solve"] == 1


def test_a_solve_without_iterations(write: Write) -> None:
    log = open_log(write(make_solve(0, rows=0)))
    assert len(log.iterations().rows) == 0
    assert log.solves()[0].iterations == 0
    assert log.events() == []


def test_an_empty_log(write: Write) -> None:
    log = open_log(write())
    assert log.methods == ()
    assert log.solves() == []
    assert log.info.counts == {}


def test_events_come_back(write: Write) -> None:
    solve = make_solve(4)
    log = open_log(write(solve))
    events = log.events(solve_id=4)
    assert {event.solve_id for event in events} == {4}
    own = [e.event for e in events if e.event.subject == "größer als π"]
    assert own == list(solve.events)
    phases = [e.event for e in events if e.event.kind is EventKind.PHASE_CHANGE]
    assert [(e.iteration, e.subject) for e in phases] == [
        (17, "thumb reaching -> hand alignment"),
        (34, "hand alignment -> refinement"),
    ]
    iterations = [e.event.iteration for e in events]
    assert iterations == sorted(iterations)
    assert log.info.counts["enhanced-dls"]["event"] == len(events)


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_mcap_and_mcap_ros2(write: Write, compression: str) -> None:
    solve = make_solve(2)
    path = write(solve, compression=compression)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header = reader.get_header()
        assert header.profile == "ros2"
        found = list(reader.iter_decoded_messages(topics="/ik/enhanced-dls/iteration"))
    assert len(found) == 50
    clock = LogClock(T0)
    for i, (schema, channel, message, decoded) in enumerate(found):
        assert schema.name == "casadi_ik/msg/IterationEnhancedDlsQ14F3J1"
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        assert channel.metadata["offered_qos_profiles"] == ""
        assert message.log_time == T0 + 2 * clock.slot + i * 1_000_000
        assert message.sequence == i
        assert_row(decoded, solve.trace[i])
    first, last = found[0][2].publish_time, found[-1][2].publish_time
    assert solve.summary.started < first < last == solve.summary.started + 250_000_000
    assert_solve_and_events(path, solve.summary)


def assert_solve_and_events(path: Path, summary: SolveSummary) -> None:
    """Mcap_ros2's own reader finds the same solve and events as ours."""
    topics = ["/ik/enhanced-dls/solve", "/ik/enhanced-dls/event"]
    messages = [m.ros_msg for m in read_ros2_messages(path, topics)]
    (solve,) = [m for m in messages if hasattr(m, "robot")]
    events = [m for m in messages if hasattr(m, "subject")]
    assert (solve.solve_id, solve.robot, solve.status) == (2, "made_up", "SOLVED")
    assert (solve.fingers, solve.ok) == (list(FINGERS), [True, False, True])
    assert dict(zip(solve.phases, solve.phase_iterations, strict=True)) == summary.phase_iterations
    assert (solve.started, solve.seed, solve.time) == (summary.started, 42, 0.25)
    np.testing.assert_array_equal(solve.q, summary.q)
    np.testing.assert_array_equal(solve.target_points, summary.target_points.ravel())
    np.testing.assert_array_equal(solve.target_normals, summary.target_normals.ravel())
    ours = open_log(path).events()
    assert [(e.iteration, e.kind, e.subject, e.solve_id) for e in events] == [
        (e.event.iteration, e.event.kind, e.event.subject, 2) for e in ours
    ]
    np.testing.assert_array_equal([e.value for e in events], [e.event.value for e in ours])
    np.testing.assert_array_equal([e.threshold for e in events], [e.event.threshold for e in ours])


def test_rosbags(write: Write) -> None:
    solve = make_solve(2)
    path = write(solve, make_solve(2, "hand-first", rows=3))
    seen = {"iteration": 0, "solve": 0, "event": 0}
    with AnyReader([path]) as reader:
        for connection, log_time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            _, _, method, kind = connection.topic.split("/")
            if method == "hand-first":
                continue
            if kind == "iteration":
                assert_row(message, solve.trace[seen[kind]])
                assert log_time == LogClock(T0).start(2) + seen[kind] * 1_000_000
            elif kind == "solve":
                for name in ("q", "position_error", "angle_error", "ok"):
                    np.testing.assert_array_equal(
                        getattr(message, name), getattr(solve.summary, name)
                    )
                for name in ("target_points", "target_normals"):
                    expected = getattr(solve.summary, name).ravel()
                    np.testing.assert_array_equal(getattr(message, name), expected)
                assert message.fingers == list(FINGERS)
            seen[kind] += 1
        constants = reader.typestore.types["casadi_ik/msg/IterationEnhancedDlsQ14F3J1"]
        assert constants.PHASE_HAND_ALIGNMENT == 1
        assert reader.typestore.types["casadi_ik/msg/Event"].OSCILLATION == 7
    assert seen["iteration"] == 50
    assert seen["solve"] == 1
    assert seen["event"] == len(open_log(path).events("enhanced-dls"))
