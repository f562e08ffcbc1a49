"""Steps and functions for the kernel tests."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.compile import RUNNING, Field, Layout, StepGraph
from casadi_ik.compile.compiler import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
BOTH = pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_compiler), False])

DONE = 7
RECORD = Layout.record(
    Field("flag", (), "u1"),
    Field("x", (4,)),
    Field("jacobian", (2, 3), "f4"),
    Field("mask", (), "u4"),
    Field("signed", (2,), "i4"),
)


def random_expression(
    inputs: ca.SX, size: int, operations: int, seed: int, turning: bool = True
) -> ca.SX:
    """A bounded random function of the inputs, in the operations kinematics is made of.

    Without the turning ones compiled code and the virtual machine agree to the last bit.
    """
    rng = np.random.default_rng(seed)
    sin, cos = (ca.sin, ca.cos) if turning else (lambda v: v / (1 + v * v), ca.tanh)
    atan2 = ca.atan2 if turning else ca.hypot
    pool = ca.vertsplit(inputs)
    for _ in range(operations):
        a, b, c = (pool[i] for i in rng.integers(len(pool), size=3))
        kind = rng.integers(6)
        if kind == 0:
            pool.append(sin(a) * cos(b) + 0.1 * c)
        elif kind == 1:
            pool.append(ca.sqrt(1 + a * a) - 1)
        elif kind == 2:
            pool.append(ca.if_else(a > b, sin(c), cos(a)))
        elif kind == 3:
            pool.append(atan2(a, 1 + b * b))
        elif kind == 4:
            pool.append(ca.fmin(ca.fmax(a - b, -1), 1))
        else:
            pool.append(ca.exp(-a * a) * b / (1 + c * c))
    return ca.vertcat(*pool[-size:])


def record_of(x: ca.SX, p: ca.SX) -> ca.SX:
    return RECORD.pack(
        {
            "flag": x[0] > 0,
            "x": x,
            "jacobian": ca.SX(np.arange(6.0).reshape(2, 3)) * p[0],
            "mask": 65536 * 65535 + ca.floor(10 * ca.fabs(x[1])),
            "signed": ca.vertcat(-1, ca.floor(1000 * x[2])),
        }
    )


def step_of(name: str, function: ca.Function, record: Layout = RECORD) -> StepGraph:
    return StepGraph(
        name,
        function,
        Layout((Field("x", (function.numel_in(0),)),)),
        Layout((Field("p", (function.numel_in(1),)),)),
        record,
    )


def random_step(seed: int = 0, turning: bool = True) -> StepGraph:
    """A chaotic step on four numbers; ends by chance, at different iterations."""
    x, p = ca.SX.sym("x", 4), ca.SX.sym("p", 2)
    noise = random_expression(ca.vertcat(x, p), 4, 120, seed, turning)
    mixed = 3 * noise + 4 * x
    # A parabola of the remainder folds like a sine.
    remainder = mixed - 2 * ca.floor(mixed / 2 + 0.5)
    new = 2 * ca.sin(mixed) if turning else 2 - 4 * remainder * remainder
    status = ca.if_else(ca.fabs(new[0] - p[1]) < 0.01, DONE, RUNNING)
    name = "random_step" if turning else "random_parabola"
    function = ca.Function(name, [x, p], [new, record_of(new, p), status])
    return step_of(name, function)


def branching_step() -> StepGraph:
    """Return an MX step whose branches are short-circuited calls."""
    x, p = ca.SX.sym("x", 4), ca.SX.sym("p", 2)
    left = ca.Function("left", [x, p], [ca.sin(3 * x) * p[0], record_of(x, p)])
    right = ca.Function("right", [x, p], [ca.sqrt(1 + x * x) - 2 * ca.cos(x), record_of(-x, p)])
    branch = ca.Function.conditional("branch", [left], right)
    condition = ca.Function("which", [x, p], [ca.sum1(x) > p[1]])
    xm, pm = ca.MX.sym("x", 4), ca.MX.sym("p", 2)
    new, record = branch(condition(xm, pm), xm, pm)
    status = ca.if_else(ca.fabs(new[0] - pm[1]) < 0.01, DONE, RUNNING)
    return step_of("branching_step", ca.Function("branching_step", [xm, pm], [new, record, status]))


COUNT = Layout.record(Field("count"))


def counting_step(name: str = "counting", offset: float = 0.0) -> StepGraph:
    """Return a step that counts by one and ends (`DONE`) at the parameter."""
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    new = x + 1
    status = ca.if_else(new >= p, DONE, RUNNING)
    function = ca.Function(name, [x, p], [new, new + offset, status])
    return step_of(name, function, COUNT)


def circling_step(name: str = "circling") -> StepGraph:
    """Return a step that counts to the parameter, then by three backwards, and never ends."""
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    new = ca.if_else(x >= p, x - 3, x + 1)
    function = ca.Function(name, [x, p], [new, new, ca.SX(RUNNING)])
    return step_of(name, function, COUNT)
