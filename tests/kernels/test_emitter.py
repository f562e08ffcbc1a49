"""C from CasADi's instructions: the values of the virtual machine, the same bits in every form."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels import FunctionGraph, FunctionKernel
from casadi_ik.kernels.function_kernel import MeasureKernel

from .graphs import needs_compiler, random_expression

pytestmark = needs_compiler

COUNT = 7
"""Numbers: more than go into one call of an elementary function, and one left over."""


def agree(function: ca.Function, samples: np.ndarray, rtol: float = 1e-13) -> np.ndarray:
    """Values of a function of one vector: compiled, side by side and in the virtual machine."""
    (found,) = FunctionKernel(function)(samples)
    (expected,) = FunctionKernel(function, compiled=False)(samples)
    beside = MeasureKernel(FunctionGraph.of(function))(samples)
    assert beside.tobytes() == found.tobytes()
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=1e-15)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_straight_lines(seed: int) -> None:
    x = ca.SX.sym("x", 5)
    function = ca.Function(f"straight_{seed}", [x], [random_expression(x, 9, 150, seed)])
    agree(function, np.random.default_rng(seed).normal(size=(50, 5)))


def test_calls_and_branches() -> None:
    """Arguments that are parts, transposed, constant or left out; branches within branches."""
    x, y, m = ca.SX.sym("x", 3), ca.SX.sym("y"), ca.SX.sym("m", 2, 3)
    cases = [
        ca.Function(f"case_{i}", [x, y, m], [x * (i + 1) + y, m @ ca.sin(x), ca.SX(i)])
        for i in range(4)
    ]
    several = ca.Function.conditional("several", cases[:-1], cases[-1])
    either = ca.Function.if_else("either", cases[0], cases[2])
    v = ca.MX.sym("v", 8)
    matrix = ca.reshape(v[2:8], 3, 2).T
    first, product, _ = several(v[0], v[[3, 1, 2]], v[1], matrix)
    second, _, number = either(v[1] > 0, first, ca.norm_2(v), ca.DM(np.arange(6.0).reshape(2, 3)))
    output = ca.vertcat(second[::-1], product, number, ca.mmin(v), ca.dot(v, v), v.T @ v)
    function = ca.Function("branches", [v], [ca.densify(output)])
    samples = np.random.default_rng(0).normal(size=(99, 8))
    samples[:, 0] = np.resize([-3.0, -0.5, 0.0, 1.0, 1.7, 2.0, 3.0, 8.0, np.nan], 99)
    agree(function, samples[~np.isnan(samples).any(axis=1)])


def test_tables() -> None:
    """The nearest row of a table, of equal ones the first."""
    table = np.random.default_rng(1).normal(size=(40, 3))
    table[7] = table[30]
    x = ca.MX.sym("x", 3)
    distances = ca.sum2((ca.DM(table) - ca.repmat(x.T, 40, 1)) ** 2)
    place = ca.find(distances <= ca.mmin(distances))
    row = ca.DM(table.T) @ (ca.DM(range(40)) == place)
    function = ca.Function("tables", [x], [ca.vertcat(place, row)])
    samples = np.concatenate([table, np.random.default_rng(2).normal(size=(40, 3))])
    found = agree(function, samples)
    rows = np.arange(40)
    rows[30] = 7
    np.testing.assert_array_equal(found[:40, 0], rows)
    np.testing.assert_array_equal(found[:40, 1:], table)


@pytest.mark.parametrize("scale", [1e-9, 0.5, 3.0, 1e9])
def test_elementary_functions_computed_together(scale: float) -> None:
    """The bits of one call each."""
    x = ca.SX.sym("x", COUNT)
    arcs = [ca.atan2(x, x[0]), ca.asin(x[:5]), ca.acos(x), ca.atan(x)]
    values = ca.vertcat(ca.sin(x), ca.cos(x[:3]), *arcs)
    later = ca.vertcat(ca.cos(values + 1), ca.atan2(values[1:], values[:-1]))
    function = ca.Function("several", [x], [ca.vertcat(values, later, ca.sin(x[0]) * values)])
    samples = np.random.default_rng(5).normal(size=(500, COUNT)) * scale
    samples[0] = [np.nan, 0.0, -0.0, np.inf, 1.0, -1.0, 6e8]
    (whole,) = FunctionKernel(function)(samples)
    np.testing.assert_array_equal(MeasureKernel(FunctionGraph.of(function))(samples), whole)
    one, other = ca.SX.sym("x"), ca.SX.sym("y")
    sine = FunctionKernel(ca.Function("one_sine", [one], [ca.sin(one)]))
    angle = FunctionKernel(ca.Function("one_angle", [one, other], [ca.atan2(one, other)]))
    size = values.numel()
    cosine = FunctionKernel(ca.Function("one_cosine", [one], [ca.cos(one)]))
    inner = np.ascontiguousarray(whole[:, :size])
    np.testing.assert_array_equal(inner[:, :COUNT].ravel(), sine(samples.ravel())[0])
    np.testing.assert_array_equal(whole[:, size : 2 * size].ravel(), cosine(inner.ravel() + 1)[0])
    rows = [np.ascontiguousarray(part).ravel() for part in (inner[:, 1:], inner[:, :-1])]
    np.testing.assert_array_equal(whole[:, 2 * size : 3 * size - 1].ravel(), angle(*rows)[0])


SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 1e-310, 1e300, np.inf, -np.inf, np.nan])


def test_operations_on_special_numbers() -> None:
    """Every operation, on every pair of special numbers."""
    v = ca.SX.sym("v", 2)
    x, y = ca.vertsplit(v)
    unary = [ca.sqrt, ca.floor, ca.ceil, ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan]
    unary += [ca.exp, ca.log, ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.acosh, ca.atanh, ca.log1p]
    unary += [ca.expm1, ca.fabs, ca.sign, ca.erf, ca.logic_not, lambda v: v * v]
    binary = [ca.atan2, ca.fmod, ca.hypot, ca.fmin, ca.fmax, ca.logic_and, ca.logic_or]
    binary += [ca.copysign]
    values = [-x, x + y, x - y, x * y, x / y, 2 / x, x < y, x <= y, x == y, x != y, x**3.7]
    values += [(x < y) + (x <= y), ca.if_else(x, y, -1), ca.if_else(x > 0, ca.inf, y)]
    values += [f(x) for f in unary] + [f(x, y) for f in binary]
    pairs = np.stack(np.meshgrid(SPECIAL, SPECIAL), axis=-1).reshape(-1, 2)
    function = ca.Function("operations", [v], [ca.vertcat(*values)])
    kernel = FunctionKernel(function)
    (found,), (expected,) = kernel(pairs), FunctionKernel(function, compiled=False)(pairs)
    beside = MeasureKernel(FunctionGraph.of(function))(pairs)
    np.testing.assert_array_equal(beside, found)
    same = np.signbit(beside) == np.signbit(found)
    assert (same | np.isnan(found)).all()
    # Two infinite coordinates have no direction here.
    expected[np.isinf(pairs).all(axis=1), len(values) - len(binary)] = np.nan
    np.testing.assert_allclose(found, expected, rtol=1e-15, atol=0)
    assert np.isfinite(found).any(axis=0).all()


def test_what_has_no_c_code_is_named() -> None:
    x = ca.MX.sym("x", 3)
    solver = ca.rootfinder("root", "newton", {"x": x, "g": x**2 - 2})
    function = ca.Function("hidden_solver", [x], [solver(x, [])])
    with pytest.raises(ik.errors.KernelError, match=r"hidden_solver|root"):
        FunctionKernel(function)


def test_solves_with_and_without_a_log_are_the_same(robot: ik.ArmHand, tmp_path) -> None:
    """What only the log needs is computed for the log alone."""
    solver = ik.Solver(robot)
    points, normals = robot.contacts(robot.random(np.random.default_rng(6), 40))
    for count in (1, 40):  # alone, and side by side
        asked = points[:count], normals[:count]
        plain, logged = solver.solve_batch(*asked), solver.solve_batch(*asked, log=tmp_path / "a")
        assert plain.q.tobytes() == logged.q.tobytes()
        np.testing.assert_array_equal(plain.iterations, logged.iterations)
