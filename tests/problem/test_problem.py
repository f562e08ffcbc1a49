"""Targets as arrays: meaning and refusals."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik


def arrays(k=2, f=3):
    rng = np.random.default_rng(5)
    return rng.normal(size=(k, f, 3)), rng.normal(size=(k, f, 3))


@pytest.fixture(scope="module")
def solver(robot):
    return ik.Solver(robot, compiled=False)


def test_normal_length_is_ignored(robot, solver):
    points, normals = (x[None] for x in robot.contacts(robot.home))
    usual, longer = (solver.solve_batch(points, scale * normals) for scale in (1, 7))
    assert longer.success.all()
    np.testing.assert_allclose(longer.q, usual.q, atol=1e-9)
    np.testing.assert_allclose(longer.angle_error, usual.angle_error, atol=1e-9)


def test_free_components_have_no_error(robot, solver):
    points, normals = (x[None].repeat(2, axis=0) for x in robot.contacts(robot.home))
    points[0, 1] = normals[0, 1] = normals[1, 2] = np.nan
    batch = solver.solve_batch(points, normals)
    assert batch.success.all()
    assert np.argwhere(np.isnan(batch.position_error)).tolist() == [[0, 1]]
    assert np.argwhere(np.isnan(batch.angle_error)).tolist() == [[0, 1], [1, 2]]


def spoiled(field, index, value):
    points, normals = arrays()
    (points if field == "points" else normals)[index] = value
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
            "normals: row 0, finger 1 has a normal but no point",
        ),
        (np.full((1, 3, 3), np.nan), np.full((1, 3, 3), np.nan), "points: row 0 has no contact"),
        (*arrays(f=2), "points: found shape (2, 2, 3), expected (k, 3, 3)"),
        (arrays()[0][0], arrays()[1], "points: found shape (3, 3), expected (k, 3, 3)"),
        (arrays()[0], arrays(k=3)[1], "points and normals: found 2 and 3 rows"),
        ("here", arrays()[1], "points: expected an array of numbers"),
        (arrays()[0], [[1, 2], [3]], "normals: expected an array of numbers"),
    ],
)
def test_malformed_targets(solver, points, normals, says):
    with pytest.raises(ik.errors.InputError) as caught:
        solver.solve_batch(points, normals)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("directions", "says"),
    [
        (arrays()[1], "directions: row 0, finger 0 has a point and a direction; expected one"),
        (np.zeros((2, 3, 3)), "directions: row 0, finger 0 is zero, expected a direction"),
        (np.full((2, 3, 3), np.inf), "directions: row 0, finger 0 is infinite"),
        (arrays(k=3)[1], "points and directions: found 2 and 3 rows"),
        (arrays(f=2)[1], "directions: found shape (2, 2, 3), expected (k, 3, 3)"),
        ("up", "directions: expected an array of numbers"),
    ],
)
def test_malformed_directions(solver, directions, says):
    with pytest.raises(ik.errors.InputError) as caught:
        solver.solve_batch(*arrays(), directions=directions)
    assert says in str(caught.value)


@pytest.mark.parametrize("value", [0, -1e-3, float("nan"), float("inf"), "5 mm", None])
def test_tolerance_is_a_positive_number(value):
    with pytest.raises(ik.errors.InputError, match=r"tolerance\.position:.*> 0"):
        ik.Tolerance(position=value)
    with pytest.raises(ik.errors.InputError, match=r"tolerance\.angle"):
        ik.Tolerance(angle=value)


def test_default_tolerance_is_the_papers():
    assert ik.Tolerance() == ik.Tolerance(position=0.005, angle=np.deg2rad(3))
