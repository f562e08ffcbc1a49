"""Batches in parts: workers solve parts, which are stored atomically, so a killed batch can resume.

Workers are processes of this machine or of a Dask cluster, both through joblib. Workers of a
cluster need the package and dask[distributed], but no shared folder.
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


CLUSTER_TIMEOUT = 30
"""Time to wait for a scheduler, and for its first worker [s]."""

REQUIRED_PACKAGES = ("casadi-ik", "casadi", "numpy", "joblib")
"""Packages whose versions must match on workers, because results depend on them."""


@contextmanager
def backend(
    jobs: int, dask: str | None, packages: tuple[str, ...] = REQUIRED_PACKAGES
) -> Iterator[Client | None]:
    """Select where joblib runs calls in this context.

    Args:
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers are used instead.
        packages: Packages whose versions must match on the workers.

    Yields:
        The client of the cluster; None: this machine.

    Raises:
        InputError: The scheduler does not answer or has no worker, or a package is missing or has
            another version on the scheduler or on a worker.
        UnsupportedError: joblib or Dask is not installed on this machine.
    """
    check_installed(dask)
    import joblib
    from joblib.externals.loky import get_reusable_executor

    if dask is None:
        with joblib.parallel_config(backend="loky", n_jobs=jobs):
            try:
                yield None
            except (KeyboardInterrupt, GeneratorExit):
                # Workers would otherwise finish their calls and wait for more.
                get_reusable_executor().shutdown(wait=False, kill_workers=True)
                raise
        return
    with _dask_loggers_disabled(), _client(dask) as client:
        _check_workers(client, dask, packages)
        with joblib.parallel_config(backend="dask"):
            yield client


@contextmanager
def _dask_loggers_disabled() -> Iterator[None]:
    """Disable the tracebacks that Dask logs for lost connections; relevant errors are raised."""
    # These loggers set their levels, so a level on a parent has no effect.
    loggers = [
        logging.getLogger(name)
        for name in list(logging.root.manager.loggerDict)
        if name.partition(".")[0] in ("asyncio", "distributed", "tornado")
    ]
    were_disabled = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        for logger, disabled in zip(loggers, were_disabled, strict=True):
            logger.disabled = disabled


def check_installed(cluster: str | None) -> None:
    """Check that joblib, and Dask for a cluster, are installed.

    Args:
        cluster: Address of a Dask scheduler; None: this machine.

    Raises:
        UnsupportedError: joblib or Dask is not installed on this machine.
    """
    try:
        import joblib  # noqa: F401
    except ImportError as error:
        raise UnsupportedError(
            "batches in parts (--resume, --part-size, --dask, Parquet, folders) need joblib: "
            "pip install joblib"
        ) from error
    if cluster is None:
        return
    try:
        import dask.distributed  # noqa: F401 - makes its loggers
    except ImportError as error:
        raise UnsupportedError("--dask needs Dask: pip install 'dask[distributed]'") from error


def _client(address: str) -> Client:
    """Return a client of the Dask scheduler at an address."""
    from dask.distributed import Client

    try:
        return Client(address, timeout=CLUSTER_TIMEOUT)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--dask {address}: found no scheduler ({error}); expected the address that "
            "`dask scheduler` prints, such as tcp://HOST:8786"
        ) from error


def _check_workers(client: Client, address: str, packages: tuple[str, ...]) -> None:
    """Check that all machines of a cluster have the versions of this one."""
    try:
        client.wait_for_workers(1, timeout=CLUSTER_TIMEOUT)
    except TimeoutError as error:
        raise InputError(
            f"--dask {address}: found no worker within {CLUSTER_TIMEOUT} s; expected at least one: "
            f"`dask worker {address}`"
        ) from error
    versions: Any = client.get_versions(packages=list(packages))
    expected = _version_text(versions["client"], packages)
    for machine, state in {**versions["workers"], "the scheduler": versions["scheduler"]}.items():
        if (actual := _version_text(state, packages)) != expected:
            raise InputError(f"--dask {address}: {machine} has {actual}; expected {expected}")


def _version_text(state: Mapping[str, Any], packages: tuple[str, ...]) -> str:
    """Return the versions of Python and packages as reported by Dask; "none" if one is missing."""
    packages_of_state = state["packages"]
    python = ".".join(packages_of_state["python"].split(".")[:2])
    return ", ".join(
        [f"python {python}", *(f"{name} {packages_of_state[name] or 'none'}" for name in packages)]
    )


MANIFEST_NAME = "batch.json"
"""Name of the file that describes the batch of a folder."""


@dataclass(frozen=True)
class EncodedPart:
    """A solved part as bytes, which need no folder shared with the worker.

    Attributes:
        number: Number of the part.
        count: Number of its targets.
        answers: An npz of the arrays of `columns`, with `row`, the number of each target in the
            batch.
        log: An MCAP log, if requested; solves are numbered as in the batch.
        faults: Problem of a target by its number in the batch.
    """

    number: int
    count: int
    answers: bytes
    log: bytes | None
    faults: dict[int, str]


def solve_part(
    solver: bytes,
    options: Mapping[str, Any],
    part: BatchPart,
    with_log: bool,
    temporary_folder: str | None = None,
) -> EncodedPart:
    """Solve a part.

    Args:
        solver: Pickled `Solver`; the unpickled one is cached for the next part.
        options: Options of `Solver.solve_blocks`, the same for all parts.
        part: The targets.
        with_log: Log every iteration.
        temporary_folder: Folder for temporary files; None: that of the system.
    """
    with tempfile.TemporaryDirectory(prefix="casadi_ik-part-", dir=temporary_folder) as folder:
        path = Path(folder) / "part.mcap" if with_log else None
        (block,) = _solver(solver).solve_blocks(
            [part.arrays], log=path, first_row=part.first_row, **options
        )
        log = None if path is None else path.read_bytes()
    answers = io.BytesIO()
    count = len(block.solution)
    rows = part.first_row + np.arange(count)
    np.savez(answers, allow_pickle=False, row=rows, **columns(block.solution))
    return EncodedPart(part.number, count, answers.getvalue(), log, dict(block.faults))


@lru_cache(maxsize=2)
def _solver(pickled: bytes) -> Solver:
    solver = pickle.loads(pickled)
    assert isinstance(solver, Solver)
    return solver


class BatchFolder:
    """Folder with the parts of one batch.

    A part is stored completely or not at all; a batch that is killed loses only the parts that
    were being solved.

    Attributes:
        path: Path of the folder.
        logs: Folder of the logs, one per part; None: no logs.
    """

    def __init__(self, path: Path, logs: Path | None = None) -> None:
        self.path, self.logs = path, logs

    def part(self, number: int) -> Path:
        """Return the path of the results of a part."""
        return self.path / f"part-{number:06d}.npz"

    def log(self, number: int) -> Path:
        """Return the path of the log of a part."""
        assert self.logs is not None
        return self.logs / f"part-{number:06d}.mcap"

    def claim(self, batch: Mapping[str, Any], resume: bool) -> None:
        """Start a batch in the folder, or resume it.

        Args:
            batch: Everything that determines the results, as JSON values.
            resume: Accept parts that are stored already.

        Raises:
            InputError: The folder holds another batch or other files, or it holds this batch and
                `resume` is false.
            OSError: The folder cannot be written.
        """
        manifest = json.loads(json.dumps({"format": 1, **batch}))
        path = self.path / MANIFEST_NAME
        if path.exists():
            try:
                stored = json.loads(path.read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise InputError(f"{path}: cannot be read: {error}") from error
            if not isinstance(stored, dict):
                raise InputError(f"{path}: found {type(stored).__name__}, expected an object")
            for key, value in manifest.items():
                if stored.get(key) != value:
                    raise InputError(
                        f"{path}: {key}: parts have {_shortened_json(stored.get(key))}, this "
                        f"batch has {_shortened_json(value)}; expected the same, or another --out"
                    )
            if not resume:
                raise InputError(
                    f"{self.path}: holds parts of this batch; expected --resume to continue, or "
                    "another --out"
                )
        elif self.path.is_dir() and any(self.path.iterdir()):
            raise InputError(
                f"{self.path}: holds files but no {MANIFEST_NAME}; expected a new folder"
            )
        for folder in filter(None, (self.path, self.logs)):
            folder.mkdir(parents=True, exist_ok=True)
            remove_stale(folder, ".part-*")
        if not path.exists():
            with atomic_write(path) as temporary:
                temporary.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")

    def done(self) -> set[int]:
        """Return the numbers of the stored parts."""
        return {
            int(path.stem.removeprefix("part-"))
            for path in self.path.glob("part-*.npz")
            if path.stem.removeprefix("part-").isdigit()
        }

    def store(self, solved: EncodedPart) -> None:
        """Store a part; its log is written first, so that a stored part is complete.

        Raises:
            OSError: A file cannot be written.
        """
        if solved.log is not None:
            with atomic_write(self.log(solved.number)) as part:
                part.write_bytes(solved.log)
        with atomic_write(self.part(solved.number)) as part:
            part.write_bytes(solved.answers)

    def answers(self, number: int, first_row: int, count: int) -> dict[str, np.ndarray]:
        """Return the arrays of a part.

        Args:
            number: Number of the part.
            first_row: Number of its first target in the batch.
            count: Number of its targets.

        Raises:
            InputError: The file is damaged, or belongs to other targets.
        """
        path = self.part(number)
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: file is damaged ({error}); remove it and resume") from error
        rows = arrays.pop("row", np.zeros(0))
        if not np.array_equal(rows, first_row + np.arange(count)):
            contents = f"{len(rows)} targets from {rows[0]} on" if len(rows) else "no row"
            raise InputError(
                f"{path}: row: found {contents}, expected {count} targets from "
                f"{first_row} on; remove it and resume"
            )
        return arrays

    def remove(self) -> None:
        """Remove the parts, and the folders unless they hold other files."""
        for number in self.done():
            self.part(number).unlink()
        (self.path / MANIFEST_NAME).unlink()
        for folder in filter(None, (self.path, self.logs)):
            if not any(folder.iterdir()):
                folder.rmdir()


def _shortened_json(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:70]}..."


def solve_parts(
    solver: Solver,
    source: TargetSource,
    options: Mapping[str, Any],
    folder: BatchFolder,
    jobs: int = 1,
    dask: str | None = None,
    object_pose: Array | None = None,
) -> Iterator[EncodedPart]:
    """Solve and store the missing parts; yield them in the order in which they finish.

    Args:
        solver: The solver; it is sent to the workers.
        source: The targets.
        options: Options of `Solver.solve_blocks`, the same for all parts.
        folder: Folder of the parts and logs, claimed already.
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers are used instead. If a worker dies, its part
            is solved again by another one.
        object_pose: (4, 4) Pose of the object in whose frame the targets are given; None: targets
            are in the base frame.

    Yields:
        The stored parts.

    Raises:
        InputError: A file of targets is damaged, or the cluster cannot be used or was lost;
            finished parts remain in the folder.
        OSError: A part cannot be stored.
    """
    done = folder.done()
    if len(done.intersection(range(len(source.sizes)))) == len(source.sizes):
        return
    pickled = pickle.dumps(solver)
    # The folder is removed even if local workers are killed in the middle of a part.
    with (
        tempfile.TemporaryDirectory(prefix="casadi_ik-parts-") as worker_folder,
        backend(jobs, dask),
    ):
        import joblib

        # A batch of several calls would return, or be lost, as a whole. The type is Any because
        # joblib annotates this argument as the literal "auto".
        batch_size: Any = 1
        parallel = joblib.Parallel(return_as="generator_unordered", batch_size=batch_size)
        parts = source.remaining_parts(done)
        if object_pose is not None:
            parts = (
                replace(part, arrays=transform_arrays(part.arrays, object_pose)) for part in parts
            )
        log_options = folder.logs is not None, worker_folder if dask is None else None
        calls = (joblib.delayed(solve_part)(pickled, options, part, *log_options) for part in parts)
        solved = iter(parallel(calls))
        while True:
            try:
                encoded = next(solved)
            except StopIteration:
                return
            except CasadiIKError:
                raise
            except Exception as error:
                if dask is None:
                    raise
                raise InputError(
                    f"--dask {dask}: the cluster was lost ({type(error).__name__}: {error}); "
                    f"{folder.path} has {len(folder.done())} of {len(source.sizes)} parts, "
                    "--resume continues with them"
                ) from error
            assert isinstance(encoded, EncodedPart)
            folder.store(encoded)
            yield encoded


STATUS_DTYPE = np.dtype(f"<U{max(len(status.name) for status in Status)}")
"""Data type of status names, as wide as the longest."""

REASON_DTYPE = np.dtype("<U9")
"""Data type of reasons; "" without a diagnosis."""


def columns(solution: BatchSolution) -> dict[str, np.ndarray]:
    """Return the arrays of a block in the form in which they are stored, one row per target."""
    arrays: dict[str, np.ndarray] = {
        "q": solution.q,
        "success": solution.success,
        "status": solution.status_names.astype(STATUS_DTYPE),
        "position_error": solution.position_error,
        "angle_error": solution.angle_error,
        "iterations": solution.iterations,
        "restarts": solution.restarts,
        "time": solution.time,
    }
    if solution.clearance is not None:
        arrays["clearance"] = solution.clearance
    if solution.diagnoses:
        arrays |= _diagnoses(solution.diagnoses, solution.q.shape[1])
    return arrays


def _diagnoses(diagnoses: tuple[Diagnosis | None, ...], n: int) -> dict[str, np.ndarray]:
    """Return diagnoses as arrays by name; rows without a diagnosis are empty or NaN."""
    count = len(diagnoses)
    arrays = {
        "reason": np.zeros(count, dtype=REASON_DTYPE),
        "nearest_q": np.full((count, n), np.nan),
        "enough_position": np.full(count, np.nan),
        "enough_angle": np.full(count, np.nan),
    }
    for row, diagnosis in enumerate(diagnoses):
        if diagnosis is not None:
            values = (
                diagnosis.reason.name,
                diagnosis.q,
                diagnosis.enough.position,
                diagnosis.enough.angle,
            )
            for array, value in zip(arrays.values(), values, strict=True):
                array[row] = value
    return arrays


@cache
def code_version() -> str:
    """Return the version of the package with a digest of the sources that determine results."""
    excluded_folders = ("app", "export", "integrations", "logs")
    digest = hashlib.sha256()
    root = Path(str(files("casadi_ik")))
    for path in sorted(path for pattern in ("*.py", "*.c") for path in root.rglob(pattern)):
        name = path.relative_to(root)
        if name.parts[0] not in excluded_folders:
            digest.update(name.as_posix().encode() + b"\0" + path.read_bytes())
    return f"{version('casadi-ik')}+{digest.hexdigest()[:12]}"
