"""What can happen in an iteration that is worth a line of its own, and how it is stored."""

from __future__ import annotations

from enum import IntEnum

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
    """What happened; "value against threshold" is what the event's two numbers are.

    Example:
        >>> ik.logs.EventKind.LIMIT_HIT.name
        'LIMIT_HIT'
    """

    NEAR_SINGULAR = 0
    """A Jacobian's smallest singular value has fallen below its threshold."""
    ILL_CONDITIONED = 1
    """A Jacobian's condition number has risen above its threshold."""
    LIMIT_HIT = 2
    """An actuator has come to a limit: its position, twice."""
    LIMIT_LEFT = 3
    """An actuator has left a limit: its position against that on the limit."""
    ACTIVATED = 4
    """Constraints have joined the active set: its size against that before."""
    RELEASED = 5
    """Constraints have left the active set: its size against that before."""
    RESTART = 6
    """A new start: its number against that before."""
    PHASE_CHANGE = 7
    """Another phase: its code against that before."""
    STALL = 8
    """The errors stand still: their relative spread against what counts as still."""
    OSCILLATION = 9
    """Actuators go to and fro without progress: the longest step against what counts as one."""
    COLLISION_ENTERED = 10
    """Two shapes have come nearer than they may: the clearance against the margin."""
    COLLISION_LEFT = 11
    """No two shapes are nearer than they may be any more: the clearance against the margin."""


SINGULAR = (EventKind.NEAR_SINGULAR, EventKind.ILL_CONDITIONED)
"""The kinds that make a solve a singular one."""


def jacobian_names(form: TraceFormat) -> tuple[str, ...]:
    """Names of the Jacobians whose measures a trace holds; one per element of such a field."""
    found: dict[str, None] = {}
    for item in form.layout:
        name = item.name.removeprefix(SIGMA).removeprefix(CONDITION)
        if name != item.name:
            labels = form.labels.get(item.name, ())
            for i in range(item.size):
                part = labels[i] if i < len(labels) else str(i)
                found[f"{name}[{part}]" if item.shape else name] = None
    return tuple(found)


def mask_words(form: TraceFormat) -> int:
    """How many 32-bit words a mask of all actuators has."""
    sizes = {item.name: item.size for item in form.layout}
    coordinates = -(-sizes.get(Q.name, 1) // WORD)
    masks = (sizes.get(mask.name, 1) for mask in (LIMIT_MASK, ACTIVE_MASK))
    return max(coordinates, *masks)


def event_format(form: TraceFormat) -> TraceFormat:
    """Layout and labels of the events of a method whose traces have the given format."""
    words = mask_words(form)
    joints = form.labels.get(Q.name) or form.labels.get(LIMIT_MASK.name, ())
    layout = Layout.record(
        Field("value", (), "f8", "", "the number that made it an event"),
        Field("threshold", (), "f8", "", "what it was compared with, or the value before"),
        Field("solve_id", (), "u4"),
        Field("iteration", (), "u4", "", "counted from 0"),
        Field("joint_mask", () if words == 1 else (words,), "u4", "", "bit i: actuator i"),
        Field("kind", (), "u1"),
        Field("jacobian", (), "u1", "", "the Jacobian concerned"),
        Field("phase", (), "u1"),
    )
    labels = {
        "kind": tuple(kind.name for kind in EventKind),
        "jacobian": ("none", *jacobian_names(form)),
        "joint_mask": joints,
        "phase": form.labels.get(PHASE.name, ()),
    }
    return TraceFormat(layout, labels)
