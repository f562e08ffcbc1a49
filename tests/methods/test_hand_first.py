"""The flagship: every reachable target solved, whatever the arm, and traces that tell how."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from robot_variants import derived_robot
from samplers import HARD, near_limits

import casadi_ik as ik
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.state import STAGES
from casadi_ik.problem.targets import TargetBatch, fixed_array, target_arrays
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.run import Run

EXACT = ik.Tolerance(1e-6, 1e-6)
TOLERANCES = {"usual": ik.Tolerance(), "exact": EXACT}


@pytest.fixture(scope="module")
def method(robot):
    return HandFirstMethod(robot.description, HandFirstParameters())


def problems(robot, q, tolerance=EXACT, enforce=True, fixed=None):
    points, normals = robot.contacts(q)
    targets = target_arrays(points, normals, len(robot.fingers))
    return TargetBatch(*targets, tolerance, enforce, fixed=fixed)


def solve(robot, method, asked):
    return Engine(robot, method).solve(asked, Run())


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("make", HARD, ids=lambda make: make.__name__)
def test_every_target_is_solved_within_limits(robot, method, make, tolerance):
    q = make(robot, np.random.default_rng(2026), 1200)
    batch = solve(robot, method, problems(robot, q, TOLERANCES[tolerance]))
    assert np.flatnonzero(~batch.success).tolist() == []
    assert (batch.q >= robot.lower).all()
    assert (batch.q <= robot.upper).all()


def test_targets_with_a_joint_next_to_its_limit(robot, method, rng):
    """Swivel intervals of a few thousandths of a degree: no sampling would find them."""
    q = robot.random(rng, 400)
    joint = rng.integers(0, 7, len(q))
    side = rng.integers(0, 2, len(q)).astype(bool)
    rows, near = np.arange(len(q)), np.radians(0.003)
    q[rows, joint] = np.where(side, robot.lower[joint] + near, robot.upper[joint] - near)
    batch = solve(robot, method, problems(robot, q))
    assert batch.success.all()
    # Most of them without the whole-system stage: the closed form found the interval.
    assert np.mean(batch.phases["refinement"] == 0) > 0.9


def test_without_limits_everything_is_solved_too(robot, method, rng):
    batch = solve(robot, method, problems(robot, near_limits(robot, rng, 200), enforce=False))
    assert batch.success.all()


def test_the_same_twice_alone_and_in_a_batch(robot, method, rng):
    asked = problems(robot, near_limits(robot, rng, 40))
    starts = np.tile(robot.home, (len(asked), 1))
    batch, again = (method.run(asked, starts, 0, False) for _ in range(2))
    np.testing.assert_array_equal(batch.q, again.q)
    for row in range(len(asked)):
        alone = method.run(asked.rows(slice(row, row + 1)), starts[:1], 7, False)
        np.testing.assert_array_equal(alone.q[0], batch.q[row])
        assert alone.iterations[0] == batch.iterations[row]
        assert alone.restarts[0] == batch.restarts[row]


def stages_made_alike(method, asked, starts):
    """The stages of a first round, which the virtual machine makes as compiled code does."""
    slow = HandFirstMethod(method.robot, method.options, compiled=False)
    rows = method.rows(asked, starts, method.postures(asked, 0))
    fast, slow = (each.run_rows(*rows, trace=True) for each in (method, slow))
    np.testing.assert_array_equal(fast.status, slow.status)
    np.testing.assert_array_equal(fast.iterations, slow.iterations)
    np.testing.assert_allclose(fast.states, slow.states, atol=1e-7)
    for name in ("phase", "status", "accepted", "restart"):
        np.testing.assert_array_equal(fast.rows[name], slow.rows[name])
    return {ik.answers.Phase(phase) for phase in fast.rows["phase"]}


def test_without_a_compiler_every_stage_is_the_same(robot, method, rng):
    q = robot.random(rng, 25)
    points, normals = robot.contacts(q)
    points += rng.normal(0, 0.005, points.shape)
    starts = np.where(np.arange(25)[:, None] % 2, robot.home, q + 0.02)
    targets, seen = target_arrays(points, normals, 3), set()
    for prefer in ("limits", "q0"):
        asked = TargetBatch(*targets, ik.Tolerance(), True, prefer=prefer)
        seen |= stages_made_alike(method, asked, starts)
    assert seen == set(STAGES)


def test_traces(robot, method, rng):
    """Stages come in their order, costs never rise, and a rejected step changes nothing."""
    asked = problems(robot, near_limits(robot, rng, 60))
    outcome = method.run(asked, np.tile(robot.home, (60, 1)), 0, True)
    order = {
        ik.answers.Phase.CANDIDATE: 0,
        ik.answers.Phase.HAND_FIT: 1,
        ik.answers.Phase.ARM_PLACEMENT: 2,
        ik.answers.Phase.REFINEMENT: 3,
    }
    rejected = 0
    for row, trace in enumerate(outcome.trace):
        assert len(trace) == outcome.iterations[row]
        assert trace["phase"][0] == ik.answers.Phase.CANDIDATE
        assert trace["restart"][0] == 0
        assert trace["status"][-1] == outcome.status[row] == ik.Status.SOLVED
        # A round that ends in vain says so, and the next one begins with other candidates.
        vain = trace["status"][:-1] == ik.Status.STALLED
        assert not trace["status"][:-1][~vain].any()
        assert (trace["phase"][:-1][vain] == ik.answers.Phase.CANDIDATE).all()
        assert (np.diff(trace["restart"].astype(int)) >= 0).all()
        for stage in order:
            assert np.sum(trace["phase"] == stage) == outcome.phases[stage.label][row]
        for one, following in pairwise(trace):
            if following["phase"] == ik.answers.Phase.CANDIDATE:
                assert one["restart"] != following["restart"] or one["status"]
                continue
            assert one["restart"] == following["restart"]
            assert order[following["phase"]] - order[one["phase"]] in (0, 1)
            if one["phase"] != following["phase"] or not np.isfinite(one["cost"]):
                continue
            assert following["cost"] <= one["cost"] * (1 + 1e-9)
            if not one["accepted"]:
                rejected += 1
                assert following["cost"] == pytest.approx(one["cost"], rel=1e-9)
                np.testing.assert_array_equal(one["q"], following["q"])
                assert following["damping"] > one["damping"]
    assert rejected > 0


def test_trace_of_an_exact_fit_shows_errors_falling_to_nothing(robot, method, rng):
    asked = problems(robot, robot.random(rng, 1))
    trace = method.run(asked, robot.home[None], 0, True).trace[0]
    fit = trace[trace["phase"] == ik.answers.Phase.HAND_FIT]
    assert fit["position_error"][0].max() > 1e-3
    assert fit["position_error"][-1].max() < 1e-4
    assert np.isfinite(fit["damping"]).all()
    assert (fit["step_size"] >= 0).all()


def test_out_of_reach_the_contacts_come_near(robot, method, rng):
    """Not solved; what comes back is finite, within limits and stretched towards the target."""
    q = robot.random(rng, 20)
    points, normals = robot.contacts(q)
    away = points.mean(axis=1, keepdims=True)
    points = points + 2.0 * away / np.linalg.norm(away, axis=2, keepdims=True)
    asked = TargetBatch(*target_arrays(points, normals, 3), EXACT, True)
    batch = solve(robot, method, asked)
    assert not batch.success.any()
    assert np.isfinite(batch.q).all()
    assert batch.limits_ok.all()
    assert (batch.position_error.mean(axis=1) < np.linalg.norm(points.mean(axis=1), axis=1)).all()


@pytest.mark.parametrize("free", ["finger", "normal", "all but one finger", "all normals"])
@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_partial_grasps(robot, method, rng, free, tolerance):
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
    targets = target_arrays(points, normals, 3)
    batch = solve(robot, method, TargetBatch(*targets, TOLERANCES[tolerance], True))
    assert batch.success.all()
    assert batch.limits_ok.all()


@pytest.mark.parametrize("enforce", [True, False])
def test_each_actuator_locked(robot, method, rng, enforce):
    for i, name in enumerate(robot.actuators):
        q = robot.random(rng, 25)
        q[:, i] = value = rng.uniform(robot.lower[i], robot.upper[i])
        fixed = fixed_array({name: value}, robot.actuators, robot.lower, robot.upper)
        batch = solve(robot, method, problems(robot, q, enforce=enforce, fixed=fixed))
        assert batch.success.all(), name
        np.testing.assert_array_equal(batch.q[:, i], value)


def test_several_actuators_locked(robot, method, rng):
    q = robot.random(rng, 25)
    names = ("lwr_joint_3", "bh_spread", "bh_thumb_distal")
    values = dict(zip(names, (0.2, 0.5, 0.3), strict=True))
    for name, value in values.items():
        q[:, robot.actuators.index(name)] = value
    fixed = fixed_array(values, robot.actuators, robot.lower, robot.upper)
    assert solve(robot, method, problems(robot, q, fixed=fixed)).success.all()


def test_locked_actuators_are_checked(robot):
    limits = robot.lower, robot.upper
    assert fixed_array({}, robot.actuators, *limits) is None
    with pytest.raises(
        ik.errors.UnknownNameError, match="no actuator 'elbow', expected one of lwr_joint_1"
    ):
        fixed_array({"elbow": 0.0}, robot.actuators, *limits)
    for value in (9.0, float("nan"), "much", None):
        with pytest.raises(
            ik.errors.InputError, match=r"fixed\.bh_spread: found .*from 0 to 3\.14"
        ):
            fixed_array({"bh_spread": value}, robot.actuators, *limits)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_robots_with_other_links_and_mounts(tmp_path, seed):
    rng = np.random.default_rng(seed)
    heights = dict(zip("1234567", rng.uniform(0.08, 0.35, 7).tolist(), strict=True))
    mount = (rng.uniform(-0.1, 0.1, 3).tolist(), rng.uniform(-1.5, 1.5, 3).tolist())
    robot = derived_robot(tmp_path, heights, mount)
    other = HandFirstMethod(robot.description, HandFirstParameters(), compiled=False)
    assert other.step.arm is not None
    batch = solve(robot, other, problems(robot, robot.random(rng, 12)))
    assert batch.success.all()


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_an_arm_without_a_closed_form(tmp_path_factory, tolerance):
    robot = derived_robot(tmp_path_factory.mktemp("offset"), wrist_offset=0.045)
    other = HandFirstMethod(robot.description, HandFirstParameters())
    assert other.step.arm is None
    # Few enough that no second kernel is compiled for many side by side.
    q = robot.random(np.random.default_rng(5), 60)
    batch = solve(robot, other, problems(robot, q, TOLERANCES[tolerance]))
    assert batch.success.all()
    stages_made_alike(other, problems(robot, q[:12], TOLERANCES[tolerance]), q[12:24])
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


def test_parameters_are_checked():
    with pytest.raises(
        ik.errors.InputError, match="candidates: found 0, expected a whole number >= 1"
    ):
        HandFirstParameters(candidates=0)
    with pytest.raises(ik.errors.InputError, match="table: found 4, expected at least"):
        HandFirstParameters(table=4)
    assert dataclasses.asdict(HandFirstParameters())["rounds"] >= 1


@pytest.mark.parametrize("name", ["hand-first", "thumb-first"])
def test_the_trace_leaves_open_what_is_free(robot, rng, name):
    points, normals = robot.contacts(robot.random(rng, 1))
    normals[:, 1] = np.nan
    points[:, 2] = normals[:, 2] = np.nan
    method = ik.Solver(robot, name)._engine.method
    asked = TargetBatch(*target_arrays(points, normals, 3), ik.Tolerance(), True)
    (rows,) = method.run(asked, robot.home[None], 0, True).trace
    measured = rows[np.isfinite(rows["position_error"][:, 0])]
    assert len(measured)
    assert np.isfinite(measured["position_error"]).all(axis=0).tolist() == [True, True, False]
    assert np.isfinite(measured["angle_error"]).all(axis=0).tolist() == [True, False, False]
    assert np.isnan(measured["position_error"][:, 2]).all()
    assert np.isnan(measured["angle_error"][:, 1:]).all()


MISSED_BY_HOLDING = (
    1.203796547,
    -1.750305748,
    2.884163381,
    -0.086668812,
    2.896685337,
    1.743456462,
    2.887481234,
    0.173290801,
    0.277041215,
    -0.332445893,
    1.269565614,
    0.011936116,
    -0.341106403,
    1.559533824,
    1.567909406,
    -0.347972917,
    1.565004856,
    0.502950570,
    0.768413391,
    -0.339814074,
    -0.257951918,
    0.320823905,
    1.038616982,
    0.007020192,
    -0.195713141,
    -0.688663896,
    1.568539825,
)


def test_a_wrist_at_its_limits_is_searched_where_holding_it_fails():
    """No place that the wrist is held at in the first round brings this arm within its limits."""
    robot = ik.load_robot("panda+shadow")
    q = np.array(MISSED_BY_HOLDING)
    points, normals = robot.contacts(q[None])
    solver = ik.Solver(robot)
    assert solver.solve_batch(points, normals).success.all()
