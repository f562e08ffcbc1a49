"""Small kernels in a cache of compiled libraries, and faulty compilers."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import casadi as ca
import pytest

from casadi_ik.compile import (
    FunctionKernel,
    compiler,
)
from casadi_ik.compile.graphs import FunctionGraph

POSIX = pytest.mark.skipif(os.name != "posix", reason="owners and modes are POSIX's")


def scaled(factor: float = 2.0, name: str = "scaled") -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function(name, [x], [factor * x])


def kernel(build: Callable[[], ca.Function] = scaled, key: str = "recipe") -> FunctionKernel:
    """Build a small kernel with a recipe; it leaves a library and a note."""
    return FunctionKernel(FunctionGraph("scaled", build, {"x": (1, 1)}, ((1, 1),), key))


def works() -> bool:
    built_kernel = kernel()
    return built_kernel.compiled and built_kernel(3)[0] == 6


def never() -> ca.Function:
    raise AssertionError("the graph was built")


def cached_files(directory: Path, suffix: str) -> list[Path]:
    return sorted(directory.glob(f"*{suffix}"))


@contextmanager
def script(text: str, **changed: str) -> Iterator[subprocess.Popen[str]]:
    """Start another process that runs a program, with pipes."""
    root = str(Path(__file__).parents[2])
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(text)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": root} | changed,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def lie(directory: Path, monkeypatch: pytest.MonkeyPatch, property_name: str) -> None:
    """Set a compiler that runs a shell command after the real one has made the library $out."""
    real = compiler.find_compiler()
    assert real is not None
    path = directory.parent / "lying cc"
    path.write_text(
        f'#!/bin/sh\n{real.command[0]} "$@" || exit\n'
        'case "$*" in *--version*) exit;; esac\n'
        'while [ "$1" != -o ]; do shift; done; out=$2\n'
        f"{property_name}\n"
    )
    path.chmod(0o700)
    monkeypatch.setenv("CC", f'"{path}"')


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def age(path: Path, seconds: float) -> None:
    then = time.time() - seconds
    for old in (*path.glob("*"), path):
        os.utime(old, (then, then))
