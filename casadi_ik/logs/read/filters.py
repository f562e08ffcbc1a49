"""How a question to a log says which rows it wants."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.logs.events.kinds import EventKind
from casadi_ik.logs.read.table import MethodRows

Names = str | EventKind | Iterable[str | EventKind] | None
Solves = int | Iterable[int] | None


def numbers(solve: Solves) -> NDArray[np.int64] | None:
    """The numbers of solves, sorted; None if all are wanted."""
    if solve is None:
        return None
    numbers = [solve] if isinstance(solve, int | np.integer) else list(solve)
    return np.unique(np.array(numbers, dtype=np.int64))


def codes(part: MethodRows, field: str, values: Names) -> list[int]:
    """The codes of names; of those the method does not know none."""
    labels = part.labels.get(field, ())
    return [labels.index(name) for name in names(values) if name in labels]


def names(values: Names) -> list[str]:
    """One name or several as a list; an `EventKind` counts as its name."""
    several = [values] if isinstance(values, str | EventKind) else list(values or ())
    return [value.name if isinstance(value, EventKind) else value for value in several]


def chosen(part: MethodRows, keep: NDArray[np.bool_]) -> MethodRows:
    """Some of the rows (k,) of a part."""
    if keep.all():
        return part
    shard = None if part.shard is None else part.shard[keep]
    return replace(
        part,
        rows=part.rows[keep],
        solve_id=part.solve_id[keep],
        iteration=part.iteration[keep],
        shard=shard,
    )
