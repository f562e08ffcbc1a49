"""CDR and schemas over random layouts and messages, against mcap_ros2 and rosbags."""

from __future__ import annotations

import string
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from casadi_ik.errors import LogError
from casadi_ik.kernels.layout import STORAGE, Field, Layout
from casadi_ik.logs.mcap import schema
from casadi_ik.logs.mcap.cdr import NUMPY_TYPES, Codec, parse_members
from casadi_ik.logs.mcap.message import CDR_HEADER

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
    ours = Codec(text).decode(payload)
    theirs = generate_dynamic(NAME, text)[NAME](payload)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, NAME))
    third = store.deserialize_cdr(payload, NAME)
    for item in layout:
        expected = flat(row[item.name])
        np.testing.assert_array_equal(flat(ours[item.name]), expected)
        np.testing.assert_array_equal(flat(getattr(theirs, item.name)), expected)
        third_name = item.name if hasattr(third, item.name) else item.name + "_"
        np.testing.assert_array_equal(flat(getattr(third, third_name)), expected)


@settings(max_examples=100)
@given(layout=layouts())
def test_the_layout_comes_back_from_the_schema(layout: Layout) -> None:
    assert schema.parse_layout(schema.schema_text(layout)) == layout


@st.composite
def messages(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    lines: list[str] = []
    values: dict[str, Any] = {}
    for name in draw(st.lists(names, min_size=1, max_size=8, unique=True)):
        kind = draw(st.sampled_from([*NUMPY_TYPES, "string"]))
        if kind == "string":
            element = st.text(st.characters(exclude_categories=["Cs"]), max_size=9)
        elif kind == "bool":
            element = st.booleans()
        elif kind.startswith("float"):
            element = st.floats(width=32 if kind == "float32" else 64, allow_nan=False)
        else:
            limits = np.iinfo(NUMPY_TYPES[kind])
            element = st.integers(int(limits.min), int(limits.max))
        array = draw(st.sampled_from(["", "[]", "[3]"]))
        lines.append(f"{kind}{array} {name}\n")
        if array == "":
            values[name] = draw(element)
        else:
            count = 3 if array == "[3]" else draw(st.integers(1, 4))
            values[name] = draw(st.lists(element, min_size=count, max_size=count))
    return "".join(lines), values


def as_lists(value: Any) -> Any:
    if isinstance(value, bytes):
        return list(value)
    return value.tolist() if isinstance(value, np.ndarray) else value


@settings(max_examples=150)
@given(message=messages())
def test_codec_agrees_with_mcap_ros2(message: tuple[str, dict[str, Any]]) -> None:
    text, values = message
    data = serialize_dynamic(NAME, text)[NAME](values)
    decoded = Codec(text).decode(data)
    theirs = generate_dynamic(NAME, text)[NAME](data)
    for name, value in values.items():
        assert as_lists(decoded[name]) == value
        assert as_lists(getattr(theirs, name)) == value


@settings(max_examples=60)
@given(message=messages(), data=st.data())
def test_a_cut_message_is_an_error(
    message: tuple[str, dict[str, Any]], data: st.DataObject
) -> None:
    text, values = message
    whole = serialize_dynamic(NAME, text)[NAME](values)
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(LogError):
        Codec(text).decode(whole[:cut])


def test_empty_sequences() -> None:
    text = "uint32[] a\nstring[] b\nbool[] c\nfloat64[] d\n"
    decoded = Codec(text).decode(CDR_HEADER + bytes(16))
    assert {name: as_lists(value) for name, value in decoded.items()} == {
        name: [] for name in "abcd"
    }


def test_a_message_of_another_encoding_is_refused() -> None:
    with pytest.raises(LogError, match="starts with 00 00 00 00"):
        Codec("uint8 a\n").decode(bytes(5))


@pytest.mark.parametrize("text", ["float64\n", "geometry_msgs/Pose pose\n", "float64[<=3] q\n"])
def test_unknown_lines_are_refused(text: str) -> None:
    with pytest.raises(LogError, match="cannot read the line"):
        parse_members(text)


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
