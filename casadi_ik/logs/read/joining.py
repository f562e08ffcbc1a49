"""The rows of several files as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import LogError
from casadi_ik.logs.read.table import MethodRows

_ROOM = 2**24
"""More than the iterations that a solve can have: makes solve and iteration one number."""


def raised(part: MethodRows, offset: int) -> MethodRows:
    """The rows of a part, the numbers of the solves raised."""
    rows = part.rows.copy()
    if "solve_id" in (rows.dtype.names or ()):
        rows["solve_id"] += np.uint32(offset)
    return replace(part, rows=rows, solve_id=part.solve_id + offset)


def joined(
    where: str,
    kind: str,
    parts: Sequence[MethodRows],
    shard: NDArray[np.int64],
    shards: tuple[str, ...],
) -> MethodRows:
    """Parts of one method as one, by solve and iteration.

    Args:
        where: The log, for the message.
        kind: "solve", "iteration" or "event".
        parts: At least one.
        shard: (k,) which of the shards each row comes from.
        shards: Their names.

    Raises:
        LogError: A solve or an iteration is there twice.
    """
    first = parts[0]
    solve_id, iteration, rows = (
        np.concatenate([getattr(part, name) for part in parts])
        if len(parts) > 1
        else getattr(first, name)
        for name in ("solve_id", "iteration", "rows")
    )
    later = np.diff(solve_id * _ROOM + iteration)
    if np.any(later < 0):
        order = np.lexsort((iteration, solve_id))
        solve_id, iteration, rows = solve_id[order], iteration[order], rows[order]
        shard, later = shard[order], np.diff(solve_id * _ROOM + iteration)
    if kind != "event":
        twice = np.flatnonzero(later == 0 if kind == "iteration" else np.diff(solve_id) == 0)
        if len(twice):
            number = solve_id[twice[0]]
            raise LogError(f"{where}: solve {number} of method {first.method!r} is there twice")
    return replace(
        first, rows=rows, solve_id=solve_id, iteration=iteration, shard=shard, shards=shards
    )
