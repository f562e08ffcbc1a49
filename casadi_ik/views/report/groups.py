"""What a study's solves came to, by method and by the targets they belong to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np

from casadi_ik.arrays import Array, Bools, Counts
from casadi_ik.logs.events import SINGULAR
from casadi_ik.logs.reader import Log
from casadi_ik.logs.tables import MethodRows

ALL = "all"


@dataclass(frozen=True, eq=False)
class Group:
    """Solves of one method that belong together.

    Attributes:
        method: The method.
        name: Of the targets: the folder of their shards, as studies lay them down; "all" if there
            is but one.
        solve_id: (k,) their numbers.
        success: (k,) whether solved.
        singular: (k,) whether a Jacobian was near singular or ill-conditioned on the way.
        iterations: (k,).
        restarts: (k,).
        time: (k,) [s].
        worst: (k,) largest error in multiples of its tolerance.
        centre: (k, 3) mean of the contact points [m], base frame; NaN if all are free.
        status: (k,) names.
    """

    method: str
    name: str
    solve_id: Counts
    success: Bools
    singular: Bools
    iterations: Counts
    restarts: Counts
    time: Array
    worst: Array
    centre: Array
    status: np.ndarray

    def __len__(self) -> int:
        return len(self.solve_id)


def groups_of(log: Log) -> tuple[Group, ...]:
    """The solves of a log in groups.

    Raises:
        LogError: The log is damaged.
    """
    found = []
    for part in log.solves().parts:
        whole = _group(part)
        origins = part.origins
        folders = [ALL] if origins is None else [str(PurePath(name).parent) for name in origins]
        names = [ALL if folder == "." else folder for folder in folders]
        known = list(dict.fromkeys(names))
        if len(known) <= 1:
            found.append(whole)
            continue
        kept = np.array(names)
        found += [_rows(whole, name, kept == name) for name in known]
    return tuple(found)


def hardest(groups: tuple[Group, ...], count: int) -> Iterator[tuple[Group, int]]:
    """The solves worth a look: what is not solved, the largest error first, then the longest.

    Args:
        groups: Of a log.
        count: How many at most.

    Yields:
        Group and number of the solve.
    """
    keys = [
        (bool(group.success[i]), -error, -int(group.iterations[i]), g, i)
        for g, group in enumerate(groups)
        for i, error in enumerate(_error(group).tolist())
    ]
    for _, _, _, g, i in sorted(keys)[:count]:
        yield groups[g], int(groups[g].solve_id[i])


def _error(group: Group) -> Array:
    """(k,) the worst error of what is not solved; of the others nothing counts but iterations."""
    return np.where(group.success, 0.0, np.nan_to_num(group.worst, nan=0.0))


def _group(part: MethodRows) -> Group:
    rows = part.rows
    known = list(part.labels["events"])
    singular = [known.index(kind.name) for kind in SINGULAR if kind.name in known]
    share = np.fmax(
        _largest(rows["position_error"] / rows["position_tolerance"]),
        _largest(rows["angle_error"] / rows["angle_tolerance"]),
    )
    points = rows["target_points"]
    there: Bools = np.all(np.isfinite(points), axis=2)
    total = np.where(there[:, :, None], points, 0.0).sum(axis=1)
    counted = there.sum(axis=1)[:, None]
    return Group(
        method=part.method,
        name=ALL,
        solve_id=part.solve_id,
        success=rows["success"] > 0,
        singular=np.any(rows["events"][:, singular], axis=1),
        iterations=rows["iterations"].astype(np.int64),
        restarts=rows["restarts"].astype(np.int64),
        time=rows["time"].astype(float),
        worst=share,
        centre=np.where(counted > 0, total / np.maximum(counted, 1), np.nan),
        status=np.array(part.labels["status"])[rows["status"]],
    )


def _largest(values: Array) -> Array:
    """(k,) of (k, f), free ones aside; NaN where all are."""
    return np.fmax.reduce(values, axis=1)


def _rows(group: Group, name: str, chosen: Bools) -> Group:
    arrays = {
        key: value[chosen] for key, value in vars(group).items() if isinstance(value, np.ndarray)
    }
    return Group(method=group.method, name=name, **arrays)
