"""What targets have beside points and normals, as arrays: checked, and sorted by kinds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arrays import Array
from casadi_ik.errors import InputError, RowError, UnknownNameError
from casadi_ik.grasps.vectors import MORE, fault, squared
from casadi_ik.problem.contacts.kinds import Kinds, kind_of, usual
from casadi_ik.problem.problems import DIRECTIONS, Problems

NAMES = tuple(f"{name}s" for name in MORE)
"""Names of the arrays."""


def more_arrays(
    more: Mapping[str, ArrayLike | None], points: Array, normals: Array, first_row: int = 0
) -> dict[str, Array]:
    """Checked vectors of a batch.

    Args:
        more: (k, f, 3) by name; NaN where free, None where there is none at all.
        points: (k, f, 3) checked [m].
        normals: (k, f, 3) checked, unit.
        first_row: Number of the first row, for messages.

    Returns:
        Unit vectors (k, f, 3) by name; nothing that is free everywhere.

    Raises:
        UnknownNameError: No such name.
        RowError: A vector that is partly NaN, infinite or zero, or does not go with the others;
            the message names row and finger.
        InputError: Wrong shape, no numbers.
    """
    found: dict[str, Array] = {}
    for name, value in more.items():
        if name not in NAMES:
            raise UnknownNameError(
                f"{name!r} does not exist; expected one of {', '.join((*NAMES, DIRECTIONS))}"
            )
        if value is None:
            continue
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected an array of numbers") from error
        if array.shape != points.shape:
            raise InputError(f"{name}: found shape {array.shape}, expected {points.shape}")
        if not np.isnan(array).all():
            found[name] = array
    if not found:
        return found
    given = np.logical_or.reduce([~np.isnan(array).all(axis=2) for array in found.values()])
    for row, finger in np.argwhere(given).tolist():
        vectors = {name: array[row, finger] for name, array in found.items()}
        vectors |= {"points": points[row, finger], "normals": normals[row, finger]}
        problem = _unit(vectors) or fault({name[:-1]: v for name, v in vectors.items()})
        if problem:
            number = first_row + row
            raise RowError(f"row {number}, finger {finger}: {problem}", number)
        if "tangents" in vectors:
            vectors["tangents"] = squared(vectors["tangents"], vectors["normals"])
        for name in found.keys() & vectors.keys():
            found[name][row, finger] = vectors[name]
    return found


def _unit(vectors: dict[str, Array]) -> str | None:
    """Leave out what is free and make the directions unit vectors; what is wrong, if anything."""
    for name, vector in list(vectors.items()):
        if np.isnan(vector).all():
            del vectors[name]
            continue
        length = float(np.linalg.norm(vector))
        if not np.isfinite(length):
            return f"{name[:-1]}: found {vector.tolist()}, expected finite numbers, or all NaN"
        if name in NAMES:
            if length < 1e-9:
                return f"{name[:-1]}: found {vector.tolist()}, expected a direction, not zero"
            vectors[name] = vector / length
    return None


def by_kinds(problems: Problems) -> Iterator[tuple[Kinds, NDArray[np.intp] | None, Problems]]:
    """Targets sorted by the kinds of their contacts: what one kernel solves.

    The kinds of a target are its own, whatever else is in the batch. If a finger has a tangent,
    the others count as having one that is free: a kernel for each of their combinations would
    have to be compiled, and gains next to nothing.

    Yields:
        Kinds, rows (None: all, as they are) and the targets in these rows.
    """
    f = problems.points.shape[1]
    if not problems.more:
        yield usual(f), None, problems
        return
    names = list(problems.more)
    given = np.stack([~np.isnan(problems.more[name][..., 0]) for name in names], axis=2)
    if "tangents" in names:
        turned = given[..., names.index("tangents")]
        turned[:] = turned.any(axis=1, keepdims=True)
    flat = given.reshape(len(given), -1)
    _, firsts, which = np.unique(
        flat @ (1 << np.arange(flat.shape[1])), return_index=True, return_inverse=True
    )
    for i, of_fingers in enumerate(given[firsts].tolist()):
        kinds = tuple(
            kind_of(name[:-1] for name, has in zip(names, row, strict=True) if has)
            for row in of_fingers
        )
        if len(firsts) == 1:
            yield kinds, None, problems
            return
        rows = np.flatnonzero(which == i)
        picked = np.array([problems.number(row) for row in rows.tolist()])
        yield kinds, rows, replace(problems.rows(rows), picked=picked)
