"""MCAP logs: every iteration into a file, and back."""

from casadi_ik.logs.clock import LogClock
from casadi_ik.logs.event_kinds import EventKind
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.logs.events import detect_events
from casadi_ik.logs.keep import Keep
from casadi_ik.logs.log import Log
from casadi_ik.logs.log import open_log as open  # noqa: A004 - read as `ik.logs.open`
from casadi_ik.logs.log_info import LogInfo
from casadi_ik.logs.table import Part, Table
from casadi_ik.logs.writer import Compression, McapRecorder

__all__ = [
    "Compression",
    "EventKind",
    "EventRules",
    "Keep",
    "Log",
    "LogClock",
    "LogInfo",
    "McapRecorder",
    "Part",
    "Table",
    "detect_events",
    "open",
]
