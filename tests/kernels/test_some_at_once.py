"""Elementary functions of several numbers in one call: the bits of one call each."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest

from casadi_ik.kernels import FunctionKernel
from casadi_ik.kernels.codegen import function_source
from casadi_ik.kernels.some_at_once import some_at_once

from .graphs import needs_compiler

COUNT = 7
"""Numbers: more than go into one call, and one left over."""


def several(name: str) -> ca.Function:
    """Sines and arcs of all entries, then those of sums of their results."""
    x = ca.SX.sym("x", COUNT)
    first = [ca.sin(x), ca.cos(x[:3]), ca.atan2(x, x[0]), ca.asin(x[:5]), ca.acos(x), ca.atan(x)]
    values = ca.vertcat(*first)
    later = ca.vertcat(ca.cos(values + 1), ca.atan2(values[1:], values[:-1]))
    return ca.Function(name, [x], [ca.vertcat(values, later, ca.sin(x[0]) * values)])


def test_calls_are_put_together() -> None:
    text = some_at_once(function_source(several("several")))
    widths = re.findall(r"own_(?:turns|arcs)_(\d)\(", text)
    assert widths.count("4") > 10
    # Only what waits for nothing but the number itself is left alone, at most one of a kind.
    assert len(re.findall(r"=(?:sin|cos|asin|acos|atan|atan2)\(", text)) <= 2


@needs_compiler
@pytest.mark.parametrize("scale", [1e-9, 0.5, 3.0, 1e9])
def test_bits_of_one_call_each(scale: float) -> None:
    x = np.random.default_rng(5).normal(size=(500, COUNT)) * scale
    x[0] = [np.nan, 0.0, -0.0, np.inf, 1.0, -1.0, 6e8]
    whole = FunctionKernel(several("several"))(x)[0]
    # A graph of one result has at most two calls that could go together: those after each other.
    one, other = ca.SX.sym("x"), ca.SX.sym("y")
    parts = [ca.Function("one_sine", [one], [ca.sin(one)])]
    parts += [ca.Function("one_cosine", [one], [ca.cos(one)])]
    parts += [ca.Function("one_angle", [one, other], [ca.atan2(one, other)])]
    sine, cosine, angle = map(FunctionKernel, parts)
    values = whole[:, : 5 * COUNT + 1]
    assert values[:, :COUNT].tobytes() == sine(x.reshape(-1))[0].reshape(-1, COUNT).tobytes()
    found = cosine(np.ascontiguousarray(values).reshape(-1) + 1)[0].reshape(len(x), -1)
    start = values.shape[1]
    assert whole[:, start : start + values.shape[1]].tobytes() == found.tobytes()
    rows = [np.ascontiguousarray(part).reshape(-1) for part in (values[:, 1:], values[:, :-1])]
    found = angle(*rows)[0].reshape(len(x), -1)
    place = start + values.shape[1]
    assert whole[:, place : place + values.shape[1] - 1].tobytes() == found.tobytes()
