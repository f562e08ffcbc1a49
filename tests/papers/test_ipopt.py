"""The whole arm-hand as one program: the reference for other methods."""

from __future__ import annotations

import numpy as np
import pytest
from toy_robots import replace, write_coupled_robot

import casadi_ik as ik
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.papers.ipopt import IpoptMethod, IpoptParameters
from casadi_ik.solve.status import Status


def middle(robot, rng, part=0.6):
    """Return a configuration well within the limits."""
    centre, half_range = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 2
    return centre + part * half_range * rng.uniform(-1, 1, len(centre))


TIGHT = ik.Tolerance(position=1e-6, angle=1e-6)
ROBOTS = ("kuka_lwr_barrett", "kuka_lwr_barrett_coupled")


@pytest.fixture(scope="module")
def solver(robot):
    return ik.Solver(robot, "ipopt")


@pytest.fixture(scope="module")
def targets(robot):
    """Ten contacts of random hands."""
    return robot.contacts(robot.random(np.random.default_rng(11), 10))


def cost(batch: ik.BatchSolution) -> np.ndarray:
    """Return squared errors with the weights of the method: 100 mm like one unit of the normal."""
    chords = 2 * np.sin(batch.angle_error / 2)
    return np.nansum((batch.position_error / 0.1) ** 2 + chords**2, axis=1)


def test_start_near_the_solution_stays_near(robot, rng):
    """A small barrier and a weak regularisation avoid detours along the self-motion of the arm."""
    q = np.array([middle(robot, rng) for _ in range(10)])
    starts = q + 1e-3 * rng.normal(size=q.shape)
    batch = ik.Solver(robot, "ipopt", TIGHT).solve_batch(*robot.contacts(q), q0=starts)
    assert batch.success.all()
    assert not batch.restarts.any()
    assert batch.iterations.mean() < 10
    assert np.abs(batch.q - starts).max() < 0.02


def test_joint_limits_are_kept(tmp_path, rng):
    """A four-bar that stops before its motor needs a constraint."""
    path = write_coupled_robot(tmp_path)
    replace(
        tmp_path / "parts" / "hand.yaml",
        "limits: [-0.1, 1], source",
        "limits: [-0.1, 0.25], source",
    )
    robot = ik.load_robot(path)
    # Over the motors' own strokes: the robot's ranges leave out what takes a joint past its limit.
    q = rng.uniform(*robot.description.actuator_limits, (20, len(robot.actuators)))
    is_beyond_limit = np.asarray(robot.joints(q)["left_3"]) > 0.25
    assert 3 <= is_beyond_limit.sum() <= 18
    start = (robot.lower + robot.upper) / 2
    slider = robot.actuators.index("screw_2")
    start[slider] = robot.lower[slider] + 0.002
    assert robot.joints(start)["left_3"] < 0.25
    solver = ik.Solver(robot, "ipopt", TIGHT, options={"restarts": 0})
    batch = solver.solve_batch(*robot.contacts(q), q0=start)
    assert batch.limits_ok.all()
    assert (np.asarray(robot.joints(batch.q)["left_3"]) <= 0.25 + 1e-9).all()
    np.testing.assert_array_equal(batch.success, ~is_beyond_limit)


@pytest.mark.filterwarnings("ignore:overflow")
def test_non_finite_numbers_have_a_status(robot):
    points, normals = robot.contacts(robot.home[None])
    method = IpoptMethod(robot.description, IpoptParameters(restarts=0))
    targets = TargetBatch(1e200 * points, normals, Tolerance(), enforce_limits=True)
    outcome = method.run(targets.starting_at(robot.home))
    assert outcome.status.tolist() != [Status.SOLVED]
    assert np.isfinite(outcome.q).all()


@pytest.mark.parametrize("name", ROBOTS)
def test_agrees_with_hand_first(name):
    """Both methods solve to a micrometre, so that their contacts agree within twice that."""
    robot = ik.load_robot(name)
    points, normals = robot.contacts(robot.random(np.random.default_rng(5), 12))
    batches = [
        ik.Solver(robot, method, TIGHT).solve_batch(points, normals)
        for method in ("ipopt", "hand-first")
    ]
    for batch in batches:
        assert batch.success.all(), batch.status_names
        assert batch.limits_ok.all()
    ours, theirs = (robot.contacts(batch.q) for batch in batches)
    np.testing.assert_allclose(ours[0], theirs[0], atol=2e-6)
    np.testing.assert_allclose(ours[1], theirs[1], atol=2e-6)


@pytest.mark.parametrize("name", ik.shipped_grasps("kuka_lwr_barrett"))
def test_shipped_grasps(name, solver):
    solution = solver.solve(ik.load_grasp(name))
    assert solution.success, solution.status


def test_impossible_contacts_are_met_as_well_as_by_hand_first(robot, targets):
    """Contacts are half a metre out of reach, too far apart, or have a reversed normal."""
    points, normals = (array[:3].copy() for array in targets)
    points[0] += [0.0, 0.0, 1.5]
    points[1, 0] += [0.15, 0.0, 0.0]
    normals[2, 1] *= -1
    solvers = ik.Solver(robot, "ipopt", options={"restarts": 10}), ik.Solver(robot, "hand-first")
    batches = [pose_solver.solve_batch(points, normals) for pose_solver in solvers]
    assert not batches[0].success.any()
    assert batches[0].limits_ok.all()
    assert np.all(batches[0].restarts == 10)
    assert np.all(cost(batches[0]) <= cost(batches[1]) * (1 + 1e-6))


def test_free_fingers_and_normals(robot, solver, targets):
    """Free components are not constrained, even if all together could not be met."""
    points, normals = (array[:4].copy() for array in targets)
    points[0, 2] = normals[0, 2] = np.nan
    points[1, 1:] = normals[1, 1:] = np.nan
    normals[2, 0] = np.nan
    normals[3] = np.nan
    batch = solver.solve_batch(points, normals)
    assert batch.success.all()
    assert np.isnan(batch.position_error[0, 2])
    assert np.isnan(batch.angle_error[2, 0])
    turned_normals = targets[1][:4].copy()
    turned_normals[2, 0] *= -1  # the wrong way round, so that it matters whether it counts
    assert solver.solve_batch(
        points[2:3], np.where(np.isnan(normals), normals, turned_normals)[2:3]
    ).success[0]
    assert not solver.solve_batch(points[2:3], turned_normals[2:3]).success[0]


def test_limits_are_never_exceeded(robot, tmp_path, targets):
    """Neither the answer nor any iterate violates limits; ignored limits are no bounds."""
    path = tmp_path / "log.mcap"
    batch = ik.Solver(robot, "ipopt").solve_batch(*targets, log=path)
    q = ik.logs.open(path).iterations().rows["q"]
    assert len(q) == batch.iterations.sum()
    assert np.all((q >= robot.lower) & (q <= robot.upper))
    assert np.all((batch.q >= robot.lower) & (batch.q <= robot.upper))
    # A thumb that would have to open beyond its limit.
    q = robot.home.copy()
    q[robot.actuators.index("bh_thumb_distal")] = -0.5
    contacts_beyond = [array[None] for array in robot.contacts(q)]
    assert (
        not ik.Solver(robot, "ipopt", options={"restarts": 1})
        .solve_batch(*contacts_beyond)
        .success[0]
    )
    free = ik.Solver(robot, "ipopt", limits="ignore").solve_batch(*contacts_beyond)
    assert free.success[0]
    assert not free.limits_ok[0]


def test_no_restarts_and_a_small_budget(robot, targets):
    without_restarts = ik.Solver(robot, "ipopt", options={"restarts": 0}).solve_batch(*targets)
    assert np.all(without_restarts.restarts == 0)
    assert 3 <= without_restarts.success.sum() < 10
    short = ik.Solver(robot, "ipopt", options={"restarts": 0, "max_iterations": 2})
    batch = short.solve_batch(*targets)
    assert set(batch.status_names) == {"ITERATION_LIMIT"}
    np.testing.assert_array_equal(batch.iterations, 3)
