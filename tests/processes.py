"""Processes of Python and of other programs, and limits of resources."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

POSIX = pytest.mark.skipif(os.name != "posix", reason="needs signals or devices of POSIX")
"""Mark of tests that send signals, limit resources or open devices."""

NOT_ROOT = pytest.mark.skipif(
    os.name != "posix" or os.geteuid() == 0, reason="needs permissions of POSIX that apply"
)
"""Mark of tests of files that may not be read or written."""

ROOT = Path(__file__).parents[1]
MODELS = ROOT / "models"


NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}
"""Environment of processes with a limit, which would truncate the bytecode of modules."""


def at_most(size: int) -> Callable[[], None]:
    """Return a function that limits the size of the files of a process [bytes]."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Limit the size of the files of this process [bytes], like a disk that is almost full."""
    import resource

    size_before, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    at_most(size)()
    try:
        yield
    finally:
        at_most(size_before)()


def python(*words: object, path: object = ROOT, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python with a file, `-m` and a module, or `-c` and a program; return its result.

    Args:
        words: Of its command line; a text may be indented.
        path: Where it finds casadi_ik, and what else it imports.
        options: As `subprocess.run` has them; `env` is what differs from this process.
    """
    changed = {"PYTHONPATH": str(path)} | options.pop("env", {})
    run_options = {
        "capture_output": True,
        "text": True,
        "timeout": 600,
        "env": os.environ | changed,
    }
    return subprocess.run(
        [sys.executable, *(textwrap.dedent(str(word)) for word in words)], **run_options | options
    )


def output_of(*words: object, **options: Any) -> str:
    """Return the output of a program that must succeed; options as in `subprocess.run`.

    Raises:
        AssertionError: It does not; the message is what it said.
    """
    done = subprocess.run(list(map(str, words)), capture_output=True, **options)
    assert done.returncode == 0, (done.stdout + done.stderr).decode()[:2000]
    return done.stdout.decode()
