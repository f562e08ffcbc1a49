"""The question of a solve apart from its contacts: all that its answer follows from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import LogError
from casadi_ik.logs.events.traces import bits_of
from casadi_ik.logs.read.table import MethodRows, element_name
from casadi_ik.problem.preference import NO_PREFERENCE
from casadi_ik.problem.problems import Tolerance


class _Parameters(msgspec.Struct):
    """What logs of earlier versions say of the solver."""

    tolerance: dict[str, dict[Literal["position", "angle"], float]] = {}
    limits: Literal["enforce", "ignore"] = "enforce"


@dataclass(frozen=True, eq=False)
class Asked:
    """The conditions of a solve; with its targets and the solver's options they repeat it.

    Attributes:
        tolerances: What counted as reached, by finger.
        limits: "enforce" or "ignore".
        seed: Of its random numbers, which follow from the number of the solve as well.
        start: (n,) where it began [rad or m]; None in logs of earlier versions.
        fixed: Actuators that were held, and where [rad or m].
        prefer: Which of several solutions was wanted; None: the method cannot choose, or the log
            is of an earlier version.

    Example:
        >>> asked = ik.logs.one_solve(ik.logs.open("cup.mcap")).asked
        >>> asked.limits, asked.seed, bool(np.allclose(asked.start, robot.home))
        ('enforce', 0, True)
    """

    tolerances: tuple[Tolerance, ...]
    limits: str = "enforce"
    seed: int = 0
    start: Array | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)
    prefer: str | None = None


def asked_of(part: MethodRows, metadata: Mapping[str, Any]) -> Asked:
    """What the only solve of a part was asked.

    Args:
        part: A row of `solve_rows`; of logs of earlier versions the solver's settings are taken.
        metadata: Of the log.
    """
    row, fingers = part.rows[0], part.labels["position_error"]
    if "start" not in (part.rows.dtype.names or ()):
        try:
            known = msgspec.convert(metadata.get("parameters", {}), _Parameters)
            seed = int(metadata["seed"][:20])
        except ValueError as error:  # msgspec's too
            raise LogError(f"metadata: {error}") from error
        tolerances = tuple(Tolerance(**known.tolerance.get(finger, {})) for finger in fingers)
        return Asked(tolerances, known.limits, seed)
    names = part.labels["q"]
    known = part.rows.dtype.names or ()
    prefer = part.labels["prefer"][int(row["prefer"])] if "prefer" in known else NO_PREFERENCE
    (held,) = bits_of(np.atleast_1d(row["fixed_mask"])[None])
    pairs = zip(row["position_tolerance"].tolist(), row["angle_tolerance"].tolist(), strict=True)
    return Asked(
        tolerances=tuple(Tolerance(*pair) for pair in pairs),
        limits="enforce" if row["limits_enforced"] else "ignore",
        seed=int(row["seed"]),
        start=row["start"],
        fixed={element_name(names, int(i)): float(row["start"][i]) for i in np.flatnonzero(held)},
        prefer=None if prefer == NO_PREFERENCE else prefer,
    )
