"""`casadi-ik batch`: everything in memory."""

from __future__ import annotations

import argparse
import io
import lzma
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import located, the_fixed, the_robot, the_solver, the_start
from casadi_ik.cli.report import batch_report
from casadi_ik.errors import InputError
from casadi_ik.solvers import BatchSolution, target_arrays

KEYS = ("points", "normals")

_UNREADABLE = (
    ValueError,
    EOFError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zlib.error,
    lzma.LZMAError,
)
"""What numpy and zipfile were seen to raise on a damaged or encrypted member."""


def batch(arguments: argparse.Namespace) -> Answer:
    """Solve the targets of a file.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
    """
    path = Path(arguments.targets)
    robot = the_robot(arguments.robot)
    q0 = the_start(arguments, robot)
    fixed = the_fixed(arguments, robot)
    points, normals = read_targets(path, len(robot.fingers))
    outputs = {"--log": arguments.log, "--out": arguments.out}
    check_outputs(outputs.items(), inputs=[path])
    solver = the_solver(arguments, robot)
    with located(str(path)):
        solved = solver.solve_batch(
            points, normals, q0, arguments.seed, arguments.jobs, arguments.log, fixed=fixed
        )
    data = as_npz(solved)
    write_output(arguments.out, "--out", lambda part: part.write_bytes(data))
    written = [(option.lstrip("-"), file) for option, file in outputs.items() if file is not None]
    report = batch_report(path.name, solver, solved, written)
    return Answer(report, Exit.DONE if solved.success.all() else Exit.NOT_SOLVED)


def read_targets(path: Path, fingers: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and unit normals (k, f, 3) of a file of targets; nothing in it is ever executed.

    Raises:
        InputError: Missing, no npz, or not what is expected; the message names file and key.
    """
    try:
        with path.open("rb") as stream:
            if not zipfile.is_zipfile(stream):
                raise InputError(f"{path}: not an npz file, expected one with points and normals")
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as data:
                points, normals = (_array(data, path, key) for key in KEYS)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except zipfile.BadZipFile as error:
        raise InputError(f"{path}: damaged: {error}") from error
    with located(str(path)):
        if points.ndim and len(points) == 0:
            raise InputError(f"points: found no targets, expected shape (k, {fingers}, 3)")
        return target_arrays(points, normals, fingers)


def _array(data: Any, path: Path, key: str) -> NDArray[Any]:
    if key not in data:
        found = ", ".join(data.files) or "nothing"
        raise InputError(f"{path}: {key}: missing, expected {' and '.join(KEYS)}; found {found}")
    try:
        array = data[key]
    except _UNREADABLE as error:
        raise InputError(f"{path}: {key}: cannot be read: {error}") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        found = f"values of type {array.dtype}" if isinstance(array, np.ndarray) else "no array"
        raise InputError(f"{path}: {key}: found {found}, expected numbers")
    return array


def as_npz(solved: BatchSolution) -> bytes:
    """The solutions as an npz file."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        q=solved.q,
        success=solved.success,
        status=solved.status_names,
        position_error=solved.position_error,
        angle_error=solved.angle_error,
        iterations=solved.iterations,
        restarts=solved.restarts,
        time=solved.time,
    )
    return buffer.getvalue()
