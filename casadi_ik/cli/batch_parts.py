"""`casadi-ik batch` in parts: here or on a cluster, taken up again after a kill."""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

from casadi_ik.api import Solver
from casadi_ik.batches.backend import check_installed
from casadi_ik.batches.code import code_version
from casadi_ik.batches.folder import BatchFolder
from casadi_ik.batches.part import Asked
from casadi_ik.batches.run import solve_parts
from casadi_ik.batches.sources import Source, source_of
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.batch_progress import progress
from casadi_ik.cli.batch_totals import BatchTotals
from casadi_ik.cli.outputs import check_outputs, writing
from casadi_ik.cli.question import the_fixed, the_object_pose, the_robot, the_solver, the_start
from casadi_ik.cli.report import batch_report
from casadi_ik.cli.say import say
from casadi_ik.cli.solution_file import growing_npz
from casadi_ik.files.shipped import resolve
from casadi_ik.logs.write.provenance import plain

PART_SIZE = 20_000
"""Targets of a part unless said: a fraction of a second to a few seconds of one core."""


def in_parts(arguments: argparse.Namespace) -> bool:
    """Whether what was asked for is done in parts."""
    return bool(
        arguments.dask is not None
        or arguments.resume
        or arguments.part_size is not None
        or arguments.out.is_dir()
        or Path(arguments.targets).is_dir()
        or Path(arguments.targets).suffix.lower() == ".parquet"
    )


def batch_in_parts(arguments: argparse.Namespace) -> Answer:
    """Solve targets part by part.

    Raises:
        CasadiIKError: Bad input, an output that cannot be written, a cluster that is not there, or
            an extra that is not installed.
        KeyboardInterrupt: Ctrl-C; the finished parts stay.
    """
    path, out = Path(arguments.targets), arguments.out
    check_installed(arguments.dask)
    robot = the_robot(arguments.robot)
    q0, fixed = the_start(arguments, robot), the_fixed(arguments, robot)
    source = source_of(path, robot.fingers, arguments.part_size or PART_SIZE)
    count = source.count
    one_file = bool(out.suffix) and not out.is_dir()
    if one_file:
        check_outputs([("--out", out)], inputs=[file.path for file in source.files])
    solver = the_solver(arguments, robot)
    asked = Asked(
        q0, arguments.seed, arguments.diagnose, fixed, arguments.prefer, arguments.log is not None
    )
    folder = BatchFolder(out.with_name(f"{out.name}.parts") if one_file else out, arguments.log)
    with writing(folder.path, "--out"):
        folder.claim(_question(arguments, solver, source, asked), arguments.resume)
    done = folder.done()
    for number in done.intersection(range(len(source.sizes))):
        _answers(folder, source, number)  # before hours are spent on the rest
    faults: dict[int, str] = {}
    before = sum(source.sizes[number] for number in done)
    with progress(count, before) as show, writing(folder.path, "--out"):
        try:
            for part in solve_parts(
                solver,
                source,
                asked,
                folder,
                arguments.jobs,
                arguments.dask,
                the_object_pose(arguments),
            ):
                faults |= part.faults
                show(part.count)
        except KeyboardInterrupt:
            kept = f"{folder.path} has {len(folder.done())} of {len(source.sizes)} parts"
            say("interrupted", f"{kept}; --resume goes on with them")
            raise
    totals = _totals(source, folder, faults, out if one_file else None)
    for fault in totals.first_faults:
        say("bad row", f"{path}: {fault}")
    written = [("out", out)] + ([("log", arguments.log)] if arguments.log is not None else [])
    report = batch_report(path.name, solver, totals, written)
    return Answer(report, Exit.DONE if totals.solved == count else Exit.NOT_SOLVED)


def _totals(
    source: Source, folder: BatchFolder, faults: dict[int, str], out: Path | None
) -> BatchTotals:
    """Totals over all parts in order; they become one file if one is asked for."""
    totals = BatchTotals()
    totals.note_faults(faults)
    if out is None:
        for number, first_row in enumerate(source.first_rows):
            totals.add(_answers(folder, source, number), first_row)
        return totals
    with growing_npz(out, "--out") as npz:
        for number, first_row in enumerate(source.first_rows):
            arrays = _answers(folder, source, number)
            npz.append(arrays)
            totals.add(arrays, first_row)
    folder.remove()
    return totals


def _answers(folder: BatchFolder, source: Source, number: int) -> dict[str, Any]:
    return folder.answers(number, source.first_rows[number], source.sizes[number])


def _question(
    arguments: argparse.Namespace, solver: Solver, source: Source, asked: Asked
) -> dict[str, Any]:
    """Everything that decides the answers, so that no part of another batch is taken for ours."""
    scene = None
    if arguments.scene is not None:
        file = resolve(arguments.scene, "scenes")
        scene = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return {
        "code": code_version(),
        "targets": source.fingerprint,
        "part_size": source.size,
        "robot": hashlib.sha256(solver.robot.urdf().encode()).hexdigest()[:16],
        "solver": plain(solver.parameters),
        "scene": scene,
        "object_pose": plain(the_object_pose(arguments)),
        "q0": asked.q0,
        "seed": asked.seed,
        "diagnose": asked.diagnose,
        "fixed": asked.fixed,
        "prefer": asked.prefer,
        "log": None if arguments.log is None else str(arguments.log),
    }
