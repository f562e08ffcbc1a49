"""Results of parts of a batch as the results of the whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from itertools import chain
from typing import Any, TypeVar

import numpy as np

from casadi_ik.solvers.method import Outcome
from casadi_ik.solvers.solution import BatchSolution

Rows = TypeVar("Rows", Outcome, BatchSolution)


def joined(parts: Sequence[Rows]) -> Rows:
    """The rows of several results, one after the other.

    Args:
        parts: At least one. A phase that a part does not know counts 0 iterations there.
    """

    def column(name: str) -> Any:
        values = [getattr(part, name) for part in parts]
        if name == "tolerances":  # of the fingers, the same for every row
            return values[0]
        if isinstance(values[0], tuple):
            return tuple(chain(*values))
        if isinstance(values[0], Mapping):
            return {key: _counts(parts, values, key) for key in dict.fromkeys(chain(*values))}
        return np.concatenate(values)

    return type(parts[0])(**{entry.name: column(entry.name) for entry in fields(parts[0])})


def _counts(parts: Sequence[Rows], values: Sequence[Mapping[str, Any]], key: str) -> Any:
    none = [np.zeros(len(part.q), dtype=np.int64) for part in parts]
    return np.concatenate([value.get(key, no) for value, no in zip(values, none, strict=True)])
