"""The columns of a trace as plain matrices, their names, and when a condition begins and ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Labels = Mapping[str, tuple[str, ...]]
Rows = np.ndarray[Any, np.dtype[Any]]


def columns(values: Rows) -> np.ndarray:
    """A field of all rows as a float matrix (k, size)."""
    return values.reshape(len(values), -1).astype(float)


def bits_of(mask: Rows) -> np.ndarray:
    """The bits of an integer field, least significant first, (k, bits) bool."""
    rows = np.ascontiguousarray(mask).reshape(len(mask), -1)
    octets = rows.astype(rows.dtype.newbyteorder("<")).view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little").astype(bool)


def name_of(names: Sequence[str], index: int, what: str) -> str:
    """The name of an element or bit, or what it is and its number."""
    return names[index] if index < len(names) else f"{what} {index}".strip()


def label_of(labels: Labels, name: str, code: int) -> str:
    """The name of a code of an integer field, or the code."""
    names = labels.get(name, ())
    return (names[code] if 0 <= code < len(names) else "") or str(code)


def settled(begun: np.ndarray, ended: np.ndarray) -> np.ndarray:
    """Whether a condition holds in each row, (k, m) bool.

    It holds from a row where it has begun until one where it has ended; in between nothing
    changes. Before the first row it does not hold.
    """
    rows = np.arange(len(begun))[:, None]
    decided = np.maximum.accumulate(np.where(begun | ended, rows, -1), axis=0)
    return np.take_along_axis(begun, np.maximum(decided, 0), axis=0) & (decided >= 0)


def entries(begun: np.ndarray, ended: np.ndarray) -> list[tuple[int, int]]:
    """Rows and columns where a condition begins to hold, as `settled` understands it."""
    return [(i, column) for i, column, sign in changes(settled(begun, ended)) if sign > 0]


def changes(holds: np.ndarray) -> list[tuple[int, int, int]]:
    """Where a condition begins (1) or ends (-1): row, column, sign; by row, then column."""
    before = np.vstack([np.zeros_like(holds[:1]), holds[:-1]])
    change = holds.astype(np.int8) - before.astype(np.int8)
    return [(int(i), int(column), int(change[i, column])) for i, column in np.argwhere(change)]
