"""`casadi-ik batch`: targets are read, solved and written block by block, or in parts.

Parts are solved here or on a cluster, each in a file of its own, and taken up again after a kill.
"""

from __future__ import annotations

import hashlib
import os
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import (
    located,
    the_fixed,
    the_object_pose,
    the_robot,
    the_solver,
    the_start,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, folder_of, output, say, writing
from casadi_ik.app.cli.table import Answer, Said, command
from casadi_ik.app.report import ROWS_SHOWN, Totals, files
from casadi_ik.errors import UnsupportedError
from casadi_ik.files.progress import progress
from casadi_ik.files.shipped import resolve_description
from casadi_ik.files.writing import remove_stale, to_json
from casadi_ik.integrations.batches import (
    BatchFolder,
    check_installed,
    code_version,
    columns,
    solve_parts,
)
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.pose import transform_arrays
from casadi_ik.solve.target_files import TargetFile, TargetSource, import_polars, open_targets

BLOCK = 4096
"""Targets in memory at once, at most."""

PART_SIZE = 20_000
"""Targets of a part unless said: a fraction of a second to a few seconds of one core."""


def _out(word: str) -> Path:
    """A file of answers to be written, or a folder: one that is there, or a name without suffix."""
    path = opt.file_name()(word)
    if path.suffix.lower() not in ("", ".npz", ".parquet") and not path.is_dir():
        raise ValueError(
            f"found {word!r}, expected OUT.npz, OUT.parquet or a folder without suffix"
        )
    return path


@command(
    Option(
        "TARGETS",
        "points and normals in an npz or Parquet file, or a folder of such files, see below",
    ),
    opt.THE_ROBOT,
    *opt.SOLVER,
    Option("--jobs N", "threads, or in parts processes", 1),
    opt.out(
        "OUT",
        "write the solutions: to OUT.npz or OUT.parquet, or in parts into a folder (a name without "
        "suffix)",
        _out,
    ),
    Option(
        "--dask ADDRESS",
        "solve in parts on a Dask cluster: what `dask scheduler` prints, tcp://HOST:8786 "
        "(needs 'casadi-ik[cluster]')",
    ),
    Option("--resume", "solve in parts that survive a kill, and go on with those that are there"),
    Option("--part-size N", f"targets of a part (default: {PART_SIZE})"),
    opt.diagnose(default=False),
    opt.SIZE_LIMITS,
)
def batch(said: Said) -> Answer:
    """Find the position of every motor for many targets.

    Example:
      casadi-ik batch targets.npz --robot kuka_lwr_barrett --jobs 4 --out solved.npz

    TARGETS.npz holds, for k targets and the f fingers in the robot's order
    (`casadi-ik robots`):
      points   (k, f, 3) contact points [m], robot's base frame; NaN: a free finger
      normals  (k, f, 3) outward pad normals; NaN: a free normal
    and if wanted, NaN where not:
      tangents (k, f, 3) second axes of the contact frames, orthogonal to the
               normals: whole poses
      lines    (k, f, 3) a contact may be anywhere on the line through its point in
               this direction
      planes   (k, f, 3) a contact may be anywhere in the plane through its point
               with this normal
      balls    (k, f, 3) outward normal of the pad's ball where it touches its point
      directions (k, f, 3) a fingertip faces this way wherever it is; it has no
               point then
    A Parquet file has a row per target: columns FINGER_x, _y, _z, _nx, _ny, _nz for
    every finger.

    OUT.npz then holds:
      q (k, n), success (k,), status (k,), position_error (k, f) [m],
      angle_error (k, f) [rad], iterations, restarts (k,), time (k,) [s]
    and with --scene:
      clearance (k,) [m]: of the pair of shapes nearest to being too near; negative:
      penetration
    and with --diagnose, where a target is not solved (else "" and NaN):
      reason (k,), nearest_q (k, n) closest to the contacts,
      enough_position (k,) [m] and enough_angle (k,) [rad]: the tolerances with
      which it would be solved
    OUT.parquet holds the same as a table (needs 'casadi-ik[dataframes]'): a row per
    target, a column per motor; q_MOTOR, FINGER_position_error and so on.
    A row that is no target (partly NaN, infinite, a zero normal) gets the status
    INVALID and NaN; it is named on stderr and does not stop the rest.

    In parts (--dask, --resume, --part-size, or files that are no npz) the finished
    ones stand in OUT, or beside OUT.npz until all are there; a kill costs those
    being solved, --resume does the rest.

    exit codes: 0 all solved, 1 not all solved, 2 bad input
    """
    path, file = Path(said.targets), said.out
    if file.suffix.lower() == ".parquet" and not file.is_dir():
        with located("--out", (UnsupportedError,)):
            import_polars()
    in_parts = said.dask is not None or said.resume or said.part_size is not None
    in_parts = in_parts or file.is_dir() or not file.suffix
    in_parts = in_parts or path.is_dir() or path.suffix.lower() == ".parquet"
    robot = the_robot(said.robot)
    asked = {
        "q0": the_start(said, robot),
        "seed": said.seed,
        "diagnose": said.diagnose,
        "fixed": the_fixed(said, robot),
        "prefer": said.prefer,
    }
    totals, faults = Totals(), _Faults(path)
    solver = (_solve_parts if in_parts else _solve_blocks)(said, path, robot, asked, totals, faults)
    faults.tell(totals.count)
    scene = solver.scene.name if solver.scene else None
    report = totals.report(solver.method, robot.name, scene, path.name)
    written = files({"--log": said.log, "--out": file})
    return Answer.solved(totals.solved == totals.count, report, *written)


class _Faults:
    """Malformed targets: the first are named, all are counted."""

    def __init__(self, path: Path) -> None:
        self._path, self._count, self._first = path, 0, {}

    def add(self, faults: Mapping[int, str]) -> None:
        """Take note of what is wrong with targets, by their numbers."""
        self._count += len(faults)
        self._first = dict(sorted({**self._first, **faults}.items())[:ROWS_SHOWN])

    def tell(self, count: int) -> None:
        """Say it on stderr, of so many targets."""
        for fault in self._first.values():
            say("bad row", f"{self._path}: {fault}")
        if self._count:
            say("bad rows", f"{self._path}: {self._count} of {count}; their status is INVALID")


def _solve_blocks(
    said: Said,
    path: Path,
    robot: ArmHand,
    asked: Mapping[str, Any],
    totals: Totals,
    faults: _Faults,
) -> Solver:
    """Solve an npz in this process.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
        KeyboardInterrupt: Ctrl-C; what was finished by then is written.
    """
    targets = TargetFile(path, len(robot.fingers))
    count = targets.check(BLOCK)
    check_outputs({"--log": said.log, "--out": said.out}, inputs=[path])
    pose, solver, pace = the_object_pose(said), the_solver(said, robot), _Pace(said.jobs)
    given = targets.blocks(pace.begin)
    given = given if pose is None else (transform_arrays(block, pose) for block in given)
    blocks = solver.solve_blocks(given, jobs=said.jobs, log=said.log, **asked)
    show_progress = progress(count, say=partial(say, "progress"))
    with _growing_file(said.out, robot) as answers, closing(blocks), show_progress as show:
        try:
            for block in blocks:
                arrays = columns(block.solution)
                answers.append(arrays)
                totals.add(arrays, block.first_row)
                faults.add(block.faults)
                show(len(block.solution))
                pace.end()
        except KeyboardInterrupt:
            if answers.count:
                say("interrupted", f"{said.out} keeps the first {answers.count} of {count} rows")
            raise
    return solver


class _Pace:
    """How large blocks are: 1 to 4 s each, whatever a target takes, which is what Ctrl-C may cost.

    The first has a target for each job.
    """

    def __init__(self, jobs: int) -> None:
        self._least = self._size = min(jobs, BLOCK)
        self._began = time.monotonic()

    def begin(self) -> int:
        """A block is begun; how many targets it has."""
        self._began = time.monotonic()
        return self._size

    def end(self) -> None:
        """It has been solved."""
        seconds = time.monotonic() - self._began
        if seconds < 1.0:
            self._size = min(4 * self._size, BLOCK)
        elif seconds > 4.0:
            self._size = max(self._size // 2, self._least)


def _solve_parts(
    said: Said,
    path: Path,
    robot: ArmHand,
    asked: Mapping[str, Any],
    totals: Totals,
    faults: _Faults,
) -> Solver:
    """Solve targets part by part.

    Raises:
        CasadiIKError: Bad input, an output that cannot be written, a cluster that is not there, or
            an extra that is not installed.
        KeyboardInterrupt: Ctrl-C; the finished parts stay.
    """
    file = said.out
    check_installed(said.dask)
    source = open_targets(path, robot.fingers, said.part_size or PART_SIZE)
    count = source.count  # read before anything is written
    one_file = bool(file.suffix) and not file.is_dir()
    if one_file:
        check_outputs({"--out": file}, inputs=[each.path for each in source.files])
    solver, pose = the_solver(said, robot), the_object_pose(said)
    folder = BatchFolder(file.with_name(f"{file.name}.parts") if one_file else file, said.log)
    with writing(folder.path, "--out"):
        folder.claim(_question(said, solver, source, asked), said.resume)
    done = folder.done()
    for number in done.intersection(range(len(source.sizes))):
        _answers(folder, source, number)  # before hours are spent on the rest
    before = sum(source.sizes[number] for number in done)
    show_progress = progress(count, done=before, say=partial(say, "progress"))
    with show_progress as show, writing(folder.path, "--out"):
        try:
            for part in solve_parts(solver, source, asked, folder, said.jobs, said.dask, pose):
                faults.add(part.faults)
                show(part.count)
        except KeyboardInterrupt:
            if done := folder.done():
                kept = f"{folder.path} has {len(done)} of {len(source.sizes)} parts"
                say("interrupted", f"{kept}; --resume goes on with them")
            else:
                folder.remove()
            raise
    every = ((first, _answers(folder, source, i)) for i, first in enumerate(source.first_rows))
    if not one_file:
        for first_row, arrays in every:
            totals.add(arrays, first_row)
        return solver
    with _growing_file(file, robot) as answers:
        for first_row, arrays in every:
            answers.append(arrays)
            totals.add(arrays, first_row)
    folder.remove()
    return solver


def _answers(folder: BatchFolder, source: TargetSource, number: int) -> dict[str, Any]:
    return folder.answers(number, source.first_rows[number], source.sizes[number])


def _question(
    said: Said, solver: Solver, source: TargetSource, asked: Mapping[str, Any]
) -> dict[str, Any]:
    """Everything that decides the answers, so that no part of another batch is taken for ours."""
    scene = None
    if said.scene is not None:
        file = resolve_description(said.scene, "scenes")
        scene = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return {
        "code": code_version(),
        "targets": source.fingerprint,
        "part_size": source.size,
        "robot": hashlib.sha256(solver.robot.urdf().encode()).hexdigest()[:16],
        "solver": to_json(solver.parameters),
        "scene": scene,
        "object_pose": to_json(the_object_pose(said)),
        **asked,
        "log": None if said.log is None else str(said.log),
    }


class _GrowingFile:
    """Arrays that grow on disk, row by row, and become one file; inside `_growing_file`.

    Attributes:
        count: Rows so far, of every array.
    """

    def __init__(self, path: Path, folder: Path, robot: ArmHand) -> None:
        self.count = 0
        self._path, self._folder, self._robot = path, folder, robot
        self._grown: dict[str, tuple[IO[bytes], np.ndarray]] = {}

    def append(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Append rows to the arrays, always the same ones.

        Raises:
            OutputError: They cannot be written.
        """
        with writing(self._path, "--out"):
            for name, array in arrays.items():
                if name not in self._grown:
                    self._grown[name] = (self._folder / name).open("wb"), array[:0]
                self._grown[name][0].write(array.tobytes())
        self.count += len(next(iter(arrays.values())))

    def close(self) -> None:
        """Write out what is in memory."""
        with writing(self._path, "--out"):
            for stream, _ in self._grown.values():
                stream.close()

    def write(self) -> None:
        """Put the file in its place; what an interrupted append began is left out.

        Raises:
            OutputError: It cannot be written.
        """
        self.close()
        arrays = {
            name: np.memmap(
                self._folder / name, rows.dtype, "r", shape=(self.count, *rows.shape[1:])
            )
            for name, (_, rows) in self._grown.items()
        }
        table = self._path.suffix.lower() == ".parquet"
        with output(self._path) as part:
            (self._parquet if table else self._npz)(arrays, part)

    def _npz(self, arrays: Mapping[str, np.ndarray], part: Path) -> None:
        with zipfile.ZipFile(part, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)

    def _parquet(self, arrays: Mapping[str, np.ndarray], part: Path) -> None:
        motors, fingers = self._robot.actuators, self._robot.fingers
        names = {
            "q": [f"q_{name}" for name in motors],
            "nearest_q": [f"nearest_q_{name}" for name in motors],
            "position_error": [f"{name}_position_error" for name in fingers],
            "angle_error": [f"{name}_angle_error" for name in fingers],
        }
        frame = {}
        for name, array in arrays.items():
            columns = array.T if array.ndim == 2 else [array]
            frame |= dict(zip(names.get(name, [name]), map(np.asarray, columns), strict=True))
        import_polars().DataFrame(frame).write_parquet(part)


@contextmanager
def _growing_file(path: Path, robot: ArmHand) -> Iterator[_GrowingFile]:
    """A file that appears when its arrays are complete; after Ctrl-C with the rows it had by then.

    Raises:
        OutputError: It cannot be written; nothing is left behind.
    """
    with writing(path, "--out"):
        remove_stale(folder_of(path), ".batch-*", 2)
        temporary = TemporaryDirectory(prefix=f".batch-{os.getpid()}-", dir=folder_of(path))
    with temporary as folder:
        answers = _GrowingFile(path, Path(folder), robot)
        try:
            yield answers
        except KeyboardInterrupt:
            if answers.count:
                answers.write()
            raise
        except BaseException:
            answers.close()
            raise
        answers.write()
