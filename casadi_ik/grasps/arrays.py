"""Numbers of a caller as real arrays; directions of any length as unit vectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array

UNIT = 1e-15
"""A vector whose length is so near to 1 has been normalised before."""

SMALL, LARGE = 1e-100, 1e100
"""Between these the squares of a length are neither rounded to zero nor infinite."""


def real_array(value: Any) -> Array:
    """A new array of real numbers.

    Raises:
        ValueError: Something else: text, complex numbers (whose imaginary part would be lost), or
            masked ones (whose mask would).
        TypeError: The same.
    """
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError("a masked array, expected plain numbers (NaN marks what is free)")
    array = np.array(value)
    if array.dtype.kind == "c":
        raise ValueError("complex numbers, expected real ones")
    return array if array.dtype == np.float64 else np.array(value, dtype=np.float64)


def unit_vectors(vectors: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Directions of any length, from the smallest number to the largest.

    Args:
        vectors: (..., 3); NaN gives NaN.

    Returns:
        Unit vectors, and (...) which of the vectors are zero (these give NaN). What is of unit
        length to the last digits stays as it is.
    """
    with np.errstate(over="ignore", under="ignore"):
        length = _length(vectors)
    odd = (length < SMALL) | (length > LARGE)
    if odd.any():
        # By powers of two, which change no digit; in two halves, as one may be out of range.
        power = np.where(odd, -np.frexp(np.abs(vectors).max(axis=-1))[1], 0)[..., None]
        vectors = np.ldexp(np.ldexp(vectors, power // 2), power - power // 2)
        length = _length(vectors)
    length = np.where(np.abs(length - 1) < UNIT, 1.0, length)
    zero = length == 0
    return vectors / np.where(zero, np.nan, length)[..., None], zero


def _length(vectors: Array) -> Array:
    """(...), summed in order: the same bits in an exported solver."""
    squares = vectors * vectors
    return np.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])
