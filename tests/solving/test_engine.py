"""The engine around a method with given answers: verdict, threads, record."""

from __future__ import annotations

import dataclasses
import pickle
import sys
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from toy_robots import grasp_at, replace
from trace_checks import TraceRecorder

import casadi_ik as ik
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.engine import Engine, SolveOptions
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.verdict import judge


class Answering:
    """Method that returns q0 of every target with a given status."""

    name, trace_format = "answering", None
    preferences, hand_search = (), None

    def __init__(self, status=ik.Status.SOLVED):
        self.status = status

    def prepare(self):
        """Do nothing."""

    def run(self, targets, trace=False):
        k = len(targets)
        return Outcome(
            q=targets.q0,
            status=np.full(k, int(self.status)),
            iterations=np.ones(k, dtype=np.int64),
            restarts=np.zeros(k, dtype=np.int64),
            time=np.full(k, 0.5),
            phases={"only": np.ones(k, dtype=np.int64)},
        )


def targets(robot, q, q0, enforce=True):
    points, normals = robot.contacts(q)
    return TargetBatch(points, normals, ik.Tolerance(), enforce, q0=q0)


@pytest.mark.parametrize("enforce", [True, False])
def test_limits_are_part_of_success_where_enforced(robot, enforce):
    """The method reports success and the contacts are met, but a motor exceeds its limit."""
    q = np.tile(robot.home, (2, 1))
    q[1, 6] = robot.upper[6] + 0.01
    batch = Engine(robot, Answering()).solve(targets(robot, q, q, enforce), SolveOptions())
    np.testing.assert_array_equal(batch.limits_ok, [True, False])
    np.testing.assert_array_equal(batch.success, [True, not enforce])
    assert list(batch.status_names) == ["SOLVED", "STALLED" if enforce else "SOLVED"]


@pytest.mark.parametrize(
    "status", [ik.Status.ITERATION_LIMIT, ik.Status.STALLED, ik.Status.INVALID]
)
def test_verdict_overrides_the_method(robot, status):
    """Targets whose contacts are met are solved; others keep the status of the method."""
    q = np.tile(robot.home, (2, 1))
    goals = q.copy()
    goals[1, 0] += 0.5
    batch = Engine(robot, Answering(status)).solve(targets(robot, goals, q), SolveOptions())
    assert list(batch.status_names) == ["SOLVED", status.name]
    np.testing.assert_array_equal(batch.success, [True, False])


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_solve_is_recorded_once_and_in_order(robot, rng, jobs):
    """Solves are recorded in parts, each with the rows of its iterations."""
    points, normals = robot.contacts(robot.random(rng, 300))
    recorder = TraceRecorder()
    batch = ik.Solver(robot).solve_batch(points, normals, jobs=jobs, log=recorder)
    assert len(recorder.blocks) > 1
    assert sorted(i for b in recorder.blocks for i in range(b.first, b.first + len(b))) == [
        *range(300)
    ]
    for block in recorder.blocks:
        rows = slice(block.first, block.first + len(block))
        np.testing.assert_array_equal(block.batch.q, batch.q[rows])
        np.testing.assert_array_equal(block.targets.points, points[rows])
        assert len(block.rows) == batch.iterations[rows].sum()
        last = block.rows[np.cumsum(batch.iterations[rows]) - 1]
        np.testing.assert_array_equal(last["status"], batch.status[rows])


def test_solution_has_every_field(robot: ik.ArmHand) -> None:
    solution = ik.Solver(robot).solve(grasp_at(robot, robot.home))
    for result in (solution, *solution.contacts.values()):
        names = [field.name for field in dataclasses.fields(result)]
        for copied in (dataclasses.replace(result), pickle.loads(pickle.dumps(result))):
            for name in names:
                assert repr(getattr(copied, name)) == repr(getattr(result, name))


def problems(points, normals, **tolerance):
    return TargetBatch(points, normals, ik.Tolerance(**tolerance), True)


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
    verdicts = judge(robot, problems(points, normals), q)
    np.testing.assert_array_equal(verdicts.ok[:, 0], [True, False, True, True])
    np.testing.assert_array_equal(verdicts.ok[:, 1], [True, True, True, False])
    np.testing.assert_allclose(verdicts.angle_error[2:, 1], np.radians([2.99, 3.01]), rtol=1e-9)


def test_small_and_opposite_angles_are_exact(robot):
    points, normals = (x[None] for x in robot.contacts(robot.home))
    tiny = 1e-9
    across = np.cross(normals[0, 0], [0.3, 0.4, 0.5])
    turned_normals = normals.copy()
    turned_normals[0, 0] = normals[0, 0] + tiny * across / np.linalg.norm(across)
    turned_normals[0, 1] = -normals[0, 1]
    verdicts = judge(robot, problems(points, turned_normals), robot.home[None])
    np.testing.assert_allclose(verdicts.angle_error[0, :2], [tiny, np.pi], rtol=1e-6)


def limits_ok(robot, q):
    points, normals = robot.contacts(robot.home)
    return judge(robot, problems(points[None], normals[None]), q).limits_ok


def test_free_components_are_met(robot):
    points, normals = (x[None].copy() for x in robot.contacts(robot.home))
    points[0, 0] = normals[0, 0] = normals[0, 1] = np.nan
    points[0, 2] += 1.0
    verdicts = judge(robot, problems(points, normals), robot.home[None])
    np.testing.assert_array_equal(verdicts.ok[0], [True, True, False])
    assert np.isnan(verdicts.position_error[0, 0])
    assert np.isnan(verdicts.angle_error[0, :2]).all()


def test_limits_of_every_motor(robot):
    for i in range(14):
        for limit, outward in ((robot.lower, -1), (robot.upper, 1)):
            q = np.tile(robot.home, (2, 1))
            q[:, i] = limit[i]
            q[1, i] += outward * 1e-6
            np.testing.assert_array_equal(limits_ok(robot, q), [True, False])


def test_limits_of_a_coupled_joint(own_robot):
    """A joint with narrower limits than its motor is judged by its own limits."""
    hand = own_robot.with_name("hand.yaml")
    text = hand.read_text()
    at = text.index("name: bh_finger_3_spread")
    hand.write_text(text[:at] + text[at:].replace("[0 deg, 180 deg]", "[0 deg, 60 deg]", 1))
    replace(own_robot, "bh_spread: 30 deg", "bh_spread: 20 deg")
    robot = ik.load_robot(own_robot)
    q = np.tile(robot.home, (2, 1))
    q[:, 7] = np.radians([59, 61])
    np.testing.assert_array_equal(limits_ok(robot, q), [True, False])


def test_a_solve_enters_few_files(robot: ik.ArmHand) -> None:
    """A reader follows a solve through twelve Python files at most, and q0 through ten."""
    solver, grasp = ik.Solver(robot), grasp_at(robot, robot.home)
    solver._engine.method.prepare()
    assert solver.solve(grasp, q0=robot.home).success
    package = Path(ik.__file__).parent
    files, files_of_q0 = set[str](), set[str]()

    def record_file(frame: FrameType, event: str, _: object) -> None:
        if event == "return" and Path(frame.f_code.co_filename).is_relative_to(package):
            files.add(frame.f_code.co_filename)
            if {"q0", "start", "starts", "targets"} & frame.f_locals.keys():
                files_of_q0.add(frame.f_code.co_filename)

    sys.setprofile(record_file)
    try:
        solver.solve(grasp, q0=robot.home)
    finally:
        sys.setprofile(None)
    assert 1 < len(files) <= 12, files
    assert 1 < len(files_of_q0) <= 10, files_of_q0
