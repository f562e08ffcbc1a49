"""Libraries on disk: found again, rebuilt when broken, built by many, done without."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import warnings
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels import (
    FunctionKernel,
    LoopKernel,
    NoCompilerWarning,
    cache,
    cache_directory,
    compiler,
)
from casadi_ik.kernels.codegen import library_source
from casadi_ik.kernels.graphs import FunctionGraph
from casadi_ik.kernels.graphs import recipe as recipe_of

from .graphs import counting_step, needs_compiler


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache and a process that has loaded nothing yet."""
    place = tmp_path / "cache"
    monkeypatch.setenv("CASADI_IK_CACHE", str(place))
    monkeypatch.setattr(cache, "_loaded", {})
    return place


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "_loaded", {})


def function(factor: float = 2.0) -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function("scaled", [x], [factor * x])


def refuse_to_build(*arguments: object) -> None:
    raise AssertionError("built again")


def kept(directory: Path, pattern: str) -> list[Path]:
    """Its files, without those that tell how wide the machine's registers are."""
    return sorted(p for p in directory.glob(pattern) if not p.name.startswith("machine_lanes"))


def libraries(directory: Path) -> list[Path]:
    return kept(directory, "*.so")


@needs_compiler
def test_second_use_builds_nothing(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert FunctionKernel(function())(3)[0] == 6
    assert [path.name for path in directory.iterdir()] == [libraries(directory)[0].name]
    monkeypatch.setattr(compiler.Compiler, "build", refuse_to_build)
    assert FunctionKernel(function())(3)[0] == 6
    forget(monkeypatch)
    assert FunctionKernel(function())(3)[0] == 6


class Pressed:
    """Presses Ctrl-C while CasADi converts it, which takes that for a number of the wrong type."""

    def __SX__(self) -> ca.SX:
        signal.raise_signal(signal.SIGINT)
        return ca.SX(1)


@needs_compiler
@pytest.mark.usefixtures("directory")
def test_ctrl_c_while_a_graph_is_built() -> None:
    def build() -> ca.Function:
        with contextlib.suppress(TypeError):
            _ = ca.SX.sym("x") * Pressed()  # type: ignore[operator]
        return function()

    with pytest.raises(KeyboardInterrupt):
        FunctionKernel(FunctionGraph("scaled", build, {"x": (1, 1)}, ((1, 1),)))


@needs_compiler
def test_a_cache_that_cannot_be_written(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A read-only home: what one process compiles the next finds."""
    directory.write_text("a file is in the way")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert FunctionKernel(function())(3)[0] == 6
        monkeypatch.setattr(compiler.Compiler, "build", refuse_to_build)
        forget(monkeypatch)
        assert FunctionKernel(function())(3)[0] == 6


@needs_compiler
def test_key_tells_everything_apart(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = compiler.find_compiler()
    assert found is not None

    def key(built: ca.Function, driver: str, by: compiler.Compiler) -> str:
        return cache.library_key(library_source(built, driver), by)

    base = key(function(), "driver", found)
    assert key(function(), "driver", found) == base
    monkeypatch.setenv("CASADI_IK_CFLAGS", "-O1")
    flagged = compiler.find_compiler()
    assert flagged is not None
    others = {
        key(function(2.5), "driver", found),
        key(function(), "other driver", found),
        key(function(), "driver", flagged),
        key(function(), "driver", compiler.Compiler(found.command, "other")),
    }
    assert len(others | {base}) == 5


@needs_compiler
@pytest.mark.parametrize("damage", ["torn", "empty", "foreign", "other library"])
def test_broken_library_is_rebuilt(
    directory: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    FunctionKernel(function())
    (path,) = libraries(directory)
    whole = path.read_bytes()
    # Never written in place: this process has the file mapped.
    path.unlink()
    if damage == "torn":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "foreign":
        path.write_bytes(b"not a library at all")
    else:
        # A whole and loadable file under a name that fits its bytes, but of another driver.
        LoopKernel(counting_step("scaled"))
        (other,) = libraries(directory)
        stem = path.name.rsplit("-", 1)[0]
        other.rename(directory / f"{stem}-{other.name.rsplit('-', 1)[1]}")
    forget(monkeypatch)
    assert FunctionKernel(function())(3)[0] == 6
    forget(monkeypatch)
    monkeypatch.setattr(compiler.Compiler, "build", refuse_to_build)
    assert FunctionKernel(function())(3)[0] == 6


@needs_compiler
def test_processes_may_build_at_once(directory: Path) -> None:
    script = """
        import sys
        import casadi as ca
        from casadi_ik.kernels import FunctionKernel
        x = ca.SX.sym("x")
        function = ca.Function("raced", [x], [ca.sin(x) + 2])
        sys.stdin.readline()
        kernel = FunctionKernel(function)
        assert kernel.compiled
        print(kernel(0)[0])
    """
    command = [sys.executable, "-W", "error", "-c", textwrap.dedent(script)]
    running = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    for process in running:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    assert [process.communicate(timeout=120)[0] for process in running] == ["2.0\n"] * 3
    assert libraries(directory)
    assert sorted(directory.iterdir()) == libraries(directory)


def test_cache_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_directory() == tmp_path / "own"
    monkeypatch.delenv("CASADI_IK_CACHE")
    assert cache_directory() == tmp_path / "xdg" / "casadi_ik"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_directory().name == "casadi_ik"
    assert os.path.commonpath([cache_directory(), tmp_path]) == str(tmp_path)


@needs_compiler
def test_compile_error_is_named(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CASADI_IK_CFLAGS", "-include does_not_exist.h")
    with pytest.raises(ik.errors.KernelError, match=r"(?s)exit code 1.*does_not_exist\.h"):
        FunctionKernel(function())
    assert list(directory.iterdir()) == []


@pytest.mark.parametrize("cc", ["/nowhere/cc", "false", ""])
def test_without_compiler_one_warning(
    directory: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cc: str
) -> None:
    monkeypatch.setattr(compiler, "_warned", False)
    monkeypatch.setenv("CC", cc)
    if not cc:
        monkeypatch.setenv("PATH", str(tmp_path))
        monkeypatch.setattr(compiler, "_zig", list)
    with pytest.warns(NoCompilerWarning, match="no C compiler") as caught:
        kernel = FunctionKernel(function())
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loop = LoopKernel(counting_step())
        FunctionKernel(function(3))
    assert not kernel.compiled
    assert not loop.compiled
    np.testing.assert_array_equal(kernel([1, 2])[0], [2, 4])
    assert loop.run([[0]], [4], 9).iterations.tolist() == [4]
    assert not directory.exists()


@needs_compiler
def test_cc_may_have_arguments(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = compiler.find_compiler()
    assert found is not None
    monkeypatch.setenv("CC", f"{found.command[0]} -DSOMETHING=1")
    again = compiler.find_compiler()
    assert again is not None
    assert again.command == (found.command[0], "-DSOMETHING=1")
    assert FunctionKernel(function())(3)[0] == 6


@needs_compiler
def test_function_named_like_one_of_libc(directory: Path) -> None:
    x = ca.SX.sym("x")
    kernel = FunctionKernel(ca.Function("qsort_r", [x], [x + 1]))
    assert kernel.compiled
    assert kernel(1)[0] == 2
    (path,) = libraries(directory)
    assert not hasattr(ctypes.CDLL(str(path)), "casadi_ik_loop")


def remembered(source: object, *parts: object) -> LoopKernel:
    """A loop whose graph is known by what it follows from."""
    step = counting_step("remembered")
    recipe = recipe_of("remembered", *parts)
    return LoopKernel(replace(step, source=source or step.source, recipe=recipe))


def never_built() -> ca.Function:
    raise AssertionError("the graph was built")


@needs_compiler
def test_a_graph_of_a_known_recipe_is_not_built(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = remembered(None, 1).run([[0]], [5], 9).states
    for loaded_before in (True, False):
        if not loaded_before:
            forget(monkeypatch)
        kernel = remembered(never_built, 1)
        assert kernel.compiled
        np.testing.assert_array_equal(kernel.run([[0]], [5], 9).states, first)
    with pytest.raises(AssertionError, match="the graph was built"):
        remembered(never_built, 2)


@needs_compiler
@pytest.mark.parametrize("damage", ["torn note", "no library", "note of another key"])
def test_what_a_recipe_led_to_may_be_gone(
    directory: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    remembered(None, 1)
    (note,) = kept(directory, "*.key")
    if damage == "torn note":
        note.write_text(note.read_text()[:7])
    elif damage == "no library":
        libraries(directory)[0].unlink()
    else:
        note.write_text("0" * 32)
    forget(monkeypatch)
    assert remembered(None, 1).compiled
    assert len(libraries(directory)) == 1
    forget(monkeypatch)
    assert remembered(never_built, 1).compiled


def test_recipes_differ_where_their_data_do() -> None:
    robot = ik.load_robot("kuka_lwr_barrett").description
    moved = replace(robot, home=robot.home + 1e-15)
    assert recipe_of(robot, 8) == recipe_of(ik.load_robot("kuka_lwr_barrett").description, 8)
    assert len({recipe_of(robot, 8), recipe_of(robot, 9), recipe_of(moved, 8)}) == 3
