"""Two solves of the same target side by side, and which solves those are."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.logs.columns import columns
from casadi_ik.logs.one_solve import OneSolve
from casadi_ik.logs.phrases import errors, number, plain_name
from casadi_ik.logs.why import held, within, worst

SAME = 1e-9
"""How far targets may be apart and be the same [m, or parts of a unit normal]."""


@dataclass(frozen=True)
class Line:
    """One line of a comparison.

    Attributes:
        what: What is compared.
        first: Of the first solve.
        second: Of the second solve.
    """

    what: str
    first: str
    second: str


def target_key(points: np.ndarray, normals: np.ndarray) -> bytes:
    """Equal for targets that are the same but for rounding.

    Args:
        points: (f, 3) [m]; NaN where free.
        normals: (f, 3); NaN where free.
    """
    rounded = np.round(np.concatenate([points, normals]).astype(float) / SAME)
    rounded[np.isnan(rounded)] = np.inf
    return (rounded + 0.0).tobytes()


def side_by_side(first: OneSolve, second: OneSolve) -> list[Line]:
    """Compare two solves of one target.

    Raises:
        InputError: They are not of the same target.
    """
    keys = [target_key(each.target_points, each.target_normals) for each in (first, second)]
    if first.fingers != second.fingers or keys[0] != keys[1]:
        raise InputError(
            f"solve {first.solve_id} of {first.method} and solve {second.solve_id} of"
            f" {second.method}: not the same target"
        )
    parts = [_lines(each) for each in (first, second)]
    names = list(dict.fromkeys(name for part in parts for name in part))
    return [Line(name, parts[0].get(name, "-"), parts[1].get(name, "-")) for name in names]


def _lines(solve: OneSolve) -> dict[str, str]:
    lines = {
        "status": solve.status,
        "iterations": str(solve.iterations),
        "restarts": str(solve.restarts),
        "time": f"{1e3 * solve.time:.3g} ms",
    }
    for i, finger in enumerate(solve.fingers):
        lines[f"{finger} off by"] = errors(
            float(solve.position_error[i]), float(solve.angle_error[i])
        )
    if len(solve.rows) == 0:
        return lines
    counts: Counter[str] = Counter()
    for stretch in solve.stretches:
        counts[plain_name(stretch.phase)] += len(stretch)
    inside = np.flatnonzero(within(solve).all(axis=1))
    share = worst(solve)
    nearest = int(np.nanargmin(share))
    lines |= {
        "phases": ", ".join(f"{name} {count}" for name, count in counts.items() if name) or "one",
        "all within tolerance": f"from iteration {inside[0]}" if len(inside) else "never",
        "nearest": f"{number(float(share[nearest]))} tolerances in iteration {nearest}",
        **_smallest(solve),
        "limits at the end": ", ".join(held(solve)) or "none",
    }
    kinds = Counter(event.kind for event in solve.events)
    for kind in ("NEAR_SINGULAR", "LIMIT_HIT", "STALL", "OSCILLATION"):
        lines[plain_name(kind.lower())] = f"{kinds[kind]} times" if kinds[kind] else "never"
    return lines


def _smallest(solve: OneSolve) -> dict[str, str]:
    """Smallest singular value of every Jacobian, and when."""
    found = {}
    for name in solve.layout.names:
        if not name.startswith("sigma_"):
            continue
        sigma = columns(solve.rows[name])
        if np.isnan(sigma).all():
            continue
        row = int(np.nanargmin(np.nanmin(np.where(np.isnan(sigma), np.inf, sigma), axis=1)))
        jacobian = plain_name(name.removeprefix("sigma_"))
        found[f"smallest sigma, {jacobian}"] = (
            f"{number(float(np.nanmin(sigma)))} in iteration {row}"
        )
    return found
