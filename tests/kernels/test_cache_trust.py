"""Whose libraries are loaded, places that are no use, compilers that lie, processes killed."""

from __future__ import annotations

import errno
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings
from pathlib import Path

import casadi as ca
import pytest

import casadi_ik as ik
from casadi_ik.kernels import (
    CacheWarning,
    FunctionKernel,
    NoCompilerWarning,
    cache,
    compiler,
)
from casadi_ik.kernels.graphs import FunctionGraph

from .graphs import needs_compiler

pytestmark = pytest.mark.skipif(os.name != "posix", reason="owners and modes are POSIX's")

SOMEBODY = 54321


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache and a process that has loaded and said nothing yet."""
    place = tmp_path / "cache"
    monkeypatch.setenv("CASADI_IK_CACHE", str(place))
    monkeypatch.setattr(compiler, "_warned", False)
    forget(monkeypatch)
    return place


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "_loaded", {})
    monkeypatch.setattr(cache, "_warned", set())


def kernel() -> FunctionKernel:
    """A small kernel of a known recipe, so that it leaves a library and a note."""
    x = ca.SX.sym("x")
    function = ca.Function("scaled", [x], [2 * x])
    return FunctionKernel(
        FunctionGraph("scaled", lambda: function, {"x": (1, 1)}, ((1, 1),), "recipe")
    )


def works() -> bool:
    made = kernel()
    return made.compiled and made(3)[0] == 6


def give_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a file or folder belong to somebody else."""
    if os.getuid() == 0:
        os.chown(path, SOMEBODY, SOMEBODY)
        return
    theirs, others = path.lstat().st_ino, cache._others

    def seen(found: os.stat_result, sticky: bool) -> str:
        if found.st_ino == theirs:
            found = os.stat_result((*found[:4], SOMEBODY, *found[5:10]))
        return others(found, sticky)

    monkeypatch.setattr(cache, "_others", seen)


def plant(directory: Path) -> Path:
    """Put a library in the place of the kernel's own that leaves a mark where it is loaded."""
    (library,) = directory.glob("*.so")
    stem = library.name.rpartition("-")[0]
    source, mark = directory / "evil.c", directory / "mark"
    source.write_text(
        "#include <stdio.h>\n#include <stdint.h>\n"
        f'__attribute__((constructor)) static void run(void) {{ fclose(fopen("{mark}", "w")); }}\n'
        "int casadi_ik_map(void *job) { (void)job; return 0; }\n"
    )
    found = compiler.find_compiler()
    assert found is not None
    built = directory / "evil.so"
    subprocess.run([*found.command, "-fPIC", "-shared", "-o", built, source], check=True)
    library.unlink()
    planted = directory / f"{stem}-{cache._content_hash(built)}.so"
    built.rename(planted)
    source.unlink()
    return planted


@needs_compiler
def test_the_planted_library_would_be_run(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests below mean something: in the user's own hands the library is loaded."""
    assert works()
    plant(directory)
    forget(monkeypatch)
    assert kernel().compiled
    assert (directory / "mark").exists()


@needs_compiler
@pytest.mark.parametrize(
    "danger", ["their file", "writable file", "link", "their folder", "writable folder", "parent"]
)
def test_a_planted_library_is_not_run(
    directory: Path, monkeypatch: pytest.MonkeyPatch, danger: str
) -> None:
    assert works()
    planted = plant(directory)
    forget(monkeypatch)
    said: type[Warning] | None = None
    if danger == "their file":
        give_away(planted, monkeypatch)
    elif danger == "writable file":
        planted.chmod(0o722)
    elif danger == "link":
        elsewhere = planted.rename(directory.parent / "elsewhere.so")
        planted.symlink_to(elsewhere)
    elif danger == "their folder":
        give_away(directory, monkeypatch)
        said = CacheWarning
    elif danger == "writable folder":
        directory.chmod(0o777)
        said = CacheWarning
    else:
        directory.parent.chmod(0o777)
        said = CacheWarning
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert works()
        assert works()
    assert [warning.category for warning in caught] == ([said] if said else [])
    assert not (directory / "mark").exists()
    assert not any("\n" in str(warning.message) for warning in caught)


@needs_compiler
@pytest.mark.parametrize("danger", ["theirs", "writable"])
def test_a_planted_note_is_not_believed(
    directory: Path, monkeypatch: pytest.MonkeyPatch, danger: str
) -> None:
    assert works()
    (note,) = directory.glob("*.key")
    (library,) = directory.glob("*.so")
    wrong = "0" * 32
    note.write_text(wrong)
    if danger == "writable":
        note.chmod(0o666)
    else:
        give_away(note, monkeypatch)
    other = library.with_name(library.name.replace(library.name.split("-")[1], wrong))
    library.rename(other)
    monkeypatch.setattr(cache, "_warned", set())
    monkeypatch.setattr(cache, "_loaded", {})
    assert works()
    assert len(list(directory.glob("*.so"))) == 2  # the one of the note was not taken


def test_a_sticky_folder_above_is_enough(directory: Path) -> None:
    directory.mkdir(mode=0o700)
    directory.parent.chmod(0o1777)
    assert cache.trusted_cache() == Path(os.path.realpath(directory))
    directory.parent.chmod(0o777)
    with pytest.warns(CacheWarning, match="can be written by every user"):
        assert cache.trusted_cache() is None


def test_a_folder_is_looked_into_and_not_listed(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To list tens of thousands of files for each library takes longer than a solve."""
    directory.mkdir(mode=0o700)

    def listed(*_: object) -> list[str]:
        raise AssertionError("listed")

    monkeypatch.setattr(os, "listdir", listed)
    assert cache.trusted_cache() == Path(os.path.realpath(directory))


def test_a_folder_is_made_for_the_user_alone(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CASADI_IK_CACHE", str(directory / "a" / "b"))
    before = os.umask(0)
    try:
        assert cache.trusted_cache() is not None
    finally:
        os.umask(before)
    for place in (directory, directory / "a", directory / "a" / "b"):
        assert place.stat().st_mode & 0o777 == 0o700


@needs_compiler
@pytest.mark.parametrize(
    "place", ["file in the way", "too long", "dead link", "no name", "unreadable", "read-only"]
)
def test_places_that_are_no_use(
    tmp_path: Path, directory: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    wanted = directory
    if place == "file in the way":
        directory.write_text("")
        wanted = directory / "cache"
    elif place == "too long":
        wanted = directory / ("x" * 5000)
    elif place == "dead link":
        directory.symlink_to(tmp_path / "nowhere")
    elif place == "no name":
        wanted = Path("/proc/nothing/here")
    elif os.getuid() == 0:
        pytest.skip("root may read and write everything")
    else:
        directory.mkdir(mode=0 if place == "unreadable" else 0o500)
    monkeypatch.setenv("CASADI_IK_CACHE", str(wanted))
    with pytest.warns(CacheWarning, match="cannot be used: ") as caught:
        assert all((works(), works()))
    assert len(caught) == 1
    assert len(str(caught[0].message)) < 500


@needs_compiler
def test_a_full_disk(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """First the cache's, so that another place has to do; then every disk."""
    write = Path.write_text

    def full(path: Path, *arguments: object, **named: object) -> int:
        if everywhere or directory in path.parents:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, "write_text", full)
    everywhere = False
    with pytest.warns(CacheWarning, match="No space left on device"):
        assert works()
    forget(monkeypatch)
    everywhere = True
    with pytest.warns((CacheWarning, NoCompilerWarning)) as caught:
        made = kernel()
    assert caught[-1].category is NoCompilerWarning
    assert not made.compiled
    assert made(3)[0] == 6
    assert list(directory.iterdir()) == []


@needs_compiler
def test_a_compiler_that_finds_the_disk_full(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lie(directory, monkeypatch, 'echo "as: write error: No space left on device" >&2; exit 1')
    with pytest.warns((CacheWarning, NoCompilerWarning)) as caught:
        assert not kernel().compiled
    assert "No space left on device" in str(caught[0].message)


def lie(directory: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """A compiler in whose hands the library $out has just been made by the real one."""
    real = compiler.find_compiler()
    assert real is not None
    script = directory.parent / "lying cc"
    script.write_text(
        f'#!/bin/sh\n{real.command[0]} "$@" || exit\n'
        'case "$*" in *--version*) exit;; esac\n'
        'while [ "$1" != -o ]; do shift; done; out=$2\n'
        f"{what}\n"
    )
    script.chmod(0o700)
    monkeypatch.setenv("CC", f'"{script}"')


@needs_compiler
@pytest.mark.parametrize(
    ("what", "said"),
    [
        ('head -c 6000 "$out" > "$out.t"; mv "$out.t" "$out"', "is cut off"),
        ('head -c 13000 "$out" > "$out.t"; mv "$out.t" "$out"', "is cut off"),
        ('head -c 3000 /dev/zero | dd of="$out" bs=1 seek=500 conv=notrunc', "cannot be loaded"),
        (': > "$out"', "cannot be loaded"),
        ('rm "$out"', "made no library"),
        ("kill -9 $$", "failed with SIGKILL"),
        ('echo "int x;" > "$out.c"; cc -shared -o "$out" "$out.c"', "undefined symbol"),
        ("seq 100000 >&2; exit 3", "failed with exit code 3"),
    ],
)
def test_a_compiler_that_lies(
    directory: Path, monkeypatch: pytest.MonkeyPatch, what: str, said: str
) -> None:
    lie(directory, monkeypatch, what)
    with pytest.raises(ik.errors.KernelError, match=said) as caught:
        kernel()
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert list(directory.iterdir()) == []


@pytest.mark.parametrize("cc", ['"x', "''", "/", "'a b' c"])
def test_a_cc_that_is_no_command(directory: Path, monkeypatch: pytest.MonkeyPatch, cc: str) -> None:
    monkeypatch.setenv("CC", cc)
    with pytest.warns(NoCompilerWarning, match="does not run"):
        assert not kernel().compiled


def test_flags_that_are_no_words(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CASADI_IK_CFLAGS", '"x')
    with pytest.raises(ik.errors.KernelError, match="CASADI_IK_CFLAGS='\"x': No closing quotation"):
        kernel()


@needs_compiler
def test_a_long_name(directory: Path) -> None:
    x = ca.SX.sym("x")
    made = FunctionKernel(ca.Function("a" * 5000, [x], [2 * x]))
    assert made.compiled
    assert made(3)[0] == 6


@needs_compiler
def test_what_killed_compilations_left_goes(directory: Path) -> None:
    """Of dead processes after an hour, of unknown ones after a day, and nothing else."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    directory.mkdir(mode=0o700)
    made = {
        f"build-{gone.pid}-a": (2, False),
        f"build-{gone.pid}-b": (0, True),
        f"build-{os.getpid()}-c": (2, True),
        f"build-{os.getpid()}-d": (30, True),
        "build-e_old": (30, False),
        "build-f_young": (2, True),
        f".x-0.key.{gone.pid}.part": (2, False),
        f".x-0.key.{os.getpid()}.part": (2, True),
        "mine": (30, True),
    }
    for name, (hours, _) in made.items():
        path = directory / name
        if name.startswith("build"):
            path.mkdir()
            (path / "kernel.c").write_text("")
        else:
            path.write_text("")
        then = time.time() - 3600 * hours - 60
        for old in (*path.glob("*"), path):
            os.utime(old, (then, then))
    assert works()
    left = {path.name for path in directory.iterdir() if not path.name.startswith("scaled")}
    assert left == {name for name, (_, stays) in made.items() if stays}


@needs_compiler
def test_a_compilation_that_is_killed(directory: Path) -> None:
    """What it leaves is no library, and the next one builds."""
    script = """
        import casadi as ca
        from pathlib import Path
        from casadi_ik.kernels import FunctionKernel, compiler
        def build(self, source, library, symbol):
            library.write_bytes(b"half")
            print("go", flush=True)
            import time; time.sleep(60)
        compiler.Compiler.build = build
        x = ca.SX.sym("x")
        FunctionKernel(ca.Function("scaled", [x], [2 * x]))
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "go\n"
    process.kill()
    process.wait()
    (left,) = directory.iterdir()
    assert left.name.startswith(f"build-{process.pid}-")
    then = time.time() - 3700
    for old in (*left.iterdir(), left):
        os.utime(old, (then, then))
    assert works()
    assert not left.exists()


@needs_compiler
def test_a_fork_while_another_thread_builds(directory: Path) -> None:
    """It holds the cache's lock, and up to Python 3.11 that of a cached property."""
    building, forked = threading.Event(), threading.Event()

    def slow() -> ca.Function:
        building.set()
        forked.wait(60)
        x = ca.SX.sym("x")
        return ca.Function("slow", [x], [x])

    graph = FunctionGraph("slow", slow, {"x": (1, 1)}, ((1, 1),))
    thread = threading.Thread(target=FunctionKernel, args=(graph,))
    thread.start()
    assert building.wait(60)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # a fork of a process with threads
        child = multiprocessing.get_context("fork").Process(target=works_or_dies)
        child.start()
    child.join(30)
    alive = child.is_alive()
    if alive:
        child.kill()
    forked.set()
    thread.join()
    assert not alive
    assert child.exitcode == 0


def works_or_dies() -> None:
    os._exit(0 if works() else 3)


@needs_compiler
def test_a_working_folder_that_is_gone(tmp_path: Path) -> None:
    """A relative place cannot be found then; one line, and the answer is right all the same."""
    script = """
        import os, sys
        import casadi as ca
        from casadi_ik.kernels import FunctionKernel
        os.rmdir(os.getcwd())
        x = ca.SX.sym("x")
        kernel = FunctionKernel(ca.Function("scaled", [x], [2 * x]))
        print(kernel.compiled, kernel(3)[0])
    """
    place = tmp_path / "gone"
    place.mkdir()
    environment = os.environ | {
        "CASADI_IK_CACHE": "relative",
        "PYTHONPATH": str(Path(__file__).parents[2]),
    }
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        cwd=place,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout == "True 6.0\n"
    assert done.stderr.count("CacheWarning") == 1


@needs_compiler
@pytest.mark.parametrize(("terminal", "size"), [(True, 10**6), (True, 10), (False, 10**6)])
def test_a_long_compilation_says_so_on_a_terminal(
    directory: Path, monkeypatch: pytest.MonkeyPatch, terminal: bool, size: int
) -> None:
    """Through a pseudo-terminal, or a pipe."""
    library_source = cache.library_source

    def padded(function: ca.Function, driver: str) -> str:
        return library_source(function, driver) + "/*" + "x" * size + "*/\n"

    x = ca.SX.sym("x")
    read, write = os.openpty() if terminal else os.pipe()
    with os.fdopen(write, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        driver = '__attribute__((visibility("default"))) int say(void) { return 0; }\n'
        for _ in range(2):
            made = cache.load_library(
                "named", lambda: ca.Function("f", [x], [x]), driver, "say", "", padded
            )
            assert made is not None
            monkeypatch.setattr(cache, "_loaded", {})
        os.set_blocking(read, False)
        try:
            said = os.read(read, 1000).decode()
        except BlockingIOError:
            said = ""
    os.close(read)
    # A million characters, and those that every library begins with.
    about = r"compiling named \(about 2\d s, once per machine\)\s*"
    assert re.fullmatch(about if terminal and size > 1000 else "", said)


def test_a_signal_in_the_making_leaves_nothing(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(compiler.Compiler, "build", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's "&" ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            kernel()
    finally:
        signal.signal(signal.SIGINT, before)
    assert list(directory.iterdir()) == []
