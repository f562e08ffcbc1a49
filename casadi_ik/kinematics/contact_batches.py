"""Contacts of batches as arrays: validation of extra vectors, and groups with equal kinds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError, RowError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import Kinds, kind_from_vectors, point_normal_kinds
from casadi_ik.model.grasp import (
    EXTRA_VECTORS,
    invalid_mask,
    invalid_reason,
    orthogonal_tangents,
    unit_vectors,
)
from casadi_ik.model.targets import DIRECTIONS_KEY, TargetBatch

EXTRA_ARRAY_NAMES = tuple(f"{name}s" for name in EXTRA_VECTORS)
"""Names of the arrays of extra target vectors."""


def check_extra_vectors(
    extra_vectors: Mapping[str, ArrayLike | None], points: Array, normals: Array, first_row: int = 0
) -> dict[str, Array]:
    """Validate the extra vectors of a batch.

    Args:
        extra_vectors: (k, f, 3) by name; NaN where free, None if absent.
        points: (k, f, 3) checked [m].
        normals: (k, f, 3) checked, unit.
        first_row: Index of the first row, for messages.

    Returns:
        Unit vectors (k, f, 3) by name, without arrays that are NaN everywhere.

    Raises:
        UnknownNameError: The name of an array is unknown.
        RowError: A vector is partly NaN, infinite, zero or inconsistent with other vectors of the
            contact; the message names row and finger.
        InputError: An array has a wrong shape or is not numeric.
    """
    arrays: dict[str, Array] = {}
    for name, value in extra_vectors.items():
        if name not in EXTRA_ARRAY_NAMES:
            expected = ", ".join((*EXTRA_ARRAY_NAMES, DIRECTIONS_KEY))
            raise UnknownNameError(f"{name!r} does not exist; expected one of {expected}")
        if value is None:
            continue
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected an array of numbers") from error
        if array.shape != points.shape:
            raise InputError(f"{name}: found shape {array.shape}, expected {points.shape}")
        if not np.isnan(array).all():
            arrays[name] = array
    if not arrays:
        return arrays
    is_invalid, units = np.zeros(points.shape[:2], dtype=bool), dict[str, Array]()
    for name, array in arrays.items():
        is_constrained = ~np.isnan(array).all(axis=2)
        with np.errstate(invalid="ignore"):
            units[name], zero = unit_vectors(array)
        is_invalid |= is_constrained & (zero | ~np.isfinite(array).all(axis=2))
    vectors = {name[:-1]: array for name, array in units.items()}
    is_invalid |= invalid_mask({"point": points, "normal": normals, **vectors})
    for row, finger in np.argwhere(is_invalid)[:1].tolist():
        all_arrays = {"points": points, "normals": normals, **arrays}
        problem = _describe_problem(
            {name: array[row, finger] for name, array in all_arrays.items()}
        )
        raise RowError(f"row {first_row + row}, finger {finger}: {problem}", first_row + row)
    if "tangents" in units:
        units["tangents"] = orthogonal_tangents(units["tangents"], normals)
    return units


def _describe_problem(vectors: Mapping[str, Array]) -> str:
    """Return the problem of an invalid contact."""
    units: dict[str, Array] = {}
    for name, vector in vectors.items():
        if np.isnan(vector).all():
            continue
        if not np.isfinite(vector).all():
            return f"{name[:-1]}: found {vector.tolist()}, expected finite numbers, or all NaN"
        unit, zero = unit_vectors(vector)
        if name in EXTRA_ARRAY_NAMES and zero:
            return f"{name[:-1]}: found {vector.tolist()}, expected a direction, not zero"
        units[name[:-1]] = unit if name in EXTRA_ARRAY_NAMES else vector
    return invalid_reason(units) or "malformed"


def group_by_kinds(
    targets: TargetBatch,
) -> Iterator[tuple[Kinds, slice | NDArray[np.intp], TargetBatch]]:
    """Group targets by the kinds of their contacts, one group per kernel.

    The kinds of a target do not depend on the batch. If a finger has a tangent, all fingers get a
    free tangent, and if a finger has a ball, fingers without a point get a ball: a kernel for every
    combination would not be faster.

    Yields:
        Kinds, rows (a full slice if there is one group) and the targets in these rows.
    """
    f = targets.points.shape[1]
    if not targets.extra_vectors:
        yield point_normal_kinds(f), slice(None), targets
        return
    names = list(targets.extra_vectors)
    has_vector = np.stack(
        [~np.isnan(targets.extra_vectors[name][..., 0]) for name in names], axis=2
    )
    if "tangents" in names:
        has_tangent = has_vector[..., names.index("tangents")]
        has_tangent[:] = has_tangent.any(axis=1, keepdims=True)
    if "balls" in names:
        has_ball = has_vector[..., names.index("balls")]
        has_ball |= has_ball.any(axis=1, keepdims=True) & np.isnan(targets.points[..., 0])
    flags = has_vector.reshape(len(has_vector), -1)
    _, first_rows, group = np.unique(
        flags @ (1 << np.arange(flags.shape[1])), return_index=True, return_inverse=True
    )
    for i, finger_flags in enumerate(has_vector[first_rows].tolist()):
        kinds = tuple(
            kind_from_vectors(name[:-1] for name, flag in zip(names, row, strict=True) if flag)
            for row in finger_flags
        )
        if len(first_rows) == 1:
            yield kinds, slice(None), targets
            return
        rows = np.flatnonzero(group == i)
        row_numbers = np.array([targets.row_number(row) for row in rows.tolist()])
        yield kinds, rows, replace(targets.rows(rows), row_numbers=row_numbers)
