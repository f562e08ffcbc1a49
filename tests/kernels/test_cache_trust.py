"""The cache of compiled libraries: files of other users, unusable folders, and full disks."""

from __future__ import annotations

import errno
import os
import subprocess
import tempfile
import warnings
from pathlib import Path

import pytest
from compilation import forbid_builds, forget

from casadi_ik.compile import (
    CacheWarning,
    NoCompilerWarning,
    cache,
    cache_directory,
    compiler,
)

from .graphs import needs_compiler
from .library_cases import POSIX, cached_files, digest, kernel, lie, script, works

SOMEBODY = 54321


def give_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change the owner of a file or folder to another user."""
    if os.getuid() == 0:
        os.chown(path, SOMEBODY, SOMEBODY)
        return
    theirs, owner_check = path.lstat().st_ino, cache._others

    def foreign_owner(status: os.stat_result, sticky: bool) -> str:
        if status.st_ino == theirs:
            status = os.stat_result((*status[:4], SOMEBODY, *status[5:10]))
        return owner_check(status, sticky)

    monkeypatch.setattr(cache, "_others", foreign_owner)


def plant(directory: Path) -> Path:
    """Replace the kernel's library by one that writes a file when it is loaded."""
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
    """Without a danger the planted library is loaded."""
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
    """The result is independent of the umask; a parent folder may be sticky."""
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
    """A private folder among temporary files replaces an unusable cache."""
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
    """First only the disk of the cache is full, then every disk."""
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
    """A relative cache path cannot be resolved then: one warning, and a correct result."""
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
