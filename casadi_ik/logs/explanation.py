"""Explanations of solves in words, and comparisons of two solves of one target.

Explanations describe the trace. Events that coincide with a failure are not proven causes.
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
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.logs.events import Event
from casadi_ik.logs.format import LogClock
from casadi_ik.logs.reader import Log
from casadi_ik.logs.solve import PhaseSpan, SolveRecord, optional_targets
from casadi_ik.logs.wording import (
    counted_noun,
    errors_text,
    format_number,
    joined_names,
    plain_name,
)
from casadi_ik.model.targets import EXTRA_ARRAY_NAMES
from casadi_ik.solve.trace import CLEARANCE

MAX_PHASE_SPANS = 6
"""Maximum number of phase spans that are listed one by one; more are combined by phase."""

NOTABLE_SIGMA_DROP = 0.1
"""Ratio of the smallest singular value to its median below which it is reported."""

MIN_ERROR_DECREASE = 0.05
"""Relative decrease of the worst error over the last tenth that counts as progress."""


@dataclass(frozen=True)
class Explanation:
    """Explanation of a solve with a few lines per part.

    Attributes:
        headline: Outcome of the solve.
        phases: Errors at the start and end of each phase.
        fingers: Fingers that missed their contacts or converged last.
        incidents: Singularities, limits, stalls, oscillations and collisions.
        verdict: Final state.

    Example:
        >>> story = ik.logs.explain(ik.logs.one_solve(ik.logs.open("cup.mcap")))
        >>> isinstance(story.headline, str), len(story.phases) > 0
        (True, True)
    """

    headline: str
    phases: tuple[str, ...] = ()
    fingers: tuple[str, ...] = ()
    incidents: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()

    @property
    def parts(self) -> dict[str, tuple[str, ...]]:
        """Lines by title of every part that is not empty."""
        parts = {
            "phases": self.phases,
            "fingers": self.fingers,
            "incidents": self.incidents,
            "verdict": self.verdict,
        }
        return {title: lines for title, lines in parts.items() if lines}

    @property
    def met(self) -> tuple[str, ...]:
        """Deprecated name of `incidents`."""
        warn_renamed("Explanation.met", "Explanation.incidents")
        return self.incidents


def explain(solve: SolveRecord) -> Explanation:
    """Explain a solve.

    Args:
        solve: The solve; without a trace only its outcome is explained.

    Example:
        >>> story = ik.logs.explain(ik.logs.one_solve(ik.logs.open("cup.mcap")))
        >>> bool(story.verdict)
        True
    """
    outcome = "solved" if solve.success else f"not solved ({solve.status})"
    headline = (
        f"{solve.method}, solve {solve.solve_id + 1}: {outcome} after "
        f"{counted_noun(solve.iterations, 'iteration')}"
    )
    if solve.restarts:
        headline += f" and {counted_noun(solve.restarts, 'restart')}"
    if len(solve.rows) == 0:
        note = "the log holds no iterations of this solve"
        if solve.iterations > LogClock().max_iterations:
            note += f" (maximum per solve: {LogClock().max_iterations:,})"
        return Explanation(headline, verdict=(note, *_verdict(solve)))
    return Explanation(
        headline,
        tuple(_phases(solve)),
        tuple(_fingers(solve)),
        (
            *_singularities(solve),
            *_limits(solve),
            *_stalls(solve),
            *collision_lines(solve),
        ),
        (*_verdict(solve), *_final_state(solve)),
    )


def _phases(solve: SolveRecord) -> Iterator[str]:
    """Yield the errors at the start and end of each phase."""
    position, angle = errors_of(solve)
    is_measured: NDArray[np.bool_] = np.any(~np.isnan(solve.columns("position_error")), axis=1)
    for name, spans in _spans_by_name(solve).items():
        first, last = spans[0].first, spans[-1].last
        iterations = (
            f"iterations {first + 1} to {last + 1}" if last > first else f"iteration {first + 1}"
        )
        if len(spans) > 1:
            iterations += f", {sum(map(len, spans))} in {len(spans)} spans"
        measured = [i for span in spans for i in range(span.first, span.last + 1) if is_measured[i]]
        if not measured:
            yield f"{name} ({iterations}): errors not measured"
            continue
        start, end = measured[0], measured[-1]
        changes = [
            f"{finger} {_error_pair(position[start, i], angle[start, i])}"
            f" -> {_error_pair(position[end, i], angle[end, i])}"
            for i, finger in enumerate(solve.fingers)
            if not (math.isnan(position[end, i]) and math.isnan(angle[end, i]))
        ]
        yield f"{name} ({iterations}): " + ", ".join(changes)


def _spans_by_name(solve: SolveRecord) -> dict[str, list[PhaseSpan]]:
    """Return the phase spans under separate names, or by phase if there are many."""
    counts = Counter(span.phase for span in solve.phase_spans)
    spans: dict[str, list[PhaseSpan]] = {}
    for i, span in enumerate(solve.phase_spans):
        name = plain_name(span.phase) or "solve"
        if len(solve.phase_spans) <= MAX_PHASE_SPANS and counts[span.phase] > 1:
            previous = sum(earlier.phase == span.phase for earlier in solve.phase_spans[:i])
            name += f" {previous + 1}"
        spans.setdefault(name, []).append(span)
    return spans


def _error_pair(position: float, angle: float) -> str:
    parts = [] if math.isnan(position) else [f"{1e3 * position:.1f} mm"]
    parts += [] if math.isnan(angle) else [f"{math.degrees(angle):.1f} deg"]
    return " ".join(parts)


def _fingers(solve: SolveRecord) -> Iterator[str]:
    """Yield the fingers that miss their contacts, or the finger that converged last."""
    is_within, (position, angle) = within_tolerance(solve), errors_of(solve)
    for i in np.flatnonzero(~solve.ok).tolist():
        tolerance = solve.tolerances[i]
        ratio = np.fmax(position[:, i] / tolerance.position, angle[:, i] / tolerance.angle)
        best = int(np.nanargmin(ratio))
        line = f"{solve.fingers[i]} misses its contact: final error {solve.errors_of(i)}"
        if is_within[:, i].any():
            last = int(np.flatnonzero(is_within[:, i])[-1])
            line += f"; within tolerance in {int(is_within[:, i].sum())} iterations"
            line += f", last in iteration {last + 1}"
        else:
            line += (
                f"; smallest error {errors_text(position[best, i], angle[best, i])}"
                f" in iteration {best + 1}"
            )
        yield line
    if solve.ok.all() and len(solve.fingers) > 1:
        entered = [_first_of_final_run(is_within[:, i]) for i in range(len(solve.fingers))]
        order = np.argsort(entered, kind="stable")
        if entered[order[-1]] > entered[order[-2]]:
            yield (
                f"{solve.fingers[order[-1]]} was the last finger to come within tolerance, in"
                f" iteration {entered[order[-1]] + 1}; the other fingers were within tolerance from"
                f" iteration {entered[order[-2]] + 1}"
            )
        else:
            iteration = entered[order[-1]] + 1
            yield f"all fingers came within tolerance in iteration {iteration}"


def _first_of_final_run(flags: NDArray[np.bool_]) -> int:
    """Return the first row from which on all flags are True."""
    false_rows = np.flatnonzero(~flags)
    return int(false_rows[-1]) + 1 if len(false_rows) else 0


def _singularities(solve: SolveRecord) -> Iterator[str]:
    """Yield the smallest singular value of each Jacobian."""
    entries: dict[str, list[Event]] = {}
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
        row, median, events = int(np.nanargmin(sigma)), np.nanmedian(sigma), entries.get(jacobian)
        smallest, location = format_number(sigma[row]), f"in iteration {row + 1}"
        if events:
            threshold = events[0].threshold
            line = (
                f"{name} near singular from iteration {events[0].iteration + 1} on,"
                f" in {int((sigma < threshold).sum())} iterations; smallest singular value"
                f" {smallest} {location} (threshold {format_number(threshold)})"
            )
            yield line + (f", entered {len(events)} times" if len(events) > 1 else "")
        elif sigma[row] < NOTABLE_SIGMA_DROP * median:
            reference = f"(median {format_number(float(median))})"
            yield f"smallest singular value of the {name}: {smallest} {location} {reference}"
        else:
            yield f"{name} never near singular: smallest singular value {smallest}"


def _limits(solve: SolveRecord) -> Iterator[str]:
    """Yield actuators that hit limits repeatedly or end at a limit."""
    hits = Counter(
        joint for event in solve.events if event.kind == "LIMIT_HIT" for joint in event.joints
    )
    repeated = {joint: count for joint, count in hits.items() if count > 3}
    if repeated:
        texts = [f"{joint} {count} times" for joint, count in Counter(repeated).most_common()]
        yield f"hit and left limits repeatedly: {joined_names(texts)}"
    or_beyond = " or beyond" if solve.target.limits == "ignore" else ""
    for joint, start in limits_at_end(solve).items():
        yield f"{joint} at{or_beyond} its limit from iteration {start + 1} to the end"


def limits_at_end(solve: SolveRecord) -> dict[str, int]:
    """Return the actuators at a limit in the last row with the row from which on they are."""
    if len(solve.rows) == 0 or "limit_mask" not in solve.layout.names:
        return {}
    bits = solve.bits("limit_mask")
    return {
        solve.name_of("limit_mask", bit): _first_of_final_run(bits[:, bit])
        for bit in np.flatnonzero(bits[-1]).tolist()
    }


def _stalls(solve: SolveRecord) -> Iterator[str]:
    """Yield stalls and oscillations."""
    stalls = [event for event in solve.events if event.kind == "STALL"]
    if stalls:
        phase = plain_name(stalls[0].phase) or "solve"
        line = f"{phase} stalled in iteration {stalls[0].iteration + 1}"
        yield line + (f" and {len(stalls) - 1} more times" if len(stalls) > 1 else "")
    oscillations = [event for event in solve.events if event.kind == "OSCILLATION"]
    if oscillations:
        counts = Counter(joint for event in oscillations for joint in event.joints)
        joints = joined_names([joint for joint, _ in counts.most_common()])
        line = f"{joints} oscillated without progress, first in iteration"
        line += f" {oscillations[0].iteration + 1}"
        yield line + (f", {len(oscillations)} times" if len(oscillations) > 1 else "")


def _verdict(solve: SolveRecord) -> Iterator[str]:
    """Yield the contacts that are missed, violated limits, and the clearance."""
    for i, finger in enumerate(solve.fingers):
        tolerance, misses = solve.tolerances[i], []
        if solve.position_error[i] > tolerance.position:
            misses.append(f"its point by {1e3 * solve.position_error[i]:.2f} mm")
        if solve.angle_error[i] > tolerance.angle:
            misses.append(f"its normal by {math.degrees(solve.angle_error[i]):.2f} deg")
        if not solve.ok[i]:
            yield f"{finger} misses {' and '.join(misses) or 'an individual tolerance'}"
    if solve.ok.all():
        summary = "every contact is within tolerance"
        if solve.status == "COLLISION":
            yield "contacts and limits are met, but the robot is in collision"
        else:
            yield summary if solve.success else f"{summary}, but a limit is violated"
    yield from solution_lines(solve)


def _final_state(solve: SolveRecord) -> Iterator[str]:
    """Yield singularities, limits and progress at the end of a failed solve."""
    if solve.success:
        return
    singular = {
        event.jacobian: event.threshold for event in solve.events if event.kind == "NEAR_SINGULAR"
    }
    for jacobian, threshold in singular.items():
        if jacobian in solve.sigmas and solve.sigmas[jacobian][-1] < threshold:
            yield f"in the last iteration the {plain_name(jacobian)} is near singular"
    at_limit = limits_at_end(solve)
    if at_limit:
        or_beyond = " or beyond" if solve.target.limits == "ignore" else ""
        yield f"in the last iteration at{or_beyond} a limit: {', '.join(at_limit)}"
    if solve.status == "ITERATION_LIMIT":
        yield _progress(solve)


def _progress(solve: SolveRecord) -> str:
    """Return whether the worst error still decreased when the iteration limit was reached."""
    ratio = worst_error_ratio(solve)
    tenth = max(len(ratio) // 10, 1)
    previous, last = float(ratio[-tenth - 1 if len(ratio) > tenth else 0]), float(ratio[-1])
    if last < (1 - MIN_ERROR_DECREASE) * previous:
        return (
            "the iteration limit was reached while the worst error was still decreasing: by"
            f" {100 * (1 - last / previous):.0f} % over the last {tenth} iterations"
        )
    return (
        "the iteration limit was reached, and the worst error did not decrease over the last"
        f" {tenth} iterations"
    )


def collision_lines(solve: SolveRecord) -> Iterator[str]:
    """Yield when iterations were in collision; nothing for a solve without a scene."""
    if CLEARANCE not in solve.layout.names or len(solve.rows) == 0:
        return
    clearance = solve.rows[CLEARANCE].astype(float)
    entered = [event for event in solve.events if event.kind == "COLLISION_ENTERED"]
    cleared = [event for event in solve.events if event.kind == "COLLISION_LEFT"]
    if not entered:
        yield f"no iteration in collision: clearance at least {_mm(float(np.nanmin(clearance)))}"
        return
    deepest = int(np.nanargmin(clearance))
    line = f"in collision from iteration {entered[0].iteration + 1} on"
    if len(entered) > 1:
        line += f", {len(entered)} times"
    line += f"; smallest clearance {_mm(float(clearance[deepest]))} in iteration {deepest + 1}"
    if len(cleared) == len(entered):
        line += f"; free from iteration {cleared[-1].iteration + 1} on"
    yield line


def solution_lines(solve: SolveRecord) -> Iterator[str]:
    """Yield the clearance of the solution."""
    if solve.clearance is None:
        yield "collision not checked"
    elif solve.closest is None:
        yield "the scene has no pairs of shapes to check"
    else:
        pair = " and ".join(solve.closest)
        verb = "overlap by" if solve.clearance < 0 else "are the closest pair, at a distance of"
        yield f"{pair} {verb} {_mm(abs(solve.clearance))}"
    if CLEARANCE in solve.layout.names and len(solve.rows) and solve.clearance is not None:
        last = float(solve.rows[CLEARANCE][-1])
        if solve.success and last < 0 <= solve.clearance:
            yield (
                "the solution is an alternative of the last iteration, which was in collision by"
                f" {_mm(-last)}"
            )


def _mm(value: float) -> str:
    return f"{1e3 * value:.2f} mm"


def within_tolerance(solve: SolveRecord) -> NDArray[np.bool_]:
    """Return which fingers are within tolerance in each row, (k, f).

    Free contacts are always within tolerance; errors that are not yet measured never are.
    """
    position, angle = errors_of(solve)
    position_ok = (position <= solve.position_tolerance) | np.isnan(solve.position_error)
    return position_ok & ((angle <= solve.angle_tolerance) | np.isnan(solve.angle_error))


def worst_error_ratio(solve: SolveRecord) -> Array:
    """Return the largest ratio of error to tolerance of each row, (k,); inf if not measured."""
    position, angle = errors_of(solve)
    ratio = np.fmax(
        np.nanmax(position / solve.position_tolerance, axis=1, initial=0.0),
        np.nanmax(angle / solve.angle_tolerance, axis=1, initial=0.0),
    )
    ratio[np.isnan(np.hstack([position, angle])).all(axis=1)] = np.inf
    return ratio


def errors_of(solve: SolveRecord) -> tuple[Array, Array]:
    """Return position errors [m] and angle errors [rad] of all fingers in each row, (k, f) each.

    Rows without measurement (NaN) repeat the errors of the row before; free contacts are NaN.
    """
    position, angle = solve.columns("position_error"), solve.columns("angle_error")
    position[:, np.isnan(solve.position_error)] = np.nan
    angle[:, np.isnan(solve.angle_error)] = np.nan
    return _forward_filled(position), _forward_filled(angle)


def _forward_filled(matrix: Array) -> Array:
    rows = np.arange(len(matrix))[:, None]
    last = np.maximum.accumulate(np.where(np.isnan(matrix), 0, rows), axis=0)
    return np.take_along_axis(matrix, last, axis=0)


# Comparison of two solves of one target.

TARGET_ROUNDING = 1e-9
"""Largest difference of targets that count as equal [m, or components of a unit normal]."""


@dataclass(frozen=True)
class ComparisonRow:
    """Row of a comparison of two solves.

    Attributes:
        quantity: Name of the compared quantity.
        first: Value of the first solve.
        second: Value of the second solve.
    """

    quantity: str
    first: str
    second: str


def target_key(points: Array, normals: Array, optional: Mapping[str, Array] | None = None) -> bytes:
    """Return a key that is equal for targets that differ only by rounding.

    Args:
        points: (f, 3) [m]; NaN where free.
        normals: (f, 3); NaN where free.
        optional: (f, 3) further vectors by name; NaN where free.
    """
    free = np.full_like(points, np.nan)
    vectors = [free if optional is None else optional.get(name, free) for name in EXTRA_ARRAY_NAMES]
    components = np.concatenate([points, normals, *vectors]).astype(float)
    rounded = np.round(components / TARGET_ROUNDING)
    rounded[np.isnan(rounded)] = np.inf
    return (rounded + 0.0).tobytes()  # 0.0 is added because -0.0 has other bytes


def compare_solves(first: SolveRecord, second: SolveRecord) -> list[ComparisonRow]:
    """Compare two solves of one target.

    Raises:
        InputError: The targets differ.

    Example:
        >>> record = ik.logs.one_solve(ik.logs.open("cup.mcap"))
        >>> len(ik.logs.compare_solves(record, record)) > 0
        True
    """
    keys = [
        target_key(solve.target_points, solve.target_normals, solve.target_more)
        for solve in (first, second)
    ]
    if first.fingers != second.fingers or keys[0] != keys[1]:
        raise InputError(
            f"solve {first.solve_id + 1} of {first.method} and solve {second.solve_id + 1} of"
            f" {second.method}: targets differ; expected solves of the same target"
        )
    columns = [_quantities(solve) for solve in (first, second)]
    names = list(dict.fromkeys(name for column in columns for name in column))
    return [
        ComparisonRow(name, columns[0].get(name, "-"), columns[1].get(name, "-")) for name in names
    ]


def _quantities(solve: SolveRecord) -> dict[str, str]:
    """Return the compared quantities of a solve as text by name."""
    lines = {
        "status": solve.status,
        "iterations": str(solve.iterations),
        "restarts": str(solve.restarts),
        "time": f"{1e3 * solve.time:.3g} ms",
    }
    for i, finger in enumerate(solve.fingers):
        lines[f"{finger} error"] = solve.errors_of(i)
    clearance = solve.clearance
    lines["collision"] = "not checked" if clearance is None else f"clearance {_mm(clearance)}"
    if len(solve.rows) == 0:
        return lines
    counts: Counter[str] = Counter()
    for span in solve.phase_spans:
        counts[plain_name(span.phase)] += len(span)
    rows_within = np.flatnonzero(within_tolerance(solve).all(axis=1))
    ratio = worst_error_ratio(solve)
    best = int(np.nanargmin(ratio))
    lines |= {
        "phases": ", ".join(f"{name} {count}" for name, count in counts.items() if name) or "one",
        "all within tolerance": f"from iteration {rows_within[0] + 1}"
        if len(rows_within)
        else "never",
        "smallest error": f"{format_number(float(ratio[best]))} tolerances in iteration {best + 1}",
        **{
            f"smallest sigma, {plain_name(jacobian)}": f"{format_number(float(np.nanmin(sigma)))}"
            f" in iteration {int(np.nanargmin(sigma)) + 1}"
            for jacobian, sigma in solve.sigmas.items()
            if not np.isnan(sigma).all()
        },
        "limits at the end": ", ".join(limits_at_end(solve)) or "none",
    }
    kinds = Counter(event.kind for event in solve.events)
    for kind in ("NEAR_SINGULAR", "LIMIT_HIT", "STALL", "OSCILLATION"):
        lines[kind] = f"{kinds[kind]} times" if kinds[kind] else "never"
    return lines


@dataclass(frozen=True)
class LoggedOutcome:
    """Outcome of a logged solve.

    Attributes:
        log: Log of the solve.
        method: Method of the solve.
        solve_id: Number of the solve.
        success: True if the target is solved.
        iterations: Number of iterations.
        time: Duration [s].
    """

    log: Log
    method: str
    solve_id: int
    success: bool
    iterations: int
    time: float


@dataclass(frozen=True)
class MatchedTargets:
    """Solves of two methods on the same targets, in the order of the first method.

    Attributes:
        first: First method.
        second: Second method.
        pairs: Outcomes of both methods by target.
    """

    first: str
    second: str
    pairs: tuple[tuple[LoggedOutcome, LoggedOutcome], ...]

    def __len__(self) -> int:
        return len(self.pairs)

    def of_first(self, solve: int) -> MatchedTargets:
        """Return only the pair of a solve of the first method."""
        pairs = tuple(pair for pair in self.pairs if pair[0].solve_id == solve)
        return MatchedTargets(self.first, self.second, pairs)


def match_targets(logs: Sequence[Log], first: str, second: str) -> MatchedTargets:
    """Find the targets that two methods have solved.

    If a method has solved a target several times, its first solve counts.

    Args:
        logs: Logs to search.
        first: First method.
        second: Second method.

    Raises:
        LogError: A log is damaged.

    Example:
        >>> log = ik.logs.open("cup.mcap")
        >>> len(ik.logs.match_targets([log], "hand-first", "hand-first").pairs)
        1
    """
    by_first, by_second = _outcomes(logs, first), _outcomes(logs, second)
    pairs = ((by_first[key], by_second[key]) for key in by_first if key in by_second)
    return MatchedTargets(first, second, tuple(pairs))


def _outcomes(logs: Sequence[Log], method: str) -> dict[bytes, LoggedOutcome]:
    """Return the first outcome of a method by key of the target."""
    outcomes: dict[bytes, LoggedOutcome] = {}
    tables = ((log, log.solves(method=method)) for log in logs if method in log.methods)
    for log, part in ((log, part) for log, table in tables for part in table.parts):
        for solve_id, row in zip(part.solve_id.tolist(), part.rows, strict=True):
            key = target_key(row["target_points"], row["target_normals"], optional_targets(row))
            success, iterations, time = row[["success", "iterations", "time"]].item()
            outcomes.setdefault(
                key, LoggedOutcome(log, method, solve_id, success > 0, iterations, time)
            )
    return outcomes
