"""CDR and schemas over random layouts and messages, against mcap_ros2 and rosbags."""

from __future__ import annotations

import string
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from casadi_ik.errors import LogError
from casadi_ik.kernels.layout import STORAGE, Field, Layout
from casadi_ik.logs import format as schema
from casadi_ik.logs.chunks import CDR_HEADER

NAME = "casadi_ik/msg/Random"
names = st.from_regex(r"[a-z]([a-z0-9]|_[a-z0-9]){0,12}", fullmatch=True)
docs = st.text(string.ascii_letters + string.digits + " .,:;#=[]()/'\"-π→", max_size=30)
units = st.sampled_from(["", "m", "rad", "m/s", "rad or m"])


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    fields = [
        Field(
            name,
            draw(st.lists(st.integers(1, 5), max_size=3).map(tuple)),
            draw(st.sampled_from(STORAGE)),
            draw(units),
            " ".join(draw(docs).split()),
        )
        for name in draw(st.lists(names, min_size=1, max_size=8, unique=True))
    ]
    return Layout.record(*fields)


def flat(value: Any) -> np.ndarray:
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    return np.asarray(value).ravel()


@settings(max_examples=60)
@given(layout=layouts(), data=st.data())
def test_a_row_is_its_own_message(layout: Layout, data: st.DataObject) -> None:
    row = np.frombuffer(
        data.draw(st.binary(min_size=layout.dtype.itemsize, max_size=layout.dtype.itemsize)),
        layout.dtype,
    )[0]
    text = schema.schema_text(layout, dict.fromkeys(layout.names, ("a", "b c")))
    payload = CDR_HEADER + row.tobytes()
    theirs = generate_dynamic(NAME, text)[NAME](payload)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, NAME))
    third = store.deserialize_cdr(payload, NAME)
    for item in layout:
        expected = flat(row[item.name])
        np.testing.assert_array_equal(flat(getattr(theirs, item.name)), expected)
        third_name = item.name if hasattr(third, item.name) else item.name + "_"
        np.testing.assert_array_equal(flat(getattr(third, third_name)), expected)


@settings(max_examples=100)
@given(layout=layouts())
def test_the_layout_comes_back_from_the_schema(layout: Layout) -> None:
    assert schema.parse_layout(schema.schema_text(layout)) == layout


@pytest.mark.parametrize(
    "line",
    [
        "float64 # []",
        "geometry_msgs/Pose pose # []",
        "float64[<=3] q # []",
        "float64[] q # []",
        "string name # []",
        "float64 q",
        "float64[6] q # (2, 2) []",
        "float64[4] q # (999999999, 999999999, 999999999) []",
        "float64[999999999] q # []",
    ],
)
def test_lines_that_are_no_part_of_a_layout_are_refused(line: str) -> None:
    with pytest.raises(LogError, match="schema: "):
        schema.parse_layout(f"{line}\n")


def test_fields_that_would_need_padding_are_refused() -> None:
    with pytest.raises(LogError, match="not sorted by falling width"):
        schema.parse_layout("uint8 a # []\nfloat64 b # []\n")


def test_the_schema_is_for_people_too() -> None:
    layout = Layout.record(
        Field("phase", dtype="u1", doc="phase of\nthe method"),
        Field("pose", (3, 4), "f8", "m"),
        Field("limit_mask", dtype="u4"),
    )
    labels = {"phase": ("", "thumb reaching", "hand-alignment"), "limit_mask": ("a",)}
    assert schema.schema_text(layout, labels) == (
        "float64[12] pose # (3, 4) [m]\n"
        "uint32 limit_mask # []\n"
        "uint8 PHASE_THUMB_REACHING=1\n"
        "uint8 PHASE_HAND_ALIGNMENT=2\n"
        "uint8 phase # [] phase of the method\n"
    )
    assert schema.schema_name("iteration", "hand-first", layout, 3) == (
        "casadi_ik/msg/IterationHandFirstQ0F3J0"
    )


@pytest.mark.parametrize(
    "layout",
    [
        Layout(()),
        Layout((Field("a", dtype="u1"), Field("b"))),
        Layout((Field("J_arm"),)),
        Layout((Field("a__b"),)),
        Layout((Field("a", (0,)),)),
    ],
)
def test_layouts_that_are_no_message(layout: Layout) -> None:
    with pytest.raises(LogError):
        schema.schema_text(layout)
