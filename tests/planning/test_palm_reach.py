"""Decisions of palm poses: witnesses are checked, refutations are never wrong."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.kinematics.intervals import interval_function
from casadi_ik.planning.reach.decide import PalmReach, Reachability, exact_family

ARMS = ("ur5e", "kuka_lwr4", "panda", "irb140")
"""One arm of each exact family."""


@pytest.fixture(scope="module", params=ARMS)
def reach(request):
    robot = ik.load_robot(request.param)
    return PalmReach(robot, exact_family(robot))


def random_poses(seed, count, extent):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.uniform(-extent, extent, (count, 3))
    return poses


def test_palms_of_configurations_are_reachable_with_witnesses(reach):
    robot = reach.robot
    q = robot.random(np.random.default_rng(5), 400)
    # Some joints at their limits: the boundary of the workspace.
    at_limit = np.random.default_rng(6).random(q.shape) < 0.1
    q[:40] = np.where(at_limit, robot.upper, q)[:40]
    palms = robot.palm(q)
    decision = reach.decide(palms)
    assert not (decision.code == Reachability.UNREACHABLE).any()
    witnessed = decision.code == Reachability.REACHABLE
    assert witnessed[40:].all()
    assert witnessed.mean() > 0.9
    witness = decision.q[witnessed]
    assert np.abs(robot.palm(witness) - palms[witnessed]).max() <= 1e-10
    assert (robot.beyond_limits(witness) <= 1e-9).all()
    assert np.isnan(decision.q[~witnessed]).all()


def test_refuted_palms_are_not_solved():
    robot = ik.load_robot("ur5e")
    reach, solver = PalmReach(robot, exact_family(robot)), ik.Solver(robot)
    poses = random_poses(7, 300, 1.0)
    exact, tolerant = reach.decide(poses), reach.decide(poses, ik.Tolerance())
    refuted = tolerant.code == Reachability.UNREACHABLE
    assert refuted.sum() > 100
    assert not solver.solve_palms(poses[refuted], {}).success.any()
    assert (exact.code[refuted] == Reachability.UNREACHABLE).all()
    assert (exact.code == Reachability.OPEN).mean() < 0.01


def test_interval_functions_enclose_all_values():
    x = ca.SX.sym("x", 3)
    inner = ca.Function("inner", [x], [x[0] * x[1] - x[2]], {"never_inline": True})
    values = [
        x[0] * x[1] / ca.fmax(x[2] ** 2, 0.1),
        ca.cos(3 * x[0]) - ca.sin(x[1] * x[2]),
        ca.if_else(x[0] < x[1], ca.sqrt(ca.fabs(x[2])), -x[0]),
        ca.fmin(x[0], ca.fmax(x[1], x[2])) + inner(x),
        1 / (3 + x[0]),
    ]
    function = ca.Function("values", [x], [ca.vertcat(*values)])
    bounds = interval_function(function)
    rng = np.random.default_rng(3)
    for _ in range(200):
        ends = np.sort(rng.uniform(-2, 2, (2, 3)), axis=0)
        lower, upper = (np.array(end).ravel() for end in bounds(*ends))
        for fractions in rng.random((20, 3)):
            value = np.array(function(ends[0] + fractions * (ends[1] - ends[0]))).ravel()
            assert (lower <= value).all()
            assert (value <= upper).all()


def test_a_divisor_that_may_be_zero_gives_no_bound():
    x = ca.SX.sym("x")
    bounds = interval_function(ca.Function("inverse", [x], [ca.fmin(1 / x, 0.0)]))
    lower, upper = bounds(-1.0, 1.0)
    assert float(lower) <= -1e100
    assert float(upper) >= 1e100
