"""`casadi-ik batch`: targets are read, solved and written block by block."""

from __future__ import annotations

import argparse
import time
from contextlib import closing
from pathlib import Path

from casadi_ik.batches.columns import columns
from casadi_ik.batches.target_file import TargetFile
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.batch_parts import batch_in_parts, in_parts
from casadi_ik.cli.batch_progress import progress
from casadi_ik.cli.batch_totals import BatchTotals
from casadi_ik.cli.outputs import check_outputs
from casadi_ik.cli.question import (
    the_fixed,
    the_object_pose,
    the_robot,
    the_solver,
    the_start,
)
from casadi_ik.cli.report import batch_report
from casadi_ik.cli.say import say
from casadi_ik.cli.solution_file import growing_npz
from casadi_ik.grasps.pose import moved

BLOCK = 4096
"""Targets in memory at once, at most."""

BRIEF, LONG = 1.0, 4.0
"""Seconds from which on the next block is not larger, or smaller: what Ctrl-C may cost."""


class Pace:
    """How large blocks are: a few seconds each, whatever a target takes; the first a target a job.

    Attributes:
        size: Of the next block.
    """

    def __init__(self, jobs: int) -> None:
        self._least = min(jobs, BLOCK)
        self.size = self._least
        self._began = time.monotonic()

    def begin(self) -> int:
        """A block is begun."""
        self._began = time.monotonic()
        return self.size

    def end(self) -> None:
        """It has been solved."""
        seconds = time.monotonic() - self._began
        if seconds < BRIEF:
            self.size = min(4 * self.size, BLOCK)
        elif seconds > LONG:
            self.size = max(self.size // 2, self._least)


def batch(arguments: argparse.Namespace) -> Answer:
    """Solve the targets of a file.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
        KeyboardInterrupt: Ctrl-C; what was finished by then is written.
    """
    if in_parts(arguments):
        return batch_in_parts(arguments)
    path = Path(arguments.targets)
    robot = the_robot(arguments.robot)
    q0 = the_start(arguments, robot)
    fixed = the_fixed(arguments, robot)
    targets = TargetFile(path, len(robot.fingers))
    count = targets.check(BLOCK)
    outputs = {"--log": arguments.log, "--out": arguments.out}
    check_outputs(outputs.items(), inputs=[path])
    pose = the_object_pose(arguments)
    solver = the_solver(arguments, robot)
    pace = Pace(arguments.jobs)
    asked = targets.blocks(pace.begin)
    blocks = solver.solve_blocks(
        asked if pose is None else (moved(block, pose) for block in asked),
        q0,
        arguments.seed,
        arguments.jobs,
        arguments.log,
        arguments.diagnose,
        fixed,
        arguments.prefer,
    )
    totals = BatchTotals()
    with growing_npz(arguments.out, "--out") as npz, closing(blocks), progress(count) as show:
        try:
            for block in blocks:
                arrays = columns(block.solution)
                npz.append(arrays)
                totals.add(arrays, block.first_row)
                totals.note_faults(block.faults)
                show(len(block.solution))
                pace.end()
        except KeyboardInterrupt:
            if npz.count:
                say("interrupted", f"{arguments.out} keeps the first {npz.count} of {count} rows")
            raise
    _say_faults(str(path), totals)
    written = [(option.lstrip("-"), file) for option, file in outputs.items() if file is not None]
    report = batch_report(path.name, solver, totals, written)
    return Answer(report, Exit.DONE if totals.solved == count else Exit.NOT_SOLVED)


def _say_faults(path: str, totals: BatchTotals) -> None:
    for fault in totals.first_faults:
        say("bad row", f"{path}: {fault}")
    if totals.faults:
        say("bad rows", f"{path}: {totals.faults} of {totals.count}; their status is INVALID")
