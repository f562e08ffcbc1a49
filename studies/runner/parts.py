"""Parts of a study, each done once: here or on a Dask cluster, kept when complete."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import joblib
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.progress import TimeRemainingColumn as TimeRemaining
from rich.text import Text

from casadi_ik.integrations import batches as places
from casadi_ik.integrations.batches import code_version

PART = ".part"
"""Ending of a file that is not complete."""

STUDIES = Path(__file__).parents[1]
PACKAGES = (*places.REQUIRED_PACKAGES, "polars")


class Part(Protocol):
    """Targets that are solved in one call.

    Attributes:
        path: Where their results are, relative to the study's folder.
        size: How many there are.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102

    @property
    def size(self) -> float: ...  # noqa: D102


P = TypeVar("P", bound=Part)


def solved(
    solve: Callable[[P], Any],
    parts: Sequence[P],
    jobs: int = 1,
    dask: str | None = None,
    title: str = "targets",
    until: float = float("inf"),
) -> Iterator[tuple[P, Any]]:
    """Parts and what came of them, in the order in which they are done.

    Args:
        solve: A function at the top of a module, so that other processes can call it.
        parts: What it is called with.
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead.
        title: Of the progress bar.
        until: No part is begun after this time [s, `time.monotonic`].

    Raises:
        InputError: The cluster cannot be used.
    """
    if not parts:
        return
    script = getattr(sys.modules["__main__"], "__file__", "")
    if jobs > 1 and dask is None and solve.__module__ == "__main__" and script:
        # What the script keeps by `functools.cache` other processes can only import.
        solve = getattr(import_module(Path(script).stem), solve.__name__)
    with backend(jobs, dask), _progress() as progress:
        task = progress.add_task(title, total=sum(part.size for part in parts))
        parallel: Any = joblib.Parallel(return_as="generator_unordered")
        begun = (part for part in parts if time.monotonic() < until)
        for part, result in parallel(joblib.delayed(_solve_with)(solve, part) for part in begun):
            yield part, result
            progress.advance(task, part.size)


def run_parts(
    solve: Callable[[P], dict[str, Any]], parts: Iterable[P], folder: Path, **options: Any
) -> None:
    """Solve the parts that a folder does not have, and keep each as JSON as soon as it is done.

    A run that is killed loses the parts being solved and nothing else; the next one goes on.

    Args:
        solve: See `solved`; what it returns can be written as JSON.
        parts: All parts.
        folder: Where their files are and go.
        options: The other arguments of `solved`.
    """
    todo = [part for part in parts if not (folder / part.path).exists()]
    for part, result in solved(solve, todo, **options):
        keep(folder / part.path, json.dumps({"code": code_version(), "found": result}))


def read_parts(folder: Path, parts: Iterable[P]) -> tuple[list[tuple[P, dict[str, Any]]], str]:
    """Return the completed parts with their results, and the versions of the code."""
    done_parts = [part for part in parts if (folder / part.path).exists()]
    stored = [json.loads((folder / part.path).read_text(encoding="utf-8")) for part in done_parts]
    codes = ", ".join(sorted({entry["code"] for entry in stored}))
    return [(part, entry["found"]) for part, entry in zip(done_parts, stored, strict=True)], codes


def add_part_options(parser: argparse.ArgumentParser, name: str, report_folder: Path) -> None:
    """Add the options of a study whose parts are stored in one folder and reported in another."""
    parser.add_argument("--seed", type=int, default=0, help="seed of all random numbers")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start nothing after")
    parser.add_argument("--parts", type=Path, default=Path("out") / name, help="results of parts")
    parser.add_argument("--out", type=Path, default=report_folder, help="folder of the report")


@dataclass(frozen=True)
class PartResults(Generic[P]):
    """Results of the parts that are complete.

    Attributes:
        done: Parts with their results.
        codes: Versions of the code that made them.
        note: Sentence on missing parts, as a list that is empty if all are complete.
    """

    done: list[tuple[P, dict[str, Any]]]
    codes: str
    note: list[str]


def complete_parts(
    solve: Callable[[P], dict[str, Any]],
    parts: Sequence[P],
    options: argparse.Namespace,
    title: str = "targets",
) -> PartResults[P]:
    """Solve parts for the time that the options allow, and return all complete ones.

    Args:
        solve: See `run_parts`.
        parts: All parts.
        options: Values of the options that `add_part_options` adds.
        title: Noun for the parts in the progress bar and in the note.
    """
    until = time.monotonic() + 60 * options.minutes
    run_parts(solve, parts, options.parts, jobs=options.jobs, until=until, title=title)
    done, codes = read_parts(options.parts, parts)
    note = [f"Of {len(parts):,} {title} {len(done):,} are done so far."]
    return PartResults(done, codes, note if len(done) < len(parts) else [])


def keep(path: Path, content: str | bytes) -> None:
    """Write a file that is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}-{os.getpid()}{PART}")
    part.write_bytes(content.encode() if isinstance(content, str) else content)
    part.replace(path)


def _solve_with(solve: Callable[[P], Any], part: P) -> tuple[P, Any]:
    return part, solve(part)


class _Rate(ProgressColumn):
    """Solves per second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.0f} solves/s")


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate())
    return Progress(*columns, TimeRemaining(), console=Console(stderr=True))


@contextmanager
def backend(jobs: int, dask: str | None) -> Iterator[None]:
    """Run calls of joblib here or on a cluster; see `casadi_ik.integrations.batches`.

    A cluster needs the installed package with its extra `dev` and nothing else: the study's own
    modules are sent to it, and what its workers solve comes back as bytes.

    Args:
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead.

    Raises:
        InputError: No scheduler answers, it has no worker, or a worker has not what is needed.
    """
    with places.backend(jobs, dask, PACKAGES) as client, tempfile.TemporaryDirectory() as place:
        if client is not None:
            modules = Path(place) / "casadi_ik_study.zip"
            _pack(modules)
            client.upload_file(str(modules))
        yield


def _pack(path: Path) -> None:
    """Write a zip of the imported modules of studies, without the script itself."""
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted({Path(name).resolve() for name in files if name}):
            if file.is_relative_to(STUDIES) and str(file) != getattr(
                sys.modules["__main__"], "__file__", ""
            ):
                archive.write(file, file.relative_to(STUDIES))
