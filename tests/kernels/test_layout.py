"""Layouts of vectors, and the rows in which records are stored."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import casadi_ik as ik
from casadi_ik.compile import Field, Layout, LoopKernel, StepGraph
from casadi_ik.compile.layout import STORAGE, store_rows

from .graphs import BOTH

shapes = st.one_of(
    st.just(()), st.tuples(st.integers(1, 4)), st.tuples(st.integers(1, 3), st.integers(1, 4))
)


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    names = draw(st.lists(st.sampled_from("abcdefg"), unique=True, min_size=1))
    return Layout(
        tuple(Field(name, draw(shapes), draw(st.sampled_from(STORAGE))) for name in names)
    )


def numbers(layout: Layout, lead: tuple[int, ...] = ()) -> dict[str, Any]:
    """Return a layout's values, all different."""
    flat = np.arange(layout.size * int(np.prod(lead, dtype=int))) + 0.5
    return layout.unpack(flat.reshape(*lead, layout.size))


@given(layouts())
def test_arrays_round_trip(layout):
    values = numbers(layout)
    vector = layout.pack(values)
    np.testing.assert_array_equal(vector, np.arange(layout.size) + 0.5)
    for item in layout:
        assert values[item.name].shape == item.shape
        np.testing.assert_array_equal(layout.unpack(vector)[item.name], values[item.name])
        np.testing.assert_array_equal(vector[layout.slice(item.name)], values[item.name].ravel())


@given(layouts())
def test_unpacking_keeps_leading_dimensions(layout):
    batch = numbers(layout, (2, 3))
    for item in layout:
        assert batch[item.name].shape == (2, 3, *item.shape)


@given(layouts(), st.booleans())
def test_symbols_have_the_layout_of_arrays(layout, mixed):
    values = numbers(layout)
    symbols: dict[str, Any] = {
        item.name: ca.SX.sym(item.name, *(item.shape if item.shape else (1,))) for item in layout
    }
    arguments = list(symbols.values())
    if mixed:
        last = layout.names[-1]
        symbols[last] = values[last]
    packed = ca.Function("packed", arguments, [ca.SX(layout.pack(symbols))])
    packed_numbers = packed.call([ca.DM(values[item.name]) for item in layout])[0]
    np.testing.assert_array_equal(packed_numbers.full().ravel(), layout.pack(values))


@given(layouts())
def test_symbols_round_trip(layout):
    vector = layout.symbols("v")
    vector_again = layout.pack(layout.unpack(vector))
    assert vector_again.sparsity().is_dense()
    assert ca.is_equal(vector_again, vector, 1)


@given(layouts())
def test_record_is_packed_widest_first(layout):
    record = Layout.record(*layout)
    widths = [np.dtype(item.dtype).itemsize for item in record]
    assert widths == sorted(widths, reverse=True)
    sizes = (item.size * np.dtype(item.dtype).itemsize for item in record)
    assert record.dtype.itemsize == sum(sizes)
    assert record.dtype.names == record.names


def test_bad_layouts_and_values_are_named():
    with pytest.raises(ik.errors.InputError, match="'a' appears twice"):
        Layout((Field("a"), Field("a")))
    with pytest.raises(ik.errors.InputError, match="'f2'"):
        Layout((Field("a", (), "f2"),))
    layout = Layout((Field("a"), Field("b", (2,))))
    with pytest.raises(ik.errors.InputError, match=r"\['b'\].*\['c'\]"):
        layout.pack({"a": 1, "c": 2})
    with pytest.raises(ik.errors.InputError, match=r"'b'.*3.*2"):
        layout.pack({"a": 1, "b": [1, 2, 3]})
    with pytest.raises(ik.errors.InputError, match="'z'; known:"):
        layout.slice("z")


def test_step_whose_sizes_disagree_is_refused():
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x, ca.SX.sym("p")], [x, x, 0])
    two, scalar_layout = Layout((Field("x", (2,)),)), Layout((Field("p"),))
    StepGraph("fine", function, two, scalar_layout, two)
    with pytest.raises(ik.errors.InputError, match="'wrong'"):
        StepGraph("wrong", function, two, scalar_layout, scalar_layout)


# A double, and its values as u1, u4 and i4.
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


def test_numpy_conversion():
    rows = np.zeros(1, LAYOUT.dtype)
    vector = np.tile(VALUES, 5)[None]
    store_rows(LAYOUT, vector, rows)
    assert rows.tobytes() == expected().tobytes()


@BOTH
def test_loop_conversion(compiled):
    """Every storage type stores special doubles correctly at unaligned offsets."""
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
        expected_rows = np.broadcast_to(expected()[name], rows[name].shape)
        np.testing.assert_array_equal(rows[name], expected_rows)
