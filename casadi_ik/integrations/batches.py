"""Batches in parts: each solved by a worker, stored whole, and gone on with after a kill.

Workers are processes of this machine, or of a Dask cluster, both through joblib. Those of a
cluster need the installed package and its extra `cluster`, and no folder in common with who asks.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import pickle
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.errors import CasadiIKError, InputError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.files.writing import atomic_write, remove_stale
from casadi_ik.model.pose import transform_arrays
from casadi_ik.solve.diagnosis import Diagnosis
from casadi_ik.solve.solution import BatchSolution
from casadi_ik.solve.status import Status
from casadi_ik.solve.target_files import BatchPart, TargetSource

if TYPE_CHECKING:
    from dask.distributed import Client


PATIENCE = 30
"""Seconds to wait for a scheduler to answer, and for a first worker to be there."""

PACKAGES = ("casadi-ik", "casadi", "numpy", "joblib")
"""What answers depend on, or what is needed to come to any."""


@contextmanager
def backend(
    jobs: int, dask: str | None, packages: tuple[str, ...] = PACKAGES
) -> Iterator[Client | None]:
    """Where joblib's calls go meanwhile.

    Args:
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead.
        packages: Which packages they have to have in the versions that are here.

    Yields:
        The client of the cluster; None: it is this machine.

    Raises:
        InputError: No scheduler answers, it has no worker, or a worker has not what is needed.
        UnsupportedError: joblib or Dask is not installed here.
    """
    check_installed(dask)
    import joblib
    from joblib.externals.loky import get_reusable_executor

    if dask is None:
        with joblib.parallel_config(backend="loky", n_jobs=jobs):
            try:
                yield None
            except (KeyboardInterrupt, GeneratorExit):
                # By themselves they would finish what they have and wait for more.
                get_reusable_executor().shutdown(wait=False, kill_workers=True)
                raise
        return
    with _quiet(), _client(dask) as client:
        _check(client, dask, packages)
        with joblib.parallel_config(backend="dask"):
            yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask from printing tracebacks of lost connections; what matters is raised."""
    # They have levels of their own, so that it does not help to set one above them.
    loggers = [
        logging.getLogger(name)
        for name in list(logging.root.manager.loggerDict)
        if name.partition(".")[0] in ("asyncio", "distributed", "tornado")
    ]
    before = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def check_installed(cluster: str | None) -> None:
    """See to it that there is what parts need.

    Args:
        cluster: Address of a Dask scheduler; None: this machine.

    Raises:
        UnsupportedError: joblib or Dask is not installed here.
    """
    try:
        import joblib  # noqa: F401
    except ImportError as error:
        raise UnsupportedError(
            "batches in parts (--resume, --part-size, --dask, Parquet, folders) need joblib: "
            "pip install 'casadi-ik[cluster]'"
        ) from error
    if cluster is None:
        return
    try:
        import dask.distributed  # noqa: F401 - makes its loggers
    except ImportError as error:
        raise UnsupportedError("--dask: needs Dask: pip install 'casadi-ik[cluster]'") from error


def _client(address: str) -> Client:
    from dask.distributed import Client

    try:
        return Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--dask {address}: found no scheduler ({error}), expected the address that "
            "`dask scheduler` prints, such as tcp://HOST:8786"
        ) from error


def _check(client: Client, address: str, packages: tuple[str, ...]) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError as error:
        raise InputError(
            f"--dask {address}: found no worker within {PATIENCE} s, expected at least one: "
            f"`dask worker {address}`"
        ) from error
    found: Any = client.get_versions(packages=list(packages))
    mine = _installed(found["client"], packages)
    for place, state in {**found["workers"], "the scheduler": found["scheduler"]}.items():
        if (theirs := _installed(state, packages)) != mine:
            raise InputError(f"--dask {address}: {place} has {theirs}, expected {mine} as here")


def _installed(state: Mapping[str, Any], packages: tuple[str, ...]) -> str:
    """Python and packages with their versions as Dask tells them; "none" of what is not there."""
    found = state["packages"]
    python = ".".join(found["python"].split(".")[:2])
    return ", ".join([f"python {python}", *(f"{one} {found[one] or 'none'}" for one in packages)])


MANIFEST = "batch.json"
"""Name of the file that says what a folder's parts are answers to."""


@dataclass(frozen=True)
class SolvedPart:
    """A part, solved; bytes, so that a worker needs no folder in common with who asked.

    Attributes:
        number: Of the part.
        count: Targets of it.
        answers: An npz of the arrays of `columns`, and `row`, each target's number among all.
        log: An MCAP log, if one was asked for; solves are numbered as among all targets.
        faults: What is wrong with a target, by its number among all.
    """

    number: int
    count: int
    answers: bytes
    log: bytes | None
    faults: dict[int, str]


def solve_part(
    solver: bytes, asked: Mapping[str, Any], part: BatchPart, logged: bool, place: str | None = None
) -> SolvedPart:
    """Solve a part.

    Args:
        solver: A pickled `Solver`; what it is made to is kept for the next part.
        asked: What is asked of all parts alike, as `Solver.solve_blocks` takes it.
        part: Its targets.
        logged: Whether every iteration is logged.
        place: Folder for what is there meanwhile; None: that of the system.
    """
    with tempfile.TemporaryDirectory(prefix="casadi_ik-part-", dir=place) as folder:
        path = Path(folder) / "part.mcap" if logged else None
        (block,) = _solver(solver).solve_blocks(
            [part.arrays], log=path, first_row=part.first_row, **asked
        )
        log = None if path is None else path.read_bytes()
    answers = io.BytesIO()
    count = len(block.solution)
    numbers = part.first_row + np.arange(count)
    np.savez(answers, allow_pickle=False, row=numbers, **columns(block.solution))
    return SolvedPart(part.number, count, answers.getvalue(), log, dict(block.faults))


@lru_cache(maxsize=2)
def _solver(pickled: bytes) -> Solver:
    solver = pickle.loads(pickled)
    assert isinstance(solver, Solver)
    return solver


class BatchFolder:
    """Parts of one batch.

    A part is there whole or not at all: whoever is killed loses what was being solved.

    Attributes:
        path: The folder.
        logs: The folder of the logs, one per part; None: there are none.
    """

    def __init__(self, path: Path, logs: Path | None = None) -> None:
        self.path, self.logs = path, logs

    def part(self, number: int) -> Path:
        """Where the answers of a part stand."""
        return self.path / f"part-{number:06d}.npz"

    def log(self, number: int) -> Path:
        """Where its log stands."""
        assert self.logs is not None
        return self.logs / f"part-{number:06d}.mcap"

    def claim(self, question: Mapping[str, Any], resume: bool) -> None:
        """Take the folder for a batch, or go on with it.

        Args:
            question: Everything that decides the answers, as JSON holds it.
            resume: Whether parts may be there already.

        Raises:
            InputError: It holds something else, or parts though `resume` is false.
            OSError: It cannot be written.
        """
        mine = json.loads(json.dumps({"format": 1, **question}))
        path = self.path / MANIFEST
        if path.exists():
            try:
                kept = json.loads(path.read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise InputError(f"{path}: cannot be read: {error}") from error
            if not isinstance(kept, dict):
                raise InputError(f"{path}: found {type(kept).__name__}, expected an object")
            for key, value in mine.items():
                if kept.get(key) != value:
                    raise InputError(
                        f"{path}: {key}: these parts were made with {_brief(kept.get(key))}, this "
                        f"batch has {_brief(value)}; expected the same, or another --out"
                    )
            if not resume:
                raise InputError(
                    f"{self.path}: holds parts of this batch, expected --resume to go on with "
                    "them, or another --out"
                )
        elif self.path.is_dir() and any(self.path.iterdir()):
            raise InputError(f"{self.path}: holds files but no {MANIFEST}, expected a new folder")
        for folder in filter(None, (self.path, self.logs)):
            folder.mkdir(parents=True, exist_ok=True)
            remove_stale(folder, ".part-*")
        if not path.exists():
            with atomic_write(path) as part:
                part.write_text(json.dumps(mine, indent=1) + "\n", encoding="utf-8")

    def done(self) -> set[int]:
        """Numbers of the parts that are there."""
        return {
            int(path.stem.removeprefix("part-"))
            for path in self.path.glob("part-*.npz")
            if path.stem.removeprefix("part-").isdigit()
        }

    def store(self, solved: SolvedPart) -> None:
        """Put what came of a part into its place: the log first, so that what is there is whole.

        Raises:
            OSError: It cannot be written.
        """
        if solved.log is not None:
            with atomic_write(self.log(solved.number)) as part:
                part.write_bytes(solved.log)
        with atomic_write(self.part(solved.number)) as part:
            part.write_bytes(solved.answers)

    def answers(self, number: int, first_row: int, count: int) -> dict[str, np.ndarray]:
        """The arrays of a part.

        Args:
            number: Of the part.
            first_row: Number of its first target among all.
            count: Targets of it.

        Raises:
            InputError: Its file is damaged, or has the answers to other targets.
        """
        path = self.part(number)
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: damaged ({error}); remove it and go on") from error
        rows = arrays.pop("row", np.zeros(0))
        if not np.array_equal(rows, first_row + np.arange(count)):
            found = f"{len(rows)} targets from {rows[0]} on" if len(rows) else "no row"
            raise InputError(
                f"{path}: row: found {found}, expected {count} targets from "
                f"{first_row} on; remove it and go on"
            )
        return arrays

    def remove(self) -> None:
        """Remove the parts, and the folders if there is nothing else in them."""
        for number in self.done():
            self.part(number).unlink()
        (self.path / MANIFEST).unlink()
        for folder in filter(None, (self.path, self.logs)):
            if not any(folder.iterdir()):
                folder.rmdir()


def _brief(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:70]}..."


def solve_parts(
    solver: Solver,
    source: TargetSource,
    asked: Mapping[str, Any],
    folder: BatchFolder,
    jobs: int = 1,
    dask: str | None = None,
    object_pose: Array | None = None,
) -> Iterator[SolvedPart]:
    """Solve what is missing and put it into its place; in the order in which parts are finished.

    Args:
        solver: The solver; it travels to the workers.
        source: The targets.
        asked: What is asked of all parts alike, as `Solver.solve_blocks` takes it.
        folder: Where parts are and go, with their logs if it has a place for them; claimed already.
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead. A worker that dies costs
            what it was solving, which others do again.
        object_pose: (4, 4) where the object is in whose frame the targets are; None: they are in
            the base frame.

    Yields:
        The parts, stored.

    Raises:
        InputError: A file of targets is damaged, or the cluster cannot be used or went away; what
            is finished by then is in the folder.
        OSError: A part cannot be stored.
    """
    done = folder.done()
    if len(done.intersection(range(len(source.sizes)))) == len(source.sizes):
        return
    pickled = pickle.dumps(solver)
    # Removed with all in it, also if workers of this machine are killed in the middle of a part.
    with tempfile.TemporaryDirectory(prefix="casadi_ik-parts-") as own, backend(jobs, dask):
        import joblib

        # A batch of calls would come back, and be lost, as a whole; joblib's annotation of this
        # argument knows the word "auto" only.
        one: Any = 1
        parallel = joblib.Parallel(return_as="generator_unordered", batch_size=one)
        parts = source.without(done)
        if object_pose is not None:
            parts = (
                replace(part, arrays=transform_arrays(part.arrays, object_pose)) for part in parts
            )
        how = folder.logs is not None, own if dask is None else None
        calls = (joblib.delayed(solve_part)(pickled, asked, part, *how) for part in parts)
        solved = iter(parallel(calls))
        while True:
            try:
                ended = next(solved)
            except StopIteration:
                return
            except CasadiIKError:
                raise
            except Exception as error:
                if dask is None:
                    raise
                raise InputError(
                    f"--dask {dask}: the cluster went away ({type(error).__name__}: {error}); "
                    f"{folder.path} has {len(folder.done())} of {len(source.sizes)} parts, "
                    "--resume goes on with them"
                ) from error
            assert isinstance(ended, SolvedPart)
            folder.store(ended)
            yield ended


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
    found = {
        "reason": np.zeros(count, dtype=REASON),
        "nearest_q": np.full((count, n), np.nan),
        "enough_position": np.full(count, np.nan),
        "enough_angle": np.full(count, np.nan),
    }
    for row, each in enumerate(diagnoses):
        if each is not None:
            values = each.reason.name, each.q, each.enough.position, each.enough.angle
            for array, value in zip(found.values(), values, strict=True):
                array[row] = value
    return found


@cache
def code_version() -> str:
    """Version of the package and a digest of the sources that decide a result."""
    without_influence = ("app", "export", "integrations", "logs")
    digest = hashlib.sha256()
    root = Path(str(files("casadi_ik")))
    for path in sorted(path for pattern in ("*.py", "*.c") for path in root.rglob(pattern)):
        name = path.relative_to(root)
        if name.parts[0] not in without_influence:
            digest.update(name.as_posix().encode() + b"\0" + path.read_bytes())
    return f"{version('casadi-ik')}+{digest.hexdigest()[:12]}"
