"""Finds in traces where Jacobians are near singular or ill-conditioned."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.logs.events.kinds import EventKind, jacobian_names
from casadi_ik.logs.events.rules import EventRules
from casadi_ik.logs.events.traces import Rows, Traces, entries
from casadi_ik.problem.trace import CONDITION, SIGMA, RecordedJacobian, TraceFormat

NONE: Rows = np.zeros(0, np.intp)


@dataclass(frozen=True)
class Measured:
    """A Jacobian with the columns of a trace that tell about it.

    Attributes:
        joints: Actuators whose motion it maps.
        singular: Threshold of its smallest singular value.
        condition: Threshold of its condition number.
        columns: Field and column of `SIGMA` and of `CONDITION`, as far as there are any.
    """

    joints: tuple[str, ...]
    singular: float
    condition: float
    columns: dict[str, tuple[str, int]] = field(default_factory=dict)


def jacobians(form: TraceFormat, rules: EventRules) -> list[Measured]:
    """The Jacobians of a trace in the order of `jacobian_names`."""
    found: dict[str, Measured] = {}
    for item in form.layout:
        kind = SIGMA if item.name.startswith(SIGMA) else CONDITION
        if not item.name.startswith(kind):
            continue
        name = item.name.removeprefix(kind)
        known = form.jacobians.get(name, RecordedJacobian())
        one = TraceFormat(type(form.layout)((item,)), form.labels)
        for column, label in enumerate(jacobian_names(one)):
            measured = found.setdefault(
                label,
                Measured(
                    known.joints,
                    rules.singular.get(name, known.singular),
                    rules.condition.get(name, known.condition),
                ),
            )
            measured.columns[kind] = (item.name, column)
    return list(found.values())


def near_singular(
    traces: Traces, jacobian: Measured, rules: EventRules
) -> Iterator[tuple[EventKind, Rows, Array, float]]:
    """Where a Jacobian comes to be singular; the entry only.

    It may enter again once it was better than its threshold by the factor `EventRules.release`,
    or was not computed (NaN) in between.

    Returns:
        Kind, rows (e,), the numbers there (e,), the threshold.
    """
    if SIGMA in jacobian.columns and jacobian.singular > 0:
        value, limit = _column(traces, jacobian, SIGMA), jacobian.singular
        begun = value < limit
        row = entries(traces, begun, ~(value <= limit * rules.release)) if begun.any() else NONE
        yield EventKind.NEAR_SINGULAR, row, value[row].astype(float), limit
    if CONDITION in jacobian.columns and jacobian.condition < math.inf:
        value, limit = _column(traces, jacobian, CONDITION), jacobian.condition
        begun = value > limit
        row = entries(traces, begun, ~(value >= limit / rules.release)) if begun.any() else NONE
        yield EventKind.ILL_CONDITIONED, row, value[row].astype(float), limit


def nearest_singular(
    traces: Traces, known: Sequence[Measured], row: Rows, rules: EventRules
) -> NDArray[np.int64]:
    """Number of the Jacobian that is nearest to its threshold in each row, from 1 on.

    0 where none has come nearer than the factor `EventRules.release`.
    """
    distance = np.full((len(row), len(known) + 1), rules.release)
    for number, jacobian in enumerate(known, start=1):
        if SIGMA in jacobian.columns and jacobian.singular > 0:
            value = _column(traces, jacobian, SIGMA)[row] / jacobian.singular
            distance[:, number] = np.where(np.isnan(value), np.inf, value)
        else:
            distance[:, number] = np.inf
    return np.argmin(distance, axis=1)


def _column(traces: Traces, jacobian: Measured, kind: str) -> NDArray[np.floating]:
    name, column = jacobian.columns[kind]
    return np.ascontiguousarray(traces.matrix(name)[:, column])
