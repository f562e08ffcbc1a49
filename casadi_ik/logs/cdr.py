"""CDR, the byte format of ROS 2 messages, for flat messages described by ros2msg text.

Covers what our schemas use: numbers, booleans and strings, alone, in fixed arrays and in
sequences. Little endian, plain CDR (the header is `HEADER`); every primitive is aligned to its
own size, counted from the end of the header.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.errors import LogError

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of little-endian plain CDR."""

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
    """Packs and unpacks the messages of one schema."""

    def __init__(self, schema: str) -> None:
        self.members = parse_members(schema)

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """The message with its CDR header.

        Args:
            values: One value per field: a number, a string, or an array or sequence of them.

        Raises:
            LogError: A field is missing, out of its type's range or of the wrong length.
        """
        out = bytearray()
        for member in self.members:
            try:
                _write(out, member, values[member.name])
            except KeyError:
                raise LogError(f"message field {member.name!r} is missing") from None
            except (struct.error, OverflowError, TypeError, ValueError) as error:
                raise LogError(
                    f"message field {member.name!r}: cannot store as {member.type}: {error}"
                ) from error
        return HEADER + bytes(out)

    def decode(self, data: bytes) -> dict[str, Any]:
        """The fields by name: Python scalars, numpy arrays, lists of strings.

        Raises:
            LogError: The bytes are no such message.
        """
        if data[:4] != HEADER:
            raise LogError(f"message starts with {data[:4].hex(' ')}, expected {HEADER.hex(' ')}")
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


def _write(out: bytearray, member: Member, value: Any) -> None:
    if member.type == "string":
        texts = [value] if member.length is None else list(value)
        if member.length is not None:
            _write_length(out, member, len(texts))
        for text in texts:
            if not isinstance(text, str):
                raise TypeError(f"found {type(text).__name__}")
            data = text.encode() + b"\0"
            out.extend(bytes(-len(out) % 4) + struct.pack("<I", len(data)) + data)
        return
    dtype = np.dtype(NUMPY_TYPES[member.type])
    array = _whole_numbers(value, dtype) if dtype.kind in "biu" else np.asarray(value)
    if array.size and array.dtype.kind not in "biuf":
        raise TypeError(f"found {array.dtype}")
    if member.length is None:
        if array.shape:
            raise ValueError(f"expected a scalar, found shape {array.shape}")
    else:
        _write_length(out, member, array.size)
    if array.size:
        out.extend(bytes(-len(out) % dtype.itemsize) + array.astype(dtype).tobytes())


def _whole_numbers(value: Any, dtype: np.dtype[Any]) -> np.ndarray:
    """The value in an integer or boolean type; neither rounds nor wraps."""
    array = value if isinstance(value, np.ndarray) else np.array(value, dtype=object)
    numbers = array.ravel().tolist()
    if not all(isinstance(number, int | np.integer | np.bool_) for number in numbers):
        raise TypeError("found something that is not a whole number")
    low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    if numbers and not low <= min(numbers) <= max(numbers) <= high:
        raise OverflowError(f"range is {low} to {high}")
    return array.astype(dtype)


def _write_length(out: bytearray, member: Member, count: int) -> None:
    if member.length == -1:
        out.extend(bytes(-len(out) % 4) + struct.pack("<I", count))
    elif member.length != count:
        raise ValueError(f"expected {member.length} elements, found {count}")


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
