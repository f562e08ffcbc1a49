"""Compiled libraries on disk, so that a machine compiles each kernel once; whose files are loaded.

A library's file name holds two hashes: of everything it was built from (the key) and of its own
bytes. The second lets a torn file be known before it is loaded (loading one can kill the
process), and being in the name it needs no second file that could disagree. Files appear by
`os.replace` only: two processes building at once both win, and one killed in the middle leaves
nothing that looks like a library.

A library is loaded into the process, so whoever can write one here can run code as the user. A
folder counts as trusted if it and every folder above it belong to the user or to root and nobody
else can write into them; of a folder above, a sticky one (/tmp) is enough, since what it holds
can be moved by its owner only. What is checked is the real path, links followed, and only that
path is used afterwards. Systems without owners of files (Windows) keep caches in the user's
profile, and nothing is checked there.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import casadi as ca

from casadi_ik.files.writing import remove_stale
from casadi_ik.kernels.cancellation import ForkSafeLock, interrupt_afterwards
from casadi_ik.kernels.codegen import library_source
from casadi_ik.kernels.compiler import (
    Compiler,
    UnloadableError,
    announce,
    find_compiler,
    warn_no_compiler,
)


class CacheWarning(RuntimeWarning):
    """The folder for compiled kernels cannot be used: they are kept in a temporary one."""


_warned: set[str] = set()


def cache_directory() -> Path:
    """Where libraries are kept, whether it can be used or not.

    `CASADI_IK_CACHE`, else `casadi_ik` in `XDG_CACHE_HOME`, else in the platform's directory for
    caches (`~/.cache`, `~/Library/Caches`, `%LOCALAPPDATA%`); a temporary one if there is no home.

    Raises:
        OSError: A relative path, and the working folder is gone; or there is no temporary folder.
    """
    if own := os.environ.get("CASADI_IK_CACHE"):
        return Path(own).absolute()
    if xdg := os.environ.get("XDG_CACHE_HOME"):
        return Path(xdg).absolute() / "casadi_ik"
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "casadi_ik"
    try:
        home = Path.home()
    except RuntimeError:
        return private_directory()
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "casadi_ik"


def trusted_cache() -> Path | None:
    """The cache as a real path, made if it is missing; None, after a warning, if it is no use.

    A folder that can be read but not written is of use.
    """
    place = "the folder for compiled kernels"
    try:
        directory = cache_directory()
        place = str(directory)
        _make(directory)
        real = Path(os.path.realpath(directory, strict=True))
        problem = distrust(real)
        if not problem:
            # Looked into, not listed: what is kept may be tens of thousands of files.
            with os.scandir(real) as entries:
                next(entries, None)
            return real
    except (OSError, ValueError) as error:
        problem = f"cannot be used: {reason(error)}"
    warn_once(place, problem)
    return None


def private_directory() -> Path:
    """The user's own folder among temporary files, for what the cache cannot keep.

    Raises:
        OSError: It cannot be made, or others could write into it.
    """
    user = f"-{os.getuid()}" if _has_owners() else ""
    directory = Path(tempfile.gettempdir(), f"casadi_ik{user}")
    _make(directory)
    real = Path(os.path.realpath(directory, strict=True))
    if problem := distrust(real):
        raise PermissionError(errno.EPERM, problem, str(real))
    return real


def warn_once(place: str, problem: str) -> None:
    """Say once per process that what is compiled cannot be kept in a place."""
    if place in _warned:
        return
    _warned.add(place)
    warnings.warn(
        f"{place[:200]}: {problem}; kernels are kept among temporary files "
        "(CASADI_IK_CACHE names another folder)",
        CacheWarning,
        stacklevel=2,
    )


def reason(error: Exception) -> str:
    """Why the system refused."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def distrust(real: Path) -> str:
    """Why others could have written into a folder, "" if they could not.

    Args:
        real: An absolute path without links.

    Raises:
        OSError: It cannot be looked at.
    """
    if not _has_owners():
        return ""
    for folder in (real, *real.parents):
        found = folder.lstat()
        where = "" if folder == real else f"{folder} "
        if not stat.S_ISDIR(found.st_mode):
            return f"{where}is no folder"
        if problem := _others(found, sticky=folder != real):
            return f"{where}{problem}"
    return ""


def own_file(path: Path) -> bool:
    """Whether this is a plain file of the user (or root) that nobody else can write."""
    try:
        found = path.lstat()
    except (OSError, ValueError):
        return False
    return stat.S_ISREG(found.st_mode) and not (_has_owners() and _others(found, sticky=False))


def _has_owners() -> bool:
    return hasattr(os, "getuid")


def _others(found: os.stat_result, sticky: bool) -> str:
    """Who else could change it, in words.

    Args:
        found: Of a folder or file.
        sticky: Whether it is enough that others cannot move what it holds.
    """
    if found.st_uid not in (os.getuid(), 0) and not (sticky and _hidden_owner(found.st_uid)):
        return f"belongs to another user (uid {found.st_uid})"
    kept = sticky and found.st_mode & stat.S_ISVTX
    if found.st_mode & stat.S_IWOTH and not kept:
        return "can be written by every user"
    if found.st_mode & stat.S_IWGRP and not kept and not (sticky and _own_group(found)):
        return f"can be written by a group of users (gid {found.st_gid})"
    return ""


@cache
def _hidden_owner(owner: int) -> bool:
    """Whether a container shows this number for all owners it has none for, root among them.

    Above the cache such folders (/, /home) are taken for the system's own.
    """
    try:
        nobody = int(Path("/proc/sys/kernel/overflowuid").read_text(encoding="ascii"))
        mapped = Path("/proc/self/uid_map").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return False
    return owner == nobody and mapped != ["0", "0", str(2**32 - 1)]


def _own_group(found: os.stat_result) -> bool:
    """Whether the group is the owner's alone, as many systems make one for every user."""
    import grp
    import pwd

    try:
        group, owner = grp.getgrgid(found.st_gid), pwd.getpwuid(found.st_uid)
    except KeyError:
        return False
    return owner.pw_gid == found.st_gid and set(group.gr_mem) <= {owner.pw_name}


def _make(directory: Path) -> None:
    """The folder and those above it, for the user alone."""
    missing = []
    while not directory.is_dir():
        if directory.is_symlink() or directory.exists():
            raise NotADirectoryError(errno.ENOTDIR, "a file is in the way", str(directory))
        missing.append(directory)
        directory = directory.parent
    for folder in reversed(missing):
        folder.mkdir(mode=0o700, exist_ok=True)


@contextlib.contextmanager
def workshop(directory: Path) -> Iterator[Path]:
    """A folder inside a folder for the files of one compilation, gone afterwards.

    Nothing but this block removes it: a fork that ends in the meantime must not.

    Raises:
        OSError: It cannot be made.
    """
    place = Path(tempfile.mkdtemp(prefix=f"build-{os.getpid()}-", dir=directory))
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)


KEY = re.compile("[0-9a-f]{32}")

_lock = ForkSafeLock()
_loaded: dict[str, ctypes.CDLL] = {}


def load_library(
    name: str,
    build: Callable[[], ca.Function],
    driver: str,
    symbol: str,
    recipe: str = "",
    write: Callable[[ca.Function, str], str] = library_source,
    at_hand: bool = False,
) -> ctypes.CDLL | None:
    """The compiled library of a function and a driver: from this process, from disk, or built.

    Args:
        name: Of the library's file.
        build: Gives the function, dense and row-major (`codegen.row_major`).
        driver: C text of the driver, with its constants.
        symbol: The function the driver exports.
        recipe: What the function follows from (`recipe`), "" if that is not known. Where a
            library of that recipe is at hand, the function is not built.
        write: Gives the library's text from the function and the driver.
        at_hand: Whether to look for a library of that recipe only, and build nothing.

    Returns:
        The library, or None where there is no compiler, or no room for what it makes (a warning
        says so once), or where it is not at hand and nothing is to be built.

    Raises:
        KernelError: The function has no C code, or the compiler refused it or made no library.
    """
    compiler = find_compiler()
    if compiler is None:
        warn_no_compiler()
        return None
    # The key tells apart what is called alike that far.
    short = name[:100]
    with _lock:
        places = _places()
        brief = (
            library_key(f"{ca.CasadiMeta.version()} {recipe} {driver}", compiler) if recipe else ""
        )
        note = f"{short}-{brief}.key"
        for directory in places if brief else ():
            library = _recognised(directory, short, note, symbol)
            if library is not None:
                return library
        if at_hand:
            return None
        with interrupt_afterwards():
            source = write(build(), driver)
        key = library_key(source, compiler)
        library = _loaded.get(key)
        if library is None:
            stem = f"{short}-{key}"
            found = (_find(directory, stem, symbol) for directory in places)
            library = next(filter(None, found), None)
            if library is None:
                library = _built(places, stem, source, compiler, symbol)
            if library is None:
                return None
            _loaded[key] = library
        for directory in places if brief else ():
            _note(directory / note, key)
        return library


def _recognised(directory: Path, name: str, note: str, symbol: str) -> ctypes.CDLL | None:
    """The library that a recipe led to before, or None."""
    path = directory / note
    try:
        key = path.read_text(encoding="ascii") if own_file(path) else ""
    except (OSError, ValueError):
        return None
    if not KEY.fullmatch(key):
        return None
    library = _loaded.get(key) or _find(directory, f"{name}-{key}", symbol)
    if library is not None:
        _loaded[key] = library
    return library


def _note(path: Path, key: str) -> None:
    """Remember what a recipe led to; that it cannot be written costs time only."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(key, encoding="ascii")
        part.chmod(0o600)
        part.replace(path)
    except OSError:
        try:
            part.unlink(missing_ok=True)
        except OSError:
            return


def library_key(source: str, compiler: Compiler) -> str:
    """Hash of everything a library is built from, 32 hexadecimal digits."""
    return _hash(platform.system(), platform.machine(), compiler.identity, source)


def _hash(*parts: str) -> str:
    digest = hashlib.sha256()
    for part in parts:
        # The length keeps the parts apart.
        digest.update(f"{len(part)}:".encode())
        digest.update(part.encode())
    return digest.hexdigest()[:32]


def _find(directory: Path, stem: str, symbol: str) -> ctypes.CDLL | None:
    """A whole, loadable library of that key that has the symbol, or None; torn ones are removed."""
    for path in directory.glob(f"{stem}-*.so"):
        try:
            if not own_file(path):
                continue
            if path.name != f"{stem}-{_content_hash(path)}.so":
                path.unlink(missing_ok=True)
                continue
            library = ctypes.CDLL(str(path))
        except OSError:
            continue
        if hasattr(library, symbol):
            return library
    return None


def _content_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _places() -> list[Path]:
    """Folders to look into: the cache, and a temporary one where that cannot be written."""
    directory = trusted_cache()
    places = [] if directory is None else [directory]
    writable = directory is not None and os.access(directory, os.W_OK)
    return places if writable else [*places, *_temporary(places)]


def _temporary(others: list[Path]) -> Iterator[Path]:
    """The temporary folder, if it can be used and is not among others."""
    try:
        directory = private_directory()
    except OSError as error:
        warn_once("a temporary folder", f"cannot be used: {reason(error)}")
        return
    if directory not in others:
        yield directory


def _built(
    places: list[Path], stem: str, source: str, compiler: Compiler, symbol: str
) -> ctypes.CDLL | None:
    """Compile into the first place that has room, else a temporary one; None if none has."""
    problems: dict[Path, OSError | UnloadableError] = {}
    library = None
    announce(stem.rpartition("-")[0], len(source))
    for place in chain(places, _temporary(places)):
        try:
            remove_stale(place, "build-*", 1)
            remove_stale(place, ".*.part", -2)
            library = _compiled(place, stem, source, compiler, symbol)
            break
        except (OSError, UnloadableError) as error:
            problems[place] = error
    for place, error in problems.items():
        if library is None and isinstance(error, UnloadableError):
            raise error
        warn_once(str(place), f"cannot be used: {reason(error)}")
    if library is None:
        warn_no_compiler("there is no room for what it makes")
    return library


def _compiled(
    directory: Path, stem: str, source: str, compiler: Compiler, symbol: str
) -> ctypes.CDLL:
    """Compile into a directory.

    Raises:
        OSError: It cannot be written, or is full.
        KernelError: The compiler refused, or made something else than the library.
    """
    with workshop(directory) as place:
        text, file = place / "kernel.c", place / "kernel.so"
        text.write_text(source, encoding="utf-8")
        compiler.build(text, file, symbol)
        # Loaded before it is shown to others, who might tidy the directory up.
        library = ctypes.CDLL(str(file))
        file.chmod(0o700)
        file.replace(directory / f"{stem}-{_content_hash(file)}.so")
    return library
