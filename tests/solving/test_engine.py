"""The engine around a method that answers what it is told: verdict, threads, record."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from pinocchio_oracle import verdict
from toy_robots import replace

import casadi_ik as ik
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.problem.trace import TraceFormat
from casadi_ik.problem.verdict import judge
from casadi_ik.solving.batch_parts import CACHED_BYTES, ENOUGH, FIRST_PART, PART_BYTES, BatchParts
from casadi_ik.solving.engine import Engine, Run

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


def test_parts_of_a_batch_keep_the_numbers_of_their_targets():
    points = np.zeros((10, 3, 3))
    problems = TargetBatch(points, points, ik.Tolerance(), True, first_row=100)
    assert problems.rows(slice(4, 8)).first_row == 104
    assert problems.rows(slice(4, 8)).rows(slice(1, None)).first_row == 105
    assert problems.rows(slice(-2, None)).first_row == 108
    assert problems.rows(slice(0, 0)).first_row == 100
    assert len(problems.rows(np.array([7, 2]))) == 2
    assert problems.rows(np.array([7, 2])).first_row == 0


def problems(points, normals, **tolerance):
    return TargetBatch(points, normals, ik.Tolerance(**tolerance), True)


def test_errors_are_pinocchios(robot, oracle, rng):
    q, goals = robot.random(rng, 10), robot.random(rng, 10)
    points, normals = robot.contacts(goals)
    found = judge(robot, problems(points, normals), q)
    for i in range(10):
        position, angle = verdict(oracle, q[i], points[i], normals[i])
        np.testing.assert_allclose(found.position_error[i], position, atol=1e-12)
        np.testing.assert_allclose(found.angle_error[i], angle, atol=1e-12)


def test_edge_of_the_tolerances(robot):
    q = np.tile(robot.home, (4, 1))
    points, normals = robot.contacts(q)
    points[0, 0] += [0.0049, 0, 0]
    points[1, 0] += [0.0051, 0, 0]
    for row, angle in ((2, 2.99), (3, 3.01)):
        across = np.cross(normals[row, 1], [0.3, 0.4, 0.5])
        across /= np.linalg.norm(across)
        turn = np.radians(angle)
        normals[row, 1] = np.cos(turn) * normals[row, 1] + np.sin(turn) * across
    found = judge(robot, problems(points, normals), q)
    np.testing.assert_array_equal(found.ok[:, 0], [True, False, True, True])
    np.testing.assert_array_equal(found.ok[:, 1], [True, True, True, False])
    np.testing.assert_allclose(found.angle_error[2:, 1], np.radians([2.99, 3.01]), rtol=1e-9)


def test_small_and_opposite_angles_are_exact(robot):
    points, normals = (x[None] for x in robot.contacts(robot.home))
    tiny = 1e-9
    across = np.cross(normals[0, 0], [0.3, 0.4, 0.5])
    turned = normals.copy()
    turned[0, 0] = normals[0, 0] + tiny * across / np.linalg.norm(across)
    turned[0, 1] = -normals[0, 1]
    found = judge(robot, problems(points, turned), robot.home[None])
    np.testing.assert_allclose(found.angle_error[0, :2], [tiny, np.pi], rtol=1e-6)


def limits_ok(robot, q):
    points, normals = robot.contacts(robot.home)
    return judge(robot, problems(points[None], normals[None]), q).limits_ok


def test_what_is_free_is_met(robot):
    points, normals = (x[None].copy() for x in robot.contacts(robot.home))
    points[0, 0] = normals[0, 0] = normals[0, 1] = np.nan
    points[0, 2] += 1.0
    found = judge(robot, problems(points, normals), robot.home[None])
    np.testing.assert_array_equal(found.ok[0], [True, True, False])
    assert np.isnan(found.position_error[0, 0])
    assert np.isnan(found.angle_error[0, :2]).all()


def test_limits_of_every_motor(robot):
    for i in range(14):
        for limit, outward in ((robot.lower, -1), (robot.upper, 1)):
            q = np.tile(robot.home, (2, 1))
            q[:, i] = limit[i]
            q[1, i] += outward * 1e-6
            np.testing.assert_array_equal(limits_ok(robot, q), [True, False])


def test_limits_of_a_coupled_joint(own_robot):
    """A joint narrower than its motor counts on its own."""
    hand = own_robot.with_name("hand.yaml")
    text = hand.read_text()
    at = text.index("name: bh_finger_3_spread")
    hand.write_text(text[:at] + text[at:].replace("[0 deg, 180 deg]", "[0 deg, 60 deg]", 1))
    replace(own_robot, "bh_spread: 30 deg", "bh_spread: 20 deg")
    robot = ik.load_robot(own_robot)
    q = np.tile(robot.home, (2, 1))
    q[:, 7] = np.radians([59, 61])
    np.testing.assert_array_equal(limits_ok(robot, q), [True, False])
