"""What was written is what is read: by our reader and by three others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_up_solves import FINGERS, FORMAT, JOINTS, LABELS, LAYOUT, PHASES, T0, make_block
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader

import casadi_ik as ik
from casadi_ik.answers.recorder import SolveBlock
from casadi_ik.errors import UnknownNameError
from casadi_ik.logs import EventKind, LogClock, Table
from casadi_ik.logs.events import event_format
from casadi_ik.logs.format import KINDS, topic
from casadi_ik.logs.rows import solve_format
from casadi_ik.logs.writer import CHUNK_SIZE

Write = Callable[..., Path]


def assert_row(message: object, row: np.void) -> None:
    """Every number of a decoded ROS message is that of the row, NaN included."""
    for name in row.dtype.names or ():
        found = getattr(message, name)
        if isinstance(found, bytes):
            found = np.frombuffer(found, np.uint8)
        found = np.asarray(found).astype(row[name].dtype).reshape(row[name].shape)
        np.testing.assert_array_equal(found, row[name], err_msg=name)


def assert_solves(table: Table, block: SolveBlock) -> None:
    """The solves of a block, and nothing else."""
    rows, batch = table.rows, block.batch
    np.testing.assert_array_equal(rows["solve_id"], block.first + np.arange(len(block)))
    np.testing.assert_array_equal(rows["solve_id"], table.solve_id)
    for name in ("q", "position_error", "angle_error", "time", "iterations", "restarts"):
        np.testing.assert_array_equal(rows[name], getattr(batch, name), err_msg=name)
    for name in ("success", "ok", "limits_ok"):
        np.testing.assert_array_equal(rows[name] > 0, getattr(batch, name), err_msg=name)
    np.testing.assert_array_equal(rows["target_points"], block.problems.points)
    np.testing.assert_array_equal(rows["target_normals"], block.problems.normals)
    phases = np.stack(list(batch.phases.values()), axis=1)
    np.testing.assert_array_equal(rows["phase_iterations"], phases)
    np.testing.assert_allclose(rows["started"], block.started * 1e-9, rtol=1e-15)
    names = [record["status"] for record in table.records()]
    assert names == batch.status_names.tolist()


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_own_reader_gives_the_same_bits(write: Write, compression: str) -> None:
    blocks = [make_block(50, 1, 7), make_block(400, first=7)]
    log = ik.logs.open(write(*blocks, compression=compression))
    found = log.iterations()
    assert found.method == "enhanced-dls"
    assert found.rows.dtype == LAYOUT.dtype
    assert found.rows.tobytes() == b"".join(block.rows.tobytes() for block in blocks)
    assert found.labels == LABELS
    assert found.part.units == {item.name: item.unit for item in LAYOUT}
    counts = [50, 1, 7, 400]
    np.testing.assert_array_equal(found.solve_id, np.repeat([0, 1, 2, 7], counts))
    np.testing.assert_array_equal(found.iteration, np.concatenate([np.arange(c) for c in counts]))
    one = log.iterations(solve=2)
    assert one.rows.tobytes() == blocks[0].rows[51:].tobytes()
    assert len(log.iterations(solve=3)) == 0
    assert_solves(log.solves(solve=[0, 1, 2]), blocks[0])
    assert_solves(log.solves(solve=7), blocks[1])


def test_a_chunk_ends_where_a_solve_ends(write: Write) -> None:
    """Whether the solves come in one block or in several."""
    counts = [3000] * 12
    whole = write(make_block(*counts), name="whole.mcap")
    single = [make_block(3000, first=i) for i in range(12)]
    parts = write(*single, name="parts.mcap")
    for path in (whole, parts):
        log = ik.logs.open(path)
        contents = log.shards[0].contents
        assert len(contents.chunks) >= 4
        firsts = [chunk.message_start_time for chunk in contents.chunks]
        assert all((first - T0) % LogClock(T0).slot == 0 for first in firsts)
        sizes = [chunk.uncompressed_size for chunk in contents.chunks[:-1]]
        assert all(CHUNK_SIZE <= size < CHUNK_SIZE + 3000 * 400 for size in sizes)
    found = ik.logs.open(whole).iterations()
    assert found.rows.tobytes() == make_block(*counts).rows.tobytes()
    assert ik.logs.open(parts).iterations(solve=5).rows.tobytes() == single[5].rows.tobytes()


def test_solves_out_of_order_come_back_in_order(write: Write) -> None:
    blocks = [make_block(20, first=i) for i in (3, 0, 2)]
    log = ik.logs.open(write(*blocks))
    assert log.solves().solve_id.tolist() == [0, 2, 3]
    assert list(np.unique(log.iterations().solve_id)) == [0, 2, 3]
    assert log.iterations().rows[:20].tobytes() == blocks[1].rows.tobytes()


def test_two_methods_share_a_log(write: Write) -> None:
    log = ik.logs.open(write(make_block(30), make_block(7, method="hand-first")))
    assert log.methods == ("enhanced-dls", "hand-first")
    with pytest.raises(UnknownNameError, match="of which method"):
        _ = log.iterations().rows
    with pytest.raises(UnknownNameError, match=r"no method 'ipopt'.*enhanced-dls, hand-first"):
        log.iterations(method="ipopt")
    assert len(log.iterations(method="hand-first").rows) == 7
    assert len(log.iterations()) == 37
    assert [part.method for part in log.solves().parts] == ["enhanced-dls", "hand-first"]
    assert {r["method"] for r in log.events(method="hand-first").records()} == {"hand-first"}
    assert log.info().counts["hand-first"]["iteration"] == 7
    assert log.info().counts["enhanced-dls"]["solve"] == 1


def test_a_solve_without_iterations(write: Write) -> None:
    log = ik.logs.open(write(make_block(0)))
    assert len(log.iterations().rows) == 0
    assert log.solves().rows["iterations"].tolist() == [0]
    assert np.isnan(log.solves().rows["lowest_sigma"]).all()
    assert len(log.events()) == 0


def test_an_empty_log(write: Write) -> None:
    log = ik.logs.open(write())
    assert log.methods == ()
    assert len(log.solves()) == len(log.iterations()) == len(log.events()) == 0
    assert log.info().counts == {}


def test_events_come_back_and_are_counted(write: Write) -> None:
    log = ik.logs.open(write(make_block(50, 50, first=4)))
    records = list(log.events(solve=4).records())
    assert {record["solve_id"] for record in records} == {4}
    phases = [record for record in records if record["kind"] == "PHASE_CHANGE"]
    assert [(record["iteration"], record["subject"]) for record in phases] == [
        (17, "thumb reaching -> hand alignment"),
        (34, "hand alignment -> refinement"),
    ]
    iterations = [record["iteration"] for record in records]
    assert iterations == sorted(iterations)
    assert log.info().counts["enhanced-dls"]["event"] == len(log.events())
    totals = log.solves().rows["events"]
    for solve, total in zip((4, 5), totals, strict=True):
        kinds = log.events(solve=solve).rows["kind"]
        np.testing.assert_array_equal(total, np.bincount(kinds, minlength=len(EventKind)))


def test_the_lowest_singular_values_are_kept(write: Write) -> None:
    block = make_block(50, 0, 20)
    solves = ik.logs.open(write(block)).solves()
    assert solves.labels["lowest_sigma"] == ("closed_chain",)
    sigma = block.rows["sigma_closed_chain"]
    expected = [sigma[:50].min(), np.nan, sigma[50:].min()]
    np.testing.assert_array_equal(solves.rows["lowest_sigma"][:, 0], np.float32(expected))


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_mcap_and_mcap_ros2(write: Write, compression: str) -> None:
    block = make_block(50, first=2)
    path = write(block, compression=compression)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        found = list(reader.iter_decoded_messages(topics="/ik/enhanced-dls/iteration"))
    assert len(found) == 50
    clock = LogClock(T0)
    for i, (schema, channel, message, decoded) in enumerate(found):
        assert schema is not None
        assert schema.name == "casadi_ik/msg/IterationEnhancedDlsQ14F3J1"
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        assert channel.metadata["offered_qos_profiles"] == ""
        assert message.log_time == T0 + 2 * clock.slot + i * 1_000_000
        assert message.sequence == i
        assert_row(decoded, block.rows[i])
    first, last = found[0][2].publish_time, found[-1][2].publish_time
    assert block.started[0] < first < last == block.started[0] + 250_000_000
    log = ik.logs.open(path)
    for kind, table in (("solve", log.solves()), ("event", log.events())):
        messages = [m.ros_msg for m in read_ros2_messages(path, [topic("enhanced-dls", kind)])]
        assert len(messages) == len(table) > 0
        for message, row in zip(messages, table.rows, strict=True):
            assert_row(message, row)


def test_rosbags(write: Write) -> None:
    block = make_block(30, 20, first=2)
    path = write(block, make_block(3, method="hand-first"))
    log = ik.logs.open(path)
    tables = (log.iterations, log.solves, log.events)
    rows = {
        kind: get(method="enhanced-dls").rows
        for kind, get in zip(("iteration", "solve", "event"), tables, strict=True)
    }
    seen = dict.fromkeys(KINDS, 0)
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            _, _, method, kind = connection.topic.split("/")
            if method == "enhanced-dls":
                message = reader.deserialize(raw, connection.msgtype)
                assert_row(message, rows[kind][seen[kind]])
                seen[kind] += 1
        types = reader.typestore.types
        constants = types["casadi_ik/msg/IterationEnhancedDlsQ14F3J1"]
        assert constants.PHASE_HAND_ALIGNMENT == 1
        assert types["casadi_ik/msg/EventEnhancedDlsQ14F3J1"].KIND_OSCILLATION == 9
        assert types["casadi_ik/msg/SolveEnhancedDlsQ14F3J1"].STATUS_STALLED == 2
    assert seen == {kind: len(found) for kind, found in rows.items()}


def test_labels_of_solves_and_events() -> None:
    labels = solve_format(make_block(1)).labels
    assert labels["ok"] == labels["target_points"] == FINGERS
    assert labels["phase_iterations"] == PHASES
    assert labels["q"] == JOINTS
    assert event_format(FORMAT).labels["jacobian"] == ("none", "closed_chain")
