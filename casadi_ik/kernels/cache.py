"""Compiled libraries on disk, so that a machine compiles each kernel once.

A library's file name holds two hashes: of everything it was built from (the key) and of its own
bytes. The second lets a torn file be known before it is loaded (loading one can kill the
process), and being in the name it needs no second file that could disagree. Files appear by
`os.replace` only: two processes building at once both win, and one killed in the middle leaves
nothing that looks like a library. Whose files are loaded is said in `folders`.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import casadi as ca

from casadi_ik.files.writing import tidy
from casadi_ik.kernels.cancellation import interrupt_afterwards
from casadi_ik.kernels.codegen import library_source
from casadi_ik.kernels.compiler import (
    Compiler,
    UnloadableError,
    find_compiler,
    warn_no_compiler,
)
from casadi_ik.kernels.folders import (
    own_file,
    private_directory,
    reason,
    trusted_cache,
    warn_once,
    workshop,
)
from casadi_ik.kernels.forks import ForkSafeLock
from casadi_ik.kernels.progress import announce

KEY = re.compile("[0-9a-f]{32}")

NAME = 100
"""Characters of a kernel's name that its file's name has at most; the key tells the rest."""

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
    short = name[:NAME]
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
            tidy(place, "build-*", 1)
            tidy(place, ".*.part", -2)
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
