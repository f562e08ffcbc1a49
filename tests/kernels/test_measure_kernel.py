"""Four samples at a time: the values of the function, whatever the number of samples."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.kernels.function_kernel import MeasureKernel
from casadi_ik.kernels.graphs import FunctionGraph


def graph() -> FunctionGraph:
    x = ca.SX.sym("x", 3)
    values = ca.vertcat(ca.sin(x[0]), ca.cos(x[0]), x[1] * x[2])
    return FunctionGraph.of(ca.Function("measured", [x], [values]))


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 64, 1003])
def test_any_number_of_samples(count, compiled):
    rng = np.random.default_rng(count)
    x = rng.normal(size=(count, 3)) * [10.0 ** rng.uniform(-8, 4), 1.0, 1.0]
    found = MeasureKernel(graph(), compiled)(x)
    expected = np.stack([np.sin(x[:, 0]), np.cos(x[:, 0]), x[:, 1] * x[:, 2]], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_all_quarters_of_a_turn_and_their_edges():
    angles = np.concatenate([np.arange(-16, 17) * np.pi / 4 + d for d in (-1e-9, 0.0, 1e-9)])
    x = np.zeros((len(angles), 3))
    x[:, 0] = angles
    found = MeasureKernel(graph())(x)
    np.testing.assert_allclose(found[:, 0], np.sin(angles), rtol=0, atol=4e-16)
    np.testing.assert_allclose(found[:, 1], np.cos(angles), rtol=0, atol=4e-16)


def test_what_is_no_number_is_none():
    x = np.array([[np.nan, 1.0, 2.0], [np.inf, 1.0, 2.0], [0.5, np.nan, 2.0]])
    found = MeasureKernel(graph())(x)
    assert np.isnan(found[:2, :2]).all()
    assert np.isnan(found[2, 2])
    assert found[0, 2] == 2.0
