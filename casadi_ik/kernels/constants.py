"""Numbers as C text that reads back to the same bits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTH = 96
"""Characters of a line of numbers."""


def number(value: float) -> str:
    """A double as C writes it."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is no constant of C")
    return repr(float(value))


def numbers(values: Iterable[Any]) -> str:
    """Numbers between braces, in lines; rows of rows have braces of their own."""
    parts = [
        numbers(value)
        if isinstance(value, Sequence | np.ndarray)
        else str(int(value))
        if isinstance(value, int | np.integer)
        else number(value)
        for value in values
    ]
    lines, line = [], ""
    for part in parts:
        if line and len(line) + len(part) + 2 > WIDTH:
            lines.append(line)
            line = ""
        line += ("" if not line else " ") + part + ","
    return "{\n" + "\n".join([*lines, line.rstrip(",")]) + "}"


def define_arrays(arrays: Mapping[str, NDArray[Any]], scope: str = "static const") -> str:
    """Arrays of doubles, of 16-bit or of common whole numbers, by name; none is empty."""
    text = ""
    for name, array in arrays.items():
        whole = "int16_t" if array.dtype == np.int16 else "int"
        kind = whole if array.dtype.kind in "iu" else "double"
        sizes = "".join(f"[{size}]" for size in array.shape)
        text += f"{scope} {kind} {name}{sizes} = {numbers(array)};\n"
    return text
