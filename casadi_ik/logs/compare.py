"""Two solves of the same target side by side, and which solves those are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.logs.events import errors_text, number, plain_name
from casadi_ik.logs.explanation import limits_held, within, worst
from casadi_ik.logs.reader import Log
from casadi_ik.logs.solve import OneSolve
from casadi_ik.problem.contacts import NAMES

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


def target_key(
    points: np.ndarray, normals: np.ndarray, more: Mapping[str, np.ndarray] | None = None
) -> bytes:
    """Equal for targets that are the same but for rounding.

    Args:
        points: (f, 3) [m]; NaN where free.
        normals: (f, 3); NaN where free.
        more: (f, 3) what they have beside; NaN where free.
    """
    free = np.full_like(points, np.nan)
    others = [free if more is None else more.get(name, free) for name in NAMES]
    rounded = np.round(np.concatenate([points, normals, *others]).astype(float) / SAME)
    rounded[np.isnan(rounded)] = np.inf
    return (rounded + 0.0).tobytes()


def side_by_side(first: OneSolve, second: OneSolve) -> list[Line]:
    """Compare two solves of one target.

    Raises:
        InputError: They are not of the same target.

    Example:
        >>> one = ik.logs.one_solve(ik.logs.open("cup.mcap"))
        >>> len(ik.logs.side_by_side(one, one)) > 0
        True
    """
    keys = [
        target_key(each.target_points, each.target_normals, each.target_more)
        for each in (first, second)
    ]
    if first.fingers != second.fingers or keys[0] != keys[1]:
        raise InputError(
            f"solve {first.solve_id + 1} of {first.method} and solve {second.solve_id + 1} of"
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
        lines[f"{finger} off by"] = errors_text(
            float(solve.position_error[i]), float(solve.angle_error[i])
        )
    clearance = solve.clearance
    lines["collision"] = (
        "not checked" if clearance is None else f"clearance {1e3 * clearance:.2f} mm"
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
        "all within tolerance": f"from iteration {inside[0] + 1}" if len(inside) else "never",
        "nearest": f"{number(float(share[nearest]))} tolerances in iteration {nearest + 1}",
        **_smallest(solve),
        "limits at the end": ", ".join(limits_held(solve)) or "none",
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
        sigma = solve.columns(name)
        if np.isnan(sigma).all():
            continue
        row = int(np.nanargmin(np.nanmin(np.where(np.isnan(sigma), np.inf, sigma), axis=1)))
        jacobian = plain_name(name.removeprefix("sigma_"))
        found[f"smallest sigma, {jacobian}"] = (
            f"{number(float(np.nanmin(sigma)))} in iteration {row + 1}"
        )
    return found


@dataclass(frozen=True)
class Ending:
    """How a solve ended, and in which log it is.

    Attributes:
        log: The log.
        method: Its method.
        solve_id: Its number.
        success: Whether it was solved.
        iterations: How many it took.
        time: How long it took [s].
    """

    log: Log
    method: str
    solve_id: int
    success: bool
    iterations: int
    time: float


@dataclass(frozen=True)
class Matched:
    """Solves of two methods on the same targets, by the number of the first.

    Attributes:
        first: The first method.
        second: The second method.
        pairs: A solve of each.
    """

    first: str
    second: str
    pairs: tuple[tuple[Ending, Ending], ...]

    def __len__(self) -> int:
        return len(self.pairs)

    def of_first(self, solve: int) -> Matched:
        """Only the pair of a solve of the first method."""
        pairs = tuple(pair for pair in self.pairs if pair[0].solve_id == solve)
        return Matched(self.first, self.second, pairs)


def matched(logs: Sequence[Log], first: str, second: str) -> Matched:
    """Find solves of two methods that were asked the same.

    A target that one method was given several times is taken once, the first time.

    Args:
        logs: Logs to look in.
        first: A method.
        second: Another.

    Raises:
        LogError: A log is damaged.

    Example:
        >>> log = ik.logs.open("cup.mcap")
        >>> type(ik.logs.matched([log], "hand-first", "hand-first")).__name__
        'Matched'
    """
    one, other = _endings(logs, first), _endings(logs, second)
    return Matched(first, second, tuple((one[key], other[key]) for key in one if key in other))


def _endings(logs: Sequence[Log], method: str) -> dict[bytes, Ending]:
    found: dict[bytes, Ending] = {}
    for log in logs:
        if method not in log.methods:
            continue
        part = log.solves(method=method).part
        for solve_id, row in zip(part.solve_id.tolist(), part.rows, strict=True):
            known = row.dtype.names or ()
            more = {name: row[f"target_{name}"] for name in NAMES if f"target_{name}" in known}
            key = target_key(row["target_points"], row["target_normals"], more)
            ending = Ending(
                log,
                method,
                solve_id,
                bool(row["success"]),
                int(row["iterations"]),
                float(row["time"]),
            )
            found.setdefault(key, ending)
    return found
