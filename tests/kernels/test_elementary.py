"""Sines, cosines and arcs of compiled code against numpy's, alone and side by side."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_ik.kernels import FunctionKernel
from casadi_ik.kernels.function_kernel import MeasureKernel
from casadi_ik.kernels.graphs import FunctionGraph

from .graphs import needs_compiler

pytestmark = needs_compiler

OF_ONE = ("sin", "cos", "tan", "asin", "acos", "atan")


@pytest.fixture(scope="module")
def functions() -> tuple[FunctionKernel, MeasureKernel]:
    x = ca.SX.sym("x", 2)
    values = [getattr(ca, name)(x[0]) for name in OF_ONE] + [ca.atan2(x[1], x[0])]
    function = ca.Function("elementary", [x], [ca.vertcat(*values)])
    return FunctionKernel(function), MeasureKernel(FunctionGraph.of(function))


def compare(functions: tuple[FunctionKernel, MeasureKernel], points: np.ndarray) -> None:
    alone, beside = functions
    (found,) = alone(points)
    assert beside(points).tobytes() == found.tobytes()
    x, y = points.T
    with np.errstate(all="ignore"):
        expected = [getattr(np, name.replace("a", "arc", 1) if name[0] == "a" else name)(x)
                    for name in OF_ONE]  # fmt: skip
        expected.append(np.arctan2(y, x))
        # Next to a multiple of pi the last places of a sine are those of pi.
        off = np.abs(found - np.stack(expected, axis=1)) - 1e-22
        units = off / np.spacing(np.abs(expected)).T
    assert (np.isnan(found) == np.isnan(np.stack(expected, axis=1))).all()
    worst = np.nan_to_num(units).max(axis=0)
    assert worst[[0, 1, 3, 4, 5, 6]].max() <= 2, worst
    assert worst[2] <= 16, worst  # a quotient of two


@pytest.mark.parametrize("scale", [1e-300, 1e-8, 1e-3, 1.0, 3.0, 1e3, 4e8, 1e12, 1e300])
def test_all_sizes(functions: tuple[FunctionKernel, MeasureKernel], scale: float) -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(20_000, 2)) * scale
    points[:, 1] *= 10.0 ** rng.uniform(-8, 7, len(points))
    compare(functions, points)


def test_quarters_of_a_turn_and_their_edges(
    functions: tuple[FunctionKernel, MeasureKernel],
) -> None:
    angles = np.concatenate([np.arange(-64, 65) * np.pi / 8 + d for d in (-1e-9, 0.0, 1e-9)])
    compare(functions, np.stack([angles, 1 + angles], axis=1))
    edges = np.nextafter([1.0, 1.0, 1.0, -1.0, -1.0, -1.0], [0.0, 1.0, 2.0, 0.0, -1.0, -2.0])
    compare(functions, np.stack([edges, edges[::-1]], axis=1))


def test_signs_of_zero(functions: tuple[FunctionKernel, MeasureKernel]) -> None:
    zeros = np.array([[x, y] for x in (0.0, -0.0, 2.0, -2.0) for y in (0.0, -0.0)])
    found = functions[0](zeros)[0][:, -1]
    np.testing.assert_array_equal(found, np.arctan2(zeros[:, 1], zeros[:, 0]))
    np.testing.assert_array_equal(np.signbit(found), np.signbit(zeros[:, 1]))


def test_one_lane_that_is_large_changes_no_other(
    functions: tuple[FunctionKernel, MeasureKernel],
) -> None:
    points = np.random.default_rng(5).normal(size=(64, 2))
    points[::5, 0] *= 1e11
    compare(functions, points)


@settings(max_examples=300, deadline=None)
@given(st.floats(allow_subnormal=False), st.floats(-1e6, 1e6, allow_subnormal=False))
def test_any_number(functions: tuple[FunctionKernel, MeasureKernel], x: float, y: float) -> None:
    alone, beside = functions
    points = np.array([[x, y]] * 3)
    (found,) = alone(points)
    assert found.tobytes() == beside(points).tobytes()
    if not np.isnan(x):
        assert abs(found[0, -1] - np.arctan2(y, x)) <= 1e-15 * 4
