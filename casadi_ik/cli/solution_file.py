"""The file `casadi-ik batch` writes: arrays that grow block by block, then become one npz."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import numpy as np

from casadi_ik.cli.outputs import folder_of, write_output, writing
from casadi_ik.problem.diagnosis import Diagnosis
from casadi_ik.problem.solution import BatchSolution
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


@contextmanager
def growing_npz(
    path: Path, option: str, count: int
) -> Iterator[Callable[[Mapping[str, np.ndarray]], None]]:
    """An npz whose arrays grow on disk; it appears when it is complete.

    Args:
        path: Where it shall stand.
        option: The option that asked for it.
        count: Rows of every array in the end.

    Yields:
        A function that appends rows to the arrays, always the same ones.

    Raises:
        OutputError: It cannot be written; nothing is left behind.
    """
    with writing(path, option):
        temporary = TemporaryDirectory(prefix=".batch-", dir=folder_of(path))
    with temporary as folder:
        streams: dict[str, IO[bytes]] = {}

        def append(arrays: Mapping[str, np.ndarray]) -> None:
            with writing(path, option):
                for name, array in arrays.items():
                    if name not in streams:
                        streams[name] = _begun(Path(folder) / name, array, count)
                    streams[name].write(array.tobytes())

        def close() -> None:
            with writing(path, option):
                for stream in streams.values():
                    stream.close()

        def zipped(part: Path) -> None:
            with zipfile.ZipFile(part, "w") as archive:
                for name in streams:
                    archive.write(Path(folder) / name, f"{name}.npy")

        try:
            yield append
        finally:
            close()
        write_output(path, option, zipped)


def _begun(file: Path, rows: np.ndarray, count: int) -> IO[bytes]:
    """A file with the header of an array of `count` such rows."""
    stream = file.open("wb")
    header: dict[str, Any] = {
        "descr": np.lib.format.dtype_to_descr(rows.dtype),
        "fortran_order": False,
        "shape": (count, *rows.shape[1:]),
    }
    np.lib.format.write_array_header_1_0(stream, header)
    return stream
