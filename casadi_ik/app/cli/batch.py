"""Command `casadi-ik batch`.

Targets are read, solved and written in blocks, or in parts. Each part is solved locally or on a
cluster and written to a separate file, so that a batch can be resumed after a kill.
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
    load_robot_arg,
    located,
    make_solver,
    parse_fixed,
    parse_object_pose,
    parse_q0,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, folder_of, output, print_message, writing
from casadi_ik.app.cli.table import Arguments, CommandResult, command
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

MAX_BLOCK = 4096
"""Maximum number of targets in memory."""

DEFAULT_PART_SIZE = 20_000
"""Default number of targets per part: a fraction of a second to a few seconds of one core."""


def _output_path(word: str) -> Path:
    """Parse the output: an npz or Parquet file, an existing folder, or a name without suffix."""
    path = opt.file_name()(word)
    if path.suffix.lower() not in ("", ".npz", ".parquet") and not path.is_dir():
        raise ValueError(
            f"found {word!r}, expected OUT.npz, OUT.parquet or a folder without suffix"
        )
    return path


@command(
    Option(
        "TARGETS",
        "npz or Parquet file, or folder of such files, see below",
    ),
    opt.REQUIRED_ROBOT,
    *opt.SOLVER,
    Option("--jobs N", "number of threads, or of processes for parts", 1),
    opt.out_option("OUT", "OUT.npz, OUT.parquet, or a folder for parts (no suffix)", _output_path),
    Option(
        "--dask ADDRESS",
        "Dask scheduler, tcp://HOST:8786 (needs dask[distributed])",
    ),
    Option("--resume", "write resumable parts; skip parts already done"),
    Option("--part-size N", f"number of targets per part (default: {DEFAULT_PART_SIZE})"),
    opt.diagnose(default=False),
    opt.BEST_EFFORT,
    opt.SIZE_LIMITS,
)
def batch(args: Arguments) -> CommandResult:
    """Solve the inverse kinematics of many targets.

    Example:
      casadi-ik batch targets.npz --robot kuka_lwr_barrett --jobs 4 --out solved.npz

    TARGETS.npz holds, for k targets and the f fingers in the robot's order
    (`casadi-ik robots`):
      points   (k, f, 3) contact points [m], robot's base frame; NaN: free finger
      normals  (k, f, 3) outward pad normals; NaN: free normal
    and optionally, with NaN for contacts without this condition:
      tangents (k, f, 3) second axes of the contact frames, orthogonal to the
               normals; they make the contacts full poses
      lines    (k, f, 3) direction of a line through the point on which the contact
               may lie anywhere
      planes   (k, f, 3) normal of a plane through the point in which the contact
               may lie anywhere
      balls    (k, f, 3) outward normal of the ball-shaped pad at its contact point
      directions (k, f, 3) direction of a fingertip at any position (no point)
    A Parquet file has a row per target: columns FINGER_x, _y, _z, _nx, _ny, _nz for
    every finger.

    OUT.npz holds:
      q (k, n), success (k,), status (k,), position_error (k, f) [m],
      angle_error (k, f) [rad], iterations, restarts (k,), time (k,) [s]
    and with --scene:
      clearance (k,) [m] of the pair of shapes with the smallest clearance beyond
      its margin; negative: penetration
    and with --diagnose for targets that are not solved (else "" and NaN):
      reason (k,), nearest_q (k, n) with the smallest contact errors,
      enough_position (k,) [m] and enough_angle (k,) [rad]: the smallest tolerances
      with which the target would be solved
    and with --best-effort the nearest q found of targets that are not solved.
    OUT.parquet holds the same as a table (needs polars) with a row
    per target and a column per motor: q_MOTOR, FINGER_position_error and so on.
    An invalid row (partly NaN, infinite, zero normal) gets the status INVALID and
    NaN. It is reported on stderr, and the other rows are solved.

    A batch is solved in parts with --dask, --resume or --part-size, and for files
    other than npz. Finished parts are in the folder OUT, or in OUT.npz.parts until
    all are done. After a kill --resume solves only the missing parts.

    exit codes: 0 all solved, 1 not all solved, 2 bad input
    """
    path, file = Path(args.targets), args.out
    if file.suffix.lower() == ".parquet" and not file.is_dir():
        with located("--out", (UnsupportedError,)):
            import_polars()
    in_parts = args.dask is not None or args.resume or args.part_size is not None
    in_parts = in_parts or file.is_dir() or not file.suffix
    in_parts = in_parts or path.is_dir() or path.suffix.lower() == ".parquet"
    robot = load_robot_arg(args.robot)
    settings = {
        "q0": parse_q0(args, robot),
        "seed": args.seed,
        "diagnose": args.diagnose,
        "fixed": parse_fixed(args, robot),
        "prefer": args.prefer,
        "best_effort": bool(args.best_effort),
    }
    totals, faults = Totals(), _MalformedTargets(path)
    solver = (_solve_parts if in_parts else _solve_blocks)(
        args, path, robot, settings, totals, faults
    )
    faults.report(totals.count)
    scene = solver.scene.name if solver.scene else None
    report = totals.report(solver.method, robot.name, scene, path.name)
    written = files({"--log": args.log, "--out": file})
    return CommandResult.of_parts(totals.solved == totals.count, report, *written)


class _MalformedTargets:
    """Number of malformed targets, and the first messages."""

    def __init__(self, path: Path) -> None:
        self._path, self._count, self._messages = path, 0, {}

    def add_messages(self, messages: Mapping[int, str]) -> None:
        """Record the messages of malformed targets by row number."""
        self._count += len(messages)
        self._messages = dict(sorted({**self._messages, **messages}.items())[:ROWS_SHOWN])

    def report(self, count: int) -> None:
        """Print the malformed targets out of `count` targets on stderr."""
        for message in self._messages.values():
            print_message("bad row", f"{self._path}: {message}")
        if self._count:
            print_message(
                "bad rows", f"{self._path}: {self._count} of {count}; their status is INVALID"
            )


def _solve_blocks(
    args: Arguments,
    path: Path,
    robot: ArmHand,
    settings: Mapping[str, Any],
    totals: Totals,
    faults: _MalformedTargets,
) -> Solver:
    """Solve an npz file in this process.

    Raises:
        CasadiIKError: The input is invalid, or an output cannot be written.
        KeyboardInterrupt: Ctrl-C was pressed; the finished rows are written.
    """
    targets = TargetFile(path, len(robot.fingers))
    count = targets.check(MAX_BLOCK)
    check_outputs({"--log": args.log, "--out": args.out}, inputs=[path])
    pose, solver, pace = parse_object_pose(args), make_solver(args, robot), _BlockSize(args.jobs)
    target_blocks = targets.blocks(pace.start_block)
    if pose is not None:
        target_blocks = (transform_arrays(block, pose) for block in target_blocks)
    blocks = solver.solve_blocks(target_blocks, jobs=args.jobs, log=args.log, **settings)
    show_progress = progress(count, say=partial(print_message, "progress"))
    with _growing_file(args.out, robot) as output_file, closing(blocks), show_progress as show:
        try:
            for block in blocks:
                arrays = columns(block.solution)
                output_file.append(arrays)
                totals.add(arrays, block.first_row)
                faults.add_messages(block.faults)
                show(len(block.solution))
                pace.finish_block()
        except KeyboardInterrupt:
            if output_file.count:
                print_message(
                    "interrupted", f"{args.out} keeps the first {output_file.count} of {count} rows"
                )
            raise
    return solver


class _BlockSize:
    """Controller of the block size, so that a block takes 1 to 4 s.

    Ctrl-C can lose the work of one block. The first block has one target per job.
    """

    def __init__(self, jobs: int) -> None:
        self._min_size = self._size = min(jobs, MAX_BLOCK)
        self._start_time = time.monotonic()

    def start_block(self) -> int:
        """Start the clock of a block and return its number of targets."""
        self._start_time = time.monotonic()
        return self._size

    def finish_block(self) -> None:
        """Adapt the size of the next block to the time of this one."""
        seconds = time.monotonic() - self._start_time
        if seconds < 1.0:
            self._size = min(4 * self._size, MAX_BLOCK)
        elif seconds > 4.0:
            self._size = max(self._size // 2, self._min_size)


def _solve_parts(
    args: Arguments,
    path: Path,
    robot: ArmHand,
    settings: Mapping[str, Any],
    totals: Totals,
    faults: _MalformedTargets,
) -> Solver:
    """Solve targets in parts.

    Raises:
        CasadiIKError: The input is invalid, an output cannot be written, the cluster cannot be
            reached, or an extra is not installed.
        KeyboardInterrupt: Ctrl-C was pressed; finished parts remain on disk.
    """
    file = args.out
    check_installed(args.dask)
    source = open_targets(path, robot.fingers, args.part_size or DEFAULT_PART_SIZE)
    count = source.count  # reads the files, so that errors are raised before output is written
    is_one_file = bool(file.suffix) and not file.is_dir()
    if is_one_file:
        check_outputs({"--out": file}, inputs=[item.path for item in source.files])
    solver, pose = make_solver(args, robot), parse_object_pose(args)
    folder = BatchFolder(file.with_name(f"{file.name}.parts") if is_one_file else file, args.log)
    with writing(folder.path, "--out"):
        folder.claim(_batch_settings(args, solver, source, settings), args.resume)
    done = folder.done()
    for number in done.intersection(range(len(source.sizes))):
        _part_solutions(folder, source, number)  # find damaged parts before the long solve
    done_count = sum(source.sizes[number] for number in done)
    show_progress = progress(count, done=done_count, say=partial(print_message, "progress"))
    with show_progress as show, writing(folder.path, "--out"):
        try:
            for part in solve_parts(solver, source, settings, folder, args.jobs, args.dask, pose):
                faults.add_messages(part.faults)
                show(part.count)
        except KeyboardInterrupt:
            if done := folder.done():
                progress_text = f"{folder.path} has {len(done)} of {len(source.sizes)} parts"
                print_message("interrupted", f"{progress_text}; continue with --resume")
            else:
                folder.remove()
            raise
    parts = (
        (first, _part_solutions(folder, source, i)) for i, first in enumerate(source.first_rows)
    )
    if not is_one_file:
        for first_row, arrays in parts:
            totals.add(arrays, first_row)
        return solver
    with _growing_file(file, robot) as output_file:
        for first_row, arrays in parts:
            output_file.append(arrays)
            totals.add(arrays, first_row)
    folder.remove()
    return solver


def _part_solutions(folder: BatchFolder, source: TargetSource, number: int) -> dict[str, Any]:
    """Read the solutions of a finished part as arrays by name."""
    return folder.answers(number, source.first_rows[number], source.sizes[number])


def _batch_settings(
    args: Arguments, solver: Solver, source: TargetSource, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the inputs that determine the solutions, which identify the parts of a batch."""
    scene = None
    if args.scene is not None:
        file = resolve_description(args.scene, "scenes")
        scene = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return {
        "code": code_version(),
        "targets": source.fingerprint,
        "part_size": source.size,
        "robot": hashlib.sha256(solver.robot.urdf().encode()).hexdigest()[:16],
        "solver": to_json(solver.parameters),
        "scene": scene,
        "object_pose": to_json(parse_object_pose(args)),
        **settings,
        "log": None if args.log is None else str(args.log),
    }


class _GrowingFile:
    """Output file whose arrays are appended to on disk; created by `_growing_file`.

    Attributes:
        count: Number of rows of every array.
    """

    def __init__(self, path: Path, folder: Path, robot: ArmHand) -> None:
        self.count = 0
        self._path, self._folder, self._robot = path, folder, robot
        self._streams: dict[str, tuple[IO[bytes], np.ndarray]] = {}

    def append(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Append rows to the arrays; all calls have the same names.

        Raises:
            OutputError: The rows cannot be written.
        """
        with writing(self._path, "--out"):
            for name, array in arrays.items():
                if name not in self._streams:
                    self._streams[name] = (self._folder / name).open("wb"), array[:0]
                self._streams[name][0].write(array.tobytes())
        self.count += len(next(iter(arrays.values())))

    def close(self) -> None:
        """Flush and close the temporary files."""
        with writing(self._path, "--out"):
            for stream, _ in self._streams.values():
                stream.close()

    def write(self) -> None:
        """Write the output file without the rows of an interrupted append.

        Raises:
            OutputError: The file cannot be written.
        """
        self.close()
        arrays = {
            name: np.memmap(
                self._folder / name, rows.dtype, "r", shape=(self.count, *rows.shape[1:])
            )
            for name, (_, rows) in self._streams.items()
        }
        is_parquet = self._path.suffix.lower() == ".parquet"
        with output(self._path) as part:
            (self._parquet if is_parquet else self._npz)(arrays, part)

    def _npz(self, arrays: Mapping[str, np.ndarray], part: Path) -> None:
        """Write results by name as an npz file."""
        with zipfile.ZipFile(part, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)

    def _parquet(self, arrays: Mapping[str, np.ndarray], part: Path) -> None:
        """Write results as a Parquet file with a column for each motor and finger."""
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
    """Yield an output file that is written at the end of the block, or on Ctrl-C.

    Raises:
        OutputError: The file cannot be written; no partial file remains.
    """
    with writing(path, "--out"):
        remove_stale(folder_of(path), ".batch-*", 2)
        temporary = TemporaryDirectory(prefix=f".batch-{os.getpid()}-", dir=folder_of(path))
    with temporary as folder:
        output_file = _GrowingFile(path, Path(folder), robot)
        try:
            yield output_file
        except KeyboardInterrupt:
            if output_file.count:
                output_file.write()
            raise
        except BaseException:
            output_file.close()
            raise
        output_file.write()
