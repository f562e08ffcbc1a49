"""The flagship: every reachable target solved, whatever the arm, and traces that tell how."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import derived_robot
from samplers import HARD, near_limits
from trace_checks import Kept

import casadi_ik as ik

EXACT = ik.Tolerance(1e-6, 1e-6)
TOLERANCES = {"usual": ik.Tolerance(), "exact": EXACT}
ORDER = ("CANDIDATE", "HAND_FIT", "ARM_PLACEMENT", "REFINEMENT")


@pytest.fixture(scope="module")
def exact(robot):
    return ik.Solver(robot, tolerance=EXACT)


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("make", HARD, ids=lambda make: make.__name__)
def test_every_target_is_solved_within_limits(robot, make, tolerance):
    q = make(robot, np.random.default_rng(2026), 1200)
    batch = ik.Solver(robot, tolerance=TOLERANCES[tolerance]).solve_batch(*robot.contacts(q))
    assert np.flatnonzero(~batch.success).tolist() == []
    assert (batch.q >= robot.lower).all()
    assert (batch.q <= robot.upper).all()


def test_targets_with_a_joint_next_to_its_limit(robot, exact, rng):
    """Swivel intervals of a few thousandths of a degree: no sampling would find them."""
    q = robot.random(rng, 400)
    joint = rng.integers(0, 7, len(q))
    side = rng.integers(0, 2, len(q)).astype(bool)
    rows, near = np.arange(len(q)), np.radians(0.003)
    q[rows, joint] = np.where(side, robot.lower[joint] + near, robot.upper[joint] - near)
    batch = exact.solve_batch(*robot.contacts(q))
    assert batch.success.all()
    # Most of them without the whole-system stage: the closed form found the interval.
    assert np.mean(batch.phases["refinement"] == 0) > 0.9


def test_without_limits_everything_is_solved_too(robot, rng):
    solver = ik.Solver(robot, tolerance=EXACT, limits="ignore")
    assert solver.solve_batch(*robot.contacts(near_limits(robot, rng, 200))).success.all()


def test_stages_come_in_their_order(robot, exact, rng):
    kept = Kept()
    exact.solve_batch(*robot.contacts(near_limits(robot, rng, 60)), log=kept)
    order = np.array([ik.answers.Phase[name] for name in ORDER])
    rows = np.concatenate([block.rows for block in kept.blocks])
    place = (rows["phase"][:, None] == order).argmax(axis=1)
    assert np.isin(rows["phase"], order).all()
    later = np.diff(place)[place[1:] > 0]
    assert np.isin(later, (0, 1)).all()
    # A round that ends in vain says so, and the next one begins with other candidates.
    vain = rows["status"][:-1] == ik.Status.STALLED
    assert (place[1:][vain] == 0).all()


def test_trace_of_an_exact_fit_shows_errors_falling_to_nothing(robot, exact, rng):
    kept = Kept()
    exact.solve_batch(*robot.contacts(robot.random(rng, 1)), log=kept)
    (trace,) = (block.rows for block in kept.blocks)
    fit = trace[trace["phase"] == ik.answers.Phase.HAND_FIT]
    assert fit["position_error"][0].max() > 1e-3
    assert fit["position_error"][-1].max() < 1e-4
    assert np.isfinite(fit["damping"]).all()
    assert (fit["step_size"] >= 0).all()


def test_out_of_reach_the_contacts_come_near(robot, exact, rng):
    """Not solved; what comes back is finite, within limits and stretched towards the target."""
    points, normals = robot.contacts(robot.random(rng, 20))
    away = points.mean(axis=1, keepdims=True)
    points = points + 2.0 * away / np.linalg.norm(away, axis=2, keepdims=True)
    batch = exact.solve_batch(points, normals)
    assert not batch.success.any()
    assert np.isfinite(batch.q).all()
    assert batch.limits_ok.all()
    assert (batch.position_error.mean(axis=1) < np.linalg.norm(points.mean(axis=1), axis=1)).all()


@pytest.mark.parametrize("free", ["finger", "normal", "all but one finger", "all normals"])
@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_partial_grasps(robot, rng, free, tolerance):
    points, normals = robot.contacts(robot.random(rng, 120))
    rows, finger = np.arange(120), rng.integers(0, 3, 120)
    if free == "finger":
        points[rows, finger] = normals[rows, finger] = np.nan
    elif free == "normal":
        normals[rows, finger] = np.nan
    elif free == "all normals":
        normals[:] = np.nan
    else:
        points[:, :2] = normals[:, :2] = np.nan
    batch = ik.Solver(robot, tolerance=TOLERANCES[tolerance]).solve_batch(points, normals)
    assert batch.success.all()
    assert batch.limits_ok.all()


@pytest.mark.parametrize("limits", ["enforce", "ignore"])
def test_each_actuator_locked(robot, rng, limits):
    solver = ik.Solver(robot, tolerance=EXACT, limits=limits)
    for i, name in enumerate(robot.actuators):
        q = robot.random(rng, 25)
        q[:, i] = value = rng.uniform(robot.lower[i], robot.upper[i])
        batch = solver.solve_batch(*robot.contacts(q), fixed={name: value})
        assert batch.success.all(), name
        np.testing.assert_array_equal(batch.q[:, i], value)


def test_several_actuators_locked(robot, exact, rng):
    q = robot.random(rng, 25)
    names = ("lwr_joint_3", "bh_spread", "bh_thumb_distal")
    values = dict(zip(names, (0.2, 0.5, 0.3), strict=True))
    for name, value in values.items():
        q[:, robot.actuators.index(name)] = value
    assert exact.solve_batch(*robot.contacts(q), fixed=values).success.all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_robots_with_other_links_and_mounts(tmp_path, seed):
    rng = np.random.default_rng(seed)
    heights = dict(zip("1234567", rng.uniform(0.08, 0.35, 7).tolist(), strict=True))
    mount = (rng.uniform(-0.1, 0.1, 3).tolist(), rng.uniform(-1.5, 1.5, 3).tolist())
    robot = derived_robot(tmp_path, heights, mount)
    solver = ik.Solver(robot, tolerance=EXACT, compiled=False)
    assert solver.solve_batch(*robot.contacts(robot.random(rng, 12))).success.all()


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_an_arm_without_a_closed_form(tmp_path_factory, tolerance):
    robot = derived_robot(tmp_path_factory.mktemp("offset"), wrist_offset=0.045)
    # Few enough that no second kernel is compiled for many side by side.
    q = robot.random(np.random.default_rng(5), 60)
    batch = ik.Solver(robot, tolerance=TOLERANCES[tolerance]).solve_batch(*robot.contacts(q))
    assert batch.success.all()
    # Nearly all by the arm stage, not by the whole-system stage.
    assert np.mean(batch.phases["refinement"] == 0) > 0.9


def test_optimisation_changes_no_bit(robot, rng, monkeypatch):
    # One after the other with an arm, many at once without: each compiles the shorter half.
    hand = ik.load_robot("ar10")
    with_arm = robot.contacts(robot.random(rng, 20))
    alone = hand.contacts(hand.random(rng, 100))

    def answers() -> bytes:
        fast, q = ik.Solver(robot).fast(), []
        for points, normals in zip(*with_arm, strict=True):
            found, status = fast(points, normals)
            assert status == ik.Status.SOLVED
            q.append(found.copy())
        batch = ik.Solver(hand).solve_batch(*alone)
        assert batch.success.all()
        return np.array(q).tobytes() + batch.q.tobytes() + batch.iterations.tobytes()

    monkeypatch.setenv("CASADI_IK_CFLAGS", "-O0")
    plain = answers()
    monkeypatch.delenv("CASADI_IK_CFLAGS")
    assert answers() == plain


def test_parameters_are_checked(robot):
    for options, says in (
        ({"candidates": 0}, "candidates: found 0, expected a whole number >= 1"),
        ({"table": 4}, "table: found 4, expected at least"),
    ):
        with pytest.raises(ik.errors.InputError, match=says):
            ik.Solver(robot, options=options)


@pytest.mark.parametrize("name", ["hand-first", "thumb-first"])
def test_the_trace_leaves_open_what_is_free(robot, rng, name):
    points, normals = robot.contacts(robot.random(rng, 1))
    normals[:, 1] = np.nan
    points[:, 2] = normals[:, 2] = np.nan
    kept = Kept()
    ik.Solver(robot, name).solve_batch(points, normals, log=kept)
    (rows,) = (block.rows for block in kept.blocks)
    measured = rows[np.isfinite(rows["position_error"][:, 0])]
    assert len(measured)
    assert np.isfinite(measured["position_error"]).all(axis=0).tolist() == [True, True, False]
    assert np.isfinite(measured["angle_error"]).all(axis=0).tolist() == [True, False, False]
    assert np.isnan(measured["position_error"][:, 2]).all()
    assert np.isnan(measured["angle_error"][:, 1:]).all()


MISSED_BY_HOLDING = (
    *(1.203796547, -1.750305748, 2.884163381, -0.086668812, 2.896685337, 1.743456462, 2.887481234),
    *(0.173290801, 0.277041215, -0.332445893, 1.269565614, 0.011936116, -0.341106403, 1.559533824),
    *(1.567909406, -0.347972917, 1.565004856, 0.502950570, 0.768413391, -0.339814074, -0.257951918),
    *(0.320823905, 1.038616982, 0.007020192, -0.195713141, -0.688663896, 1.568539825),
)


def test_a_wrist_at_its_limits_is_searched_where_holding_it_fails():
    """No place that the wrist is held at in the first round brings this arm within its limits."""
    robot = ik.load_robot("panda+shadow")
    q = np.array(MISSED_BY_HOLDING)
    points, normals = robot.contacts(q[None])
    solver = ik.Solver(robot)
    assert solver.solve_batch(points, normals).success.all()
