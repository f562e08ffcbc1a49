"""MCAP logs: every iteration into a file, and back."""

from casadi_ik.logs.clock import LogClock
from casadi_ik.logs.contents import Iterations, LoggedEvent, LogInfo
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.logs.events import detect_events
from casadi_ik.logs.reader import LogFile, open_log
from casadi_ik.logs.writer import McapRecorder

__all__ = [
    "EventRules",
    "Iterations",
    "LogClock",
    "LogFile",
    "LogInfo",
    "LoggedEvent",
    "McapRecorder",
    "detect_events",
    "open_log",
]
