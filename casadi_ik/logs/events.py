"""Events of a log: their kinds with phrases and colours, thresholds, and how they are stored."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Self

from casadi_ik.errors import InputError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.problem.trace import (
    ACTIVE_MASK,
    CONDITION,
    LIMIT_MASK,
    PHASE,
    SIGMA,
    WORD,
    Q,
    TraceFormat,
)


class EventKind(IntEnum):
    """Kind of an event in an iteration: its code, phrase and colour.

    "Value against threshold" in the docstrings is what the event's two numbers are.

    Attributes:
        phrase: The event in a few words, with fields of `Happening` in braces; `mm` is the value
            in millimetres.
        subject: What it is about, likewise; `before` and `after` are names of phases.
        color: Of its marks in diagrams; "": not marked, it shows as a phase or a limit.
        serious: Whether it may be why a solve fails.

    Example:
        >>> ik.logs.EventKind.LIMIT_HIT.name
        'LIMIT_HIT'
    """

    phrase: str
    subject: str
    color: str
    serious: bool

    def __new__(
        cls,
        code: int,
        phrase: str,
        subject: str = "{joints}",
        color: str = "",
        serious: bool = False,
    ) -> Self:
        """A member by its row."""
        kind = int.__new__(cls, code)
        kind._value_ = code
        kind.phrase, kind.subject, kind.color, kind.serious = phrase, subject, color, serious
        return kind

    NEAR_SINGULAR = (
        0,
        "{jacobian} near singular: smallest singular value {value} (below {threshold})",
        "{jacobian}",
        "#8e4ec6",
        True,
    )
    """A Jacobian's smallest singular value has fallen below its threshold."""
    ILL_CONDITIONED = (
        1,
        "{jacobian} ill-conditioned: condition number {value} (above {threshold})",
        "{jacobian}",
        "#b48ad6",
        True,
    )
    """A Jacobian's condition number has risen above its threshold."""
    LIMIT_HIT = 2, "{joints} at its limit ({value})"
    """An actuator has come to a limit: its position, twice."""
    LIMIT_LEFT = 3, "{joints} off its limit ({threshold}), now {value}"
    """An actuator has left a limit: its position against that on the limit."""
    ACTIVATED = 4, "{joints} activated: {value} active constraints, {threshold} before"
    """Constraints have joined the active set: its size against that before."""
    RELEASED = 5, "{joints} released: {value} active constraints, {threshold} before"
    """Constraints have left the active set: its size against that before."""
    RESTART = 6, "restart {value}", "{threshold} -> {value}", "#2f6db3"
    """A new start: its number against that before."""
    PHASE_CHANGE = 7, "on to {phase}", "{before} -> {after}"
    """Another phase: its code against that before."""
    STALL = 8, "{phase} stalls: errors change by {value} of themselves", "{phase}", "#2b333b", True
    """The errors stand still: their relative spread against what counts as still."""
    OSCILLATION = (
        9,
        "{joints} to and fro without progress: steps up to {value}",
        "{joints}",
        "#0f8b8d",
        True,
    )
    """Actuators go to and fro without progress: the longest step against what counts as one."""
    COLLISION_ENTERED = 10, "something touches: clearance {mm} mm"
    """Two shapes have come nearer than they may: the clearance against the margin."""
    COLLISION_LEFT = 11, "nothing touches any more: clearance {mm} mm"
    """No two shapes are nearer than they may be any more: the clearance against the margin."""


SINGULAR = (EventKind.NEAR_SINGULAR, EventKind.ILL_CONDITIONED)
"""The kinds that make a solve a singular one."""

MOVES = (EventKind.LIMIT_HIT, EventKind.LIMIT_LEFT, EventKind.OSCILLATION)
"""The kinds whose numbers are positions or steps of actuators."""

SERIOUS = tuple(kind.name for kind in EventKind if kind.serious)
"""Names of the kinds that may be why a solve fails."""

EVENT_COLORS: Mapping[str, str] = {kind.name: kind.color for kind in EventKind if kind.color}
"""Colours of the kinds that are marked in diagrams, by name."""


@dataclass(frozen=True)
class EventRules:
    """When something counts as an event; the defaults are checked by studies/event_thresholds.py.

    Attributes:
        singular: Smallest singular value below which a Jacobian is near singular, by the name
            behind ``sigma_``, in the unit of that field. One not named here has the threshold
            that its method states (`RecordedJacobian.singular`).
        condition: Condition number above which it is ill-conditioned, by the name behind
            ``condition_``; likewise.
        release: A Jacobian has to rise above this multiple of its threshold (a condition number
            to fall below the threshold by this factor) before it can enter again.
        limit_slack: How far a coordinate has to move from its limit to have left it [rad or m];
            so that a rounding error is not an event.
        stall_window: Iterations over which a stall is judged.
        stall_change: Spread of the error over the window, relative to the error, that counts as
            standing still.
        oscillation_window: Iterations over which an oscillation is judged, at least 3.
        oscillation_step: Shortest step of a coordinate that counts as moving [rad or m].
        oscillation_progress: Relative fall of the error over the window that counts as progress.
        clearance: Clearance below which something is touched [m]; a log with a scene takes the
            scene's margin.

    Example:
        >>> ik.logs.EventRules(release=3.0).release
        3.0
    """

    singular: Mapping[str, float] = field(default_factory=dict)
    condition: Mapping[str, float] = field(default_factory=dict)
    release: float = 1.5
    limit_slack: float = 1e-6
    stall_window: int = 10
    stall_change: float = 1e-4
    oscillation_window: int = 6
    oscillation_step: float = 1e-4
    oscillation_progress: float = 0.05
    clearance: float = 0.0

    def __post_init__(self) -> None:
        if self.stall_window < 1 or self.oscillation_window < 3:
            raise InputError(
                f"event rules: windows {self.stall_window} and {self.oscillation_window},"
                " expected at least 1 (stall) and 3 (oscillation)"
            )
        if self.release < 1:
            raise InputError(f"event rules: release {self.release}, expected at least 1")


@dataclass(frozen=True)
class Happening:
    """An event of a solve.

    Attributes:
        iteration: In which iteration, from 0.
        kind: Name of its `EventKind`, e.g. "NEAR_SINGULAR".
        jacobian: The Jacobian concerned; "" if none.
        joints: The actuators concerned.
        phase: The phase it happened in; "" without phases.
        value: The number that made it an event.
        threshold: The number it was compared with, or the value before.
        unit: Of both, "rad" or "m", if they are positions or steps of actuators.
    """

    iteration: int
    kind: str
    jacobian: str
    joints: tuple[str, ...]
    phase: str
    value: float
    threshold: float
    unit: str = ""


def told(event: Happening) -> str:
    """An event in a few words."""
    if event.kind not in EventKind.__members__:
        return f"{plain_name(event.kind.lower())}: {number(event.value)}"
    return EventKind[event.kind].phrase.format(
        jacobian=plain_name(event.jacobian),
        joints=listed(event.joints),
        phase=plain_name(event.phase),
        value=quantity(event.value, event.unit),
        threshold=quantity(event.threshold, event.unit),
        mm=f"{1e3 * event.value:.2f}",
    )


def plain_name(name: str) -> str:
    """A name of the code as words: ``closed_chain`` is "closed chain"."""
    return name.replace("_", " ").replace("-", " ")


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}"


def quantity(value: float, unit: str) -> str:
    """A value with its unit as people read it: angles in degrees, lengths in millimetres."""
    if unit == "rad":
        return f"{math.degrees(value):.4g} deg"
    return f"{1e3 * value:.4g} mm" if unit == "m" else number(value)


def plural(count: int, thing: str) -> str:
    """How many of a thing: "1 restart", "2 restarts"."""
    return f"{count} {thing}" + ("" if count == 1 else "s")


def listed(names: Sequence[str], most: int = 4) -> str:
    """Names with commas, the first few of many."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def errors_text(position: float, angle: float) -> str:
    """Distance and angle to a contact; what is free (NaN) is left out.

    Args:
        position: [m].
        angle: [rad].
    """
    parts = [] if math.isnan(position) else [f"{1e3 * position:.2f} mm"]
    parts += [] if math.isnan(angle) else [f"{math.degrees(angle):.2f} deg"]
    return " and ".join(parts) or "free"


def jacobian_names(form: TraceFormat) -> tuple[str, ...]:
    """Names of the Jacobians whose measures a trace holds; one per element of such a field."""
    found = (name for item in form.layout for name in measured_jacobians(form, item))
    return tuple(dict.fromkeys(found))


def measured_jacobians(form: TraceFormat, item: Field) -> tuple[str, ...]:
    """Names of the Jacobians that the elements of a field measure; none if it measures none."""
    name = item.name.removeprefix(SIGMA).removeprefix(CONDITION)
    if name == item.name:
        return ()
    labels = form.labels.get(item.name, ())
    parts = (*labels[: item.size], *map(str, range(len(labels), item.size)))
    return tuple(f"{name}[{part}]" for part in parts) if item.shape else (name,)


def mask_words(form: TraceFormat) -> int:
    """Number of 32-bit words of a mask of all actuators."""
    sizes = {item.name: item.size for item in form.layout}
    coordinates = -(-sizes.get(Q.name, 1) // WORD)
    masks = (sizes.get(mask.name, 1) for mask in (LIMIT_MASK, ACTIVE_MASK))
    return max(coordinates, *masks)


def event_layout(words: int) -> Layout:
    """Fields of an event whose mask of actuators has so many words."""
    return Layout.record(
        Field("value", (), "f8", "", "the number that made it an event"),
        Field("threshold", (), "f8", "", "what it was compared with, or the value before"),
        Field("solve_id", (), "u4"),
        Field("iteration", (), "u4", "", "counted from 0"),
        Field("joint_mask", () if words == 1 else (words,), "u4", "", "bit i: actuator i"),
        Field("kind", (), "u1"),
        Field("jacobian", (), "u1", "", "the Jacobian concerned"),
        Field("phase", (), "u1"),
    )


def event_format(form: TraceFormat) -> TraceFormat:
    """Layout and labels of the events of a method whose traces have the given format."""
    labels = {
        "kind": tuple(kind.name for kind in EventKind),
        "jacobian": ("none", *jacobian_names(form)),
        "joint_mask": form.labels.get(Q.name) or form.labels.get(LIMIT_MASK.name, ()),
        "joint_unit": form.labels.get("q_unit", ()),
        "phase": form.labels.get(PHASE.name, ()),
    }
    return TraceFormat(event_layout(mask_words(form)), labels)
