"""The extreme singular values of small matrices, against numpy's."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.symbolic.singular_values import extreme_singular_values


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
def test_zero_and_rank_deficient_are_numbers(shape):
    extremes = function(*shape)
    assert tuple(map(float, extremes(np.zeros(shape)))) == (0.0, 0.0)
    smallest, largest = map(float, extremes(np.ones(shape)))
    expected = np.linalg.svd(np.ones(shape), compute_uv=False)
    assert smallest == pytest.approx(expected[-1], abs=1e-6)
    assert largest == pytest.approx(expected[0], rel=1e-3)
