"""Solves in words, from their traces alone: how one ended, and two of one target side by side.

Nothing here is a cause that was proven: what is said to have happened together, happened together.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import EXTRA_ARRAY_NAMES
from casadi_ik.logs.events import Happening, errors_text, listed, number, plain_name, plural
from casadi_ik.logs.format import LogClock
from casadi_ik.logs.reader import Log
from casadi_ik.logs.solve import OneSolve, Stretch, targets_beside
from casadi_ik.solve.trace import CLEARANCE

STRETCHES_SHOWN = 6
"""More stretches than this are told phase by phase."""

DIP = 0.1
"""A smallest singular value below this share of its median is worth a line."""

STILL_FALLING = 0.05
"""Share by which the worst error has to fall over the last tenth to count as still falling."""


@dataclass(frozen=True)
class Explanation:
    """Explanation of a solve in a few lines per part.

    Attributes:
        headline: How it ended.
        phases: What each phase achieved.
        fingers: Which finger lagged, and how.
        met: Singularities, limits, stalls and oscillations, and when.
        verdict: How it stood at the end.

    Example:
        >>> story = ik.logs.explain(ik.logs.one_solve(ik.logs.open("cup.mcap")))
        >>> isinstance(story.headline, str), len(story.phases) > 0
        (True, True)
    """

    headline: str
    phases: tuple[str, ...] = ()
    fingers: tuple[str, ...] = ()
    met: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()

    @property
    def parts(self) -> dict[str, tuple[str, ...]]:
        """The lines of every part that has any, by its title."""
        every = {
            "phases": self.phases,
            "fingers": self.fingers,
            "met on its way": self.met,
            "verdict": self.verdict,
        }
        return {title: lines for title, lines in every.items() if lines}


def explain(solve: OneSolve) -> Explanation:
    """Explain a solve.

    Args:
        solve: The solve; without a trace only how it ended can be said.

    Example:
        >>> story = ik.logs.explain(ik.logs.one_solve(ik.logs.open("cup.mcap")))
        >>> bool(story.verdict)
        True
    """
    outcome = "solved" if solve.success else f"not solved ({solve.status})"
    headline = (
        f"{solve.method}, solve {solve.solve_id + 1}: {outcome} after "
        f"{plural(solve.iterations, 'iteration')}"
    )
    if solve.restarts:
        headline += f" and {plural(solve.restarts, 'restart')}"
    if len(solve.rows) == 0:
        kept = "the log kept no iterations of this solve"
        if solve.iterations > LogClock().room:
            kept += f": it has room for {LogClock().room:,}"
        return Explanation(headline, verdict=(kept, *_verdict(solve)))
    return Explanation(
        headline,
        tuple(_phases(solve)),
        tuple(_fingers(solve)),
        (
            *_singularities(solve),
            *_limits(solve),
            *_standstills(solve),
            *collision_lines(solve),
        ),
        (*_verdict(solve), *_at_the_end(solve)),
    )


def _phases(solve: OneSolve) -> Iterator[str]:
    position, angle = errors_of(solve)
    seen: NDArray[np.bool_] = np.any(~np.isnan(solve.columns("position_error")), axis=1)
    for name, stretches in _by_phase(solve).items():
        first, last = stretches[0].first, stretches[-1].last
        where = (
            f"iterations {first + 1} to {last + 1}" if last > first else f"iteration {first + 1}"
        )
        if len(stretches) > 1:
            where += f", {sum(map(len, stretches))} in {len(stretches)} stretches"
        measured = [i for each in stretches for i in range(each.first, each.last + 1) if seen[i]]
        if not measured:
            yield f"{name} ({where}): errors not measured"
            continue
        begin, end = measured[0], measured[-1]
        ways = [
            f"{finger} {_short(position[begin, i], angle[begin, i])}"
            f" -> {_short(position[end, i], angle[end, i])}"
            for i, finger in enumerate(solve.fingers)
            if not (math.isnan(position[end, i]) and math.isnan(angle[end, i]))
        ]
        yield f"{name} ({where}): " + ", ".join(ways)


def _by_phase(solve: OneSolve) -> dict[str, list[Stretch]]:
    """Stretches one by one under names of their own, or by phase if they are many."""
    names = Counter(stretch.phase for stretch in solve.stretches)
    found: dict[str, list[Stretch]] = {}
    for i, stretch in enumerate(solve.stretches):
        name = plain_name(stretch.phase) or "the solve"
        if len(solve.stretches) <= STRETCHES_SHOWN and names[stretch.phase] > 1:
            before = sum(each.phase == stretch.phase for each in solve.stretches[:i])
            name += f" {before + 1}"
        found.setdefault(name, []).append(stretch)
    return found


def _short(position: float, angle: float) -> str:
    parts = [] if math.isnan(position) else [f"{1e3 * position:.1f} mm"]
    parts += [] if math.isnan(angle) else [f"{math.degrees(angle):.1f} deg"]
    return " ".join(parts)


def _fingers(solve: OneSolve) -> Iterator[str]:
    """Who lagged: on failure every finger that is out, otherwise the last one to come in."""
    inside, (position, angle) = within(solve), errors_of(solve)
    for i in np.flatnonzero(~solve.ok).tolist():
        tolerance = solve.tolerances[i]
        share = np.fmax(position[:, i] / tolerance.position, angle[:, i] / tolerance.angle)
        best = int(np.nanargmin(share))
        line = f"{solve.fingers[i]} lagged: it ends {solve.errors_of(i)} off"
        if inside[:, i].any():
            last = int(np.flatnonzero(inside[:, i])[-1])
            line += f"; it was within tolerance in {int(inside[:, i].sum())} iterations"
            line += f", the last of them {last + 1}"
        else:
            line += (
                f"; at its nearest, in iteration {best + 1}, it was"
                f" {errors_text(position[best, i], angle[best, i])} off"
            )
        yield line
    if solve.ok.all() and len(solve.fingers) > 1:
        entered = [_entered(inside[:, i]) for i in range(len(solve.fingers))]
        order = np.argsort(entered, kind="stable")
        if entered[order[-1]] > entered[order[-2]]:
            yield (
                f"{solve.fingers[order[-1]]} was the last to come within tolerance, in iteration"
                f" {entered[order[-1]] + 1}; the others were there in iteration"
                f" {entered[order[-2]] + 1}"
            )
        else:
            when = entered[order[-1]] + 1
            yield f"the fingers came within tolerance together, in iteration {when}"


def _entered(inside: NDArray[np.bool_]) -> int:
    """From which row on it holds to the end."""
    out = np.flatnonzero(~inside)
    return int(out[-1]) + 1 if len(out) else 0


def _singularities(solve: OneSolve) -> Iterator[str]:
    entries: dict[str, list[Happening]] = {}
    for event in solve.events:
        if event.kind == "NEAR_SINGULAR":
            entries.setdefault(event.jacobian, []).append(event)
    if not solve.sigmas:
        yield "singular values: not measured"
    for jacobian, sigma in solve.sigmas.items():
        name = plain_name(jacobian)
        if np.isnan(sigma).all():
            yield f"singular values of the {name}: not measured"
            continue
        row, usual, events = int(np.nanargmin(sigma)), np.nanmedian(sigma), entries.get(jacobian)
        lowest, when = number(sigma[row]), f"in iteration {row + 1}"
        if events:
            threshold = events[0].threshold
            line = (
                f"{name} near singular from iteration {events[0].iteration + 1} on,"
                f" {int((sigma < threshold).sum())} iterations in all; smallest singular value"
                f" {lowest} {when} (threshold {number(threshold)})"
            )
            yield line + (f", entered {len(events)} times" if len(events) > 1 else "")
        elif sigma[row] < DIP * usual:
            about = f"(median {number(float(usual))})"
            yield f"smallest singular value of the {name} down to {lowest} {when} {about}"
        else:
            yield f"{name} never near singular: smallest singular value {lowest}"


def _limits(solve: OneSolve) -> Iterator[str]:
    hits = Counter(
        joint for event in solve.events if event.kind == "LIMIT_HIT" for joint in event.joints
    )
    restless = {joint: count for joint, count in hits.items() if count > 3}
    if restless:
        shown = [f"{joint} {count} times" for joint, count in Counter(restless).most_common()]
        yield f"to its limit and off again: {listed(shown)}"
    beyond = " or beyond" if solve.asked.limits == "ignore" else ""
    for joint, since in limits_held(solve).items():
        yield f"{joint} at{beyond} its limit from iteration {since + 1} to the end"


def limits_held(solve: OneSolve) -> dict[str, int]:
    """Actuators that stand at a limit in the last row, and since which row."""
    if len(solve.rows) == 0 or "limit_mask" not in solve.layout.names:
        return {}
    bits = solve.bits("limit_mask")
    return {
        solve.name_of("limit_mask", bit): _entered(bits[:, bit])
        for bit in np.flatnonzero(bits[-1]).tolist()
    }


def _standstills(solve: OneSolve) -> Iterator[str]:
    stalls = [event for event in solve.events if event.kind == "STALL"]
    if stalls:
        phase = plain_name(stalls[0].phase) or "it"
        line = f"{phase} stood still in iteration {stalls[0].iteration + 1}"
        yield line + (f" and {len(stalls) - 1} times more" if len(stalls) > 1 else "")
    swings = [event for event in solve.events if event.kind == "OSCILLATION"]
    if swings:
        joints = Counter(joint for event in swings for joint in event.joints)
        line = f"{listed([joint for joint, _ in joints.most_common()])} went to and fro without"
        line += f" progress, first in iteration {swings[0].iteration + 1}"
        yield line + (f", {len(swings)} times" if len(swings) > 1 else "")


def _verdict(solve: OneSolve) -> Iterator[str]:
    for i, finger in enumerate(solve.fingers):
        tolerance, missed = solve.tolerances[i], []
        if solve.position_error[i] > tolerance.position:
            missed.append(f"its point by {1e3 * solve.position_error[i]:.2f} mm")
        if solve.angle_error[i] > tolerance.angle:
            missed.append(f"its normal by {math.degrees(solve.angle_error[i]):.2f} deg")
        if not solve.ok[i]:
            yield f"{finger} misses {' and '.join(missed) or 'a tolerance of its own'}"
    if solve.ok.all():
        good = "every contact is within tolerance"
        if solve.status == "COLLISION":
            yield f"{good}, and limits are kept, but something touches"
        else:
            yield good if solve.success else f"{good}, but a limit is violated"
    yield from answer_lines(solve)


def _at_the_end(solve: OneSolve) -> Iterator[str]:
    """What held when a solve that failed came to its end."""
    if solve.success:
        return
    singular = {
        event.jacobian: event.threshold for event in solve.events if event.kind == "NEAR_SINGULAR"
    }
    for jacobian, threshold in singular.items():
        if jacobian in solve.sigmas and solve.sigmas[jacobian][-1] < threshold:
            yield f"at its end the {plain_name(jacobian)} is near singular"
    at_limit = limits_held(solve)
    if at_limit:
        beyond = " or beyond" if solve.asked.limits == "ignore" else ""
        yield f"at its end at{beyond} a limit: {', '.join(at_limit)}"
    if solve.status == "ITERATION_LIMIT":
        yield _progress(solve)


def _progress(solve: OneSolve) -> str:
    share = worst(solve)
    tenth = max(len(share) // 10, 1)
    before, now = float(share[-tenth - 1 if len(share) > tenth else 0]), float(share[-1])
    if now < (1 - STILL_FALLING) * before:
        return (
            f"its budget ran out while the worst error was still falling: by"
            f" {100 * (1 - now / before):.0f} % over the last {tenth} iterations"
        )
    return f"its budget ran out, and over the last {tenth} iterations the worst error did not fall"


def collision_lines(solve: OneSolve) -> Iterator[str]:
    """When iterations touched something; nothing is said of a solve without a scene."""
    if CLEARANCE not in solve.layout.names or len(solve.rows) == 0:
        return
    clearance = solve.rows[CLEARANCE].astype(float)
    entered = [one for one in solve.events if one.kind == "COLLISION_ENTERED"]
    left = [one for one in solve.events if one.kind == "COLLISION_LEFT"]
    if not entered:
        yield f"nothing touched on the way: clearance at least {_mm(float(np.nanmin(clearance)))}"
        return
    deepest = int(np.nanargmin(clearance))
    line = f"something touched from iteration {entered[0].iteration + 1} on"
    if len(entered) > 1:
        line += f", {len(entered)} times"
    line += f"; clearance down to {_mm(float(clearance[deepest]))} in iteration {deepest + 1}"
    if len(left) == len(entered):
        line += f"; free from iteration {left[-1].iteration + 1} on"
    yield line


def answer_lines(solve: OneSolve) -> Iterator[str]:
    """How far the answer is from touching something."""
    if solve.clearance is None:
        yield "collision not checked"
    elif solve.closest is None:
        yield "nothing there to touch"
    else:
        pair = " and ".join(solve.closest)
        what = "overlap by" if solve.clearance < 0 else "are nearest to touching:"
        yield f"{pair} {what} {_mm(abs(solve.clearance))}"
    if CLEARANCE in solve.layout.names and len(solve.rows) and solve.clearance is not None:
        last = float(solve.rows[CLEARANCE][-1])
        if solve.success and last < 0 <= solve.clearance:
            yield f"chosen among other answers; the last iteration touched by {_mm(-last)}"


def _mm(value: float) -> str:
    return f"{1e3 * value:.2f} mm"


def within(solve: OneSolve) -> NDArray[np.bool_]:
    """Whether each finger is within tolerance in each row, (k, f).

    What is free always is; what was not yet measured is not.
    """
    position, angle = errors_of(solve)
    near = (position <= solve.position_tolerance) | np.isnan(solve.position_error)
    return near & ((angle <= solve.angle_tolerance) | np.isnan(solve.angle_error))


def worst(solve: OneSolve) -> Array:
    """Error of the worst finger in multiples of its tolerance, (k,); inf if not yet measured."""
    position, angle = errors_of(solve)
    share = np.fmax(
        np.nanmax(position / solve.position_tolerance, axis=1, initial=0.0),
        np.nanmax(angle / solve.angle_tolerance, axis=1, initial=0.0),
    )
    share[np.isnan(np.hstack([position, angle])).all(axis=1)] = np.inf
    return share


def errors_of(solve: OneSolve) -> tuple[Array, Array]:
    """Distances [m] and angles [rad] of all fingers in each row, (k, f) each.

    A row in which they were not measured (NaN) has those of the row before; what is free is NaN.
    """
    position, angle = solve.columns("position_error"), solve.columns("angle_error")
    position[:, np.isnan(solve.position_error)] = np.nan
    angle[:, np.isnan(solve.angle_error)] = np.nan
    return _filled(position), _filled(angle)


def _filled(matrix: Array) -> Array:
    rows = np.arange(len(matrix))[:, None]
    last = np.maximum.accumulate(np.where(np.isnan(matrix), 0, rows), axis=0)
    return np.take_along_axis(matrix, last, axis=0)


# Two solves of one target.

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


def target_key(points: Array, normals: Array, more: Mapping[str, Array] | None = None) -> bytes:
    """Equal for targets that are the same but for rounding.

    Args:
        points: (f, 3) [m]; NaN where free.
        normals: (f, 3); NaN where free.
        more: (f, 3) what they have beside; NaN where free.
    """
    free = np.full_like(points, np.nan)
    others = [free if more is None else more.get(name, free) for name in EXTRA_ARRAY_NAMES]
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
        lines[f"{finger} off by"] = solve.errors_of(i)
    clearance = solve.clearance
    lines["collision"] = "not checked" if clearance is None else f"clearance {_mm(clearance)}"
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
        **{
            f"smallest sigma, {plain_name(jacobian)}": f"{number(float(np.nanmin(sigma)))} in"
            f" iteration {int(np.nanargmin(sigma)) + 1}"
            for jacobian, sigma in solve.sigmas.items()
            if not np.isnan(sigma).all()
        },
        "limits at the end": ", ".join(limits_held(solve)) or "none",
    }
    kinds = Counter(event.kind for event in solve.events)
    for kind in ("NEAR_SINGULAR", "LIMIT_HIT", "STALL", "OSCILLATION"):
        lines[kind] = f"{kinds[kind]} times" if kinds[kind] else "never"
    return lines


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
    """Find solves of two methods with the same question.

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
    endings: dict[bytes, Ending] = {}
    tables = ((log, log.solves(method=method)) for log in logs if method in log.methods)
    for log, part in ((log, part) for log, table in tables for part in table.parts):
        for solve_id, row in zip(part.solve_id.tolist(), part.rows, strict=True):
            key = target_key(row["target_points"], row["target_normals"], targets_beside(row))
            success, iterations, seconds = row[["success", "iterations", "time"]].item()
            endings.setdefault(key, Ending(log, method, solve_id, success > 0, iterations, seconds))
    return endings
