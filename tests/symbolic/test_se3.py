"""Rigid transforms against pinocchio (whose Motion is [v; w] as well)."""

import numpy as np
import pinocchio as pin
from algebra_samples import (
    PROPERTY,
    central_difference,
    gradient,
    graph,
    rotation_vectors,
    vectors,
)
from hypothesis import given

from casadi_ik.symbolic import se3

V, M, W, H = (3, 1), (3, 3), (6, 1), (4, 4)
exp = graph(se3.exp_se3, W)
log = graph(lambda R, p: se3.log_se3((R, p)), M, V)
compose = graph(lambda R, p, Q, q: se3.compose((R, p), (Q, q)), M, V, M, V)
inverse = graph(lambda R, p: se3.inverse((R, p)), M, V)
act = graph(lambda R, p, x: se3.act((R, p), x), M, V, (3, 2))
to_matrix = graph(lambda R, p: se3.to_matrix((R, p)), M, V)
from_matrix = graph(se3.from_matrix, H)
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
    assert np.allclose(log(*exp(twist)).full()[:, 0], twist, rtol=0, atol=2e-14)
    if np.linalg.norm(w) < np.pi - 1e-3:
        expected = pin.log6(pin.exp6(pin.Motion(v, w))).vector
        assert np.allclose(log(*exp(twist)).full()[:, 0], expected, rtol=0, atol=1e-11)


@PROPERTY
@given(rotation_vectors, vectors, rotation_vectors, vectors, vectors)
def test_group_operations(wa, pa, wb, pb, x):
    A, B = transform(wa, pa), transform(wb, pb)
    R, p = compose(A.rotation, pa, B.rotation, pb)
    AB = A * B
    assert np.allclose(R.full(), AB.rotation, rtol=0, atol=2e-15)
    assert np.allclose(p.full()[:, 0], AB.translation, rtol=0, atol=2e-15)
    R, p = inverse(A.rotation, pa)
    assert np.allclose(to_matrix(R, p).full(), A.inverse().homogeneous, rtol=0, atol=2e-15)
    both = np.stack([x, 2 * x], axis=1)
    moved = act(A.rotation, pa, both).full()
    assert np.allclose(moved, A.rotation @ both + pa[:, None], rtol=0, atol=2e-15)
    R, p = from_matrix(A.homogeneous)
    assert np.array_equal(to_matrix(R, p).full(), A.homogeneous)


@PROPERTY
@given(vectors, rotation_vectors.filter(lambda w: np.linalg.norm(w) < 3.0))
def test_derivatives(v, w):
    twist = np.concatenate([v, w])
    assert np.allclose(
        exp_gradient(twist).full(), central_difference(exp, twist), rtol=0, atol=1e-9
    )
    assert np.allclose(log_of_exp_gradient(twist).full(), np.eye(6), rtol=0, atol=1e-10)


def test_derivative_of_log_is_finite_at_the_identity_and_at_half_turns():
    df = gradient(lambda R, p: se3.log_se3((R, p)), M, V)
    for R in (np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1])):
        assert df(R, [0.1, 0.2, 0.3]).is_regular()
        assert df(R, [0, 0, 0]).is_regular()
    assert exp_gradient(np.zeros(6)).is_regular()
