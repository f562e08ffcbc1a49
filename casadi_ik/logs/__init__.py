"""MCAP logs of solves: writing, reading, events, explanations, repair and merging."""

from __future__ import annotations

from typing import TYPE_CHECKING

from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.logs.cdr import RecordedMotion, read_motion
from casadi_ik.logs.events import EventKind, EventRules, detect_events
from casadi_ik.logs.explanation import Explanation, compare_solves, explain, match_targets
from casadi_ik.logs.format import LogClock
from casadi_ik.logs.reader import Log, LogInfo
from casadi_ik.logs.reader import open_log as open  # noqa: A004 - used as `ik.logs.open`
from casadi_ik.logs.repair import finish_log, merge_logs
from casadi_ik.logs.solve import LoggedTarget, SolveRecord, one_solve
from casadi_ik.logs.tables import MethodRows, Table
from casadi_ik.logs.writer import Compression, Keep, McapRecorder

__all__ = [
    "Compression",
    "EventKind",
    "EventRules",
    "Explanation",
    "Keep",
    "Log",
    "LogClock",
    "LogInfo",
    "LoggedTarget",
    "McapRecorder",
    "MethodRows",
    "RecordedMotion",
    "SolveRecord",
    "Table",
    "compare_solves",
    "detect_events",
    "explain",
    "finish_log",
    "match_targets",
    "merge_logs",
    "one_solve",
    "open",
    "read_motion",
]

_RENAMED = {
    "Asked": "LoggedTarget",
    "OneSolve": "SolveRecord",
    "matched": "match_targets",
    "side_by_side": "compare_solves",
}
"""Deprecated name -> new name."""


if not TYPE_CHECKING:  # type checkers report deprecated names as unknown

    def __getattr__(name: str) -> object:
        """Return the object of a deprecated name with a warning."""
        if name not in _RENAMED:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        new = _RENAMED[name]
        warn_renamed(f"casadi_ik.logs.{name}", f"casadi_ik.logs.{new}")
        return globals()[new]
