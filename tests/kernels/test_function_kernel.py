"""Functions on numpy arrays: shapes, batches, threads, the same in C and in the VM."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels import FunctionKernel

from .graphs import needs_compiler, random_expression

BOTH = pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_compiler), False])


def matrices(kind: Any) -> ca.Function:
    """Scalar, vector and matrix inputs; matrix, sparse, row and scalar outputs."""
    a, v, m = kind.sym("a"), kind.sym("v", 3), kind.sym("m", 2, 3)
    sparse = ca.diag(v)
    outputs = [a * m, sparse, m @ v, (m @ v).T, ca.sum1(v)]
    return ca.Function(
        "matrices", [a, v, m], outputs, ["a", "v", "m"], ["am", "diag", "mv", "row", "sum"]
    )


@BOTH
@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_matrices_are_row_major(compiled: bool, kind: Any) -> None:
    kernel = FunctionKernel(matrices(kind), compiled=compiled)
    assert kernel.compiled == compiled
    assert kernel.input_shapes == ((), (3,), (2, 3))
    assert kernel.output_shapes == ((2, 3), (3, 3), (2,), (1, 2), ())
    rng = np.random.default_rng(0)
    a, v, m = 1.5, rng.normal(size=3), rng.normal(size=(2, 3))
    found = kernel(a, v, m)
    wanted = (a * m, np.diag(v), m @ v, (m @ v)[None], v.sum())
    for one, other in zip(found, wanted, strict=True):
        assert one.flags.c_contiguous
        assert one.shape == np.shape(other)
        np.testing.assert_allclose(one, other, rtol=1e-14, atol=1e-14)
    # Column-major input and lists are the same numbers.
    for one, other in zip(kernel(a, v.tolist(), np.asfortranarray(m)), found, strict=True):
        np.testing.assert_array_equal(one, other)


@BOTH
def test_batches_broadcast(compiled: bool) -> None:
    kernel = FunctionKernel(matrices(ca.SX), compiled=compiled)
    rng = np.random.default_rng(1)
    a, v, m = rng.normal(size=5), rng.normal(size=3), rng.normal(size=(5, 2, 3))
    found = kernel(a, v, m)
    assert [output.shape for output in found] == [(5, 2, 3), (5, 3, 3), (5, 2), (5, 1, 2), (5,)]
    for i in range(5):
        for one, other in zip(found, kernel(a[i], v, m[i]), strict=True):
            np.testing.assert_array_equal(one[i], other)
    assert [output.shape[0] for output in kernel(a[:1], v, m[0])] == [1] * 5
    assert [output.shape[0] for output in kernel(a[:0], v, m[0])] == [0] * 5


@BOTH
def test_unaligned_numbers(compiled: bool) -> None:
    kernel = FunctionKernel(matrices(ca.SX), compiled=compiled)
    packed = np.zeros(1, dtype=[("flag", "u1"), ("v", "<f8", (3,))])
    packed["v"] = [1, 2, 3]
    assert not packed[0]["v"].flags.aligned
    assert kernel(1, packed[0]["v"], np.ones((2, 3)))[2].tolist() == [6, 6]


@needs_compiler
@pytest.mark.parametrize("turning", [False, True])
def test_compiled_equals_vm(turning: bool) -> None:
    """Bit for bit, but for the last places of sines and arcs."""
    x = ca.SX.sym("x", 6)
    function = ca.Function(f"noise_{turning}", [x], [random_expression(x, 10, 300, 2, turning)])
    points = np.random.default_rng(2).normal(size=(200, 6))
    fast, slow = FunctionKernel(function), FunctionKernel(function, compiled=False)
    np.testing.assert_allclose(
        fast(points)[0], slow(points)[0], rtol=0, atol=1e-14 if turning else 0
    )
    assert np.std(fast(points)[0], axis=0).min() > 0


@needs_compiler
def test_pauses_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    x = ca.SX.sym("x")
    kernel = FunctionKernel(ca.Function("twice", [x], [2 * x]))
    points = np.arange(1000.0)
    monkeypatch.setattr("casadi_ik.kernels.function_kernel.SLICE", 0.0)
    np.testing.assert_array_equal(kernel(points)[0], 2 * points)


@BOTH
def test_threads_share_a_kernel(compiled: bool) -> None:
    kernel = FunctionKernel(matrices(ca.MX), compiled=compiled)
    rng = np.random.default_rng(3)
    samples = [(rng.normal(), rng.normal(size=(40, 3)), rng.normal(size=(2, 3))) for _ in range(60)]
    alone = [kernel(*sample) for sample in samples]
    with ThreadPoolExecutor(6) as pool:
        together = list(pool.map(lambda sample: kernel(*sample), samples))
    for a, b in zip(alone, together, strict=True):
        for one, other in zip(a, b, strict=True):
            np.testing.assert_array_equal(one, other)


@BOTH
def test_no_inputs(compiled: bool) -> None:
    kernel = FunctionKernel(ca.Function("constant", [], [ca.DM([1, 2])]), compiled=compiled)
    assert kernel()[0].tolist() == [1, 2]


def test_failure_of_the_function_is_an_error() -> None:
    x = ca.MX.sym("x")
    function = ca.Function("positive", [x], [ca.sqrt(x.attachAssert(x > 0, "negative"))])
    kernel = FunctionKernel(function, compiled=False)
    assert kernel(4.0)[0] == 2
    with pytest.raises(ik.errors.KernelError, match="positive"):
        kernel([4.0, -1.0])
    with pytest.raises(ik.errors.KernelError, match=r"positive.* assertion"):
        FunctionKernel(function)


def test_wrong_inputs_are_named() -> None:
    kernel = FunctionKernel(matrices(ca.SX), compiled=False)
    v, m = np.zeros(3), np.zeros((2, 3))
    with pytest.raises(ik.errors.InputError, match=r"2 inputs, expected 3 \(a, v, m\)"):
        kernel(1, v)
    with pytest.raises(
        ik.errors.InputError, match=r"input 'm' has shape \(3, 2\), expected \(2, 3\) or"
    ):
        kernel(1, v, m.T)
    with pytest.raises(ik.errors.InputError, match="input 'v' is a batch of 4, another of 2"):
        kernel([1, 2], np.zeros((4, 3)), m)
