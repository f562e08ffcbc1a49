"""Linear solves against numpy, and the identities that damped least squares must keep."""

import casadi as ca
import numpy as np
import pytest
from algebra_samples import central_difference, gradient, graph

from casadi_ik.symbolic import linear_algebra as la

solve_spd = graph(la.solve_spd, (6, 6), (6, 4))
solve = graph(la.solve, (6, 6), (6, 4))
WIDE, TALL = (3, 9), (6, 4)


def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def conditioned(random: np.random.Generator, n: int, decades: float) -> np.ndarray:
    U, _, Vt = np.linalg.svd(random.standard_normal((n, n)))
    return U * 10.0 ** -np.linspace(0, decades, n) @ Vt


def test_solve_is_backward_stable_up_to_condition_1e12():
    random = rng()
    for _ in range(300):
        decades = random.uniform(0, 12)
        A, x = conditioned(random, 6, decades), random.standard_normal((6, 4))
        found = solve(A, A @ x).full()
        assert np.abs(found - x).max() < 1e-14 * 10**decades
        residual = np.linalg.norm(A @ found - A @ x, axis=0)
        assert np.all(residual < 4e-15 * np.linalg.norm(A) * np.linalg.norm(found, axis=0))


def test_solve_needs_no_lucky_diagonal():
    A = np.roll(np.eye(6), 1, axis=0)
    assert np.allclose(A @ solve(A, np.ones((6, 4))).full(), 1, rtol=0, atol=1e-15)


def test_solve_spd():
    random = rng()
    for _ in range(100):
        B = conditioned(random, 6, random.uniform(0, 4))
        A, x = B @ B.T, random.standard_normal((6, 4))
        scale = np.linalg.cond(A)
        assert np.abs(solve_spd(A, A @ x).full() - x).max() < 2e-14 * scale
        upper_is_ignored = np.tril(A)
        assert np.array_equal(solve_spd(upper_is_ignored, A @ x).full(), solve_spd(A, A @ x).full())


@pytest.mark.parametrize("f", [solve, solve_spd])
def test_singular_systems_stay_finite(f):
    assert f(np.zeros((6, 6)), np.ones((6, 4))).is_regular()
    assert f(np.ones((6, 6)), np.ones((6, 4))).is_regular()
    assert f(np.diag([1.0, 0, 1, 0, 1, 0]), np.ones((6, 4))).is_regular()


@pytest.mark.parametrize("f", [la.solve, la.solve_spd])
def test_solves_differentiate(f):
    random = rng()
    B = random.standard_normal((3, 3))
    A, b = B @ B.T + np.eye(3), random.standard_normal((3, 1))
    ad = gradient(f, (3, 3), (3, 1))(A, b).full()
    assert np.allclose(ad, central_difference(graph(f, (3, 3), (3, 1)), A, b), rtol=0, atol=1e-7)


@pytest.mark.parametrize("shape", [WIDE, TALL])
def test_damped_least_squares(shape):
    m, n = shape
    random = rng()
    dls = graph(la.damped_pinv_times, shape, (m, 1), (1, 1))
    weighted = graph(la.weighted_damped_pinv_times, shape, (m, 1), (1, 1), (n, 1))
    for _ in range(30):
        J, e = random.standard_normal(shape), random.standard_normal(m)
        lam, w = 10 ** random.uniform(-3, 0), random.uniform(0.2, 5, n)
        rhs = np.concatenate([e, np.zeros(n)])
        for found, damping in (
            (dls(J, e, lam), lam * np.eye(n)),
            (weighted(J, e, lam, w), lam * np.diag(np.sqrt(w))),
        ):
            expected = np.linalg.lstsq(np.vstack([J, damping]), rhs)[0]
            assert np.allclose(found.full()[:, 0], expected, rtol=1e-11, atol=1e-12)
        equal = weighted(J, e, lam, np.ones(n)).full()
        assert np.allclose(equal, dls(J, e, lam).full(), rtol=0, atol=1e-12)
    assert np.array_equal(dls(np.zeros(shape), e, 0.1).full(), np.zeros((n, 1)))


@pytest.mark.parametrize("shape", [WIDE, TALL])
def test_pseudoinverse_and_null_space(shape):
    m, n = shape
    random = rng()
    pinv = graph(la.pinv_times, shape, (m, 1))
    projector = graph(la.null_projector, shape)
    project = graph(la.project_to_null_space, shape, (n, 1))
    for k in range(30):
        J, x = random.standard_normal(shape), random.standard_normal(n)
        if k % 2:
            J[1] = J[0]  # rank-deficient, in the null space of which more fits
        s = np.linalg.svd(J, compute_uv=False)
        smallest = s[s > 1e-10].min()
        tolerance = 1e-3 if k % 2 else 4e-12 / smallest**2 + 1e-12
        e = J @ x
        N = projector(J).full()
        assert np.allclose(N, np.eye(n) - np.linalg.pinv(J) @ J, rtol=0, atol=tolerance)
        assert np.allclose(N, N.T, rtol=0, atol=tolerance)
        assert np.allclose(project(J, x).full()[:, 0], N @ x, rtol=0, atol=tolerance)
        found = pinv(J, e).full()[:, 0]
        assert np.allclose(found, np.linalg.pinv(J) @ e, rtol=0, atol=10 * tolerance)


def test_solves_take_mx_and_dm():
    A, b = ca.MX.sym("A", 3, 3), ca.MX.sym("b", 3)
    f = ca.Function("f", [A, b], [la.solve(A, b), la.solve_spd(A, b), la.null_projector(A)])
    M = np.diag([1.0, 2.0, 4.0])
    assert np.allclose(f(M, [1, 1, 1])[0].full()[:, 0], [1, 0.5, 0.25])
    assert np.allclose(la.solve(ca.DM(M), ca.DM([1, 1, 1])).full()[:, 0], [1, 0.5, 0.25])


def test_instruction_counts_stay_small():
    assert solve.n_instructions() < 960
    assert solve_spd.n_instructions() < 430
    assert graph(la.damped_pinv_times, WIDE, (3, 1), (1, 1)).n_instructions() < 230
