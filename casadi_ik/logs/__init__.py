"""MCAP logs: every iteration into a file, and back."""

from casadi_ik.logs.events.detect import detect_events
from casadi_ik.logs.events.kinds import EventKind
from casadi_ik.logs.events.rules import EventRules
from casadi_ik.logs.explain.compare import matched, side_by_side
from casadi_ik.logs.explain.why import Explanation, explain
from casadi_ik.logs.mcap.clock import LogClock
from casadi_ik.logs.read.asked import Asked
from casadi_ik.logs.read.info import LogInfo
from casadi_ik.logs.read.log import Log
from casadi_ik.logs.read.log import open_log as open  # noqa: A004 - read as `ik.logs.open`
from casadi_ik.logs.read.one_solve import OneSolve, one_solve
from casadi_ik.logs.read.table import MethodRows, Table
from casadi_ik.logs.repair.finish import finish_log
from casadi_ik.logs.repair.merge import merge_logs
from casadi_ik.logs.write.keep import Keep
from casadi_ik.logs.write.recorder import Compression, McapRecorder

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
