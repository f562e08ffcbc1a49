"""The engine around a method that answers what it is told: verdict, threads, record."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.problem.trace import TraceFormat
from casadi_ik.solving.batch_parts import CACHED_BYTES, ENOUGH, FIRST_PART, PART_BYTES, BatchParts
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.run import Run

LAYOUT = Layout.record(Field("row", (), "f8"))


class Answering:
    """Gives for every target the q0 it was given, and the status it was made with."""

    name = "answering"

    def __init__(self, status=ik.Status.SOLVED):
        self.status = status
        self.prepared = 0
        self.calls = []

    @property
    def trace_format(self):
        return TraceFormat(LAYOUT, {"row": ("a",)})

    @property
    def parameters(self):
        return {}

    def prepare(self):
        self.prepared += 1

    def run(self, problems, q0, seed, trace):
        self.calls.append((len(problems), seed, trace))
        k = len(problems)
        rows = np.zeros(k, LAYOUT.dtype)
        rows["row"] = problems.first_row + np.arange(k)
        return Outcome(
            q=q0,
            status=np.full(k, int(self.status)),
            iterations=np.ones(k, dtype=np.int64),
            restarts=np.zeros(k, dtype=np.int64),
            time=np.full(k, 0.5),
            phases={"only": np.ones(k, dtype=np.int64)},
            rows=rows if trace else None,
        )


class Keeping:
    """A recorder that keeps what it is given."""

    def __init__(self):
        self.blocks = []

    def record(self, block):
        self.blocks.append(block)


def targets(robot, q, enforce=True):
    points, normals = robot.contacts(q)
    return TargetBatch(points, normals, ik.Tolerance(), enforce)


@pytest.mark.parametrize("enforce", [True, False])
def test_limits_are_part_of_success_where_enforced(robot, enforce):
    """The method is sure of itself, the contacts are met, but a motor is beyond its limit."""
    q = np.tile(robot.home, (2, 1))
    q[1, 6] = robot.upper[6] + 0.01
    batch = Engine(robot, Answering()).solve(targets(robot, q, enforce), Run(q))
    np.testing.assert_array_equal(batch.limits_ok, [True, False])
    np.testing.assert_array_equal(batch.success, [True, not enforce])
    assert list(batch.status_names) == ["SOLVED", "STALLED" if enforce else "SOLVED"]


@pytest.mark.parametrize(
    "status", [ik.Status.ITERATION_LIMIT, ik.Status.STALLED, ik.Status.INVALID]
)
def test_the_verdict_outvotes_the_method(robot, status):
    """What meets its contacts is solved; what does not keeps the method's word for it."""
    q = np.tile(robot.home, (2, 1))
    goals = q.copy()
    goals[1, 0] += 0.5
    batch = Engine(robot, Answering(status)).solve(targets(robot, goals), Run(q))
    assert list(batch.status_names) == ["SOLVED", status.name]
    np.testing.assert_array_equal(batch.success, [True, False])


def test_threads_share_a_batch_in_order(robot, rng):
    q = robot.random(rng, 11)
    method = Answering()
    batch = Engine(robot, method).solve(targets(robot, q), Run(q, 5, jobs=3))
    assert method.prepared == 1
    assert sorted(count for count, _, _ in method.calls) == [3, 4, 4]
    assert {seed for _, seed, _ in method.calls} == {5}
    np.testing.assert_array_equal(batch.q, q)
    assert batch.success.all()
    np.testing.assert_array_equal(batch.phases["only"], np.ones(11))


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_solve_is_recorded_once_and_in_order(robot, rng, jobs):
    """In parts, the first of a fixed size, the others as large as the memory set aside for them."""
    q = robot.random(rng, 300)
    keeping = Keeping()
    problems = targets(robot, q)
    method = Answering()
    batch = Engine(robot, method).solve(problems, Run(q, 9, jobs=jobs, recorder=keeping))
    assert method.prepared == 1
    assert len(keeping.blocks) > 1
    assert keeping.blocks[0].first == 0
    assert sum(len(block) for block in keeping.blocks) == 300
    for block in keeping.blocks:
        rows = slice(block.first, block.first + len(block))
        assert (block.method, block.robot, block.fingers) == (
            "answering",
            robot.name,
            robot.fingers,
        )
        assert block.batch.success.all()
        assert block.format.labels == {"row": ("a",)}
        np.testing.assert_array_equal(np.diff(block.started), 500_000_000)
        np.testing.assert_array_equal(block.batch.q, batch.q[rows])
        np.testing.assert_array_equal(block.targets.points, problems.points[rows])
        np.testing.assert_array_equal(block.rows["row"], np.arange(rows.start, rows.stop))


@pytest.mark.parametrize(
    ("bytes_per_solve", "size"),
    [
        (CACHED_BYTES // 2**10, 2**10),
        (PART_BYTES // ENOUGH, ENOUGH),
        (PART_BYTES // 100, 100),
        (2**30, 1),
        (1, 10**6),
    ],
)
def test_parts_are_as_large_as_their_iterations_allow(bytes_per_solve, size):
    parts = BatchParts(10**6, 1, trace=True)
    found = []
    for part in parts:
        found.append(part)
        parts.learn(part.stop - part.start, bytes_per_solve * (part.stop - part.start))
        if len(found) == 3:
            break
    assert found[0] == slice(0, FIRST_PART)
    assert found[1].stop - found[1].start == min(size, (10**6 - FIRST_PART) // 2)


def test_little_is_left_to_record_when_all_are_solved():
    parts = BatchParts(10_000, 1, trace=True)
    sizes = []
    for part in parts:
        sizes.append(part.stop - part.start)
        parts.learn(10, 10 * CACHED_BYTES // 4000)
    assert sum(sizes) == 10_000
    assert sizes[1:4] == [4000, 2968, 1484]
    assert sizes[-1] <= ENOUGH


@pytest.mark.parametrize(("count", "jobs", "sizes"), [(0, 2, [0]), (5, 2, [3, 2]), (1, 4, [1])])
def test_without_a_trace_there_is_a_part_for_each_thread(count, jobs, sizes):
    parts = list(BatchParts(count, jobs, trace=False))
    assert [part.stop - part.start for part in parts] == sizes


def test_a_quick_answer_has_every_field(robot: ik.ArmHand) -> None:
    points, normals = robot.contacts(robot.home)
    contacts = map(ik.Contact, points, normals)
    solution = ik.Solver(robot).solve(ik.Grasp(dict(zip(robot.fingers, contacts, strict=True))))
    for one in (solution, *solution.contacts.values()):
        needed = {f.name for f in dataclasses.fields(one) if f.default is dataclasses.MISSING}
        names = {f.name for f in dataclasses.fields(one)}
        assert needed <= vars(one).keys() <= names
        for again in (dataclasses.replace(one), pickle.loads(pickle.dumps(one))):
            for name in names:
                assert repr(getattr(again, name)) == repr(getattr(one, name))
