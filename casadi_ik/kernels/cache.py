"""Compiled libraries on disk, so that a machine compiles each kernel once.

A library's file name holds two hashes: of everything it was built from (the key) and of its own
bytes. The second lets a torn file be known before it is loaded (loading one can kill the
process), and being in the name it needs no second file that could disagree. Files appear by
`os.replace` only: two processes building at once both win, and one killed in the middle leaves
nothing that looks like a library.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import casadi as ca

from casadi_ik.errors import KernelError
from casadi_ik.kernels.codegen import library_source
from casadi_ik.kernels.compiler import Compiler, find_compiler, warn_no_compiler

KEY = re.compile("[0-9a-f]{32}")

_lock = threading.Lock()
_loaded: dict[str, ctypes.CDLL] = {}
_private: list[tempfile.TemporaryDirectory[str]] = []


def cache_directory() -> Path:
    """Where libraries are kept.

    `CASADI_IK_CACHE`, else `casadi_ik` in `XDG_CACHE_HOME`, else in the platform's directory for
    caches (`~/.cache`, `~/Library/Caches`, `%LOCALAPPDATA%`).
    """
    if own := os.environ.get("CASADI_IK_CACHE"):
        return Path(own).absolute()
    if xdg := os.environ.get("XDG_CACHE_HOME"):
        return Path(xdg) / "casadi_ik"
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "casadi_ik"
    try:
        home = Path.home()
    except RuntimeError:
        return _private_directory()
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "casadi_ik"


def load_library(
    name: str,
    build: Callable[[], ca.Function],
    driver: str,
    symbol: str,
    recipe: str = "",
    write: Callable[[ca.Function, str], str] = library_source,
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

    Returns:
        The library, or None where there is no compiler (a `NoCompilerWarning` says so once).

    Raises:
        KernelError: The function has no C code, or the compiler refused it.
    """
    compiler = find_compiler()
    if compiler is None:
        warn_no_compiler()
        return None
    directory = cache_directory()
    with _lock:
        brief = (
            library_key(f"{ca.CasadiMeta.version()} {recipe} {driver}", compiler) if recipe else ""
        )
        library = _recognised(directory, name, brief, symbol) if brief else None
        if library is not None:
            return library
        source = write(build(), driver)
        key = library_key(source, compiler)
        library = _loaded.get(key)
        if library is None:
            stem = f"{name}-{key}"
            library = _find(directory, stem, symbol)
            if library is None:
                library = _build(directory, stem, source, compiler)
            _loaded[key] = library
        if brief:
            _note(directory / f"{name}-{brief}.key", key)
        return library


def _recognised(directory: Path, name: str, brief: str, symbol: str) -> ctypes.CDLL | None:
    """The library that a recipe led to before, or None."""
    try:
        key = (directory / f"{name}-{brief}.key").read_text(encoding="ascii")
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
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)


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


def _build(directory: Path, stem: str, source: str, compiler: Compiler) -> ctypes.CDLL:
    """Compile into the directory, or into a private temporary one if it cannot be written."""
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        workshop = tempfile.TemporaryDirectory(prefix="build-", dir=directory)
    except OSError:
        directory = _private_directory()
        workshop = tempfile.TemporaryDirectory(prefix="build-", dir=directory)
    with workshop as place:
        text, file = Path(place) / "kernel.c", Path(place) / "kernel.so"
        text.write_text(source, encoding="utf-8")
        compiler.build(text, file)
        try:
            # Loaded before it is shown to others, who might tidy the directory up.
            library = ctypes.CDLL(str(file))
        except OSError as error:
            raise KernelError(
                f"a library built in {directory} cannot be loaded: {error}; "
                "CASADI_IK_CACHE can name another directory"
            ) from error
        file.replace(directory / f"{stem}-{_content_hash(file)}.so")
    return library


def _private_directory() -> Path:
    """A directory of this process alone: one of a known name in /tmp could be somebody else's."""
    if not _private:
        _private.append(tempfile.TemporaryDirectory(prefix="casadi_ik-"))
    return Path(_private[0].name)
