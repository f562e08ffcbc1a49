"""Sliders of the AR10: unconstrained fingers stay, and triangles stay closed."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik


def contacts(robot, q, fingers):
    """Return targets (k, f, 3): contacts of some fingers [m], NaN for the others."""
    points, normals = robot.contacts(q)
    free = [finger not in fingers for finger in robot.fingers]
    points[:, free], normals[:, free] = np.nan, np.nan
    return points, normals


@pytest.fixture(scope="module", params=["ar10", "baxter_ar10"])
def robot(request) -> ik.ArmHand:
    return ik.load_robot(request.param)


def test_free_fingers_stay(robot, rng):
    q0 = robot.random(rng, 20)
    points, normals = contacts(robot, robot.random(rng, 20), ["thumb", "middle"])
    batch = ik.Solver(robot).solve_batch(points, normals, q0=q0)
    for finger in ("index", "ring", "little"):
        columns = list(robot.description.finger_actuators(finger))
        np.testing.assert_array_equal(batch.q[:, columns], q0[:, columns])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["hand-first", "ipopt"])
def test_without_limits_a_slider_keeps_to_its_triangle(robot, method, rng):
    """Beyond that stroke the mechanism does not exist, even without limits."""
    points, normals = robot.contacts(robot.random(rng, 2))
    points[:, 1:] += rng.uniform(-0.03, 0.03, (2, 4, 3))
    batch = ik.Solver(robot, method, limits="ignore").solve_batch(points, normals)
    lower, upper = robot.description.mechanical_limits
    assert np.isfinite(lower[-10:]).all()
    assert np.all(batch.q >= lower)
    assert np.all(batch.q <= upper)
    assert np.any((batch.q < robot.lower) | (batch.q > robot.upper))
    assert np.all(np.isfinite(batch.q))
