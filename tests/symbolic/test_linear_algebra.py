"""Small linear systems, bounded steps and singular values, against numpy and scipy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from algebra_samples import central_difference, gradient, graph
from scipy.optimize import lsq_linear

from casadi_ik.kinematics import linear_algebra as la
from casadi_ik.kinematics.box_qp import BoxBounds, damped_step
from casadi_ik.kinematics.linear_algebra import extreme_singular_values

solve_spd = graph(la.solve_spd, (6, 6), (6, 4))
solve = graph(la.solve, (6, 6), (6, 4))
WIDE, TALL = (3, 9), (6, 4)


def seeded() -> np.random.Generator:
    return np.random.default_rng(11)


def conditioned(random: np.random.Generator, n: int, decades: float) -> np.ndarray:
    U, _, Vt = np.linalg.svd(random.standard_normal((n, n)))
    return U * 10.0 ** -np.linspace(0, decades, n) @ Vt


def test_solve_is_backward_stable_up_to_condition_1e12():
    random = seeded()
    for _ in range(300):
        decades = random.uniform(0, 12)
        A, x = conditioned(random, 6, decades), random.standard_normal((6, 4))
        solution = solve(A, A @ x).full()
        assert np.abs(solution - x).max() < 1e-14 * 10**decades
        residual = np.linalg.norm(A @ solution - A @ x, axis=0)
        assert np.all(residual < 4e-15 * np.linalg.norm(A) * np.linalg.norm(solution, axis=0))


def test_solve_needs_no_lucky_diagonal():
    A = np.roll(np.eye(6), 1, axis=0)
    assert np.allclose(A @ solve(A, np.ones((6, 4))).full(), 1, rtol=0, atol=1e-15)


def test_solve_spd():
    random = seeded()
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
    random = seeded()
    B = random.standard_normal((3, 3))
    A, b = B @ B.T + np.eye(3), random.standard_normal((3, 1))
    ad = gradient(f, (3, 3), (3, 1))(A, b).full()
    assert np.allclose(ad, central_difference(graph(f, (3, 3), (3, 1)), A, b), rtol=0, atol=1e-7)


@pytest.mark.parametrize("shape", [WIDE, TALL])
def test_damped_least_squares(shape):
    m, n = shape
    random = seeded()
    dls = graph(la.damped_pinv_times, shape, (m, 1), (1, 1))
    weighted = graph(la.weighted_damped_pinv_times, shape, (m, 1), (1, 1), (n, 1))
    for _ in range(30):
        J, e = random.standard_normal(shape), random.standard_normal(m)
        lam, w = 10 ** random.uniform(-3, 0), random.uniform(0.2, 5, n)
        rhs = np.concatenate([e, np.zeros(n)])
        for step_found, damping in (
            (dls(J, e, lam), lam * np.eye(n)),
            (weighted(J, e, lam, w), lam * np.diag(np.sqrt(w))),
        ):
            expected = np.linalg.lstsq(np.vstack([J, damping]), rhs)[0]
            assert np.allclose(step_found.full()[:, 0], expected, rtol=1e-11, atol=1e-12)
        equal = weighted(J, e, lam, np.ones(n)).full()
        assert np.allclose(equal, dls(J, e, lam).full(), rtol=0, atol=1e-12)
    assert np.array_equal(dls(np.zeros(shape), e, 0.1).full(), np.zeros((n, 1)))


@pytest.mark.parametrize("shape", [WIDE, TALL])
def test_pseudoinverse_and_null_space(shape):
    m, n = shape
    random = seeded()
    pinv = graph(la.pinv_times, shape, (m, 1))
    project = graph(la.project_to_null_space, shape, (n, 1))
    for k in range(30):
        J, x = random.standard_normal(shape), random.standard_normal(n)
        if k % 2:
            J[1] = J[0]  # rank-deficient, in the null space of which more fits
        s = np.linalg.svd(J, compute_uv=False)
        smallest = s[s > 1e-10].min()
        tolerance = 1e-3 if k % 2 else 4e-12 / smallest**2 + 1e-12
        e = J @ x
        expected = x - np.linalg.pinv(J) @ e
        assert np.allclose(project(J, x).full()[:, 0], expected, rtol=0, atol=10 * tolerance)
        solution = pinv(J, e).full()[:, 0]
        assert np.allclose(solution, np.linalg.pinv(J) @ e, rtol=0, atol=10 * tolerance)


SHAPES = [(3, 9), (2, 9), (6, 4), (6, 6), (3, 3), (1, 5), (6, 14)]
SVD = {shape: graph(la.svd, shape) for shape in SHAPES}
VALUES = {shape: graph(la.singular_values, shape) for shape in SHAPES}


def samples(rng: np.random.Generator, m: int, n: int, count: int):
    """Yield matrices of full rank, ill-conditioned, with scaled rows, low rank, and 0."""
    k = min(m, n)
    for i in range(count):
        A = rng.standard_normal((m, n))
        if i % 4 == 1:
            U, _, Vt = np.linalg.svd(A, full_matrices=False)
            A = U * 10.0 ** rng.uniform(-14, 0, k) @ Vt
        if i % 4 == 2:
            A = A * 10.0 ** rng.uniform(-6, 1, (m, 1))
        if i % 4 == 3:
            rank = int(rng.integers(0, k))
            A = rng.standard_normal((m, rank)) @ rng.standard_normal((rank, n))
        yield A


@pytest.mark.parametrize("shape", SHAPES)
def test_svd_against_numpy(shape):
    m, n = shape
    k = min(m, n)
    for A in samples(np.random.default_rng(5), m, n, 200):
        U, s, V = (x.full() for x in SVD[shape](A))
        s = s[:, 0]
        expected = np.linalg.svd(A, compute_uv=False)
        scale = max(expected[0], 1e-30)
        assert np.abs(s - expected).max() <= 4e-15 * scale
        assert np.all(np.diff(s) <= 0)
        assert np.abs(U * s @ V.T - A).max() <= 5e-15 * scale
        narrow = U if m <= n else V
        assert np.abs(narrow.T @ narrow - np.eye(k)).max() <= 1e-14
        wide = (V if m <= n else U)[:, s > 1e-100]
        assert np.abs(np.linalg.norm(wide, axis=0) - 1).max(initial=0) <= 1e-14
        assert np.array_equal(VALUES[shape](A).full()[:, 0], s)


def test_condition_number_is_capped():
    s = ca.SX.sym("s", 3)
    f = ca.Function("f", [s], [la.condition_number(s, 1e6)])
    assert float(f([4, 2, 1])) == pytest.approx(4)
    assert float(f([1, 1e-9, 1])) == pytest.approx(1e6)
    assert float(f([0, 0, 0])) == pytest.approx(1e6)


@pytest.mark.parametrize("shape", [(3, 9), (6, 4), (6, 6)])
def test_manipulability(shape):
    rng = np.random.default_rng(7)
    f, df = (
        graph(la.manipulability, shape),
        gradient(la.manipulability, shape),
    )
    for _ in range(20):
        A = rng.standard_normal(shape)
        assert float(f(A)) == pytest.approx(np.prod(np.linalg.svd(A)[1]), rel=1e-10)
        assert np.allclose(df(A).full(), central_difference(f, A), rtol=1e-5, atol=1e-5)
    assert float(f(np.zeros(shape))) < 1e-100
    assert df(np.zeros(shape)).is_regular()
    A[:, 1] = A[:, 0]
    A[1] = A[0]
    assert float(f(A)) < 1e-6
    assert df(A).is_regular()


def function(m: int, n: int) -> ca.Function:
    J = ca.SX.sym("J", m, n)
    return ca.Function("extremes", [J], list(extreme_singular_values(J)))


@pytest.mark.parametrize("shape", [(1, 3), (3, 2), (3, 3), (3, 5), (4, 4), (5, 10), (6, 7), (6, 6)])
def test_random_and_nearly_singular(shape):
    rng, extremes = np.random.default_rng(1), function(*shape)
    for i in range(100):
        U, s, Vt = np.linalg.svd(rng.normal(size=shape), full_matrices=False)
        if i % 2:
            s[-1] *= 10.0 ** -rng.uniform(0, 5)
        smallest, largest = map(float, extremes(U @ np.diag(s) @ Vt))
        assert smallest == pytest.approx(s[-1], rel=1e-4, abs=1e-7 * s[0])
        assert largest == pytest.approx(s[0], rel=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 3), (6, 7)])
def test_zero_and_rank_deficient_are_finite(shape):
    extremes = function(*shape)
    assert tuple(map(float, extremes(np.zeros(shape)))) == (0.0, 0.0)
    smallest, largest = map(float, extremes(np.ones(shape)))
    expected = np.linalg.svd(np.ones(shape), compute_uv=False)
    assert smallest == pytest.approx(expected[-1], abs=1e-6)
    assert largest == pytest.approx(expected[0], rel=1e-3)


M, N, FIRST = 9, 7, 3


@pytest.fixture(scope="module")
def step():
    """Function (J, r, damping, value, lower, upper, passes) -> step, predicted decrease."""
    J, r, damping = ca.SX.sym("J", M, N), ca.SX.sym("r", M), ca.SX.sym("damping")
    value, lower, upper = (ca.SX.sym(name, N - FIRST) for name in ("value", "lower", "upper"))
    functions = {}

    def call(*inputs, passes=4):
        if passes not in functions:
            bounded_step = damped_step(J, r, damping, BoxBounds(value, lower, upper, FIRST), passes)
            symbols = [J, r, damping, value, lower, upper]
            functions[passes] = ca.Function(
                "step", symbols, [bounded_step.step, bounded_step.predicted_decrease]
            )
        s, predicted = functions[passes](*inputs)
        return np.array(s).ravel(), float(predicted)

    return call


def problem(rng, tight):
    """Return a problem whose solution has some coordinates at bounds, or none."""
    J, r = rng.normal(size=(M, N)), rng.normal(size=M)
    lower, upper = -rng.uniform(0, tight, N - FIRST), rng.uniform(0, tight, N - FIRST)
    value = rng.uniform(lower, upper)
    # Some coordinates start at a bound.
    at = rng.integers(0, 4, N - FIRST)
    value = np.where(at == 0, lower, np.where(at == 1, upper, value))
    return J, r, rng.uniform(1e-6, 1e-1), value, lower, upper


def exact(J, r, damping, value, lower, upper):
    """Return the solution of the same problem by scipy."""
    matrix = np.vstack([J, np.sqrt(damping) * np.eye(N)])
    right = np.concatenate([-r, np.zeros(N)])
    free = np.full(FIRST, np.inf)
    # lsq_linear needs lower < upper and an interior: bounds are widened slightly.
    low = np.concatenate([-free, lower - value]) - 1e-13
    high = np.concatenate([free, upper - value]) + 1e-13
    return lsq_linear(matrix, right, (low, high), method="bvls", tol=1e-14).x


def test_without_active_bounds_it_is_the_damped_least_squares_step(step, rng):
    for _ in range(20):
        J, r, damping, value, lower, upper = problem(rng, 1.0)
        s, predicted = step(J, r, damping, 0 * value, lower - 100, upper + 100)
        expected = -np.linalg.solve(J.T @ J + damping * np.eye(N), J.T @ r)
        np.testing.assert_allclose(s, expected, atol=1e-10)
        assert predicted == pytest.approx(r @ r - np.sum((r + J @ expected) ** 2))


@pytest.mark.parametrize("tight", [0.05, 0.3, 1.0])
def test_enough_passes_give_the_exact_solution(step, rng, tight):
    same_count, bound_count = 0, 0
    for _ in range(100):
        inputs = problem(rng, tight)
        _, _, _, value, lower, upper = inputs
        s, expected = step(*inputs, passes=6)[0], exact(*inputs)
        new_value = value + s[FIRST:]
        assert (new_value >= lower - 1e-12).all()
        assert (new_value <= upper + 1e-12).all()
        same_count += np.allclose(s, expected, atol=1e-6)
        bound_count += np.sum((new_value <= lower + 1e-12) | (new_value >= upper - 1e-12))
    # The method is not exact for all quadratics, but nearly so for a few coordinates.
    assert same_count >= 95
    assert bound_count > 50


@pytest.mark.parametrize("passes", [1, 2, 4])
def test_every_step_descends_and_stays_within(step, rng, passes):
    ascents = 0
    for _ in range(100):
        inputs = problem(rng, 0.3)
        J, r, _, value, lower, upper = inputs
        s, predicted = step(*inputs, passes=passes)
        new_value = value + s[FIRST:]
        assert (new_value >= lower - 1e-12).all()
        assert (new_value <= upper + 1e-12).all()
        assert predicted == pytest.approx(r @ r - np.sum((r + J @ s) ** 2), abs=1e-9)
        ascents += predicted < 0
    assert ascents <= (5 if passes == 1 else 0)


def test_bound_coordinate_is_released_when_pulled_inside(step):
    """The slope of the coordinate points outwards until the others have moved."""
    J, r = np.zeros((M, N)), np.zeros(M)
    J[:N, :N] = np.eye(N)
    J[3, 4] = -1.0
    r[3:5] = [0.5, -2.0]
    value, lower, upper = np.zeros(4), np.array([0.0, -5, -5, -5]), np.full(4, 5.0)
    assert (J.T @ r)[3] > 0
    inputs = (J, r, 1e-9, value, lower, upper)
    s = step(*inputs)[0]
    assert s[3] > 0.1
    np.testing.assert_allclose(s, exact(*inputs), atol=1e-6)


def test_locked_coordinate_does_not_move(step, rng):
    J, r, damping, value, lower, upper = problem(rng, 1.0)
    lower, upper = lower.copy(), upper.copy()
    lower[1] = upper[1] = value[1]
    s, _ = step(J, r, damping, value, lower, upper)
    assert s[FIRST + 1] == 0.0


def test_singular_problem_is_finite(step):
    s, _ = step(np.zeros((M, N)), np.ones(M), 1e-12, np.zeros(4), -np.ones(4), np.ones(4))
    np.testing.assert_array_equal(s, 0)


FINGERS, JOINTS, PALM = 5, 4, 6


@pytest.mark.parametrize("full", [0, 3])
def test_sparse_problem_matches_the_dense_one(rng, full):
    """Apart from rows of all coordinates, fingers share only their palm."""
    count = PALM + FINGERS * JOINTS
    J = fingers()
    r, damping = ca.SX.sym("r", J.shape[0]), ca.SX.sym("damping")
    value, lower, upper = (ca.SX.sym(name, count - PALM) for name in ("value", "lower", "upper"))
    rows, other_part = ca.SX.sym("rows", full, count), ca.SX.sym("rest", full)
    bounded = BoxBounds(value, lower, upper, PALM)
    bounded_step = damped_step(J, r, damping, bounded, 6, (rows, other_part) if full else None)
    inputs = [ca.vertcat(*J.nonzeros()), r, rows, other_part, damping, value, lower, upper]
    step = ca.Function("step", inputs, [bounded_step.step, bounded_step.predicted_decrease])
    same_count, bound_count = 0, 0
    for _ in range(10):
        numbers, concern_all = rng.normal(size=J.nnz()), rng.normal(size=(full, count))
        dense = np.vstack([ca.DM(J.sparsity(), numbers).full(), concern_all])
        low, high = -rng.uniform(0, 0.3, count - PALM), rng.uniform(0, 0.3, count - PALM)
        at, right = rng.uniform(low, high), rng.normal(size=len(dense))
        split = np.split(right, [J.shape[0]])
        s, predicted = step(numbers, split[0], concern_all, split[1], 1e-2, at, low, high)
        s = np.array(s).ravel()
        matrix = np.vstack([dense, 0.1 * np.eye(count)])
        free = np.full(PALM, np.inf)
        ends = np.r_[-free, low - at] - 1e-13, np.r_[free, high - at] + 1e-13
        expected = lsq_linear(
            matrix, np.r_[-right, np.zeros(count)], ends, method="bvls", tol=1e-14
        )
        same_count += np.allclose(s, expected.x, atol=1e-6)
        bound_count += np.sum(np.isclose(at + s[PALM:], low) | np.isclose(at + s[PALM:], high))
        assert float(predicted) == pytest.approx(right @ right - np.sum((right + dense @ s) ** 2))
    assert same_count >= 8
    assert bound_count > 10


def fingers():
    """Return a Jacobian of fingers with joints of their own on a palm that moves them all."""
    rows = []
    for i in range(FINGERS):
        finger_columns = [ca.SX(6, JOINTS) for _ in range(FINGERS)]
        finger_columns[i] = ca.SX.sym(f"own{i}", 6, JOINTS)
        rows.append(ca.horzcat(ca.SX.sym(f"palm{i}", 6, PALM), *finger_columns))
    return ca.vertcat(*rows)
