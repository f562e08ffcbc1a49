"""Rotations, rigid transforms and dual quaternions, compared with pinocchio and scipy.

Pinocchio's Motion is [v; w] as well.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from algebra_samples import (
    PROPERTY,
    angles,
    central_difference,
    coordinate,
    gradient,
    graph,
    random_rotation,
    rotation_vectors,
    unit_vectors,
    vectors,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.kinematics import se3
from casadi_ik.kinematics.se3 import align

V, M, W = (3, 1), (3, 3), (6, 1)
exp = graph(se3.exp_se3, W)
log = graph(lambda R, p: se3.log_se3((R, p)), M, V)
compose = graph(lambda R, p, Q, q: se3.compose((R, p), (Q, q)), M, V, M, V)
inverse = graph(lambda R, p: se3.inverse((R, p)), M, V)
exp_gradient = gradient(se3.exp_se3, W)
log_of_exp_gradient = gradient(lambda xi: se3.log_se3(se3.exp_se3(xi)), W)


def transform(w: np.ndarray, p: np.ndarray) -> pin.SE3:
    return pin.SE3(pin.exp3(w), p)


@PROPERTY
@given(vectors, rotation_vectors)
def test_exp_agrees_with_pinocchio(v, w):
    R, p = exp(np.concatenate([v, w]))
    expected = pin.exp6(pin.Motion(v, w))
    assert np.allclose(R.full(), expected.rotation, rtol=0, atol=2e-15)
    assert np.allclose(p.full()[:, 0], expected.translation, rtol=0, atol=4e-15)


@PROPERTY
@given(vectors, rotation_vectors)
def test_log_undoes_exp(v, w):
    twist = np.concatenate([v, w])
    logarithm = log(*exp(twist)).full()[:, 0]
    assert np.allclose(logarithm, twist, rtol=0, atol=2e-14)
    assert np.allclose(logarithm[3:], w, rtol=1e-15, atol=4e-15)
    if np.linalg.norm(w) < np.pi - 1e-3:
        expected = pin.log6(pin.exp6(pin.Motion(v, w))).vector
        assert np.allclose(logarithm, expected, rtol=0, atol=1e-11)


@PROPERTY
@given(rotation_vectors, vectors, rotation_vectors, vectors)
def test_group_operations(wa, pa, wb, pb):
    A, B = transform(wa, pa), transform(wb, pb)
    R, p = compose(A.rotation, pa, B.rotation, pb)
    AB = A * B
    assert np.allclose(R.full(), AB.rotation, rtol=0, atol=2e-15)
    assert np.allclose(p.full()[:, 0], AB.translation, rtol=0, atol=2e-15)
    R, p = inverse(A.rotation, pa)
    back = np.hstack([R.full(), p.full()])
    assert np.allclose(back, A.inverse().homogeneous[:3], rtol=0, atol=2e-15)


@PROPERTY
@given(vectors, rotation_vectors.filter(lambda w: np.linalg.norm(w) < 3.0))
def test_derivatives(v, w):
    twist = np.concatenate([v, w])
    assert np.allclose(
        exp_gradient(twist).full(), central_difference(exp, twist), rtol=0, atol=1e-9
    )
    assert np.allclose(log_of_exp_gradient(twist).full(), np.eye(6), rtol=0, atol=1e-10)


Q = (4, 1)
so3_exp = graph(se3.exp_so3, V)
so3_log = graph(se3.log_so3, M)
quaternion_exp = graph(se3.quaternion_exp, V)
quaternion_log = graph(se3.quaternion_log, Q)
so3_from_matrix = graph(se3.quaternion_from_matrix, M)
so3_to_matrix = graph(se3.quaternion_to_matrix, Q)
to_rpy = graph(se3.matrix_to_rpy, M)
euler = graph(se3.euler_zyx, M)
euler_inverse = graph(se3.angular_velocity_to_euler_zyx, V)
mean = graph(se3.mean_rotation, M, M)
project = graph(se3.project_to_rotation, M)


def svd_projection(A: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(A)
    return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt


@PROPERTY
@given(unit_vectors)
def test_log_of_half_turn_is_one_of_two_vectors(axis):
    w = so3_log(so3_exp(np.pi * axis)).full()[:, 0]
    assert min(np.abs(w - np.pi * axis).max(), np.abs(w + np.pi * axis).max()) < 1e-14


@PROPERTY
@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    assert np.allclose(se3.skew(ca.DM(a)).full() @ b, np.cross(a, b), rtol=0, atol=1e-15)


@PROPERTY
@given(rotation_vectors)
def test_quaternions_agree_with_scipy(w):
    R = Rotation.from_rotvec(w)
    expected = R.as_quat(scalar_first=True)
    for q in (quaternion_exp(w).full()[:, 0], so3_from_matrix(R.as_matrix()).full()[:, 0]):
        assert min(np.abs(q - expected).max(), np.abs(q + expected).max()) < 2e-15
    assert np.allclose(so3_to_matrix(expected).full(), R.as_matrix(), rtol=0, atol=2e-15)
    assert np.allclose(quaternion_log(-expected).full()[:, 0], w, rtol=0, atol=4e-15)


@PROPERTY
@given(st.tuples(st.floats(-3.1, 3.1), st.floats(-1.57, 1.57), st.floats(-3.1, 3.1)))
def test_rpy_is_the_urdf_convention(rpy_angles):
    R = pin.rpy.rpyToMatrix(np.array(rpy_angles))
    assert np.allclose(to_rpy(R).full()[:, 0], rpy_angles, rtol=0, atol=1e-12)
    assert np.allclose(euler(R).full()[::-1, 0], rpy_angles, rtol=0, atol=1e-12)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_gimbal_lock_keeps_the_rotation(pitch):
    R = pin.rpy.rpyToMatrix(0.4, pitch, -0.3)
    angles_read = to_rpy(R).full()[:, 0]
    assert angles_read[0] == 0
    assert np.allclose(pin.rpy.rpyToMatrix(angles_read), R, rtol=0, atol=1e-15)
    assert gradient(se3.matrix_to_rpy, M)(R).is_regular()
    assert euler_inverse([0.4, pitch, 0.1]).is_regular()


@PROPERTY
@given(st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3)))
def test_euler_rates(zyx):
    inverse, order = euler_inverse(zyx).full(), np.eye(3)[::-1]
    R = pin.rpy.rpyToMatrix(order @ zyx)
    for k, step in enumerate(1e-6 * np.eye(3)):
        high, low = (pin.rpy.rpyToMatrix(order @ (np.array(zyx) + s)) for s in (step, -step))
        spin = (high - low) @ R.T / 2e-6
        omega = [spin[2, 1], spin[0, 2], spin[1, 0]]
        assert np.allclose(inverse @ omega, np.eye(3)[k], rtol=0, atol=1e-7)


@PROPERTY
@given(rotation_vectors, angles.filter(lambda a: a < np.pi - 1e-2), unit_vectors)
def test_mean_of_two_rotations_is_the_svd_projection(w, angle, axis):
    Ra = pin.exp3(w)
    Rb = Ra @ pin.exp3(angle * axis)
    expected = svd_projection(0.5 * (Ra + Rb))
    assert np.allclose(mean(Ra, Rb).full(), expected, rtol=0, atol=1e-13)
    assert np.allclose(project(0.5 * (Ra + Rb)).full(), expected, rtol=0, atol=1e-12)


def test_mean_at_half_a_turn_apart_is_still_a_rotation():
    R = mean(np.eye(3), np.diag([1.0, -1.0, -1.0])).full()
    assert np.allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-15)
    assert np.linalg.det(R) > 0


def test_projection_of_random_matrices_is_the_svd_projection():
    rng = np.random.default_rng(0)
    samples = [rng.standard_normal((3, 3)) * 10 ** rng.uniform(-3, 3) for _ in range(300)]
    samples = [A for A in samples if np.linalg.det(A) > 0 and np.linalg.cond(A) < 1e4]
    assert len(samples) > 100
    for A in samples:
        assert np.allclose(project(A).full(), svd_projection(A), rtol=0, atol=1e-11)


def test_derivatives_are_finite_at_the_identity_and_at_half_turns():
    rng = np.random.default_rng(1)
    log_gradient = gradient(lambda R, p: se3.log_se3((R, p)), M, V)
    mean_gradient = gradient(se3.mean_rotation, M, M)
    turns = [np.diag(d) for d in ([1.0, 1, 1], [1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    for R in [*turns, *(random_rotation(rng) for _ in range(5))]:
        for p in ([0.1, 0.2, 0.3], [0, 0, 0]):
            assert log_gradient(R, p).is_regular()
        assert mean_gradient(R, turns[0]).is_regular()
    assert exp_gradient(np.zeros(6)).is_regular()
    assert gradient(se3.project_to_rotation, M)(np.eye(3)).is_regular()
    half_turn = gradient(se3.quaternion_log, Q)
    assert half_turn([0, 1, 0, 0]).is_regular()
    assert half_turn([-1, 0, 0, 0]).is_regular()


angle = graph(se3.angle_between, V, V)
error = graph(se3.normal_error, V, V)
rotation = graph(se3.rotation_between, V, V)
perpendicular = graph(se3.perpendicular, V)
gradients = [gradient(f, V, V) for f in (se3.angle_between, se3.normal_error, se3.rotation_between)]
SPECIAL = [np.array(v, float) for v in ([0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0])]


def rotated_line(n: np.ndarray, w: np.ndarray, theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit axis perpendicular to n nearest to w, and n turned about it by theta."""
    axis = np.cross(n, np.cross(w, n))
    axis /= np.linalg.norm(axis)
    return axis, np.cos(theta) * n + np.sin(theta) * np.cross(axis, n)


thetas = st.one_of(
    st.sampled_from([1e-300, 1e-15, 1e-9, 1e-5, 0.99e-4, 1.01e-4, 1e-3]),
    st.floats(1e-3, 3.14),
    st.sampled_from([np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-8, np.pi - 1e-10]),
)


@PROPERTY
@given(unit_vectors, unit_vectors, thetas)
def test_error_turns_current_into_desired(n, w, theta):
    if np.linalg.norm(np.cross(n, w)) < 0.1:
        w = np.roll(n, 1) * [1, -1, 1]
    if np.linalg.norm(np.cross(n, w)) < 0.1:
        return
    axis, d = rotated_line(n, w, theta)
    # Rounding of the normals changes their angle by about 1e-16, and the axis by 1e-16 / sin.
    slack = 1e-15 / max(np.sin(theta), 1e-15)
    assert abs(float(angle(n, d)) - theta) < 1e-15
    e = error(n, d).full()[:, 0]
    assert abs(np.linalg.norm(e) - theta) < 4e-15 + slack * slack
    assert np.linalg.norm(e - theta * axis) < theta * slack + 1e-15
    R = rotation(n, d).full()
    assert np.allclose(R @ n, d, rtol=0, atol=4e-15)
    assert np.allclose(R @ R.T, np.eye(3), rtol=0, atol=4e-15)
    assert np.allclose(R @ axis, axis, rtol=0, atol=2 * slack + 1e-15)


@PROPERTY
@given(unit_vectors)
def test_opposite_normals_get_a_half_turn(n):
    for n_ in (n, *SPECIAL):
        e = error(n_, -n_).full()[:, 0]
        assert abs(np.linalg.norm(e) - np.pi) < 2e-15
        assert abs(e @ n_) < 2e-15
        R = rotation(n_, -n_).full()
        assert np.allclose(R @ n_, -n_, rtol=0, atol=2e-15)
        assert np.allclose(R @ R.T, np.eye(3), rtol=0, atol=4e-15)
        assert np.linalg.det(R) > 0
        p = perpendicular(n_).full()[:, 0]
        assert abs(np.linalg.norm(p) - 1) < 2e-15
        assert abs(p @ n_) < 2e-15


@PROPERTY
@given(unit_vectors)
def test_equal_normals_have_no_error(n):
    assert np.array_equal(error(n, n).full()[:, 0], np.zeros(3))
    assert float(angle(n, n)) < 1e-149
    assert np.allclose(rotation(n, n).full(), np.eye(3), rtol=0, atol=2e-15)
    assert abs(float(angle(3 * n, -0.1 * n)) - np.pi) < 1e-15  # lengths do not matter


@PROPERTY
@given(unit_vectors, unit_vectors)
def test_derivatives_match_central_differences(n, d):
    if np.linalg.norm(n - d) < 0.1 or np.linalg.norm(n + d) < 0.1:
        return
    for f, df in zip((angle, error, rotation), gradients, strict=True):
        assert np.allclose(df(n, d).full(), central_difference(f, n, d), rtol=1e-6, atol=1e-7)


def test_derivatives_are_finite_at_equal_and_opposite_normals():
    for n in [*SPECIAL, np.array([0.6, 0.0, 0.8]), np.array([0.48, -0.6, 0.64])]:
        for df in gradients:
            assert df(n, n).is_regular()
            assert df(n, -n).is_regular()


def test_small_error_is_the_cross_product_to_first_order():
    n = np.array([0.48, -0.6, 0.64])
    J = gradients[1](n, n).full()[:, 3:]
    assert np.allclose(J, np.cross(n, np.eye(3)).T, rtol=0, atol=1e-15)


@pytest.fixture(scope="module")
def best():
    B = ca.SX.sym("B", 3, 3)
    function = ca.Function("align", [B], [align(B)])
    return lambda matrix: np.array(function(matrix))


def contraction(B):
    """Return the remaining error of 128 power iterations, from Davenport's eigenvalues."""
    B = B / np.linalg.norm(B)
    z = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
    K = np.block(
        [[np.trace(B), z[None]], [z[:, None], B + B.T - np.trace(B) * np.eye(3)]]
    ) + 2 * np.eye(4)
    values = np.linalg.eigvalsh(K)
    return (values[-2] / values[-1]) ** 128


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
def test_as_good_as_scipy(best, rng, count, noise):
    clear = 0
    for _ in range(30):
        turn = Rotation.random(rng=rng).as_matrix()
        a, w = rng.normal(size=(count, 3)), rng.uniform(0.1, 2, count)
        b = a @ turn.T + noise * rng.normal(size=(count, 3))
        R = best((w[:, None] * b).T @ a)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
        expected = Rotation.align_vectors(b, a, weights=w)[0].as_matrix()
        left = contraction((w[:, None] * b).T @ a)
        if left < 0.01:
            clear += 1
            np.testing.assert_allclose(R, expected, atol=20 * left + 1e-7)
    assert clear > 10


def test_half_turns_at_any_scale_and_degenerate_inputs(best):
    turn = Rotation.from_rotvec([0, 0, np.pi]).as_matrix()
    for scale in (1e-6, 1.0, 1e6):
        np.testing.assert_allclose(best(scale * turn), turn, atol=1e-9)
    for B in (np.outer([0, 0, 1.0], [1.0, 0, 0]), np.zeros((3, 3))):
        R = best(B)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert best(np.outer([0, 0, 1.0], [1.0, 0, 0]))[2, 0] == pytest.approx(1, abs=1e-9)


X = (8, 1)
multiply = graph(dq.multiply, X, X)
conjugate = graph(dq.conjugate, X)
norm = graph(dq.norm, X)
from_pose = graph(dq.from_pose, M, V)
from_translation = graph(dq.from_translation, V)
from_quaternion = graph(dq.from_quaternion, Q, V)
to_pose = graph(dq.to_pose, X)
dq_exp = graph(dq.exp, V, V)
dq_log = graph(dq.log, X)
on_point = graph(dq.act_on_point, X, V)
on_line = graph(dq.act_on_line, X, V, V)
error_norm = graph(dq.screw_error_norm, X)
dq_log_of_exp_gradient = gradient(lambda w, v: dq.log(dq.exp(w, v)), V, V)
dq_exp_gradient = gradient(dq.exp, V, V)
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
def test_dual_quaternions_are_a_ring(a, b, c):
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
    moved_direction, moved_moment = (full(x) for x in on_line(number(A), direction, moment))
    assert np.allclose(moved_direction, A.rotation @ direction, rtol=0, atol=4e-15)
    assert np.allclose(moved_moment, np.cross(A.act(point), moved_direction), rtol=0, atol=6e-15)
    # Eq. (6) literally: x s x* with the classical conjugate.
    x = number(A)
    s = np.concatenate([[0], direction, [0], moment])
    literal = full(multiply(multiply(x, s), conjugate(x)))
    assert np.allclose(literal, [0, *moved_direction, 0, *moved_moment], rtol=0, atol=6e-15)


@PROPERTY
@given(rotation_vectors, vectors)
def test_exp_and_log_are_those_of_se3(w, v):
    x = full(dq_exp(w, v))
    expected = pin.exp6(pin.Motion(v, w))
    assert same_pose(x, number(expected))
    found_w, found_v = (full(y) for y in dq_log(x))
    assert np.allclose(found_w, w, rtol=0, atol=4e-15)
    assert np.allclose(found_v, v, rtol=0, atol=2e-14)
    minus_w, minus_v = (full(y) for y in dq_log(-x))
    assert np.array_equal(minus_w, found_w)
    assert np.array_equal(minus_v, found_v)
    size = np.hypot(np.linalg.norm(w), np.linalg.norm(v))
    assert abs(float(error_norm(x)) - size) < 2e-14


@PROPERTY
@given(rotation_vectors.filter(lambda w: np.linalg.norm(w) < 3), vectors)
def test_dual_quaternion_derivatives(w, v):
    through = dq_log_of_exp_gradient(w, v).full()
    assert np.allclose(through, np.eye(6), rtol=0, atol=1e-10)
    ad = dq_exp_gradient(w, v).full()
    assert np.allclose(ad, central_difference(dq_exp, w, v), rtol=0, atol=1e-9)


def test_dual_quaternion_derivatives_are_finite_at_special_rotations():
    log_gradient, norm_gradient = gradient(dq.log, X), gradient(dq.screw_error_norm, X)
    for x in (dq.identity(), from_translation([0.1, 0.2, 0.3]), dq_exp([np.pi, 0, 0], [0, 1, 0])):
        assert log_gradient(x).is_regular()
        assert norm_gradient(x).is_regular()
    assert log_gradient([0, 0, 1, 0, 0.1, 0.2, 0, 0]).is_regular()
    assert gradient(dq.from_pose, M, V)(np.eye(3), np.zeros(3)).is_regular()
