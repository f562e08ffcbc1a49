"""Diagnoses where less is asked or less may move: free fingers, fixed actuators, another arm."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import derived_robot

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.problem.problems import Problems


@pytest.fixture(scope="module")
def cup(robot: ik.ArmHand) -> tuple[Array, Array]:
    """Contacts that can be reached."""
    return ik.load_grasp("cup").arrays(robot.fingers)


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> ik.ArmHand:
    """The arm with its elbow off the links: no closed form."""
    return derived_robot(tmp_path_factory.mktemp("bent"), wrist_offset=0.045)


def diagnosed(
    solver: ik.Solver, points: Array, normals: Array, **options: dict[str, float]
) -> ik.BatchSolution:
    return solver.solve_batch(points, normals, diagnose=True, **options)


@pytest.mark.parametrize("finger", range(3))
def test_free_finger(robot: ik.ArmHand, cup: tuple[Array, Array], finger: int) -> None:
    """What two fingers reach is never unreachable; what they do not is said to be too far."""
    solver, rng = ik.Solver(robot), np.random.default_rng(finger)
    q = robot.random(rng, 200)
    q = np.where(rng.random(q.shape) < 0.3, robot.upper, q)
    points, normals = robot.contacts(q)
    points[:, finger], normals[:, finger] = np.nan, np.nan
    assert diagnosed(solver, points, normals).success.all()

    points, normals = cup[0][None] - [1.0, 0, 0], cup[1][None].copy()
    points[:, finger], normals[:, finger] = np.nan, np.nan
    far = diagnosed(solver, points, normals)
    (why,) = far.diagnoses
    assert far.status_names.tolist() == ["UNREACHABLE"]
    assert why is not None
    assert why.reason is ik.answers.Reason.REACH
    assert np.isnan(why.nearest[robot.fingers[finger]].position_error)
    assert robot.fingers[finger] not in {item.finger for item in why.freed}


def test_fixed_actuators(robot: ik.ArmHand, cup: tuple[Array, Array]) -> None:
    """They are nobody's relief, and what can be reached without them is never unreachable."""
    solver, rng = ik.Solver(robot), np.random.default_rng(4)
    for name in ("lwr_joint_3", "bh_spread"):
        column = robot.actuators.index(name)
        value = float(0.6 * robot.lower[column] + 0.4 * robot.upper[column])
        q = robot.random(rng, 200)
        q[:, column] = value
        batch = diagnosed(solver, *robot.contacts(q), fixed={name: value})
        assert batch.success.all(), batch.status_names[~batch.success]

    closed = diagnosed(solver, cup[0][None], cup[1][None], fixed={"bh_spread": 2.5})
    (why,) = closed.diagnoses
    assert set(closed.status_names) <= {"UNREACHABLE", "NOT_FOUND"}
    assert why is not None
    assert why.reason is ik.answers.Reason.HAND
    assert why.q[robot.actuators.index("bh_spread")] == pytest.approx(2.5)
    for relief in why.reliefs:
        assert "bh_spread" not in relief.beyond
        assert relief.q[robot.actuators.index("bh_spread")] == pytest.approx(2.5)


def test_arm_without_a_closed_form(bent: ik.ArmHand) -> None:
    solver, rng = ik.Solver(bent), np.random.default_rng(5)
    batch = diagnosed(solver, *bent.contacts(bent.random(rng, 150)))
    assert "UNREACHABLE" not in batch.status_names
    assert batch.success.all()

    points, normals = bent.contacts(bent.home)
    wide = points + 0.25 * np.array([[0, 1, 0], [1, -1, 0], [-1, -1, 0]])
    (why,) = diagnosed(solver, wide[None], normals[None]).diagnoses
    assert why is not None
    assert why.reason is ik.answers.Reason.HAND
    assert why.established

    # What such an arm can span is not known: too far is seen, but not called by its name.
    far = diagnosed(solver, points[None] + [3.0, 0, 0], normals[None])
    (why,) = far.diagnoses
    assert not far.success[0]
    assert why is not None
    assert why.reach is None
    assert why.reason is not ik.answers.Reason.HAND
    assert why.enough.position > 1.0


def test_a_bad_start_never_makes_it_unreachable(robot: ik.ArmHand) -> None:
    """The diagnosis alone, from what a method that gave up at once would hand it."""
    rng = np.random.default_rng(6)
    count = 1200
    q = robot.random(rng, count)
    q = np.where(rng.random(q.shape) < 0.4, robot.lower, q)
    points, normals = robot.contacts(q)
    asked = Problems(points, normals, ik.Tolerance(), True)
    starts = np.tile(robot.home, (count, 1))
    diagnostician = ik.Solver(robot)._engine.diagnostician
    found = diagnostician.diagnose(asked, starts, robot.random(rng, count))
    assert {diagnosis.reason for diagnosis in found} == {ik.answers.Reason.REACHABLE}
    reached, _ = robot.contacts(np.stack([diagnosis.q for diagnosis in found]))
    assert np.linalg.norm(reached - points, axis=2).max() < 5.01e-3
