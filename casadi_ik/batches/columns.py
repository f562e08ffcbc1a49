"""Answers to targets as arrays, the way they are written to files."""

from __future__ import annotations

import numpy as np

from casadi_ik.answers.diagnosis import Diagnosis
from casadi_ik.answers.solution import BatchSolution
from casadi_ik.problem.status import Status

STATUS = np.dtype(f"<U{max(len(status.name) for status in Status)}")
"""Names of statuses, as wide as the longest."""

REASON = np.dtype("<U9")
"""Names of reasons, "" where there is no diagnosis."""


def columns(solved: BatchSolution) -> dict[str, np.ndarray]:
    """The arrays of a block as they are written, a row per target."""
    found: dict[str, np.ndarray] = {
        "q": solved.q,
        "success": solved.success,
        "status": solved.status_names.astype(STATUS),
        "position_error": solved.position_error,
        "angle_error": solved.angle_error,
        "iterations": solved.iterations,
        "restarts": solved.restarts,
        "time": solved.time,
    }
    if solved.clearance is not None:
        found["clearance"] = solved.clearance
    if solved.diagnoses:
        found |= _diagnoses(solved.diagnoses, solved.q.shape[1])
    return found


def _diagnoses(diagnoses: tuple[Diagnosis | None, ...], n: int) -> dict[str, np.ndarray]:
    count = len(diagnoses)
    reason = np.zeros(count, dtype=REASON)
    nearest, enough = np.full((count, n), np.nan), np.full((count, 2), np.nan)
    for row, diagnosis in enumerate(diagnoses):
        if diagnosis is not None:
            reason[row] = diagnosis.reason.name
            nearest[row] = diagnosis.q
            enough[row] = diagnosis.enough.position, diagnosis.enough.angle
    return {
        "reason": reason,
        "nearest_q": nearest,
        "enough_position": enough[:, 0],
        "enough_angle": enough[:, 1],
    }
