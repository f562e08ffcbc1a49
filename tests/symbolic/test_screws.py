"""Dual quaternions, and kinematics by them, against pinocchio and products of frames."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from algebra_samples import (
    PROPERTY,
    central_difference,
    coordinate,
    gradient,
    graph,
    rotation_vectors,
    unit_vectors,
    vectors,
)
from hypothesis import given
from hypothesis import strategies as st

import casadi_ik as ik
from casadi_ik.symbolic import dual_quaternion as dq
from casadi_ik.symbolic.kinematics import actuated, forward
from casadi_ik.symbolic.screws import screw_chain_to_contact


@pytest.fixture(params=["shipped", "coupled"])
def any_robot(request, robot, coupled_robot):
    return robot if request.param == "shipped" else coupled_robot


def symbols(robot):
    theta = ca.SX.sym("theta", len(robot.description.movable))
    index = {name: i for i, name in enumerate(robot.description.joint_names)}
    return theta, lambda chain: theta[[index[name] for name in chain.joints]]


def evaluated(f, theta):
    return [np.array(value) for value in f.call([ca.DM(theta)])]


def random_theta(robot, rng, count):
    d = robot.description
    return rng.uniform(d.joint_lower, d.joint_upper, (count, len(d.movable)))


def test_contact_frames(any_robot, rng):
    theta, of = symbols(any_robot)
    kinematics = forward(any_robot.description, theta)
    for finger in any_robot.fingers:
        chain = screw_chain_to_contact(any_robot.description, finger)
        pose = chain.at(of(chain)).pose
        expected = kinematics.contact_frame(finger)
        f = ca.Function(
            "f",
            [theta],
            [*dq.to_pose(pose), dq.norm(pose), ca.densify(expected.rotation), expected.origin],
        )
        for row in random_theta(any_robot, rng, 10):
            R, p, norm, R_se3, p_se3 = evaluated(f, row)
            np.testing.assert_allclose(R, R_se3, atol=1e-12)
            np.testing.assert_allclose(p, p_se3, atol=1e-12)
            np.testing.assert_allclose(norm.ravel(), [1, 0], atol=1e-13)


def test_axes_are_the_lines_the_joints_turn_about(any_robot, rng):
    """Eq. (6): the direction is the joint's axis and the line runs through its frame."""
    theta, of = symbols(any_robot)
    kinematics = forward(any_robot.description, theta)
    children = {joint.name: joint.child for joint in any_robot.description.movable}
    for finger in any_robot.fingers:
        chain = screw_chain_to_contact(any_robot.description, finger)
        axes = chain.at(of(chain)).axes
        outputs = []
        for name, (direction, moment) in zip(chain.joints, axes, strict=True):
            axis = kinematics.axes[name]
            outputs += [
                direction - axis,
                moment - ca.cross(kinematics.links[children[name]].origin, axis),
            ]
        f = ca.Function("f", [theta], [ca.densify(ca.horzcat(*outputs))])
        for row in random_theta(any_robot, rng, 5):
            assert np.abs(evaluated(f, row)[0]).max() < 1e-12


def test_screw_jacobian_over_the_motors(any_robot, rng):
    """Eqs. (5) and (12): couplings by the chain rule, then the reference point moved to the tip."""
    q = ca.SX.sym("q", len(any_robot.actuators))
    body = actuated(any_robot.description, q)
    everything = range(q.numel())
    index = {name: i for i, name in enumerate(any_robot.description.joint_names)}
    for finger in any_robot.fingers:
        chain = screw_chain_to_contact(any_robot.description, finger)
        rows = [index[name] for name in chain.joints]
        screws = chain.at(body.kinematics.theta[rows]).jacobian @ body.coupling[rows, :]
        point, _ = body.kinematics.contact(finger)
        moved = screws[:3, :] + ca.horzcat(*(ca.cross(screws[3:, i], point) for i in everything))
        linear, angular = body.contact_jacobian(finger, everything)
        f = ca.Function(
            "f", [q], [ca.densify(ca.vertcat(moved, screws[3:, :])), ca.vertcat(linear, angular)]
        )
        for row in any_robot.random(rng, 5):
            ours, geometric = (np.array(x) for x in f.call([ca.DM(row)]))
            scale = np.abs(geometric).max()
            assert scale > 0.1
            np.testing.assert_allclose(ours, geometric, atol=1e-12 * scale)


def test_reference_pose_is_that_of_all_joints_at_zero(robot):
    chain = screw_chain_to_contact(robot.description, "thumb")
    assert chain.joints[:2] == ("lwr_joint_1", "lwr_joint_2")
    assert chain.joints[-2:] == ("bh_thumb_proximal", "bh_thumb_distal")
    points, _ = robot.contacts(np.zeros(14))
    start = np.array(dq.translation(ca.DM(chain.reference))).ravel()
    np.testing.assert_allclose(start, points[0], atol=1e-15)
    np.testing.assert_allclose(chain.screws[0].moment, 0, atol=1e-15)
    # Joint 2 turns about -y at the shoulder's height.
    np.testing.assert_allclose(chain.screws[1].moment, [0.3105, 0, 0], atol=1e-15)


def test_unknown_finger(robot):
    with pytest.raises(ik.errors.UnknownNameError, match="no finger 'x'"):
        screw_chain_to_contact(robot.description, "x")


X, V, M, S, Q = (8, 1), (3, 1), (3, 3), (1, 1), (4, 1)
multiply = graph(dq.multiply, X, X)
conjugate = graph(dq.conjugate, X)
norm = graph(dq.norm, X)
from_pose = graph(dq.from_pose, M, V)
from_translation = graph(dq.from_translation, V)
from_quaternion = graph(dq.from_quaternion, Q, V)
to_pose = graph(dq.to_pose, X)
exp_screw = graph(dq.exp_screw, S, S, V, V)
exp = graph(dq.exp, V, V)
log = graph(dq.log, X)
on_point = graph(dq.act_on_point, X, V)
on_line = graph(dq.act_on_line, X, V, V)
error = graph(dq.error, X, X)
error_norm = graph(dq.screw_error_norm, X)
poses = st.builds(lambda w, p: pin.SE3(pin.exp3(w), p), rotation_vectors, vectors)
numbers = st.tuples(*[coordinate] * 8).map(np.array)


def number(pose: pin.SE3) -> np.ndarray:
    return from_pose(pose.rotation, pose.translation).full()[:, 0]


def same_pose(a: np.ndarray, b: np.ndarray, atol: float = 4e-15) -> bool:
    return min(np.abs(a - b).max(), np.abs(a + b).max()) < atol


def full(x) -> np.ndarray:
    return x.full()[:, 0]


@PROPERTY
@given(numbers, numbers, numbers)
def test_ring(a, b, c):
    left, right = full(multiply(multiply(a, b), c)), full(multiply(a, multiply(b, c)))
    assert np.allclose(left, right, rtol=0, atol=1e-14)
    reversed_ = full(multiply(conjugate(b), conjugate(a)))
    assert np.allclose(full(conjugate(multiply(a, b))), reversed_, rtol=0, atol=4e-15)
    assert np.array_equal(full(multiply(a, dq.identity())), a)
    if np.linalg.norm(a[:4]) > 0.1:
        length = full(norm(a))
        squared = full(multiply(a, conjugate(a)))
        assert np.allclose(squared[[0, 4]], [length[0] ** 2, 2 * length[0] * length[1]], atol=1e-14)


@PROPERTY
@given(poses, poses, vectors)
def test_poses_multiply_like_transforms(A, B, x):
    a, b = number(A), number(B)
    assert same_pose(full(multiply(a, b)), number(A * B))
    assert same_pose(full(multiply(a, conjugate(a))), dq.identity().full()[:, 0])
    assert same_pose(full(conjugate(a)), number(A.inverse()))
    R, p = to_pose(multiply(a, b))
    assert np.allclose(R.full(), (A * B).rotation, rtol=0, atol=4e-15)
    assert np.allclose(full(p), (A * B).translation, rtol=0, atol=4e-15)
    assert np.allclose(full(on_point(-a, x)), A.act(x), rtol=0, atol=4e-15)
    rotation = from_quaternion(a[:4], np.zeros(3))
    shift = from_translation(A.translation)
    assert np.allclose(full(multiply(shift, rotation)), a, rtol=0, atol=1e-15)


@PROPERTY
@given(poses, unit_vectors, vectors)
def test_lines_move_with_their_points(A, direction, point):
    moment = np.cross(point, direction)
    moved, moved_moment = (full(x) for x in on_line(number(A), direction, moment))
    assert np.allclose(moved, A.rotation @ direction, rtol=0, atol=4e-15)
    assert np.allclose(moved_moment, np.cross(A.act(point), moved), rtol=0, atol=6e-15)
    # Eq. (6) literally: x s x* with the classical conjugate.
    x = number(A)
    s = np.concatenate([[0], direction, [0], moment])
    literal = full(multiply(multiply(x, s), conjugate(x)))
    assert np.allclose(literal, [0, *moved, 0, *moved_moment], rtol=0, atol=6e-15)


@PROPERTY
@given(rotation_vectors, vectors)
def test_exp_and_log_are_those_of_se3(w, v):
    x = full(exp(w, v))
    expected = pin.exp6(pin.Motion(v, w))
    assert same_pose(x, number(expected))
    found_w, found_v = (full(y) for y in log(x))
    assert np.allclose(found_w, w, rtol=0, atol=4e-15)
    assert np.allclose(found_v, v, rtol=0, atol=2e-14)
    minus_w, minus_v = (full(y) for y in log(-x))
    assert np.array_equal(minus_w, found_w)
    assert np.array_equal(minus_v, found_v)
    size = np.hypot(np.linalg.norm(w), np.linalg.norm(v))
    assert abs(float(error_norm(x)) - size) < 2e-14


@PROPERTY
@given(st.floats(-np.pi + 1e-6, np.pi - 1e-6), coordinate, unit_vectors, vectors)
def test_screw_of_eq_1_has_the_logarithm_of_eq_14(theta, d, direction, point):
    moment = np.cross(point, direction)
    x = full(exp_screw(theta, d, direction, moment))
    assert np.allclose(full(norm(x)), [1, 0], rtol=0, atol=1e-15)
    w, v = (full(y) for y in log(x))
    assert np.allclose(w, theta * direction, rtol=0, atol=4e-15)
    assert np.allclose(v, theta * moment + d * direction, rtol=0, atol=2e-14)
    # A point of the axis only slides along it; without a turn the screw is a translation.
    assert np.allclose(full(on_point(x, point)), point + d * direction, rtol=0, atol=6e-15)
    slid = full(exp_screw(0, d, direction, moment))
    assert np.allclose(slid, full(from_translation(d * direction)), rtol=0, atol=1e-16)


@PROPERTY
@given(poses, poses)
def test_error_leads_from_one_pose_to_the_other(A, B):
    a, b = number(A), number(B)
    assert same_pose(full(multiply(full(error(a, b)), b)), a, atol=1e-14)


@PROPERTY
@given(rotation_vectors.filter(lambda w: np.linalg.norm(w) < 3), vectors)
def test_derivatives(w, v):
    through = LOG_OF_EXP_GRADIENT(w, v).full()
    assert np.allclose(through, np.eye(6), rtol=0, atol=1e-10)
    ad = EXP_GRADIENT(w, v).full()
    assert np.allclose(ad, central_difference(exp, w, v), rtol=0, atol=1e-9)


LOG_OF_EXP_GRADIENT = gradient(lambda w, v: dq.log(dq.exp(w, v)), V, V)
EXP_GRADIENT = gradient(dq.exp, V, V)


def test_derivatives_are_finite_at_no_rotation_and_at_half_a_turn():
    log_gradient, norm_gradient = gradient(dq.log, X), gradient(dq.screw_error_norm, X)
    for x in (dq.identity(), from_translation([0.1, 0.2, 0.3]), exp([np.pi, 0, 0], [0, 1, 0])):
        assert log_gradient(x).is_regular()
        assert norm_gradient(x).is_regular()
    assert log_gradient([0, 0, 1, 0, 0.1, 0.2, 0, 0]).is_regular()
    assert gradient(dq.from_pose, M, V)(np.eye(3), np.zeros(3)).is_regular()
