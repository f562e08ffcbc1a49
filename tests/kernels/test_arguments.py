"""Generated code looks once whether an argument is there."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.kernels import FunctionKernel
from casadi_ik.kernels.arguments import argument_sizes
from casadi_ik.kernels.codegen import function_source


def test_sizes_of_a_signature() -> None:
    assert argument_sizes("i0,i1[3],i2[3x2],i3[3x2,4nz]") == (1, 3, 6, 4)
    assert argument_sizes("") == ()
    assert argument_sizes("i0[3;2]") is None


def test_no_number_is_asked_for_by_itself() -> None:
    x, y = ca.SX.sym("x", 5), ca.SX.sym("y", 3, 2)
    inner = ca.Function("inner", [x, y], [ca.sin(x), y[:, 0] * x[1:4]])
    a = ca.MX.sym("a", 5)
    # An output that nobody wants, and an input of zeros.
    first, _ = inner(a, ca.MX(3, 2))
    text = function_source(ca.Function("outer", [a], [first]))
    assert "out0[4]=" in text
    assert "arg[0][" not in text
    assert "res[0][" not in text


def test_what_is_not_given_is_zero_and_what_is_not_wanted_is_left() -> None:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 3)
    inner = ca.Function("inner", [x, y], [x * 2 + y, x * y + 1])
    a = ca.MX.sym("a", 3)
    _, second = inner(a, ca.MX(3, 1))
    kernel = FunctionKernel(ca.Function("absent_arguments", [a], [ca.densify(second)]))
    np.testing.assert_array_equal(kernel(np.array([1.0, 2.0, 3.0]))[0], 1.0)
