"""Logs are read as they were written, by four readers; a solve is repeated from its log."""

from __future__ import annotations

import string
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_solves import (
    LABELS,
    LAYOUT,
    STORAGE,
    T0,
    Field,
    Layout,
    SolveBlock,
    TargetBatch,
    changed,
    make_block,
    parse_layout,
    schema_text,
)
from mcap.reader import make_reader
from mcap_ros2._dynamic import generate_dynamic
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import casadi_ik as ik
from casadi_ik import errors, logs

Write = Callable[..., Path]
KINDS = ("iteration", "solve", "event")
CDR_HEADER = b"\0\1\0\0"


def assert_row(message: object, row: np.void) -> None:
    """Assert that every number of a decoded ROS message is that of the row, including NaN."""
    for name in row.dtype.names or ():
        logged = getattr(message, name)
        if isinstance(logged, bytes):
            logged = np.frombuffer(logged, np.uint8)
        logged = np.asarray(logged).astype(row[name].dtype).reshape(row[name].shape)
        np.testing.assert_array_equal(logged, row[name], err_msg=name)


def assert_solves(table: logs.Table, block: SolveBlock) -> None:
    """Assert that a table has exactly the solves of a block."""
    rows, batch = table.rows, block.batch
    np.testing.assert_array_equal(rows["solve_id"], block.first + np.arange(len(block)))
    np.testing.assert_array_equal(rows["solve_id"], table.solve_id)
    for name in ("q", "position_error", "angle_error", "time", "iterations", "restarts"):
        np.testing.assert_array_equal(rows[name], getattr(batch, name), err_msg=name)
    for name in ("success", "ok", "limits_ok"):
        np.testing.assert_array_equal(rows[name] > 0, getattr(batch, name), err_msg=name)
    np.testing.assert_array_equal(rows["target_points"], block.targets.points)
    np.testing.assert_array_equal(rows["target_normals"], block.targets.normals)
    phases = np.stack(list(batch.phases.values()), axis=1)
    np.testing.assert_array_equal(rows["phase_iterations"], phases)
    np.testing.assert_allclose(rows["started"], block.started * 1e-9, rtol=1e-15)
    names = [record["status"] for record in table.records()]
    assert names == batch.status_names.tolist()


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_reader_gives_the_same_bits(write: Write, compression: str) -> None:
    blocks = [make_block(50, 1, 7), make_block(400, first=7)]
    log = logs.open(write(*blocks, compression=compression))
    iterations = log.iterations()
    assert iterations.method == "enhanced-dls"
    assert iterations.rows.dtype == LAYOUT.dtype
    assert iterations.rows.tobytes() == b"".join(block.rows.tobytes() for block in blocks)
    assert iterations.labels == LABELS
    assert iterations.part.units == {item.name: item.unit for item in LAYOUT}
    counts = [50, 1, 7, 400]
    np.testing.assert_array_equal(iterations.solve_id, np.repeat([0, 1, 2, 7], counts))
    np.testing.assert_array_equal(
        iterations.iteration, np.concatenate([np.arange(c) for c in counts])
    )
    rows_of_solve = log.iterations(solve=2)
    assert rows_of_solve.rows.tobytes() == blocks[0].rows[51:].tobytes()
    assert len(log.iterations(solve=3)) == 0
    assert_solves(log.solves(solve=[0, 1, 2]), blocks[0])
    assert_solves(log.solves(solve=7), blocks[1])


def test_solves_out_of_order_come_back_in_order(write: Write) -> None:
    blocks = [make_block(20, first=i) for i in (3, 0, 2)]
    log = logs.open(write(*blocks))
    assert log.solves().solve_id.tolist() == [0, 2, 3]
    assert list(np.unique(log.iterations().solve_id)) == [0, 2, 3]
    assert log.iterations().rows[:20].tobytes() == blocks[1].rows.tobytes()


def test_two_methods_share_a_log(write: Write) -> None:
    log = logs.open(write(make_block(30), make_block(7, method="hand-first")))
    assert log.methods == ("enhanced-dls", "hand-first")
    with pytest.raises(errors.UnknownNameError, match="method is missing"):
        _ = log.iterations().rows
    assert len(log.iterations(method="hand-first").rows) == 7
    assert len(log.iterations()) == 37
    assert [part.method for part in log.solves().parts] == ["enhanced-dls", "hand-first"]
    assert {r["method"] for r in log.events(method="hand-first").records()} == {"hand-first"}
    assert log.info().counts["hand-first"]["iteration"] == 7
    assert log.info().counts["enhanced-dls"]["solve"] == 1


def test_a_solve_without_iterations_and_an_empty_log(write: Write) -> None:
    log = logs.open(write(make_block(0)))
    assert len(log.iterations().rows) == len(log.events()) == 0
    assert log.solves().rows["iterations"].tolist() == [0]
    assert np.isnan(log.solves().rows["lowest_sigma"]).all()
    log = logs.open(write())
    assert log.methods == ()
    assert len(log.solves()) == len(log.iterations()) == len(log.events()) == 0
    assert log.info().counts == {}


def test_events_come_back_and_are_counted(write: Write) -> None:
    log = logs.open(write(make_block(50, 50, first=4)))
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
        np.testing.assert_array_equal(total, np.bincount(kinds, minlength=len(logs.EventKind)))


def test_the_lowest_singular_values_are_kept(write: Write) -> None:
    block = make_block(50, 0, 20)
    solves = logs.open(write(block)).solves()
    assert solves.labels["lowest_sigma"] == ("closed_chain",)
    sigma = block.rows["sigma_closed_chain"]
    expected = [sigma[:50].min(), np.nan, sigma[50:].min()]
    np.testing.assert_array_equal(solves.rows["lowest_sigma"][:, 0], np.float32(expected))


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_mcap_and_mcap_ros2_and_rosbags(write: Write, compression: str) -> None:
    """Two independent readers give every row, and schemas and constants are as viewers expect."""
    block = make_block(50, 20, first=2)
    path = write(block, make_block(3, method="hand-first"), compression=compression)
    log = logs.open(path)
    rows = {
        kind: ask(method="enhanced-dls").rows
        for kind, ask in zip(KINDS, (log.iterations, log.solves, log.events), strict=True)
    }
    for kind in KINDS:
        messages = [m.ros_msg for m in read_ros2_messages(path, [f"/ik/enhanced-dls/{kind}"])]
        for message, row in zip(messages, rows[kind], strict=True):
            assert_row(message, row)
    counts = dict.fromkeys(KINDS, 0)
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            _, _, method, kind = connection.topic.split("/")
            if method == "enhanced-dls":
                assert_row(reader.deserialize(raw, connection.msgtype), rows[kind][counts[kind]])
                counts[kind] += 1
        types = reader.typestore.types
        for kind, constant, code in (
            *(("Iteration", "PHASE_HAND_ALIGNMENT", 1), ("Event", "KIND_OSCILLATION", 9)),
            ("Solve", "STATUS_STALLED", 2),
        ):
            assert getattr(types[f"casadi_ik/msg/{kind}EnhancedDlsQ14F3J1"], constant) == code
    assert counts == {kind: len(kind_rows) for kind, kind_rows in rows.items()}
    assert min(counts.values()) > 0
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        kind_rows = list(reader.iter_messages(topics="/ik/enhanced-dls/iteration"))[:50]
    for i, (form, channel, message) in enumerate(kind_rows):
        assert form is not None
        assert (form.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        assert channel.metadata["offered_qos_profiles"] == ""
        assert message.log_time == T0 + 2 * logs.LogClock(T0).slot + i * 1_000_000
        assert message.sequence == i
    first, last = kind_rows[0][2].publish_time, kind_rows[-1][2].publish_time
    assert block.started[0] < first < last == block.started[0] + 250_000_000


NAME = "casadi_ik/msg/Random"
names = st.from_regex(r"[a-z]([a-z0-9]|_[a-z0-9]){0,12}", fullmatch=True)
docs = st.text(string.ascii_letters + string.digits + " .,:;#=[]()/'\"-π→", max_size=30)
units = st.sampled_from(["", "m", "rad", "m/s", "rad or m"])


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    fields = [
        Field(
            name,
            draw(st.lists(st.integers(1, 5), max_size=3).map(tuple)),
            draw(st.sampled_from(STORAGE)),
            draw(units),
            " ".join(draw(docs).split()),
        )
        for name in draw(st.lists(names, min_size=1, max_size=8, unique=True))
    ]
    return Layout.record(*fields)


def flat(value: Any) -> np.ndarray:
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    return np.asarray(value).ravel()


@settings(max_examples=30)
@given(layout=layouts(), data=st.data())
def test_a_row_is_its_own_message(layout: Layout, data: st.DataObject) -> None:
    row = np.frombuffer(
        data.draw(st.binary(min_size=layout.dtype.itemsize, max_size=layout.dtype.itemsize)),
        layout.dtype,
    )[0]
    text = schema_text(layout, dict.fromkeys(layout.names, ("a", "b c")))
    payload = CDR_HEADER + row.tobytes()
    theirs = generate_dynamic(NAME, text)[NAME](payload)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, NAME))
    third = store.deserialize_cdr(payload, NAME)
    for item in layout:
        expected = flat(row[item.name])
        np.testing.assert_array_equal(flat(getattr(theirs, item.name)), expected)
        third_name = item.name if hasattr(third, item.name) else item.name + "_"
        np.testing.assert_array_equal(flat(getattr(third, third_name)), expected)


@settings(max_examples=50)
@given(layout=layouts())
def test_the_layout_comes_back_from_the_schema(layout: Layout) -> None:
    assert parse_layout(schema_text(layout)) == layout


@pytest.mark.parametrize(
    "line",
    [
        "float64 # []",
        "geometry_msgs/Pose pose # []",
        "float64[<=3] q # []",
        "float64[] q # []",
        "string name # []",
        "float64 q",
        "float64[6] q # (2, 2) []",
        "float64[4] q # (999999999, 999999999, 999999999) []",
        "float64[999999999] q # []",
        "uint8 a # []\nfloat64 b # []",
    ],
)
def test_invalid_layout_lines_are_refused(line: str) -> None:
    with pytest.raises(errors.LogError, match="schema: "):
        parse_layout(f"{line}\n")


@pytest.mark.parametrize(
    "layout",
    [
        Layout(()),
        Layout((Field("a", dtype="u1"), Field("b"))),
        Layout((Field("J_arm"),)),
        Layout((Field("a__b"),)),
        Layout((Field("a", (0,)),)),
    ],
)
def test_invalid_layouts_are_refused(layout: Layout) -> None:
    with pytest.raises(errors.LogError):
        schema_text(layout)


GRASP = ik.load_grasp("cup")


def repeated(solve: logs.SolveRecord) -> ik.Solution:
    """Return the solution of the same target by a solver that is built from the log."""
    contacts = {
        finger: ik.Contact(point, None if np.isnan(normal).any() else normal, tolerance)
        for finger, point, normal, tolerance in zip(
            solve.fingers, solve.target_points, solve.target_normals, solve.tolerances, strict=True
        )
        if not np.isnan(point).any()
    }
    target = solve.target
    solver = ik.Solver(ik.load_robot(solve.robot), solve.method, limits=target.limits)
    return solver.solve(
        ik.Grasp(contacts),
        q0=target.start,
        seed=target.seed,
        fixed=target.fixed,
        prefer=target.prefer,
    )


@pytest.mark.parametrize("limits", ["enforce", "ignore"])
def test_a_solve_is_repeated_from_its_log(tmp_path: Path, limits: str) -> None:
    """The log keeps tolerances, a free normal, a start, a seed and a fixed actuator."""
    robot = ik.load_robot("kuka_lwr_barrett")
    contacts = dict(GRASP.contacts)
    contacts["thumb"] = ik.Contact(contacts["thumb"].point, None, ik.Tolerance(1e-5, 0.2))
    fixed = {"lwr_joint_3": 0.2, "bh_spread": float(robot.upper[7])}
    q0 = robot.random(np.random.default_rng(5), 1)[0]
    path = tmp_path / "target.mcap"
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-3, 0.01), limits=limits)
    first = solver.solve(ik.Grasp(contacts), q0=q0, seed=12345678901, fixed=fixed, log=path)
    solve = logs.one_solve(logs.open(path))
    target = solve.target
    assert (target.limits, target.seed, target.fixed) == (limits, 12345678901, fixed)
    free = [name not in fixed for name in robot.actuators]
    assert target.start is not None
    np.testing.assert_array_equal(target.start[free], q0[free])
    assert target.tolerances == (ik.Tolerance(1e-5, 0.2), *(ik.Tolerance(1e-3, 0.01),) * 2)
    repeated_solution = repeated(solve)
    assert (repeated_solution.status, repeated_solution.iterations, repeated_solution.restarts) == (
        *(first.status, first.iterations, first.restarts),
    )
    # Normalising a unit normal again may change its last bit.
    np.testing.assert_allclose(repeated_solution.q, first.q, rtol=0, atol=1e-9)
    limited_solution = ik.Solver(robot, limits=limits).solve(GRASP)
    assert not np.allclose(limited_solution.q, first.q, atol=1e-3)


def test_fixed_actuators_beyond_one_word(write: Callable[..., Path]) -> None:
    block = make_block(3)
    fixed = np.full(40, np.nan)
    fixed[[1, 33]] = 0.5, -0.25
    points, normals = block.targets.points, block.targets.normals
    wide = changed(
        block,
        q=np.zeros((1, 40)),
        targets=TargetBatch(
            points, normals, ik.Tolerance(), enforce_limits=False, fixed=fixed, q0=np.ones((1, 40))
        ),
    )
    log = logs.open(write(wide))
    assert log.solves().rows["fixed_mask"].shape == (1, 2)
    solve = logs.one_solve(log)
    assert list(solve.target.fixed.values()) == [0.5, -0.25]
    assert solve.target.limits == "ignore"
    assert solve.target.start is not None
    assert solve.target.start[[0, 1, 33]].tolist() == [1.0, 0.5, -0.25]
