"""Compiled libraries: found again, rebuilt when broken, built once by many, trusted or not."""

from __future__ import annotations

import ctypes
import errno
import hashlib
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from build_kernels import wheel
from compilation import forbid_builds, forget

import casadi_ik as ik
from casadi_ik.compile import (
    CacheWarning,
    FunctionKernel,
    LoopKernel,
    NoCompilerWarning,
    cache,
    cache_directory,
    compiler,
    libraries,
)
from casadi_ik.compile.cancellation import cached_only, virtual_machine
from casadi_ik.compile.graphs import FunctionGraph, package_sources, recipe

from .graphs import counting_step, needs_compiler

POSIX = pytest.mark.skipif(os.name != "posix", reason="owners and modes are POSIX's")
SOMEBODY = 54321


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, of a process that has loaded and said nothing yet."""
    place = tmp_path / "cache"
    monkeypatch.setenv("CASADI_IK_CACHE", str(place))
    forget(monkeypatch)
    return place


def scaled(factor: float = 2.0, name: str = "scaled") -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function(name, [x], [factor * x])


def kernel(build: Callable[[], ca.Function] = scaled, key: str = "recipe") -> FunctionKernel:
    """A small kernel of a known recipe: it leaves a library and a note."""
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
    """Another process, with Python's pipes."""
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


# What is found again.


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
    # Never written in place: this process has the file mapped.
    path.unlink()
    if damage == "other library":
        # A whole and loadable file under a name that fits its bytes, but of another driver.
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


# Kernels made ahead, and what may be built when.


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


# Compilers.


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
    """Of one of the C library, and too long for a file."""
    built_kernel = FunctionKernel(scaled(name=name))
    assert built_kernel.compiled
    assert built_kernel(3)[0] == 6
    assert not hasattr(ctypes.CDLL(str(cached_files(directory, ".so")[0])), "casadi_ik_loop")


def lie(directory: Path, monkeypatch: pytest.MonkeyPatch, property_name: str) -> None:
    """A compiler in whose hands the library $out has just been made by the real one."""
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


@POSIX
@needs_compiler
@pytest.mark.parametrize(
    ("property_name", "expected_words"),
    [
        (': > "$out"', "cannot be loaded"),
        ('rm "$out"', "made no library"),
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
    """Through a pseudo-terminal or a pipe; in a pipe not to those who asked to wait."""
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


# Whose files are loaded, and places that are no use.


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def give_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a file or folder belong to somebody else."""
    if os.getuid() == 0:
        os.chown(path, SOMEBODY, SOMEBODY)
        return
    theirs, owner_check = path.lstat().st_ino, cache._others

    def foreign_owner(found: os.stat_result, sticky: bool) -> str:
        if found.st_ino == theirs:
            found = os.stat_result((*found[:4], SOMEBODY, *found[5:10]))
        return owner_check(found, sticky)

    monkeypatch.setattr(cache, "_others", foreign_owner)


def plant(directory: Path) -> Path:
    """Put a library in the place of the kernel's own that leaves a mark where it is loaded."""
    (library,) = cached_files(directory, ".so")
    source, mark = directory / "evil.c", directory / "mark"
    source.write_text(
        "#include <stdio.h>\n#include <stdint.h>\n"
        f'__attribute__((constructor)) static void run(void) {{ fclose(fopen("{mark}", "w")); }}\n'
        "int casadi_ik_map(void *job) { (void)job; return 0; }\n"
    )
    compiler_path = compiler.find_compiler()
    assert compiler_path is not None
    built = directory / "evil.so"
    subprocess.run([*compiler_path.command, "-fPIC", "-shared", "-o", built, source], check=True)
    library.unlink()
    source.unlink()
    return built.rename(directory / f"{library.stem.rpartition('-')[0]}-{digest(built)}.so")


DANGERS = ("their file", "writable file", "link", "their folder", "writable folder", "parent")


@POSIX
@needs_compiler
@pytest.mark.parametrize("danger", ["none", *DANGERS])
def test_planted_libraries_are_not_loaded(directory, monkeypatch, danger):
    """In the user's own hands alone they are: the test means something."""
    assert works()
    planted = plant(directory)
    forget(monkeypatch)
    if danger == "their file":
        give_away(planted, monkeypatch)
    elif danger == "writable file":
        planted.chmod(0o722)
    elif danger == "link":
        elsewhere = planted.rename(directory.parent / "elsewhere.so")
        planted.symlink_to(elsewhere)
    elif danger == "their folder":
        give_away(directory, monkeypatch)
    elif danger == "writable folder":
        directory.chmod(0o777)
    elif danger == "parent":
        directory.parent.chmod(0o777)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert (works() and works()) == (danger != "none")
    warnings_expected = [CacheWarning] if "folder" in danger or danger == "parent" else []
    assert [warning.category for warning in caught] == warnings_expected
    assert (directory / "mark").exists() == (danger == "none")
    assert not any("\n" in str(warning.message) for warning in caught)


@POSIX
@needs_compiler
@pytest.mark.parametrize("danger", ["theirs", "writable"])
def test_planted_note_is_ignored(directory, monkeypatch, danger):
    assert works()
    (note,), (library,) = cached_files(directory, ".key"), cached_files(directory, ".so")
    wrong = "0" * 32
    note.write_text(wrong)
    library.rename(library.with_name(library.name.replace(library.name.split("-")[1], wrong)))
    if danger == "writable":
        note.chmod(0o666)
    else:
        give_away(note, monkeypatch)
    forget(monkeypatch)
    assert works()
    assert len(cached_files(directory, ".so")) == 2  # the one of the note was not taken


def test_cache_directory(monkeypatch, tmp_path):
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_directory() == tmp_path / "own"
    monkeypatch.delenv("CASADI_IK_CACHE")
    assert cache_directory() == tmp_path / "xdg" / "casadi_ik"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_directory().name == "casadi_ik"
    assert tmp_path in cache_directory().parents


@POSIX
def test_cache_folders_are_private(directory, monkeypatch):
    """Made so, whatever the mask; of one above a sticky one is enough."""
    monkeypatch.setenv("CASADI_IK_CACHE", str(directory / "a"))
    mask_before = os.umask(0)
    try:
        assert cache.trusted_cache() == Path(os.path.realpath(directory / "a"))
    finally:
        os.umask(mask_before)
    assert [place.stat().st_mode & 0o777 for place in (directory, directory / "a")] == [0o700] * 2
    directory.chmod(0o1777)
    assert cache.trusted_cache() is not None
    directory.chmod(0o777)
    with pytest.warns(CacheWarning, match="can be written by every user"):
        assert cache.trusted_cache() is None


@POSIX
@needs_compiler
@pytest.mark.parametrize(
    "place", ["file in the way", "too long", "dead link", "no name", "unreadable", "read-only"]
)
def test_unusable_cache_folders(tmp_path, directory, monkeypatch, place):
    """One line, and a folder of the user's own among temporary files serves: the next finds it."""
    expected_folder = directory
    if place == "file in the way":
        directory.write_text("")
        expected_folder = directory / "cache"
    elif place == "too long":
        expected_folder = directory / ("x" * 5000)
    elif place == "dead link":
        directory.symlink_to(tmp_path / "nowhere")
    elif place == "no name":
        expected_folder = Path("/proc/nothing/here")
    elif os.getuid() == 0:
        pytest.skip("root may read and write everything")
    else:
        directory.mkdir(mode=0 if place == "unreadable" else 0o500)
    monkeypatch.setenv("CASADI_IK_CACHE", str(expected_folder))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert works()
        forbid_builds(monkeypatch)
        forget(monkeypatch)
        assert works()
    assert {warning.category for warning in caught} == {CacheWarning}
    (text,) = {str(warning.message) for warning in caught}
    assert len(text) < 500
    assert (tmp_path / f"casadi_ik-{os.getuid()}").stat().st_mode & 0o777 == 0o700


@needs_compiler
def test_a_full_disk(directory, monkeypatch):
    """First the cache's, so that another place has to do; then every disk."""
    write = Path.write_text

    def full(path: Path, *arguments: object, **named: object) -> int:
        if everywhere or directory in path.parents:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, "write_text", full)
    everywhere = False
    with pytest.warns(CacheWarning, match="No space left"):
        assert works()
    forget(monkeypatch)
    everywhere = True
    with pytest.warns((CacheWarning, NoCompilerWarning)) as caught:
        built_kernel = kernel()
    assert caught[-1].category is NoCompilerWarning
    assert not built_kernel.compiled
    assert built_kernel(3)[0] == 6
    assert list(directory.iterdir()) == []


@POSIX
@needs_compiler
def test_compiler_reporting_a_full_disk(directory, monkeypatch):
    lie(directory, monkeypatch, 'echo "as: write error: No space left on device" >&2; exit 1')
    with pytest.warns((CacheWarning, NoCompilerWarning)) as caught:
        assert not kernel().compiled
    assert "No space left on device" in str(caught[0].message)


@POSIX
@needs_compiler
def test_deleted_working_folder(tmp_path):
    """A relative place cannot be found then; one line, and the answer is right all the same."""
    text = f"""
        import os
        import casadi as ca
        from casadi_ik.compile import FunctionKernel
        os.chdir({str(tmp_path)!r})
        os.rmdir(os.getcwd())
        x = ca.SX.sym("x")
        kernel = FunctionKernel(ca.Function("scaled", [x], [2 * x]))
        print(kernel.compiled, kernel(3)[0])
    """
    with script(text, CASADI_IK_CACHE="relative") as process:
        output, complaint = process.communicate(timeout=300)
    assert output == "True 6.0\n"
    assert complaint.count("CacheWarning") == 1


# Signals, forks, processes that are killed.


class Pressed:
    """Presses Ctrl-C while CasADi converts it, which takes that for a number of the wrong type."""

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
    """Of dead processes after an hour, of unknown ones after a day, and nothing else."""
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


def age(path: Path, seconds: float) -> None:
    then = time.time() - seconds
    for old in (*path.glob("*"), path):
        os.utime(old, (then, then))


@needs_compiler
def test_killed_compilation_does_not_block_others(directory):
    """What it leaves is no library and holds nobody up: the next one builds."""
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
    """It holds the lock of libraries, and up to Python 3.11 that of a cached property."""
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
