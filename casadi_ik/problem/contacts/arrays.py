"""What targets have beside points and normals, as arrays: checked, and sorted by kinds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arrays import Array
from casadi_ik.errors import InputError, RowError, UnknownNameError
from casadi_ik.grasps.grasp import MORE, fault, faulty, squared, unit_vectors
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
    wrong, units = np.zeros(points.shape[:2], dtype=bool), dict[str, Array]()
    for name, array in found.items():
        given = ~np.isnan(array).all(axis=2)
        with np.errstate(invalid="ignore"):
            units[name], zero = unit_vectors(array)
        wrong |= given & (zero | ~np.isfinite(array).all(axis=2))
    vectors = {name[:-1]: array for name, array in units.items()}
    wrong |= faulty({"point": points, "normal": normals, **vectors})
    for row, finger in np.argwhere(wrong)[:1].tolist():
        of_contact = {"points": points, "normals": normals, **found}
        problem = _problem({name: array[row, finger] for name, array in of_contact.items()})
        raise RowError(f"row {first_row + row}, finger {finger}: {problem}", first_row + row)
    if "tangents" in units:
        units["tangents"] = squared(units["tangents"], normals)
    return units


def _problem(vectors: Mapping[str, Array]) -> str:
    """What is wrong with a contact, of which something is."""
    units: dict[str, Array] = {}
    for name, vector in vectors.items():
        if np.isnan(vector).all():
            continue
        if not np.isfinite(vector).all():
            return f"{name[:-1]}: found {vector.tolist()}, expected finite numbers, or all NaN"
        unit, zero = unit_vectors(vector)
        if name in NAMES and zero:
            return f"{name[:-1]}: found {vector.tolist()}, expected a direction, not zero"
        units[name[:-1]] = unit if name in NAMES else vector
    return fault(units) or "malformed"


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
