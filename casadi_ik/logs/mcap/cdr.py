"""Reads CDR, the byte format of ROS 2 messages, for flat messages described by ros2msg text.

Covers numbers, booleans and strings, alone, in fixed arrays and in sequences; our own layouts use
but a part of it and have a faster way. Little endian, plain CDR (the header is `CDR_HEADER`);
every primitive is aligned to its own size, counted from the end of the header.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.message import CDR_HEADER

NUMPY_TYPES = {
    "bool": "?",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
"""The primitives of ros2msg and how numpy stores them."""

_CONSTANT = re.compile(r"[a-z]+[0-9]*\s+[A-Z][A-Z0-9_]*\s*=")
_LINE = re.compile(r"(?P<type>[a-z]+[0-9]*)(?P<array>\[\d*\])?\s+(?P<name>[a-z]\w*)\Z")


@dataclass(frozen=True)
class Member:
    """One field of a message.

    Attributes:
        name: Its name.
        type: A key of `NUMPY_TYPES`, or "string".
        length: None for a scalar, -1 for a sequence, otherwise the length of the fixed array.
        comment: What stands behind "#" on its line.
    """

    name: str
    type: str
    length: int | None
    comment: str = ""


def parse_members(schema: str) -> tuple[Member, ...]:
    """The fields of a flat message, in order; constants and comment lines are skipped.

    Raises:
        LogError: A line is none of these, or of a type that is not covered.
    """
    members: list[Member] = []
    for line in schema.splitlines():
        code, _, comment = line.partition("#")
        code = code.strip()
        if not code or _CONSTANT.match(code):
            continue
        match = _LINE.match(code)
        if match is None or match["type"] not in (*NUMPY_TYPES, "string"):
            raise LogError(f"message definition: cannot read the line {line.strip()!r}")
        array = match["array"]
        length = None if array is None else -1 if array == "[]" else int(array[1:-1])
        members.append(Member(match["name"], match["type"], length, comment.strip()))
    return tuple(members)


class Codec:
    """Unpacks the messages of one schema."""

    def __init__(self, schema: str) -> None:
        self.members = parse_members(schema)

    def decode(self, data: bytes) -> dict[str, Any]:
        """The fields by name: Python scalars, numpy arrays, lists of strings.

        Raises:
            LogError: The bytes are no such message.
        """
        if data[:4] != CDR_HEADER:
            raise LogError(
                f"message starts with {data[:4].hex(' ')}, expected {CDR_HEADER.hex(' ')}"
            )
        values: dict[str, Any] = {}
        offset = 4
        try:
            for member in self.members:
                values[member.name], offset = _read(data, offset, member)
        except (struct.error, ValueError) as error:
            raise LogError(f"message of {len(data)} bytes is cut or damaged: {error}") from error
        return values


def _align(offset: int, size: int) -> int:
    return offset + -offset % size


def _read(data: bytes, offset: int, member: Member) -> tuple[Any, int]:
    count = 1 if member.length is None else member.length
    if count == -1:
        offset = 4 + _align(offset - 4, 4)
        (count,) = struct.unpack_from("<I", data, offset)
        offset += 4
    if member.type == "string":
        if count > len(data):
            raise ValueError(f"{count} strings announced")
        texts: list[str] = []
        for _ in range(count):
            offset = 4 + _align(offset - 4, 4)
            (size,) = struct.unpack_from("<I", data, offset)
            text = data[offset + 4 : offset + 4 + size]
            if size == 0 or len(text) != size or text[-1] != 0:
                raise ValueError(f"string of {size} bytes does not end where it should")
            texts.append(text[:-1].decode())
            offset += 4 + size
        return (texts[0] if member.length is None else texts), offset
    dtype = np.dtype(NUMPY_TYPES[member.type])
    if count:
        offset = 4 + _align(offset - 4, dtype.itemsize)
    array = np.frombuffer(data, dtype, count, min(offset, len(data)))
    return (array[0].item() if member.length is None else array), offset + array.nbytes
