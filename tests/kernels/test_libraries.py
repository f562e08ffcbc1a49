"""Compiled libraries: reuse, repair of broken files, prebuilt kernels, and compilers."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import sys
import warnings
import zipfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from build_kernels import wheel
from compilation import forbid_builds, forget

import casadi_ik as ik
from casadi_ik.compile import (
    FunctionKernel,
    LoopKernel,
    NoCompilerWarning,
    compiler,
    libraries,
)
from casadi_ik.compile.cancellation import cached_only, virtual_machine
from casadi_ik.compile.graphs import package_sources, recipe

from .graphs import counting_step, needs_compiler
from .library_cases import POSIX, cached_files, digest, kernel, lie, never, scaled, script, works


@needs_compiler
def test_second_use_builds_nothing(directory, monkeypatch):
    assert works()
    assert len(cached_files(directory, ".so")) == len(cached_files(directory, ".key")) == 1
    forbid_builds(monkeypatch)
    assert kernel(never)(3)[0] == 6
    forget(monkeypatch)
    assert kernel(never)(3)[0] == 6
    assert FunctionKernel(scaled())(3)[0] == 6  # by its text, without a recipe
    with pytest.raises(AssertionError, match="the graph was built"):
        kernel(never, "another recipe")


@needs_compiler
def test_every_dependency_changes_the_library_name(directory, monkeypatch):
    for factor in (2.0, 2.5):
        assert FunctionKernel(scaled(factor))(3)[0] == 3 * factor
    LoopKernel(counting_step("scaled"))
    LoopKernel(counting_step("scaled", offset=1.0))
    monkeypatch.setenv("CASADI_IK_CFLAGS", "-O1")
    assert works()
    count_before = len(
        [path for path in cached_files(directory, ".so") if path.name.startswith("scaled")]
    )
    assert count_before == 5


@needs_compiler
@pytest.mark.parametrize("damage", ["torn", "empty", "foreign", "other library", "gone"])
def test_broken_library_is_rebuilt(directory, monkeypatch, damage):
    assert works()
    (path,) = cached_files(directory, ".so")
    data = path.read_bytes()
    # The file is not changed in place, because this process has mapped it.
    path.unlink()
    if damage == "other library":
        # A valid library under a name that fits its bytes, but of another driver.
        LoopKernel(counting_step("other"))
        (other_library,) = [
            cached_file
            for cached_file in cached_files(directory, ".so")
            if cached_file.name.startswith("other")
        ]
        other_library.rename(
            path.with_name(f"{path.stem.rpartition('-')[0]}-{digest(other_library)}.so")
        )
    elif damage != "gone":
        damaged = {"torn": data[: len(data) // 2], "empty": b"", "foreign": b"no library"}
        path.write_bytes(damaged[damage])
    forget(monkeypatch)
    assert works()
    forget(monkeypatch)
    forbid_builds(monkeypatch)
    assert works()


@needs_compiler
@pytest.mark.parametrize("note", ["012345", "0" * 32, "\N{SNOWMAN}"])
def test_broken_note_is_written_again(directory, monkeypatch, note):
    assert works()
    cached_files(directory, ".key")[0].write_text(note, encoding="utf-8")
    forget(monkeypatch)
    assert works()
    forget(monkeypatch)
    assert kernel(never)(3)[0] == 6


def test_recipes_depend_on_their_data():
    robot, same_robot = (ik.load_robot("kuka_lwr_barrett").description for _ in range(2))
    moved_robot, machine = (replace(robot, home=robot.home + by) for by in (1e-9, 1e-16))
    assert recipe(robot, 8) == recipe(same_robot, 8) == recipe(machine, 8)
    distinct_recipes = [
        (robot, 9),
        (moved_robot, 8),
        (robot, 8.0),
        (robot, "8"),
        (robot, (8,)),
        (robot, None),
    ]
    assert len({recipe(*parts) for parts in ((robot, 8), *distinct_recipes)}) == 7


@needs_compiler
def test_concurrent_processes_build_once(directory):
    text = """
        import sys
        import casadi as ca
        from casadi_ik.compile import FunctionKernel, compiler
        build = compiler.Compiler.build
        def counted(*arguments):
            print("built")
            build(*arguments)
        compiler.Compiler.build = counted
        x = ca.SX.sym("x")
        sys.stdin.readline()
        print(FunctionKernel(ca.Function("raced", [x], [ca.sin(x) + 2]))(0)[0])
    """
    with script(text) as first, script(text) as two, script(text) as three:
        for process in (first, two, three):
            assert process.stdin is not None
            process.stdin.write("go\n")
            process.stdin.flush()
        outputs = [process.communicate(timeout=300)[0].split() for process in (first, two, three)]
    assert sorted(outputs) == [["2.0"], ["2.0"], ["built", "2.0"]]
    assert sorted(directory.iterdir()) == cached_files(directory, ".so")


@needs_compiler
@pytest.mark.parametrize("made_for", ["these sources", "others"])
def test_prebuilt_kernels_work_without_a_compiler(directory, tmp_path, monkeypatch, made_for):
    texts: dict[str, str] = {}
    monkeypatch.setattr(libraries, "text_listeners", [texts.__setitem__])
    assert works()
    (name,), (library,) = texts, cached_files(directory, ".so")
    files = {
        "__init__.py": b"",
        "made_for": package_sources().encode() if made_for == "these sources" else b"0",
        f"{name}.so": library.read_bytes(),
    }
    library.unlink()
    with zipfile.ZipFile(wheel(files, "linux_x86_64", tmp_path)) as archive:
        archive.extractall(tmp_path / "site")
        record = archive.read(
            f"{libraries.PREBUILT_PACKAGE}-{ik.__version__}.dist-info/RECORD"
        ).decode()
        assert {line.split(",")[0] for line in record.splitlines()} == set(archive.namelist())
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    libraries.prebuilt_folder.cache_clear()
    monkeypatch.setenv("CC", "none")
    forget(monkeypatch)
    try:
        if made_for == "these sources":
            assert kernel(never)(3)[0] == 6
            return
        with pytest.warns(RuntimeWarning) as caught:
            assert not kernel().compiled
        assert f"casadi-ik {ik.__version__}" in str(caught[0].message)
    finally:
        libraries.prebuilt_folder.cache_clear()


@needs_compiler
def test_cache_only_blocks_build_nothing(directory):
    with virtual_machine():
        assert not kernel(never).compiled
    with cached_only(), pytest.raises(libraries.NotCachedError):
        kernel(never)
    assert works()
    with cached_only():
        assert kernel(never).compiled


@pytest.mark.parametrize("cc", ["/nowhere/cc", "false", '"x', "''", "/", "'a b' c", ""])
def test_without_compiler_one_warning(directory, monkeypatch, tmp_path, cc):
    monkeypatch.setenv("CC", cc)
    if not cc:
        monkeypatch.setenv("PATH", str(tmp_path))
        monkeypatch.setitem(sys.modules, "ziglang", None)
    with pytest.warns(NoCompilerWarning, match="no C compiler") as caught:
        built_kernel = kernel()
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loop = LoopKernel(counting_step())
        FunctionKernel(scaled(3))
    assert not built_kernel.compiled
    assert not loop.compiled
    np.testing.assert_array_equal(built_kernel([1, 2])[0], [2, 4])
    assert loop.run([[0]], [4], 9).iterations.tolist() == [4]
    assert not directory.exists()


@needs_compiler
def test_cc_may_have_arguments(directory, monkeypatch):
    compiler_path = compiler.find_compiler()
    assert compiler_path is not None
    monkeypatch.setenv("CC", f"{compiler_path.command[0]} -DSOMETHING=1")
    compiler_again = compiler.find_compiler()
    assert compiler_again is not None
    assert compiler_again.command == (compiler_path.command[0], "-DSOMETHING=1")
    assert works()


@pytest.mark.parametrize(
    ("variable", "value", "expected_words"),
    [
        ("CASADI_IK_CFLAGS", '"x', "CASADI_IK_CFLAGS='\"x': No closing quotation"),
        ("CASADI_IK_LANES", "3", "CASADI_IK_LANES='3': expected 1, 4 or 8"),
        ("CASADI_IK_COMPILE", "later", "CASADI_IK_COMPILE='later': expected background or wait"),
    ],
)
def test_malformed_variables(directory, monkeypatch, variable, value, expected_words):
    monkeypatch.setenv(variable, value)
    with pytest.raises(ik.errors.KernelError, match=expected_words):
        _ = compiler.find_compiler(), compiler.waits_for_compiler(), LoopKernel(counting_step())


@needs_compiler
@pytest.mark.parametrize("name", ["qsort_r", "a" * 5000])
def test_names_of_functions(directory, name):
    """The names collide with the C library, or are too long for a file."""
    built_kernel = FunctionKernel(scaled(name=name))
    assert built_kernel.compiled
    assert built_kernel(3)[0] == 6
    assert not hasattr(ctypes.CDLL(str(cached_files(directory, ".so")[0])), "casadi_ik_loop")


@POSIX
@needs_compiler
@pytest.mark.parametrize(
    ("property_name", "expected_words"),
    [
        (': > "$out"', "cannot be loaded"),
        ('rm "$out"', "produced no library"),
        ("kill -9 $$", "failed with SIGKILL"),
        ('echo "int x;" > "$out.c"; cc -shared -o "$out" "$out.c"', "undefined symbol"),
        ("seq 100000 >&2; exit 3", "failed with exit code 3"),
        ('echo "no such header.h" >&2; exit 1', r"exit code 1.*no such header\.h"),
    ],
)
def test_faulty_compilers_are_reported(directory, monkeypatch, property_name, expected_words):
    lie(directory, monkeypatch, property_name)
    with pytest.raises(ik.errors.KernelError, match=expected_words) as caught:
        kernel()
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert list(directory.iterdir()) == []


@POSIX
@needs_compiler
@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize("size", [10, 10**6])
def test_a_long_compilation_is_announced(directory, monkeypatch, terminal, waits, size):
    """The announcement appears in a terminal; in a pipe only without CASADI_IK_COMPILE=wait."""
    monkeypatch.setenv("CASADI_IK_COMPILE", "wait" if waits else "background")
    read, write = os.openpty() if terminal else os.pipe()
    with os.fdopen(write, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        text = '__attribute__((visibility("default"))) int say(void) { return 0; }\n'
        padded = f"{text}/*{'x' * size}*/\n"
        for _ in range(2):
            assert libraries.load_library("named", lambda: padded, "say") is not None
            forget(monkeypatch)
        os.set_blocking(read, False)
        output = ""
        with suppress(BlockingIOError):
            output = os.read(read, 1000).decode()
    os.close(read)
    expected = size > 1000 and (terminal or not waits)
    announcement = r"compiling named \(about 5 s, once per machine\)\s*"
    assert re.fullmatch(announcement if expected else "", output)


@pytest.mark.parametrize("options", ["", " -pipe"])
def test_a_path_with_a_blank_has_to_be_quoted(
    options: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler_path = shutil.which("cc") or shutil.which("gcc")
    if compiler_path is None:
        pytest.skip("needs a C compiler")
    program = tmp_path / "my tools" / "cc"
    program.parent.mkdir()
    program.symlink_to(compiler_path)
    forget(monkeypatch)
    monkeypatch.setenv("CC", f"{program}{options}")
    assert compiler.find_compiler() is None
    with pytest.warns(compiler.NoCompilerWarning) as caught:
        compiler.warn_no_compiler()
    advice = str(caught[0].message)
    # The advice of the message works.
    quoted = advice.partition('CC="')[2].partition('"')[0]
    assert str(program) in quoted
    monkeypatch.setitem(os.environ, "CC", f"{quoted}{options}")
    assert compiler.find_compiler() is not None
