"""MCAP logs: every iteration into a file, and back."""

from casadi_ik.logs.cdr import RecordedMotion, read_motion
from casadi_ik.logs.events import EventKind, EventRules, detect_events
from casadi_ik.logs.explanation import Explanation, explain, matched, side_by_side
from casadi_ik.logs.format import LogClock
from casadi_ik.logs.reader import Log, LogInfo
from casadi_ik.logs.reader import open_log as open  # noqa: A004 - read as `ik.logs.open`
from casadi_ik.logs.repair import finish_log, merge_logs
from casadi_ik.logs.solve import Asked, OneSolve, one_solve
from casadi_ik.logs.tables import MethodRows, Table
from casadi_ik.logs.writer import Compression, Keep, McapRecorder

__all__ = [
    "Asked",
    "Compression",
    "EventKind",
    "EventRules",
    "Explanation",
    "Keep",
    "Log",
    "LogClock",
    "LogInfo",
    "McapRecorder",
    "MethodRows",
    "OneSolve",
    "RecordedMotion",
    "Table",
    "detect_events",
    "explain",
    "finish_log",
    "matched",
    "merge_logs",
    "one_solve",
    "open",
    "read_motion",
    "side_by_side",
]
