"""The AR10's reachable targets: a slice of the study, and what is special about sliders."""

from __future__ import annotations

import numpy as np
import pytest
from samplers import SAMPLERS

import casadi_ik as ik

EXACT = ik.Tolerance(1e-6, 1e-6)
FINGERS = ("thumb", "index", "middle")
SETS = {
    "anywhere": ("random", FINGERS),
    "near limits": ("limits", FINGERS),
    "anywhere, thumb and index": ("random", FINGERS[:2]),
    "anywhere, thumb alone": ("random", FINGERS[:1]),
    "anywhere, all five fingers": ("random", (*FINGERS, "ring", "little")),
}


def contacts(robot, q, fingers):
    """Targets (k, f, 3): contacts of some fingers [m], NaN for the others."""
    points, normals = robot.contacts(q)
    free = [finger not in fingers for finger in robot.fingers]
    points[:, free], normals[:, free] = np.nan, np.nan
    return points, normals


@pytest.fixture(scope="module", params=["ar10", "baxter_ar10"])
def robot(request) -> ik.ArmHand:
    return ik.load_robot(request.param)


@pytest.mark.parametrize("tolerance", [ik.Tolerance(), EXACT], ids=["usual", "exact"])
@pytest.mark.parametrize("targets", SETS)
def test_reachable_targets_are_solved(robot, targets, tolerance):
    sampler, fingers = SETS[targets]
    _, made = SAMPLERS[sampler]
    rng = np.random.default_rng(2019)
    points, normals = contacts(robot, made(robot, rng, 300), fingers)
    assert np.isnan(points[:, :, 0]).sum(axis=1).tolist() == [5 - len(fingers)] * 300
    batch = ik.Solver(robot, tolerance=tolerance).solve_batch(points, normals)
    assert np.flatnonzero(~batch.success).tolist() == []
    assert batch.limits_ok.all()
    assert np.isnan(batch.position_error).sum() == 300 * (5 - len(fingers))


def test_free_fingers_stay(robot, rng):
    q0 = robot.random(rng, 20)
    points, normals = contacts(robot, robot.random(rng, 20), ["thumb", "middle"])
    batch = ik.Solver(robot).solve_batch(points, normals, q0=q0)
    for finger in ("index", "ring", "little"):
        columns = list(robot.description.finger_actuators(finger))
        np.testing.assert_array_equal(batch.q[:, columns], q0[:, columns])


def test_ipopt_agrees(robot, rng):
    points, normals = contacts(robot, robot.random(rng, 6), FINGERS)
    batch = ik.Solver(robot, "ipopt", EXACT).solve_batch(points, normals)
    assert batch.success.all(), batch.status_names
    found, facing = robot.contacts(batch.q)
    np.testing.assert_allclose(found[:, :3], points[:, :3], atol=1e-6)
    np.testing.assert_allclose(facing[:, :3], normals[:, :3], atol=2e-6)


@pytest.mark.parametrize("method", ["hand-first", "ipopt"])
def test_without_limits_a_slider_keeps_to_its_triangle(robot, method, rng):
    """Beyond it there is no such mechanism, limits or not."""
    points, normals = robot.contacts(robot.random(rng, 2))
    points[:, 1:] += rng.uniform(-0.03, 0.03, (2, 4, 3))
    batch = ik.Solver(robot, method, limits="ignore").solve_batch(points, normals)
    lower, upper = robot.description.mechanical_limits
    assert np.isfinite(lower[-10:]).all()
    assert np.all(batch.q >= lower)
    assert np.all(batch.q <= upper)
    assert np.any((batch.q < robot.lower) | (batch.q > robot.upper))
    assert np.all(np.isfinite(batch.q))
