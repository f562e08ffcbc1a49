"""`casadi-ik batch`: targets are read, solved and written block by block, or in parts.

Parts are solved here or on a cluster, each in a file of its own, and taken up again after a kill.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import numpy as np
from rich.console import Console, Group
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from casadi_ik.api import Solver
from casadi_ik.batches.backend import check_installed
from casadi_ik.batches.parts import Asked, BatchFolder, code_version, columns, solve_parts
from casadi_ik.batches.targets import Source, TargetFile, source_of
from casadi_ik.cli import options as opt
from casadi_ik.cli.inputs import the_fixed, the_object_pose, the_robot, the_solver, the_start
from casadi_ik.cli.outputs import check_outputs, folder_of, say, write_output, writing
from casadi_ik.cli.report import counted, duration, fields, files, headline
from casadi_ik.cli.table import Answer, Said, command
from casadi_ik.files.shipped import resolve
from casadi_ik.files.writing import remove_stale
from casadi_ik.grasps.pose import moved
from casadi_ik.logs.format import plain

BLOCK = 4096
"""Targets in memory at once, at most."""

PART_SIZE = 20_000
"""Targets of a part unless said: a fraction of a second to a few seconds of one core."""

ROWS_SHOWN = 10
"""How many unsolved rows, and how many malformed ones, are named."""


@command(
    opt.Option(
        "TARGETS",
        "points and normals in an npz or Parquet file, or a folder of such files, see below",
    ),
    opt.needed(opt.ROBOT),
    *opt.SOLVER,
    opt.Option("--jobs N", "threads, or in parts processes", opt.whole(1), default=1),
    opt.out(
        "OUT",
        "write the solutions: to OUT.npz, or in parts into a folder (a name without suffix)",
        opt.npz_or_folder,
    ),
    opt.Option(
        "--dask ADDRESS",
        "solve in parts on a Dask cluster: what `dask scheduler` prints, tcp://HOST:8786 "
        "(needs casadi-ik[cluster])",
    ),
    opt.Option(
        "--resume", "solve in parts that survive a kill, and go on with those that are there"
    ),
    opt.Option("--part-size N", "targets of a part", opt.whole(1), otherwise=str(PART_SIZE)),
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
    A row that is no target (partly NaN, infinite, a zero normal) gets the status
    INVALID and NaN; it is named on stderr and does not stop the rest.

    In parts (--dask, --resume, --part-size, or files that are no npz) the finished
    ones stand in OUT, or beside OUT.npz until all are there; a kill costs those
    being solved, --resume does the rest.

    exit codes: 0 all solved, 1 not all solved, 2 bad input
    """
    path, file = Path(said.targets), said.out
    in_parts = said.dask is not None or said.resume or said.part_size is not None
    in_parts = in_parts or file.is_dir() or path.is_dir() or path.suffix.lower() == ".parquet"
    totals = _Totals()
    solver = (_solve_parts if in_parts else _solve_blocks)(said, path, totals)
    for fault in totals.first_faults:
        say("bad row", f"{path}: {fault}")
    if totals.faults:
        say("bad rows", f"{path}: {totals.faults} of {totals.count}; their status is INVALID")
    return Answer.solved(
        totals.solved == totals.count,
        _report(path.name, solver, totals, {"--log": said.log, "--out": file}),
    )


class _Totals:
    """What the report on a batch needs to know, gathered block by block.

    Attributes:
        count: Targets so far.
        solved: Of those, solved.
        statuses: How many of each status, by name.
        reasons: How many of each reason of a diagnosis, by name.
        efforts: Sum and largest number of iterations and restarts.
        missed: Numbers of the first targets that are not solved.
        faults: How many targets are malformed.
        first_faults: What is wrong with the first of them.
        times: Seconds of the targets, block by block; four bytes each are all that grows.
    """

    def __init__(self) -> None:
        self.count = self.solved = self.faults = 0
        self.statuses: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.efforts = {"iterations": (0, 0), "restarts": (0, 0)}
        self.missed: list[int] = []
        self.first_faults: list[str] = []
        self.times: list[np.ndarray] = []

    def add(self, arrays: Mapping[str, np.ndarray], first_row: int) -> None:
        """Count answers in: the arrays of `columns`, and the number of their first target."""
        success = arrays["success"]
        self.count += len(success)
        self.solved += int(success.sum())
        self.statuses.update(arrays["status"].tolist())
        self.reasons.update(filter(None, arrays.get("reason", np.zeros(0)).tolist()))
        for name, (total, most) in self.efforts.items():
            found = arrays[name]
            self.efforts[name] = total + int(found.sum()), max(most, int(found.max()))
        rows = first_row + np.flatnonzero(~success)
        self.missed += rows[: ROWS_SHOWN - len(self.missed)].tolist()
        self.times.append(arrays["time"].astype(np.float32))

    def note_faults(self, faults: Mapping[int, str]) -> None:
        """Take note of malformed targets: what is wrong, by number."""
        self.faults += len(faults)
        texts = [text for _, text in sorted(faults.items())]
        self.first_faults += texts[: ROWS_SHOWN - len(self.first_faults)]


def _report(name: str, solver: Solver, found: _Totals, written: dict[str, Path | None]) -> Group:
    count, solved, times = found.count, found.solved, np.concatenate(found.times)
    (iterations, most), (restarts, most_restarts) = found.efforts.values()
    rest = count - solved - len(found.missed)
    missed = f"rows {', '.join(map(str, found.missed))}" + (f" and {rest} more" if rest else "")
    pairs = {
        "status": ", ".join(f"{n} {status}" for status, n in sorted(found.statuses.items())),
        "iterations": f"mean {iterations / count:.1f}, most {most}",
        "time": f"mean {duration(float(times.mean()))}, 99th percentile "
        + duration(float(np.percentile(times, 99))),
        "collision": f"scene {solver.scene.name}" if solver.scene else "not checked",
        "restarts": f"mean {restarts / count:.2f}, most {most_restarts}" if restarts else "",
        "not solved": f"{missed} (from 0)" if solved < count else "",
        "reasons": ", ".join(f"{n} {reason}" for reason, n in sorted(found.reasons.items())),
    }
    status = "SOLVED" if solved == count else "NOT ALL SOLVED"
    share = f"{solved} of {counted(count, 'target')} ({100 * solved / count:.1f} %)"
    what = f"{share} of {name}: {solver.method} on {solver.robot.name}"
    return Group(headline(solved == count, status, what), fields(pairs), *files(written))


def _solve_blocks(said: Said, path: Path, totals: _Totals) -> Solver:
    """Solve an npz in this process.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
        KeyboardInterrupt: Ctrl-C; what was finished by then is written.
    """
    robot = the_robot(said.robot)
    q0, fixed = the_start(said, robot), the_fixed(said, robot)
    targets = TargetFile(path, len(robot.fingers))
    count = targets.check(BLOCK)
    check_outputs({"--log": said.log, "--out": said.out}, inputs=[path])
    pose, solver, pace = the_object_pose(said), the_solver(said, robot), _Pace(said.jobs)
    asked = targets.blocks(pace.begin)
    blocks = solver.solve_blocks(
        asked if pose is None else (moved(block, pose) for block in asked),
        q0,
        said.seed,
        said.jobs,
        said.log,
        said.diagnose,
        fixed,
        said.prefer,
    )
    with _growing_npz(said.out) as npz, closing(blocks), _progress(count) as show:
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
                say("interrupted", f"{said.out} keeps the first {npz.count} of {count} rows")
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


def _solve_parts(said: Said, path: Path, totals: _Totals) -> Solver:
    """Solve targets part by part.

    Raises:
        CasadiIKError: Bad input, an output that cannot be written, a cluster that is not there, or
            an extra that is not installed.
        KeyboardInterrupt: Ctrl-C; the finished parts stay.
    """
    file = said.out
    check_installed(said.dask)
    robot = the_robot(said.robot)
    q0, fixed = the_start(said, robot), the_fixed(said, robot)
    source = source_of(path, robot.fingers, said.part_size or PART_SIZE)
    count = source.count  # read before anything is written
    one_file = bool(file.suffix) and not file.is_dir()
    if one_file:
        check_outputs({"--out": file}, inputs=[each.path for each in source.files])
    solver, pose = the_solver(said, robot), the_object_pose(said)
    asked = Asked(q0, said.seed, said.diagnose, fixed, said.prefer, said.log is not None)
    folder = BatchFolder(file.with_name(f"{file.name}.parts") if one_file else file, said.log)
    with writing(folder.path, "--out"):
        folder.claim(_question(said, solver, source, asked), said.resume)
    done = folder.done()
    for number in done.intersection(range(len(source.sizes))):
        _answers(folder, source, number)  # before hours are spent on the rest
    before = sum(source.sizes[number] for number in done)
    faults: dict[int, str] = {}
    with _progress(count, before) as show, writing(folder.path, "--out"):
        parts = solve_parts(solver, source, asked, folder, said.jobs, said.dask, pose)
        try:
            for part in parts:
                faults |= part.faults
                show(part.count)
        except KeyboardInterrupt:
            kept = f"{folder.path} has {len(folder.done())} of {len(source.sizes)} parts"
            say("interrupted", f"{kept}; --resume goes on with them")
            raise
    totals.note_faults(faults)
    every = ((first, _answers(folder, source, i)) for i, first in enumerate(source.first_rows))
    if not one_file:
        for first_row, arrays in every:
            totals.add(arrays, first_row)
        return solver
    with _growing_npz(file) as npz:
        for first_row, arrays in every:
            npz.append(arrays)
            totals.add(arrays, first_row)
    folder.remove()
    return solver


def _answers(folder: BatchFolder, source: Source, number: int) -> dict[str, Any]:
    return folder.answers(number, source.first_rows[number], source.sizes[number])


def _question(said: Said, solver: Solver, source: Source, asked: Asked) -> dict[str, Any]:
    """Everything that decides the answers, so that no part of another batch is taken for ours."""
    scene = None
    if said.scene is not None:
        file = resolve(said.scene, "scenes")
        scene = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return {
        "code": code_version(),
        "targets": source.fingerprint,
        "part_size": source.size,
        "robot": hashlib.sha256(solver.robot.urdf().encode()).hexdigest()[:16],
        "solver": plain(solver.parameters),
        "scene": scene,
        "object_pose": plain(the_object_pose(said)),
        "q0": asked.q0,
        "seed": asked.seed,
        "diagnose": asked.diagnose,
        "fixed": asked.fixed,
        "prefer": asked.prefer,
        "log": None if said.log is None else str(said.log),
    }


@contextmanager
def _progress(count: int, done: int = 0) -> Iterator[Callable[[int], None]]:
    """How far it is: a bar on a terminal, elsewhere a line on stderr every ten seconds.

    Args:
        count: Targets in all.
        done: Of those, solved before.

    Yields:
        Moves it on by so many targets.
    """
    console, began = Console(file=sys.stderr), time.monotonic()
    total, last = done, began

    def rate() -> float:
        return (total - done) / max(time.monotonic() - began, 1e-9)

    def say_how_far(solved: int) -> None:
        nonlocal total, last
        total += solved
        if time.monotonic() - last < 10.0:
            return
        last = time.monotonic()
        text = f"{total:,} of {count:,} targets, {rate():,.0f} a second"
        if rate() > 0:
            minutes, seconds = divmod(round((count - total) / rate()), 60)
            left = f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
            text += f", {left if minutes else f'{seconds} s'} left"
        say("progress", text)

    def move_bar(solved: int) -> None:
        nonlocal total
        total += solved
        bar.update(task, completed=total, speed=f"{rate():,.0f}/s")

    if not console.is_terminal:
        yield say_how_far
        return
    speed = TextColumn("{task.fields[speed]}")
    parts = BarColumn(), MofNCompleteColumn(), speed, TimeRemainingColumn()
    with Progress(*parts, console=console, transient=True) as bar:
        task = bar.add_task("", total=count, completed=done, speed="")
        yield move_bar


class _GrowingNpz:
    """Arrays that grow on disk and become one npz; inside `_growing_npz`.

    Attributes:
        count: Rows so far, of every array.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        self.count = 0
        self._path, self._folder = path, folder
        self._streams: dict[str, IO[bytes]] = {}
        self._rows: dict[str, np.ndarray] = {}

    def append(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Append rows to the arrays, always the same ones.

        Raises:
            OutputError: They cannot be written.
        """
        with writing(self._path, "--out"):
            for name, array in arrays.items():
                if name not in self._streams:
                    self._streams[name] = (self._folder / name).open("wb")
                    self._rows[name] = array[:0]
                    self._head(name, 0)
                self._streams[name].write(array.tobytes())
        self.count += len(next(iter(arrays.values())))

    def close(self) -> None:
        """Give every array its number of rows; what an interrupted append began is cut off."""
        with writing(self._path, "--out"):
            for name, stream in self._streams.items():
                rows = self._rows[name]
                stream.seek(0)
                self._head(name, self.count)
                size = rows.dtype.itemsize * int(np.prod(rows.shape[1:]))
                stream.truncate(stream.tell() + self.count * size)
                stream.close()

    def write(self) -> None:
        """Put the npz in its place.

        Raises:
            OutputError: It cannot be written.
        """
        self.close()

        def zipped(part: Path) -> None:
            with zipfile.ZipFile(part, "w") as archive:
                for name in self._streams:
                    archive.write(self._folder / name, f"{name}.npy")

        write_output(self._path, "--out", zipped)

    def _head(self, name: str, count: int) -> None:
        """Write the header of an array of `count` rows; as long for any number of them."""
        rows = self._rows[name]
        header: dict[str, Any] = {
            "descr": np.lib.format.dtype_to_descr(rows.dtype),
            "fortran_order": False,
            "shape": (count, *rows.shape[1:]),
        }
        np.lib.format.write_array_header_1_0(self._streams[name], header)


@contextmanager
def _growing_npz(path: Path) -> Iterator[_GrowingNpz]:
    """An npz that appears when its arrays are complete; after Ctrl-C with the rows it had by then.

    Raises:
        OutputError: It cannot be written; nothing is left behind.
    """
    with writing(path, "--out"):
        remove_stale(folder_of(path), ".batch-*", 2)
        temporary = TemporaryDirectory(prefix=f".batch-{os.getpid()}-", dir=folder_of(path))
    with temporary as folder:
        arrays = _GrowingNpz(path, Path(folder))
        try:
            yield arrays
        except KeyboardInterrupt:
            if arrays.count:
                arrays.write()
            raise
        except BaseException:
            arrays.close()
            raise
        arrays.write()
