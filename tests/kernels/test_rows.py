"""Doubles into rows: every storage type, every awkward number, in C and in numpy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.kernels import Field, Layout, LoopKernel, StepGraph
from casadi_ik.kernels.layout import store_rows

from .graphs import needs_compiler

# Double, and what it has to become in u1, u4 and i4.
CASES = [
    (0.0, 0, 0, 0),
    (-0.0, 0, 0, 0),
    (1.0, 1, 1, 1),
    (2.9, 2, 2, 2),
    (-2.9, 0, 0, -2),
    (255.0, 255, 255, 255),
    (255.9, 255, 255, 255),
    (256.0, 255, 256, 256),
    (2.0**31, 255, 2**31, 2**31 - 1),
    (2.0**32 - 1, 255, 2**32 - 1, 2**31 - 1),
    (2.0**32, 255, 2**32 - 1, 2**31 - 1),
    (-(2.0**31), 0, 0, -(2**31)),
    (-1e300, 0, 0, -(2**31)),
    (1e300, 255, 2**32 - 1, 2**31 - 1),
    (np.inf, 255, 2**32 - 1, 2**31 - 1),
    (-np.inf, 0, 0, -(2**31)),
    (np.nan, 0, 0, 0),
]
VALUES = np.array([case[0] for case in CASES])
LAYOUT = Layout.record(
    *(Field(dtype, (len(CASES),), dtype) for dtype in ("u1", "i4", "f4", "u4", "f8"))
)


def expected() -> np.ndarray:
    row = np.zeros(1, LAYOUT.dtype)
    row["f8"] = VALUES
    with np.errstate(over="ignore"):
        row["f4"] = VALUES.astype(np.float32)
    for column, dtype in enumerate(("u1", "u4", "i4"), start=1):
        row[dtype] = [case[column] for case in CASES]
    return row


def test_numpy_conversion() -> None:
    rows = np.zeros(1, LAYOUT.dtype)
    vector = np.tile(VALUES, 5)[None]
    store_rows(LAYOUT, vector, rows)
    assert rows.tobytes() == expected().tobytes()


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_compiler), False])
def test_loop_conversion(compiled: bool) -> None:
    """Every storage type, every awkward double, at offsets that are not aligned."""
    layout = Layout.record(*LAYOUT, Field("odd", (2,), "u1"))
    x, p = ca.SX.sym("x"), ca.SX.sym("p", len(CASES))
    function = ca.Function("awkward", [x, p], [x + 1, ca.vertcat(*[p] * 5, 1, 2), 0])
    step = StepGraph(
        "awkward", function, Layout((Field("x"),)), Layout((Field("p", (len(CASES),)),)), layout
    )
    result = LoopKernel(step, compiled=compiled).run(np.zeros((1, 1)), VALUES, 3, trace=True)
    rows = result.trace[0]
    assert rows.dtype == layout.dtype
    assert rows.dtype.itemsize % 4
    np.testing.assert_array_equal(rows["odd"], [[1, 2]] * 3)
    for name in LAYOUT.names:
        wanted = np.broadcast_to(expected()[name], rows[name].shape)
        np.testing.assert_array_equal(rows[name], wanted)
