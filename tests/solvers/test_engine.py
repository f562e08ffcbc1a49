"""The engine around a method that answers what it is told: verdict, threads, record."""

from __future__ import annotations

import numpy as np
import pytest

from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.solvers import Engine, Problems, Status, Tolerance
from casadi_ik.solvers.method import Outcome, TraceFormat

LAYOUT = Layout.record(Field("row", (), "f8"))


class Answering:
    """Gives for every target the q0 it was given, and the status it was made with."""

    name = "answering"

    def __init__(self, status=Status.SOLVED):
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
        rows = np.zeros(1, LAYOUT.dtype)
        return Outcome(
            q=q0,
            status=np.full(k, int(self.status)),
            iterations=np.ones(k, dtype=np.int64),
            restarts=np.zeros(k, dtype=np.int64),
            time=np.full(k, 0.5),
            phases={"only": np.ones(k, dtype=np.int64)},
            trace=tuple(rows for _ in range(k)) if trace else (),
        )


class Keeping:
    """A recorder that keeps what it is given."""

    def __init__(self):
        self.solves = []

    def record(self, solve):
        self.solves.append(solve)


def targets(robot, q, enforce=True):
    points, normals = robot.contacts(q)
    return Problems(points, normals, Tolerance(), enforce)


@pytest.mark.parametrize("enforce", [True, False])
def test_limits_are_part_of_success_where_enforced(robot, enforce):
    """The method is sure of itself, the contacts are met, but a motor is beyond its limit."""
    q = np.tile(robot.home, (2, 1))
    q[1, 6] = robot.upper[6] + 0.01
    batch = Engine(robot, Answering()).solve(targets(robot, q, enforce), q, 0)
    np.testing.assert_array_equal(batch.limits_ok, [True, False])
    np.testing.assert_array_equal(batch.success, [True, not enforce])
    assert list(batch.status_names) == ["SOLVED", "STALLED" if enforce else "SOLVED"]


@pytest.mark.parametrize("status", [Status.ITERATION_LIMIT, Status.STALLED, Status.INVALID])
def test_the_verdict_outvotes_the_method(robot, status):
    """What meets its contacts is solved; what does not keeps the method's word for it."""
    q = np.tile(robot.home, (2, 1))
    goals = q.copy()
    goals[1, 0] += 0.5
    batch = Engine(robot, Answering(status)).solve(targets(robot, goals), q, 0)
    assert list(batch.status_names) == ["SOLVED", status.name]
    np.testing.assert_array_equal(batch.success, [True, False])


def test_threads_share_a_batch_in_order(robot, rng):
    q = robot.random(rng, 11)
    method = Answering()
    batch = Engine(robot, method).solve(targets(robot, q), q, 5, jobs=3)
    assert method.prepared == 1
    assert sorted(count for count, _, _ in method.calls) == [3, 4, 4]
    assert {seed for _, seed, _ in method.calls} == {5}
    np.testing.assert_array_equal(batch.q, q)
    assert batch.success.all()
    np.testing.assert_array_equal(batch.phases["only"], np.ones(11))


def test_every_solve_is_recorded_once(robot, rng):
    q = robot.random(rng, 6)
    keeping = Keeping()
    problems = targets(robot, q)
    batch = Engine(robot, Answering()).solve(problems, q, 9, jobs=2, recorder=keeping)
    assert [solve.summary.solve_id for solve in keeping.solves] == list(range(6))
    starts = [solve.summary.started for solve in keeping.solves]
    np.testing.assert_array_equal(np.diff(starts), 500_000_000)
    for row, solve in enumerate(keeping.solves):
        summary = solve.summary
        assert (summary.method, summary.robot, summary.seed) == ("answering", robot.name, 9)
        assert (summary.status, summary.success) == ("SOLVED", True)
        assert summary.phase_iterations == {"only": 1}
        assert solve.labels == {"row": ("a",)}
        np.testing.assert_array_equal(summary.q, batch.q[row])
        np.testing.assert_array_equal(summary.target_points, problems.points[row])
        assert len(solve.trace) == 1
