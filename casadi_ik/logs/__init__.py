"""MCAP logs: every iteration into a file, and back."""

from casadi_ik.logs.asked import Asked
from casadi_ik.logs.clock import LogClock
from casadi_ik.logs.compare import matched, side_by_side
from casadi_ik.logs.event_kinds import EventKind
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.logs.events import detect_events
from casadi_ik.logs.finish import finish_log
from casadi_ik.logs.keep import Keep
from casadi_ik.logs.log import Log
from casadi_ik.logs.log import open_log as open  # noqa: A004 - read as `ik.logs.open`
from casadi_ik.logs.log_info import LogInfo
from casadi_ik.logs.merge import merge_logs
from casadi_ik.logs.one_solve import OneSolve, one_solve
from casadi_ik.logs.table import Part, Table
from casadi_ik.logs.why import Explanation, explain
from casadi_ik.logs.writer import Compression, McapRecorder

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
    "OneSolve",
    "Part",
    "Table",
    "detect_events",
    "explain",
    "finish_log",
    "matched",
    "merge_logs",
    "one_solve",
    "open",
    "side_by_side",
]
