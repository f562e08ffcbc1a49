"""Singular values against numpy, for healthy, badly scaled and rank-deficient Jacobians."""

import casadi as ca
import numpy as np
import pytest
from algebra_samples import central_difference, gradient, graph

from casadi_ik.symbolic import singular_values as sv

SHAPES = [(3, 9), (2, 9), (6, 4), (6, 6), (3, 3), (1, 5), (6, 14)]
SVD = {shape: graph(sv.svd, shape) for shape in SHAPES}
VALUES = {shape: graph(sv.singular_values, shape) for shape in SHAPES}


def samples(rng: np.random.Generator, m: int, n: int, count: int):
    """Matrices of full rank, with singular values over 14 decades, scaled rows, low rank, 0."""
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


def test_default_sweeps_leave_a_margin():
    """One sweep fewer than the default is already good to 1e-4: the last one squares that."""
    for m, n in [(3, 9), (6, 4), (6, 6)]:
        fewer = graph(
            lambda J: sv.singular_values(J, sv.SWEEPS[min(J.shape)] - 1),
            (m, n),
        )
        for A in samples(np.random.default_rng(6), m, n, 100):
            expected = np.linalg.svd(A, compute_uv=False)
            assert np.abs(fewer(A).full()[:, 0] - expected).max() <= 1e-4 * max(expected[0], 1e-30)


def test_condition_number_is_capped():
    s = ca.SX.sym("s", 3)
    f = ca.Function("f", [s], [sv.condition_number(s, 1e6)])
    assert float(f([4, 2, 1])) == pytest.approx(4)
    assert float(f([1, 1e-9, 1])) == pytest.approx(1e6)
    assert float(f([0, 0, 0])) == pytest.approx(1e6)


@pytest.mark.parametrize("shape", [(3, 9), (6, 4), (6, 6)])
def test_manipulability(shape):
    rng = np.random.default_rng(7)
    f, df = (
        graph(sv.manipulability, shape),
        gradient(sv.manipulability, shape),
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


def test_instruction_counts_stay_small():
    counts = {shape: f.n_instructions() for shape, f in SVD.items()}
    assert counts[3, 9] < 1400
    assert counts[6, 4] < 3300
    assert counts[6, 6] < 9800
