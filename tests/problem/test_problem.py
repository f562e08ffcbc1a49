"""Targets as arrays, and the verdict on what came out."""

from __future__ import annotations

import numpy as np
import pytest
from pinocchio_oracle import verdict
from toy_robots import replace

import casadi_ik as ik
from casadi_ik.problem.targets import TargetBatch, target_arrays
from casadi_ik.problem.verdict import judge


def arrays(k=2, f=3):
    rng = np.random.default_rng(5)
    return rng.normal(size=(k, f, 3)), rng.normal(size=(k, f, 3))


def test_normals_become_unit():
    points, normals = arrays()
    p, n = target_arrays(points, 7 * normals, 3)
    np.testing.assert_array_equal(p, points)
    np.testing.assert_allclose(np.linalg.norm(n, axis=2), 1.0, rtol=1e-15)
    np.testing.assert_allclose(np.cross(n, normals), 0, atol=1e-14)


def test_free_fingers_and_normals_stay_nan():
    points, normals = arrays()
    points[0, 1] = normals[0, 1] = normals[1, 2] = np.nan
    p, n = target_arrays(points, normals, 3)
    assert np.isnan(p[0, 1]).all()
    assert np.isnan(n[[0, 1], [1, 2]]).all()
    assert np.isnan(p).sum() == 3
    assert np.isnan(n).sum() == 6


def spoiled(which, index, value):
    points, normals = arrays()
    (points if which == "points" else normals)[index] = value
    return points, normals


@pytest.mark.parametrize(
    ("points", "normals", "says"),
    [
        (*spoiled("points", (1, 2, 0), np.nan), "points: row 1, finger 2 is partly NaN"),
        (*spoiled("normals", (0, 1, 2), np.nan), "normals: row 0, finger 1 is partly NaN"),
        (*spoiled("points", (1, 0), np.inf), "points: row 1, finger 0 is infinite"),
        (*spoiled("normals", (1, 0, 1), -np.inf), "normals: row 1, finger 0 is infinite"),
        (*spoiled("normals", (0, 2), 0.0), "normals: row 0, finger 2 is zero"),
        (
            *spoiled("points", (0, 1), np.nan),
            "normals: row 0, finger 1 is given for a finger without",
        ),
        (np.full((1, 3, 3), np.nan), np.full((1, 3, 3), np.nan), "points: row 0 has no contact"),
        (*arrays(f=2), "points: found shape (2, 2, 3), expected (k, 3, 3)"),
        (arrays()[0][0], arrays()[1], "points: found shape (3, 3), expected (k, 3, 3)"),
        (arrays()[0], arrays(k=3)[1], "points and normals: found 2 and 3 rows"),
        ("here", arrays()[1], "points: expected an array of numbers"),
        (arrays()[0], [[1, 2], [3]], "normals: expected an array of numbers"),
    ],
)
def test_malformed_targets(points, normals, says):
    with pytest.raises(ik.errors.InputError) as caught:
        target_arrays(points, normals, 3)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_direction_is_a_normal_without_a_point():
    points, normals = arrays()
    directions = np.full_like(normals, np.nan)
    directions[0, 1] = 3 * normals[0, 1]
    points[0, 1] = normals[0, 1] = np.nan
    p, n = target_arrays(points, normals, 3, directions=directions)
    np.testing.assert_allclose(n, target_arrays(*arrays(), 3)[1], atol=1e-15)
    assert np.isnan(p[0, 1]).all()
    assert np.isnan(p).sum() == 3
    only, _ = target_arrays(*np.full((2, 1, 3, 3), np.nan), 3, directions=arrays(k=1)[1])
    assert np.isnan(only).all()


@pytest.mark.parametrize(
    ("directions", "says"),
    [
        (arrays()[1], "directions: row 4, finger 0 has a point too, expected it alone"),
        (np.zeros((2, 3, 3)), "directions: row 4, finger 0 is zero, expected a direction"),
        (np.full((2, 3, 3), np.inf), "directions: row 4, finger 0 is infinite"),
        (arrays(k=3)[1], "points and directions: found 2 and 3 rows, expected as many"),
        (arrays(f=2)[1], "directions: found shape (2, 2, 3), expected (k, 3, 3)"),
        ("up", "directions: expected an array of numbers"),
    ],
)
def test_malformed_directions(directions, says):
    with pytest.raises(ik.errors.InputError) as caught:
        target_arrays(*arrays(), 3, 4, directions)
    assert says in str(caught.value)


@pytest.mark.parametrize("value", [0, -1e-3, float("nan"), float("inf"), "5 mm", None])
def test_tolerance_is_a_positive_number(value):
    with pytest.raises(
        ik.errors.InputError, match=r"tolerance\.position: found .*, expected a number > 0"
    ):
        ik.Tolerance(position=value)
    with pytest.raises(ik.errors.InputError, match=r"tolerance\.angle"):
        ik.Tolerance(angle=value)


def test_default_tolerance_is_the_papers():
    assert ik.Tolerance() == ik.Tolerance(position=0.005, angle=np.deg2rad(3))


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
