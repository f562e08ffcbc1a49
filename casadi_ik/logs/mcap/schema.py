"""The messages of a log as ros2msg text: iterations, solves and events, each by its layout.

The text is all a reader needs to get the `Layout` back: each line carries the type and the name
and, behind "#", the shape if it has more than one axis, the unit and the doc.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from casadi_ik.errors import InputError, LogError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs.mcap.records import check_size

PACKAGE = "casadi_ik/msg"
KINDS = ("iteration", "solve", "event")
"""The kinds of messages, each on a topic of its own per method."""

ROS_TYPES = {"f8": "float64", "f4": "float32", "u4": "uint32", "i4": "int32", "u1": "uint8"}
"""How a layout's storage is called in ros2msg."""

_STORAGE = {ros: dtype for dtype, ros in ROS_TYPES.items()}
_AXES = 8
"""A field has no more axes."""

_ROS_NAME = re.compile(r"(?!.*__)(?!.*_\Z)[a-z][a-z0-9_]*\Z")
_CONSTANT = re.compile(r"[a-z]+[0-9]*\s+[A-Z][A-Z0-9_]*\s*=")
_LINE = re.compile(r"(?P<type>[a-z]+[0-9]*)(?P<array>\[\d{1,9}\])?\s+(?P<name>[a-z]\w*)\Z")
_COMMENT = re.compile(
    r"(?:\((?P<shape>\d{1,9}(?:, \d{1,9})*)\) )?\[(?P<unit>[^\]]*)\](?: (?P<doc>.*))?\Z"
)


def topic(method: str, kind: str) -> str:
    """Topic of a method's messages; kind is one of `KINDS`."""
    return f"/ik/{method}/{kind}"


def schema_name(kind: str, method: str, layout: Layout, fingers: int) -> str:
    """Schema name of a method's messages: the kind, the method and the robot's shape.

    Q is the number of coordinates, F of fingers, J of singular values that are logged:
    "casadi_ik/msg/IterationEnhancedDlsQ14F3J4".

    Args:
        kind: One of `KINDS`.
        method: Name of the method.
        layout: Of its iterations.
        fingers: How many.
    """
    words = "".join(word[:1].upper() + word[1:] for word in re.findall(r"[A-Za-z0-9]+", method))
    coordinates = next((item.size for item in layout if item.name == "q"), 0)
    jacobians = sum(item.size for item in layout if item.name.startswith("sigma_"))
    return f"{PACKAGE}/{kind.capitalize()}{words}Q{coordinates}F{fingers}J{jacobians}"


def schema_text(layout: Layout, labels: Mapping[str, tuple[str, ...]] | None = None) -> str:
    """The ros2msg text of a record layout.

    Args:
        layout: Fields by falling width, as `Layout.record` sorts them.
        labels: Names of the codes of integer scalars become constants right before the field,
            where viewers take them for its enum names.

    Raises:
        LogError: The layout cannot be a message: a field would need padding, is empty, or has a
            name that ROS forbids.
    """
    widths = [np.dtype(item.dtype).itemsize for item in layout]
    if not widths or widths != sorted(widths, reverse=True):
        raise LogError(f"layout of {layout.names} is not sorted by falling width, or empty")
    lines: list[str] = []
    for item in layout:
        if not _ROS_NAME.match(item.name):
            raise LogError(f"field {item.name!r}: a ROS field name is lower_snake_case")
        if item.size == 0 or "]" in item.unit:
            raise LogError(f"field {item.name!r}: shape {item.shape}, unit {item.unit!r}")
        ros_type = ROS_TYPES[item.dtype]
        names = (labels or {}).get(item.name, ())
        if item.shape == () and item.dtype[0] in "ui" and not item.name.endswith("_mask"):
            lines += [
                f"{ros_type} {_constant(item.name, name)}={code}"
                for code, name in enumerate(names)
                if name
            ]
        length = f"[{item.size}]" if item.shape else ""
        shape = f"({', '.join(map(str, item.shape))}) " if len(item.shape) > 1 else ""
        comment = f"{shape}[{item.unit}] {' '.join(item.doc.split())}".rstrip()
        lines.append(f"{ros_type}{length} {item.name} # {comment}")
    return "\n".join(lines) + "\n"


def parse_layout(text: str) -> Layout:
    """The layout that `schema_text` was given.

    Raises:
        LogError: Not such a text.
    """
    lines = (line.partition("#") for line in text.splitlines())
    coded = ((code.strip(), comment.strip()) for code, _, comment in lines)
    wanted = [each for each in coded if each[0] and not _CONSTANT.match(each[0])]
    try:
        layout = Layout(tuple(_field(*each) for each in wanted))
        widths = [np.dtype(item.dtype).itemsize for item in layout]
        if not widths or widths != sorted(widths, reverse=True):
            raise LogError("schema: its fields are not sorted by falling width, or there are none")
        size = sum(item.size * width for item, width in zip(layout, widths, strict=True))
        check_size("schema: a message", size)
    except InputError as error:
        raise LogError(f"schema: {error}") from error
    return layout


def _field(code: str, comment: str) -> Field:
    """The field that a line of a schema describes."""
    line, about = _LINE.match(code), _COMMENT.match(comment)
    if line is None or line["type"] not in _STORAGE or about is None:
        raise LogError(f"schema: the line {code[:60]!r} is no part of a record layout")
    length = int(line["array"][1:-1]) if line["array"] else None
    shape = () if length is None else (length,)
    if about["shape"]:
        shape = tuple(int(number) for number in about["shape"].split(", "))
    found = Field(line["name"], shape, _STORAGE[line["type"]], about["unit"], about["doc"] or "")
    if found.size != (1 if length is None else length) or len(shape) > _AXES:
        raise LogError(f"schema: field {found.name!r}: its shape has not {length} elements")
    return found


def _constant(field_name: str, label: str) -> str:
    words = re.findall(r"[A-Z0-9]+", f"{field_name} {label}".upper())
    return "_".join(words)
