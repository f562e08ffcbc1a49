"""Targets and tolerances: what is taken, and what is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.problem.problems import Problems, target_arrays


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


def test_rows_of_a_batch():
    problems = Problems(*arrays(k=4), ik.Tolerance(), True)
    part = problems.rows(slice(1, 3))
    assert len(problems) == 4
    assert len(part) == 2
    np.testing.assert_array_equal(part.points, problems.points[1:3])
    assert part.enforce_limits


def test_parts_of_a_batch_keep_the_numbers_of_their_targets():
    points = np.zeros((10, 3, 3))
    problems = Problems(points, points, ik.Tolerance(), True, first_row=100)
    assert problems.rows(slice(4, 8)).first_row == 104
    assert problems.rows(slice(4, 8)).rows(slice(1, None)).first_row == 105
    assert problems.rows(slice(-2, None)).first_row == 108
    assert problems.rows(slice(0, 0)).first_row == 100
    assert len(problems.rows(np.array([7, 2]))) == 2
    assert problems.rows(np.array([7, 2])).first_row == 0
