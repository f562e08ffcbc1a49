"""The table of hand postures: what it compares, and that it finds the right ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.common.posture_table import PostureTable, contact_shape, differing
from casadi_ik.symbolic.even_spread import evenly

HAND = tuple(range(7, 14))


def shape(points, normals):
    (values,) = FunctionKernel(contact_shape(points.shape[1]))(points, normals)
    return values.reshape(len(points), -1)


@pytest.fixture(scope="module")
def table(robot):
    return PostureTable(robot, HAND, 512)


def test_shape_does_not_see_rigid_motions(robot, rng):
    points, normals = robot.contacts(robot.random(rng, 30))
    turn = Rotation.random(rng=rng).as_matrix()
    values = shape(points, normals)
    moved = shape(points @ turn.T + [1.0, -2.0, 0.5], normals @ turn.T)
    np.testing.assert_allclose(moved, values, atol=1e-9)
    assert (np.ptp(values, axis=0) > 0.1).all()


def test_shape_sees_a_mirror(robot, rng):
    """Mirrored contacts are another shape: no hand turns into its mirror image."""
    points, normals = robot.contacts(robot.random(rng, 30))
    mirror = np.diag([1.0, 1.0, -1.0])
    difference = shape(points @ mirror, normals @ mirror) - shape(points, normals)
    assert np.median(np.abs(difference).max(axis=1)) > 0.1


def test_shape_of_free_contacts(robot, rng):
    points, normals = robot.contacts(robot.random(rng, 2))
    points[0, 1] = normals[0, 1] = normals[1, 2] = np.nan
    known = ~np.isnan(shape(points, normals))
    assert 0 < known[0].sum() < known[1].sum() < known.shape[1]


def test_shape_of_one_finger():
    values = shape(np.zeros((3, 1, 3)), np.ones((3, 1, 3)))
    assert values.shape == (3, 1)
    assert np.isnan(values).all()


def test_a_posture_of_the_table_finds_itself(robot, table):
    q = np.tile(robot.home, (512, 1))
    q[:, HAND] = table.postures
    found = table.nearest(*robot.contacts(q), 1)[:, 0]
    assert np.mean(np.all(found == table.postures, axis=1)) > 0.99


def test_nearest_are_the_nearest_in_order(robot, table, rng):
    points, normals = robot.contacts(robot.random(rng, 20))
    q = np.tile(robot.home, (512, 1))
    q[:, HAND] = table.postures
    values = shape(*robot.contacts(q))
    wanted = shape(points, normals)
    distance = np.linalg.norm(values[None] - wanted[:, None], axis=2)
    for count in (8, 40):
        found = table.nearest(points, normals, count)
        rows = [
            [np.flatnonzero((table.postures == posture).all(axis=1))[0] for posture in row]
            for row in found
        ]
        reached = np.take_along_axis(distance, np.array(rows), axis=1)
        # Values are compared in steps of 1/64.
        assert (np.diff(reached, axis=1) > -0.1).all()
        np.testing.assert_allclose(reached, np.sort(distance, axis=1)[:, :count], atol=0.1)
        assert all(len(set(row)) == count for row in rows)


def test_a_target_finds_the_same_alone_and_in_a_batch(robot, table, rng):
    points, normals = robot.contacts(robot.random(rng, 300))
    normals[::7, 1] = np.nan
    batch = table.nearest(points, normals, 8)
    for i in range(0, 300, 11):
        alone = table.nearest(points[i : i + 1], normals[i : i + 1], 8)[0]
        np.testing.assert_array_equal(alone, batch[i])


def test_the_known_part_decides(robot, table, rng):
    """With a free normal the others still rank: an exact posture comes first."""
    q = np.tile(robot.home, (20, 1))
    q[:, HAND] = table.postures[:20]
    points, normals = robot.contacts(q)
    normals[:, 2] = np.nan
    found = table.nearest(points, normals, 3)
    assert np.mean((found == table.postures[:20, None]).all(axis=2).any(axis=1)) > 0.9


def test_all_free_but_one_finger_takes_any(robot, table):
    points, normals = robot.contacts(robot.home)
    points[1:] = normals[1:] = np.nan
    assert table.nearest(points[None], normals[None], 4).shape == (1, 4, 7)


@pytest.mark.parametrize("pull", [0.0, 0.3])
def test_numpy_finds_what_compiled_code_finds(robot, rng, pull):
    points, normals = robot.contacts(robot.random(rng, 50))
    normals[::3, 1] = np.nan
    near = robot.random(rng, 50)[:, HAND]
    found = [
        PostureTable(robot, HAND, 300, pull=pull, compiled=compiled).nearest(
            points, normals, 20, near
        )
        for compiled in (True, False)
    ]
    np.testing.assert_array_equal(found[0], found[1])


def test_postures_at_limits(robot):
    table = PostureTable(robot, HAND, 256, at_limits=0.5)
    at = (table.postures == robot.lower[7:]) | (table.postures == robot.upper[7:])
    assert at.mean() == pytest.approx(0.5, abs=0.05)
    assert (table.postures >= robot.lower[7:]).all()
    assert (table.postures <= robot.upper[7:]).all()


@pytest.mark.parametrize("dimensions", [1, 3, 10])
def test_evenly(dimensions):
    points = evenly(1000, dimensions)
    assert points.shape == (1000, dimensions)
    assert (points >= 0).all()
    assert (points < 1).all()
    counts = np.array([np.histogram(column, 10, (0, 1))[0] for column in points.T])
    assert np.abs(counts - 100).max() <= 25
    np.testing.assert_array_equal(points[:10], evenly(10, dimensions))


def test_varied_postures_differ_and_begin_with_the_nearest(robot, table, rng):
    points, normals = robot.contacts(robot.random(rng, 300))
    nearest = table.nearest(points, normals, 1)
    pool = table.nearest(points, normals, 48)
    varied = differing(pool, table.ranges, 8, 0.2)
    np.testing.assert_array_equal(varied[:, 0], nearest[:, 0])
    places = varied / (robot.upper - robot.lower)[list(HAND)]
    apart = np.sqrt(np.mean((places[:, :, None] - places[:, None]) ** 2, axis=3))
    assert np.median(apart[:, *np.triu_indices(8, 1)].min(axis=1)) >= 0.2
    few = differing(pool[:, :8], table.ranges, 8, 0.9)
    np.testing.assert_array_equal(few[:, 0], nearest[:, 0])
    for row, alike in zip(few, table.nearest(points, normals, 8), strict=True):
        assert {tuple(posture) for posture in row} == {tuple(posture) for posture in alike}


def test_a_table_beyond_limits(robot):
    bounds = robot.lower - 0.5, robot.upper + 0.5
    table = PostureTable(robot, HAND, 256, bounds=bounds)
    assert (table.postures < robot.lower[7:]).any(axis=0).all()
    assert (table.postures > robot.upper[7:]).any(axis=0).all()
