"""The verdict: errors against pinocchio, tolerances at their edge, limits of joints and motors."""

from __future__ import annotations

import numpy as np
import pytest
from pinocchio_oracle import verdict
from toy_robots import replace

import casadi_ik as ik
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import judge


def problems(points, normals, **tolerance):
    return Problems(points, normals, ik.Tolerance(**tolerance), True)


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


@pytest.mark.parametrize("limits", ["enforce", "ignore"])
def test_success_counts_limits_only_where_they_are_enforced(robot, limits):
    """A start that meets every contact from beyond a limit."""
    q = robot.home.copy()
    q[6] = robot.upper[6] + 0.1
    points, normals = robot.contacts(q)
    solver = ik.Solver(robot, "enhanced-dls", limits=limits, finger_step="closed-form")
    batch = solver.solve_batch(points[None], normals[None], q0=q)
    if limits == "ignore":
        assert batch.success[0]
        assert not batch.limits_ok[0]
        np.testing.assert_allclose(batch.q[0, 6], q[6], atol=0.2)
    else:
        assert batch.limits_ok[0]
    assert batch.success[0] == bool(
        batch.ok[0].all() and (limits == "ignore" or batch.limits_ok[0])
    )
