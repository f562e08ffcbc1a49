"""Functions called as C: shapes, batches, elementary functions, nearest rows."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import casadi_ik as ik
from casadi_ik.compile import FunctionGraph, FunctionKernel, LookupKernel
from casadi_ik.compile.codegen import standalone_source
from casadi_ik.compile.lookup import MAX_STEPS, STEPS_PER_UNIT
from casadi_ik.compile.straight_lines import CodeOptions
from casadi_ik.kinematics.smooth import call_function

from .graphs import BOTH, needs_compiler, random_expression


def matrices(kind: Any) -> ca.Function:
    """Return a function with scalar, vector, matrix, sparse and row arguments or results."""
    a, v, m = kind.sym("a"), kind.sym("v", 3), kind.sym("m", 2, 3)
    sparse = ca.diag(v)
    outputs = [a * m, sparse, m @ v, (m @ v).T, ca.sum1(v)]
    return ca.Function(
        "matrices", [a, v, m], outputs, ["a", "v", "m"], ["am", "diag", "mv", "row", "sum"]
    )


@BOTH
@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_matrices_are_row_major(compiled, kind):
    kernel = FunctionKernel(matrices(kind), compiled=compiled)
    assert kernel.compiled == compiled
    assert kernel.input_shapes == ((), (3,), (2, 3))
    assert kernel.output_shapes == ((2, 3), (3, 3), (2,), (1, 2), ())
    rng = np.random.default_rng(0)
    a, v, m = 1.5, rng.normal(size=3), rng.normal(size=(2, 3))
    results = kernel(a, v, m)
    expected = (a * m, np.diag(v), m @ v, (m @ v)[None], v.sum())
    for result, expected_result in zip(results, expected, strict=True):
        assert result.flags.c_contiguous
        assert result.shape == np.shape(expected_result)
        np.testing.assert_allclose(result, expected_result, rtol=1e-14, atol=1e-14)
    # Column-major input and lists give the same numbers.
    for result, expected_result in zip(
        kernel(a, v.tolist(), np.asfortranarray(m)), results, strict=True
    ):
        np.testing.assert_array_equal(result, expected_result)


@needs_compiler
@pytest.mark.parametrize("in_lanes", [False, True])
def test_subfunctions_are_called_or_inlined(in_lanes, rng):
    """Arguments are adjacent in memory, other results or comparisons; a result is unused."""
    x, w = ca.SX.sym("x", 3), ca.SX.sym("w", 2)
    inner = call_function("inner", [x, w], [2 * ca.sin(x) + w[0], ca.sumsqr(x) * w[1]])
    y, z = ca.SX.sym("y", 3), ca.SX.sym("z", 4)
    first, length = inner(y + 1, z[1:3])
    second, _ = inner(first, z[1:3])
    swapped, _ = inner(y < 0, ca.vertcat(z[3], 0.5))
    repeated, _ = inner(y + 1, z[1:3])
    outputs = [second * length + swapped, repeated + first]
    function = ca.Function("with_parts", [y, z], outputs)
    kernel = FunctionKernel(function, in_lanes=in_lanes)
    assert kernel.compiled
    inputs = rng.normal(size=(9, 3)), rng.normal(size=(9, 4))
    expected = FunctionKernel(function, compiled=False)(*inputs)
    for result, expected_result in zip(kernel(*inputs), expected, strict=True):
        np.testing.assert_allclose(result, expected_result, rtol=1e-13, atol=1e-13)
    text = standalone_source(function, CodeOptions())
    assert text.count("CODE void f0_inner(") == 1
    assert text.count("f0_inner(") == 4


@BOTH
def test_batches_broadcast(compiled):
    kernel = FunctionKernel(matrices(ca.SX), compiled=compiled)
    rng = np.random.default_rng(1)
    a, v, m = rng.normal(size=5), rng.normal(size=3), rng.normal(size=(5, 2, 3))
    results = kernel(a, v, m)
    assert [output.shape for output in results] == [(5, 2, 3), (5, 3, 3), (5, 2), (5, 1, 2), (5,)]
    for i in range(5):
        for result, single_result in zip(results, kernel(a[i], v, m[i]), strict=True):
            np.testing.assert_array_equal(result[i], single_result)
    assert [output.shape[0] for output in kernel(a[:1], v, m[0])] == [1] * 5
    assert [output.shape[0] for output in kernel(a[:0], v, m[0])] == [0] * 5


@BOTH
def test_unaligned_numbers(compiled):
    kernel = FunctionKernel(matrices(ca.SX), compiled=compiled)
    packed = np.zeros(1, dtype=[("flag", "u1"), ("v", "<f8", (3,))])
    packed["v"] = [1, 2, 3]
    assert not packed[0]["v"].flags.aligned
    assert kernel(1, packed[0]["v"], np.ones((2, 3)))[2].tolist() == [6, 6]


@needs_compiler
def test_pauses_for_signals_change_nothing():
    """A call of more than half a second returns to Python every 0.2 s."""
    x = ca.SX.sym("x")
    y, points = x, np.linspace(0, 3, 300_000)
    for _ in range(100):
        y = ca.sqrt(x + y)
    expected = points
    for _ in range(100):
        expected = np.sqrt(points + expected)
    np.testing.assert_array_equal(
        FunctionKernel(ca.Function("roots", [x], [y]))(points)[0], expected
    )


@BOTH
def test_threads_share_a_kernel(compiled):
    kernel = FunctionKernel(matrices(ca.MX), compiled=compiled)
    rng = np.random.default_rng(3)
    samples = [(rng.normal(), rng.normal(size=(40, 3)), rng.normal(size=(2, 3))) for _ in range(60)]
    sequential = [kernel(*sample) for sample in samples]
    with ThreadPoolExecutor(6) as pool:
        concurrent = list(pool.map(lambda sample: kernel(*sample), samples))
    for a, b in zip(sequential, concurrent, strict=True):
        for result, expected_result in zip(a, b, strict=True):
            np.testing.assert_array_equal(result, expected_result)


@BOTH
def test_no_inputs(compiled):
    kernel = FunctionKernel(ca.Function("constant", [], [ca.DM([1, 2])]), compiled=compiled)
    assert kernel()[0].tolist() == [1, 2]


def test_failure_of_the_function_is_an_error():
    x = ca.MX.sym("x")
    function = ca.Function("positive", [x], [ca.sqrt(x.attachAssert(x > 0, "negative"))])
    kernel = FunctionKernel(function, compiled=False)
    assert kernel(4.0)[0] == 2
    with pytest.raises(ik.errors.KernelError, match="positive"):
        kernel([4.0, -1.0])
    with pytest.raises(ik.errors.KernelError, match=r"positive.* assertion"):
        FunctionKernel(function)


def test_wrong_inputs_are_named():
    kernel = FunctionKernel(matrices(ca.SX), compiled=False)
    v, m = np.zeros(3), np.zeros((2, 3))
    with pytest.raises(ik.errors.InputError, match=r"2 inputs, expected 3 \(a, v, m\)"):
        kernel(1, v)
    with pytest.raises(ik.errors.InputError, match=r"'m'.*\(3, 2\).*\(2, 3\)"):
        kernel(1, v, m.T)
    with pytest.raises(ik.errors.InputError, match=r"'v'.*4.*2"):
        kernel([1, 2], np.zeros((4, 3)), m)


def graph() -> FunctionGraph:
    x = ca.SX.sym("x", 3)
    values = ca.vertcat(ca.sin(x[0]), ca.cos(x[0]), x[1] * x[2])
    return FunctionGraph.from_function(ca.Function("measured", [x], [values]))


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 64, 1003])
def test_sample_counts_in_lanes(count, compiled):
    rng = np.random.default_rng(count)
    x = rng.normal(size=(count, 3)) * [10.0 ** rng.uniform(-8, 4), 1.0, 1.0]
    (values,) = FunctionKernel(graph(), compiled, in_lanes=True)(x)
    expected = np.stack([np.sin(x[:, 0]), np.cos(x[:, 0]), x[:, 1] * x[:, 2]], axis=1)
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-12)


pytestmark = needs_compiler

OF_ONE = ("sin", "cos", "tan", "asin", "acos", "atan")


@pytest.fixture(scope="module")
def functions() -> tuple[FunctionKernel, FunctionKernel]:
    x = ca.SX.sym("x", 2)
    values = [getattr(ca, name)(x[0]) for name in OF_ONE] + [ca.atan2(x[1], x[0])]
    function = ca.Function("elementary", [x], [ca.vertcat(*values)])
    return FunctionKernel(function), FunctionKernel(function, in_lanes=True)


def compare(functions: tuple[FunctionKernel, FunctionKernel], points: np.ndarray) -> None:
    single_kernel, beside = functions
    (values,) = single_kernel(points)
    assert beside(points)[0].tobytes() == values.tobytes()
    x, y = points.T
    with np.errstate(all="ignore"):
        expected = [getattr(np, name.replace("a", "arc", 1) if name[0] == "a" else name)(x)
                    for name in OF_ONE]  # fmt: skip
        expected.append(np.arctan2(y, x))
        # Near a multiple of pi the last digits of a sine are those of pi.
        off = np.abs(values - np.stack(expected, axis=1)) - 1e-22
        units = off / np.spacing(np.abs(expected)).T
    assert (np.isnan(values) == np.isnan(np.stack(expected, axis=1))).all()
    worst = np.nan_to_num(units).max(axis=0)
    assert worst[[0, 1, 3, 4, 5, 6]].max() <= 2, worst
    assert worst[2] <= 16, worst  # a quotient of two


@pytest.mark.parametrize("scale", [1e-300, 1e-8, 1e-3, 1.0, 3.0, 1e3, 4e8, 1e12, 1e300])
def test_all_sizes(functions, scale):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(20_000, 2)) * scale
    points[:, 1] *= 10.0 ** rng.uniform(-8, 7, len(points))
    compare(functions, points)


def test_quarters_of_a_turn_and_their_edges(
    functions,
):
    angles = np.concatenate([np.arange(-64, 65) * np.pi / 8 + d for d in (-1e-9, 0.0, 1e-9)])
    compare(functions, np.stack([angles, 1 + angles], axis=1))
    edges = np.nextafter([1.0, 1.0, 1.0, -1.0, -1.0, -1.0], [0.0, 1.0, 2.0, 0.0, -1.0, -2.0])
    compare(functions, np.stack([edges, edges[::-1]], axis=1))


def test_signs_of_zero(functions):
    zeros = np.array([[x, y] for x in (0.0, -0.0, 2.0, -2.0) for y in (0.0, -0.0)])
    last_column = functions[0](zeros)[0][:, -1]
    np.testing.assert_array_equal(last_column, np.arctan2(zeros[:, 1], zeros[:, 0]))
    np.testing.assert_array_equal(np.signbit(last_column), np.signbit(zeros[:, 1]))


def test_large_lane_does_not_affect_others(
    functions,
):
    points = np.random.default_rng(5).normal(size=(64, 2))
    points[::5, 0] *= 1e11
    compare(functions, points)


@settings(max_examples=300, deadline=None)
@given(st.floats(allow_subnormal=False), st.floats(-1e6, 1e6, allow_subnormal=False))
def test_sample_counts_of_special_functions(functions, x, y):
    single_kernel, beside = functions
    points = np.array([[x, y]] * 3)
    (values,) = single_kernel(points)
    assert values.tobytes() == beside(points)[0].tobytes()
    if not np.isnan(x):
        assert abs(values[0, -1] - np.arctan2(y, x)) <= 1e-15 * 4


COUNT = 7
"""Numbers: more than one call of an elementary function takes, with a remainder."""


def agree(function: ca.Function, samples: np.ndarray, rtol: float = 1e-13) -> np.ndarray:
    """Return the values of a function, equal in scalar code, lanes and virtual machine."""
    (values,) = FunctionKernel(function)(samples)
    (expected,) = FunctionKernel(function, compiled=False)(samples)
    (beside,) = FunctionKernel(function, in_lanes=True)(samples)
    assert beside.tobytes() == values.tobytes()
    np.testing.assert_allclose(values, expected, rtol=rtol, atol=1e-15)
    return values


@pytest.mark.parametrize("seed", range(4))
def test_straight_lines(seed):
    x = ca.SX.sym("x", 5)
    function = ca.Function(f"straight_{seed}", [x], [random_expression(x, 9, 150, seed)])
    agree(function, np.random.default_rng(seed).normal(size=(50, 5)))


def test_calls_and_branches():
    """Arguments are parts, transposed, constant or left out; branches are nested."""
    x, y, m = ca.SX.sym("x", 3), ca.SX.sym("y"), ca.SX.sym("m", 2, 3)
    cases = [
        ca.Function(f"case_{i}", [x, y, m], [x * (i + 1) + y, m @ ca.sin(x), ca.SX(i)])
        for i in range(4)
    ]
    switch = ca.Function.conditional("several", cases[:-1], cases[-1])
    either = ca.Function.if_else("either", cases[0], cases[2])
    v = ca.MX.sym("v", 8)
    matrix = ca.reshape(v[2:8], 3, 2).T
    first, product, _ = switch(v[0], v[[3, 1, 2]], v[1], matrix)
    second, _, number = either(v[1] > 0, first, ca.norm_2(v), ca.DM(np.arange(6.0).reshape(2, 3)))
    output = ca.vertcat(second[::-1], product, number, ca.mmin(v), ca.dot(v, v), v.T @ v)
    function = ca.Function("branches", [v], [ca.densify(output)])
    samples = np.random.default_rng(0).normal(size=(99, 8))
    samples[:, 0] = np.resize([-3.0, -0.5, 0.0, 1.0, 1.7, 2.0, 3.0, 8.0, np.nan], 99)
    agree(function, samples[~np.isnan(samples).any(axis=1)])


def test_tables():
    """The nearest row of a table is found; of equal ones it is the first."""
    table = np.random.default_rng(1).normal(size=(40, 3))
    table[7] = table[30]
    x = ca.MX.sym("x", 3)
    distances = ca.sum2((ca.DM(table) - ca.repmat(x.T, 40, 1)) ** 2)
    place = ca.find(distances <= ca.mmin(distances))
    row = ca.DM(table.T) @ (ca.DM(range(40)) == place)
    function = ca.Function("tables", [x], [ca.vertcat(place, row)])
    samples = np.concatenate([table, np.random.default_rng(2).normal(size=(40, 3))])
    values = agree(function, samples)
    rows = np.arange(40)
    rows[30] = 7
    np.testing.assert_array_equal(values[:40, 0], rows)
    np.testing.assert_array_equal(values[:40, 1:], table)


@pytest.mark.parametrize("scale", [1e-9, 0.5, 3.0, 1e9])
def test_elementary_functions_computed_together(scale):
    """Elementary functions computed together give the bits of single calls."""
    x = ca.SX.sym("x", COUNT)
    arcs = [ca.atan2(x, x[0]), ca.asin(x[:5]), ca.acos(x), ca.atan(x)]
    values = ca.vertcat(ca.sin(x), ca.cos(x[:3]), *arcs)
    later = ca.vertcat(ca.cos(values + 1), ca.atan2(values[1:], values[:-1]))
    function = ca.Function("several", [x], [ca.vertcat(values, later, ca.sin(x[0]) * values)])
    samples = np.random.default_rng(5).normal(size=(500, COUNT)) * scale
    samples[0] = [np.nan, 0.0, -0.0, np.inf, 1.0, -1.0, 6e8]
    (function_values,) = FunctionKernel(function)(samples)
    (beside,) = FunctionKernel(function, in_lanes=True)(samples)
    np.testing.assert_array_equal(beside, function_values)
    input_x, y = ca.SX.sym("x"), ca.SX.sym("y")
    sine = FunctionKernel(ca.Function("one_sine", [input_x], [ca.sin(input_x)]))
    angle = FunctionKernel(ca.Function("one_angle", [input_x, y], [ca.atan2(input_x, y)]))
    size = values.numel()
    cosine = FunctionKernel(ca.Function("one_cosine", [input_x], [ca.cos(input_x)]))
    inner = np.ascontiguousarray(function_values[:, :size])
    np.testing.assert_array_equal(inner[:, :COUNT].ravel(), sine(samples.ravel())[0])
    np.testing.assert_array_equal(
        function_values[:, size : 2 * size].ravel(), cosine(inner.ravel() + 1)[0]
    )
    rows = [np.ascontiguousarray(block).ravel() for block in (inner[:, 1:], inner[:, :-1])]
    np.testing.assert_array_equal(
        function_values[:, 2 * size : 3 * size - 1].ravel(), angle(*rows)[0]
    )


SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 1e-310, 1e300, np.inf, -np.inf, np.nan])


def test_operations_on_special_numbers():
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
    (compiled_values,), (expected,) = kernel(pairs), FunctionKernel(function, compiled=False)(pairs)
    (beside,) = FunctionKernel(function, in_lanes=True)(pairs)
    np.testing.assert_array_equal(beside, compiled_values)
    same_sign = np.signbit(beside) == np.signbit(compiled_values)
    assert (same_sign | np.isnan(compiled_values)).all()
    # Two infinite coordinates have no direction here.
    expected[np.isinf(pairs).all(axis=1), len(values) - len(binary)] = np.nan
    np.testing.assert_allclose(compiled_values, expected, rtol=1e-15, atol=0)
    assert np.isfinite(compiled_values).any(axis=0).all()


def test_functions_without_c_code_are_named():
    x = ca.MX.sym("x", 3)
    solver = ca.rootfinder("root", "newton", {"x": x, "g": x**2 - 2})
    function = ca.Function("hidden_solver", [x], [solver(x, [])])
    with pytest.raises(ik.errors.KernelError, match=r"hidden_solver|root"):
        FunctionKernel(function)


# Nearest rows compared with sorting: with ties, unknown entries and odd table sizes.


def identity(size: int) -> ca.Function:
    x = ca.SX.sym("x", size)
    return ca.Function(f"identity_{size}", [x], [x])


def sorted_rows(table, keys, count):
    """Return the nearest rows by exact integers and a stable sort."""
    rounded = [
        np.rint(x * STEPS_PER_UNIT).clip(-MAX_STEPS, MAX_STEPS)
        for x in (table, np.nan_to_num(keys))
    ]
    steps, order = (x.astype(np.int64) for x in rounded)
    rank_distance = np.where(np.isnan(keys)[:, None], 0, steps[None] - order[:, None])
    return (rank_distance**2).sum(axis=2).argsort(axis=1, kind="stable")[:, :count]


@BOTH
@pytest.mark.parametrize(("rows", "size"), [(1, 2), (16, 3), (37, 2), (300, 7)])
def test_nearest_in_order(compiled, rows, size, rng):
    """Coarse entries make many rows equally near."""
    table, keys = rng.integers(-9, 10, (rows, size)) / 4, rng.normal(size=(40, size)) * 3
    keys[::3, 0] = np.nan
    keys[5] = 100.0
    lookup = LookupKernel(identity(size), [table], compiled)
    assert lookup.compiled == compiled
    count = min(rows, 20)
    np.testing.assert_array_equal(lookup(count, keys), sorted_rows(table, keys, count))
    np.testing.assert_array_equal(lookup(1, keys)[:, 0], sorted_rows(table, keys, 1)[:, 0])


@BOTH
def test_nearest_of_unknown_values_is_the_first(compiled, rng):
    lookup = LookupKernel(identity(3), [rng.normal(size=(30, 3))], compiled)
    np.testing.assert_array_equal(lookup(4, np.full((2, 3), np.nan)), [[0, 1, 2, 3]] * 2)


@BOTH
def test_nearest_of_no_samples_and_of_wrong_inputs(compiled, rng):
    lookup = LookupKernel(identity(3), [rng.normal(size=(30, 3))], compiled)
    assert lookup(4, np.zeros((0, 3))).shape == (0, 4)
    with pytest.raises(ik.errors.InputError, match="expected"):
        lookup(4, np.zeros((2, 2)))
