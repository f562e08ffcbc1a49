"""One iteration of the enhanced method, stepped by hand."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.papers.qiu.enhanced import EnhancedStep
from casadi_ik.papers.qiu.finger_step import finger_step_function
from casadi_ik.papers.qiu.parameters import QiuParameters
from casadi_ik.problem.problems import Problems, Tolerance
from casadi_ik.problem.status import Phase, Status


class Stepper:
    """Takes the step graph's iterations one at a time."""

    def __init__(self, robot, **options):
        self.step = EnhancedStep(
            robot.description, QiuParameters(finger_step="closed-form", **options)
        )
        self.graph = self.step.graph()

    def state(self, q, phase=Phase.THUMB_REACHING):
        return self.step.state.pack(
            {"q": q, "phase": float(phase), "best": 1e9, "waited": 0.0, "reached": 0.0}
        )

    def parameters(self, points, normals, enforce_limits=False):
        problems = Problems(points[None], normals[None], Tolerance(), enforce_limits)
        values = self.step.parameter_values(problems)
        return self.step.parameters.pack_rows(values, 1)[0]

    def __call__(self, state, parameters):
        after, record, status = self.graph.function(state, parameters)
        return (
            self.step.state.unpack(np.array(after).ravel()),
            self.step.record.unpack(np.array(record).ravel()),
            int(status),
        )


@pytest.fixture(scope="module")
def stepper(robot):
    return Stepper(robot)


def pinch(robot, rng):
    """A pinching hand on a random arm."""
    q = robot.random(rng, 1)[0]
    q[7:] = np.radians([10, 75, 15, 75, 15, 75, 15])
    return q


def test_reaching_starts_from_the_recorded_configuration(robot, stepper, rng):
    points, normals = robot.contacts(pinch(robot, rng))
    q = robot.home
    after, record, status = stepper(stepper.state(q), stepper.parameters(points, normals))
    assert status == Status.RUNNING == record["status"]
    assert record["phase"] == Phase.THUMB_REACHING
    np.testing.assert_array_equal(record["q"], q)
    reached_points, reached_normals = robot.contacts(q)
    np.testing.assert_allclose(
        record["position_error"], np.linalg.norm(reached_points - points, axis=1), rtol=1e-12
    )
    cosine = np.einsum("ij,ij->i", reached_normals, normals)
    np.testing.assert_allclose(record["angle_error"], np.arccos(cosine), rtol=1e-9)
    assert record["step_size"] == pytest.approx(np.abs(after["q"] - q).max(), rel=1e-12)
    # Only the arm and the thumb move.
    np.testing.assert_array_equal(after["q"][[7, 10, 11, 12, 13]], q[[7, 10, 11, 12, 13]])
    assert np.all(after["q"][:7] != q[:7])
    assert after["reached"] == 1
    assert np.isnan(record["sigma_closed_chain"])
    assert np.isnan(record["palm_motion"]).all()
    assert record["sigma_thumb"] > 0
    assert record["sigma_palm"] > 0


def test_reaching_brings_palm_and_thumb_to_their_goal(robot, stepper, rng):
    """Without spread the palm estimate is exact, so both errors vanish."""
    goal = robot.home.copy()
    goal[7] = 0.0
    start = goal.copy()
    goal[:7] += rng.normal(scale=0.05, size=7)
    parameters = stepper.parameters(*robot.contacts(goal))
    parameters[stepper.step.parameters.slice("position_tolerance")] = 1e-12
    q, palm, thumb = start, [], []
    for _ in range(30):
        after, record, _ = stepper(stepper.state(q), parameters)
        palm.append(record["palm_error"])
        thumb.append(record["position_error"][0])
        q = after["q"]
    assert palm[0] > 0.02
    assert thumb[0] > 0.01
    assert palm[-1] < 1e-3 * palm[0]
    assert thumb[-1] < 0.1 * thumb[0]


def test_reaching_ends_within_tolerance_without_another_step(robot, stepper):
    q = robot.home.copy()
    q[7] = 0.0  # without spread the contacts' own palm estimate is the palm
    after, record, status = stepper(stepper.state(q), stepper.parameters(*robot.contacts(q)))
    assert record["palm_error"] < 1e-9
    assert after["phase"] == Phase.HAND_ALIGNMENT
    assert status == Status.RUNNING
    np.testing.assert_array_equal(after["q"], q)


@pytest.mark.parametrize(
    ("waited", "reached"), [(9.0, 20.0), (0.0, 99.0)], ids=["patience", "iterations"]
)
def test_reaching_gives_up_after_a_while(robot, stepper, waited, reached):
    points, normals = robot.contacts(robot.home)
    parameters = stepper.parameters(points + 5.0, normals)
    state = stepper.state(robot.home)
    layout = stepper.step.state
    state[layout.slice("best")] = 1e-3
    state[layout.slice("waited")] = waited - 1
    state[layout.slice("reached")] = reached - 1
    after, _, _ = stepper(state, parameters)
    assert after["phase"] == Phase.THUMB_REACHING
    state[layout.slice("waited")] = waited
    state[layout.slice("reached")] = reached
    after, _, _ = stepper(state, parameters)
    assert after["phase"] == Phase.HAND_ALIGNMENT
    assert after["waited"] == 0


def test_alignment_closes_the_fingers_first(robot, stepper, rng):
    """With the arm in place the fingers' own step is all there is to do."""
    goal = pinch(robot, rng)
    q = goal.copy()
    q[[7, 10, 11, 12, 13]] = robot.home[[7, 10, 11, 12, 13]]
    after, record, status = stepper(
        stepper.state(q, Phase.HAND_ALIGNMENT), stepper.parameters(*robot.contacts(goal))
    )
    assert status == Status.SOLVED == record["status"]
    assert record["phase"] == Phase.HAND_ALIGNMENT
    np.testing.assert_allclose(record["q"], goal, atol=1e-6)
    np.testing.assert_array_equal(after["q"], record["q"])
    assert record["position_error"].max() < 1e-8


def test_alignment_records_the_configuration_after_the_fingers(robot, stepper, rng):
    """The row holds the finger step's own result and its errors."""
    fingers = finger_step_function(robot.description, "closed-form")
    points, normals = robot.contacts(pinch(robot, rng))
    q = robot.home
    after, record, status = stepper(
        stepper.state(q, Phase.HAND_ALIGNMENT), stepper.parameters(points, normals)
    )
    palm = robot.palm(q)
    local = palm[:3, :3].T @ (points[1:] - palm[:3, 3]).T
    closed = np.array(fingers(q, local, palm[:3, :3].T @ normals[1:].T)).ravel()
    assert status == Status.RUNNING
    np.testing.assert_allclose(record["q"], closed, atol=1e-12)
    np.testing.assert_allclose(
        record["position_error"],
        np.linalg.norm(robot.contacts(closed)[0] - points, axis=1),
        rtol=1e-10,
    )
    assert np.isnan(record["palm_error"])
    assert record["condition_closed_chain"] >= 1
    assert record["step_size"] == pytest.approx(np.abs(after["q"] - q).max(), rel=1e-9)
    assert np.all(record["palm_motion"] > 0)


def test_alignment_keeps_the_thumb(robot, stepper, rng):
    """Thumb keeping brings a thumb that is off its contact back to it."""
    goal = pinch(robot, rng)
    points, normals = robot.contacts(goal)
    q = goal.copy()
    q[:7] += rng.normal(scale=2e-3, size=7)
    before = np.linalg.norm(robot.contacts(q)[0][0] - points[0])
    state = stepper.state(q, Phase.HAND_ALIGNMENT)
    parameters = stepper.parameters(points, normals)
    parameters[stepper.step.parameters.slice("position_tolerance")] = 1e-9
    after, _, _ = stepper(state, parameters)
    assert before > 1e-4
    assert np.linalg.norm(robot.contacts(after["q"])[0][0] - points[0]) < 0.05 * before


def test_limits_are_kept_or_ignored(robot, stepper, rng):
    """The same step, clamped or not."""
    points, normals = robot.contacts(robot.random(rng, 1)[0])
    q = robot.upper.copy()
    free, record, _ = stepper(stepper.state(q), stepper.parameters(points, normals))
    kept, _, _ = stepper(stepper.state(q), stepper.parameters(points, normals, True))
    assert np.any(free["q"] > robot.upper + 1e-3)
    np.testing.assert_array_equal(kept["q"], np.clip(free["q"], robot.lower, robot.upper))
    assert record["limit_mask"] == 2**14 - 1


def test_limit_mask_names_the_actuators(robot, stepper):
    q = robot.home.copy()
    q[1], q[4], q[9] = robot.upper[1], robot.lower[4] - 0.1, robot.lower[9]
    points, normals = robot.contacts(robot.home)
    _, record, _ = stepper(stepper.state(q), stepper.parameters(points, normals))
    assert int(record["limit_mask"]) == 2**1 + 2**4 + 2**9


def test_step_cap(robot, rng):
    capped = Stepper(robot, step_cap=0.01)
    points, normals = robot.contacts(pinch(robot, rng))
    after, record, _ = capped(capped.state(robot.home), capped.parameters(points, normals))
    assert np.abs(after["q"] - robot.home).max() == pytest.approx(0.01, rel=1e-12)
    assert record["step_size"] == pytest.approx(0.01, rel=1e-12)


def test_graph_sizes_and_name(robot, stepper):
    graph = stepper.graph
    assert graph.compilable
    assert graph.name == "enhanced_dls_kuka_lwr_barrett"
    assert isinstance(graph.function, ca.Function)
    assert not EnhancedStep(robot.description, QiuParameters()).graph().compilable
    assert stepper.step.record.names[0] == "q"


@pytest.mark.parametrize("options", [{"platform": "palm"}, {"palm_error": "rotation-vector"}])
def test_other_readings_step_as_well(robot, rng, options):
    other = Stepper(robot, **options)
    points, normals = robot.contacts(pinch(robot, rng))
    for phase in (Phase.THUMB_REACHING, Phase.HAND_ALIGNMENT):
        after, _, _ = other(other.state(robot.home, phase), other.parameters(points, normals))
        assert np.all(np.isfinite(after["q"]))
