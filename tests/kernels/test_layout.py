"""Layouts: numbers and symbols lie at the same places and come back."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import casadi_ik as ik
from casadi_ik.kernels import Field, Layout, StepGraph
from casadi_ik.kernels.layout import STORAGE

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
    """A different number in every place."""
    flat = np.arange(layout.size * int(np.prod(lead, dtype=int))) + 0.5
    return layout.unpack(flat.reshape(*lead, layout.size))


@given(layouts())
def test_numbers_go_round(layout: Layout) -> None:
    values = numbers(layout)
    vector = layout.pack(values)
    np.testing.assert_array_equal(vector, np.arange(layout.size) + 0.5)
    for item in layout:
        assert values[item.name].shape == item.shape
        np.testing.assert_array_equal(layout.unpack(vector)[item.name], values[item.name])
        np.testing.assert_array_equal(vector[layout.slice(item.name)], values[item.name].ravel())


@given(layouts())
def test_unpacking_keeps_leading_dimensions(layout: Layout) -> None:
    batch = numbers(layout, (2, 3))
    for item in layout:
        assert batch[item.name].shape == (2, 3, *item.shape)


@given(layouts(), st.booleans())
def test_symbols_lie_where_numbers_lie(layout: Layout, mixed: bool) -> None:
    values = numbers(layout)
    symbols: dict[str, Any] = {
        item.name: ca.SX.sym(item.name, *(item.shape if item.shape else (1,))) for item in layout
    }
    arguments = list(symbols.values())
    if mixed:
        last = layout.names[-1]
        symbols[last] = values[last]
    packed = ca.Function("packed", arguments, [ca.SX(layout.pack(symbols))])
    found = packed.call([ca.DM(values[item.name]) for item in layout])[0]
    np.testing.assert_array_equal(found.full().ravel(), layout.pack(values))


@given(layouts())
def test_symbols_go_round(layout: Layout) -> None:
    vector = layout.symbols("v")
    again = layout.pack(layout.unpack(vector))
    assert again.sparsity().is_dense()
    assert ca.is_equal(again, vector, 1)


@given(layouts())
def test_record_is_packed_widest_first(layout: Layout) -> None:
    record = Layout.record(*layout)
    widths = [np.dtype(item.dtype).itemsize for item in record]
    assert widths == sorted(widths, reverse=True)
    sizes = (item.size * np.dtype(item.dtype).itemsize for item in record)
    assert record.dtype.itemsize == sum(sizes)
    assert record.dtype.names == record.names


def test_bad_layouts_and_values_are_named() -> None:
    with pytest.raises(ik.errors.InputError, match="'a' appears twice"):
        Layout((Field("a"), Field("a")))
    with pytest.raises(ik.errors.InputError, match="'f2'"):
        Layout((Field("a", (), "f2"),))
    layout = Layout((Field("a"), Field("b", (2,))))
    with pytest.raises(ik.errors.InputError, match=r"missing \['b'\], unknown \['c'\]"):
        layout.pack({"a": 1, "c": 2})
    with pytest.raises(ik.errors.InputError, match="'b' has 3 numbers, expected 2"):
        layout.pack({"a": 1, "b": [1, 2, 3]})
    with pytest.raises(ik.errors.InputError, match="no field 'z'; known: a, b"):
        layout.slice("z")


def test_step_whose_sizes_disagree_is_refused() -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x, ca.SX.sym("p")], [x, x, 0])
    two, one = Layout((Field("x", (2,)),)), Layout((Field("p"),))
    StepGraph("fine", function, two, one, two)
    with pytest.raises(ik.errors.InputError, match="step graph 'wrong'"):
        StepGraph("wrong", function, two, one, one)
