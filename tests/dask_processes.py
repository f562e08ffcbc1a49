"""Scheduler and workers of Dask as processes, started like in its documentation."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import casadi_ik as ik

SCHEDULER = ("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show")
WORKER = ("--nthreads", "1", "--no-dashboard", "--no-nanny")


@contextmanager
def dask_process(*words: str, says: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a process of Dask's command line, and return it with the line that reports its start.

    It runs in another folder and imports the installed package only.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=Path(ik.__file__).parents[1] / "casadi_ik",
        env=os.environ | {"PYTHONPATH": str(Path(ik.__file__).parents[1])},
    )
    assert process.stdout is not None
    try:
        yield process, next(line for line in process.stdout if says in line)
        # Later output must not fill the pipe.
    finally:
        process.terminate()
        process.communicate(timeout=180)


@contextmanager
def scheduler_process() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a scheduler without workers, and return its address."""
    with dask_process(*SCHEDULER, says="Scheduler at:") as (process, line):
        yield process, line.split()[-1]


@contextmanager
def worker_process(address: str) -> Iterator[subprocess.Popen[str]]:
    """Start a worker of one thread, and wait until the scheduler knows it."""
    with dask_process("worker", address, *WORKER, says="Registered to:") as (process, _):
        yield process
