"""The best rotation against scipy's."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from casadi_ik.symbolic.se3 import align


@pytest.fixture(scope="module")
def best():
    B = ca.SX.sym("B", 3, 3)
    function = ca.Function("align", [B], [align(B)])
    return lambda matrix: np.array(function(matrix))


def contraction(B):
    """What 128 steps of the power iteration leave of an error, from Davenport's eigenvalues."""
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


def test_any_scale(best, rng):
    a, turn = rng.normal(size=(4, 3)), Rotation.random(rng=rng).as_matrix()
    B = (a @ turn.T).T @ a
    for scale in (1e-6, 1.0, 1e6):
        np.testing.assert_allclose(best(scale * B), best(B), atol=1e-9)


def test_half_a_turn(best):
    turn = Rotation.from_rotvec([0, 0, np.pi]).as_matrix()
    np.testing.assert_allclose(best(turn), turn, atol=1e-9)


def test_one_vector_and_nothing_give_a_rotation(best):
    for B in (np.outer([0, 0, 1.0], [1.0, 0, 0]), np.zeros((3, 3))):
        R = best(B)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert best(np.outer([0, 0, 1.0], [1.0, 0, 0]))[2, 0] == pytest.approx(1, abs=1e-9)
