"""Interrupted and killed compilations, and forks during a build."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import threading
import warnings
from contextlib import suppress

import casadi as ca
import pytest

from casadi_ik.compile import (
    FunctionKernel,
)
from casadi_ik.compile.graphs import FunctionGraph

from .graphs import needs_compiler
from .library_cases import POSIX, age, kernel, lie, scaled, script, works


class Pressed:
    """Value that raises SIGINT while CasADi converts it."""

    def __SX__(self) -> ca.SX:
        signal.raise_signal(signal.SIGINT)
        return ca.SX(1)


@needs_compiler
@pytest.mark.parametrize("moment", ["graph", "compiler"])
def test_ctrl_c_leaves_no_files(directory, monkeypatch, moment):
    def build() -> ca.Function:
        with suppress(TypeError):
            _ = ca.SX.sym("x") * Pressed()  # type: ignore[operator]
        return scaled()

    if moment == "compiler":
        lie(directory, monkeypatch, "kill -INT $PPID; sleep 2")
    handler_before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell's "&" ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            kernel(build if moment == "graph" else scaled)
    finally:
        signal.signal(signal.SIGINT, handler_before)
    assert list(directory.iterdir()) == []


@needs_compiler
def test_leftovers_of_killed_compilations_are_removed(directory):
    """Leftovers of dead processes are removed after an hour, of unknown ones after a day."""
    ended_process = subprocess.Popen(["true"])
    ended_process.wait()
    directory.mkdir(mode=0o700)
    leftovers = {
        f"build-{ended_process.pid}-a": (2, False),
        f"build-{ended_process.pid}-b": (0, True),
        f"build-{os.getpid()}-c": (2, True),
        f"build-{os.getpid()}-d": (30, True),
        "build-e_old": (30, False),
        "build-f_young": (2, True),
        f".x-0.key.{ended_process.pid}.part": (2, False),
        f".x-0.key.{os.getpid()}.part": (2, True),
        "mine": (30, True),
    }
    for name, (hours, _) in leftovers.items():
        path = directory / name
        if name.startswith("build"):
            path.mkdir()
            (path / "kernel.c").write_text("")
        else:
            path.write_text("")
        age(path, 3600 * hours + 60)
    assert works()
    left = {path.name for path in directory.iterdir() if not path.name.startswith("scaled")}
    assert left == {name for name, (_, stays) in leftovers.items() if stays}


@needs_compiler
def test_killed_compilation_does_not_block_others(directory):
    """The leftovers are not a library and do not block the next build."""
    text = """
        import casadi as ca
        from casadi_ik.compile import FunctionKernel, compiler
        def build(self, source, library):
            library.write_bytes(b"half")
            print("go", flush=True)
            import time; time.sleep(60)
        compiler.Compiler.build = build
        x = ca.SX.sym("x")
        FunctionKernel(ca.Function("scaled", [x], [2 * x]))
    """
    with script(text) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "go\n"
    (left,) = directory.glob("build-*")
    assert left.name.startswith(f"build-{process.pid}-")
    age(left, 3700)
    assert works()
    assert not left.exists()
    assert sorted(directory.iterdir()) == sorted(
        (*directory.glob("*.so"), *directory.glob("*.key"))
    )


@POSIX
@needs_compiler
def test_fork_during_a_build_in_another_thread(directory):
    """The other thread holds the lock of libraries (Python 3.11: also of a cached property)."""
    building, forked = threading.Event(), threading.Event()

    def slow() -> ca.Function:
        building.set()
        forked.wait(300)
        return scaled(name="slow")

    graph = FunctionGraph("slow", slow, {"x": (1, 1)}, ((1, 1),))
    thread = threading.Thread(target=FunctionKernel, args=(graph,))
    thread.start()
    assert building.wait(300)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # a fork of a process with threads
        child = multiprocessing.get_context("fork").Process(target=works_or_dies)
        child.start()
    child.join(180)
    alive = child.is_alive()
    if alive:
        child.kill()
    forked.set()
    thread.join()
    assert not alive
    assert child.exitcode == 0


def works_or_dies() -> None:
    os._exit(0 if works() else 3)
