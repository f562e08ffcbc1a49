"""Runs what is missing of a study, here or on a Dask cluster."""

from __future__ import annotations

from pathlib import Path

import joblib
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.progress import TimeRemainingColumn as TimeRemaining
from rich.text import Text

from casadi_ik.logs import Keep
from runner.block import SolvedBlock, solve_block, store
from runner.cluster import backend
from runner.results import claim, missing
from runner.study import Study


def run(
    study: Study, folder: Path, jobs: int = 1, dask: str | None = None, keep: Keep | None = None
) -> None:
    """Solve what is missing.

    Args:
        study: The study.
        folder: Where its results are and go: one file per block. A run that is killed loses the
            blocks being solved and nothing else; the next one goes on.
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead; they need the installed
            package with its extra `studies`, and neither this folder nor this script.
        keep: What to log, in one file per block; None: no logs.

    Raises:
        InputError: The folder holds results that were made otherwise, or the cluster cannot be
            used.
    """
    claim(study, folder)
    todo = missing(study, folder)
    if not todo:
        return
    with backend(jobs, dask), _progress() as progress:
        task = progress.add_task(study.name, total=sum(block.size for block in todo))
        parallel = joblib.Parallel(return_as="generator_unordered")
        calls = (joblib.delayed(solve_block)(study, block, keep) for block in todo)
        for solved in parallel(calls):
            assert isinstance(solved, SolvedBlock)
            store(solved, folder)
            progress.advance(task, solved.block.size)


class _Rate(ProgressColumn):
    """Solves per second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.0f} solves/s")


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate())
    return Progress(*columns, TimeRemaining(), console=Console(stderr=True))
