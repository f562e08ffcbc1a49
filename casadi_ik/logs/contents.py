"""What a log answers with: plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.kernels.layout import Layout
from casadi_ik.solvers.recorder import Event


@dataclass(frozen=True)
class LogInfo:
    """What is in a log, without reading its messages.

    Attributes:
        path: The file.
        size: Its size [bytes].
        robot: Name of the robot.
        counts: Messages by method and kind: {"enhanced-dls": {"iteration": 120, ...}}.
        start: First log time [ns]; 0 in a log without messages.
        end: Last log time [ns].
        compression: Of the chunks.
        chunks: How many chunks there are.
        uncompressed: Size of the chunks' contents [bytes].
        compressed: Size of the chunks as stored [bytes].
        metadata: Where the log comes from (seed, versions, parameters, ...).
        attachments: Attached files and their sizes [bytes].
    """

    path: Path
    size: int
    robot: str
    counts: Mapping[str, Mapping[str, int]]
    start: int
    end: int
    compression: str
    chunks: int
    uncompressed: int
    compressed: int
    metadata: Mapping[str, Any]
    attachments: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class Iterations:
    """Iterations of one method, by solve and iteration.

    Attributes:
        method: The method.
        layout: Fields of a row.
        labels: Names of phases, mask bits and elements, as in `SolveRecord.labels`.
        rows: The rows, (k,) of `layout.dtype`.
        solve_id: The solve that each row belongs to, (k,).
        iteration: Its number within the solve from 0, (k,).
    """

    method: str
    layout: Layout
    labels: Mapping[str, tuple[str, ...]]
    rows: np.ndarray[Any, np.dtype[Any]]
    solve_id: np.ndarray
    iteration: np.ndarray


@dataclass(frozen=True)
class LoggedEvent:
    """An event and the solve in which it happened."""

    method: str
    solve_id: int
    event: Event
