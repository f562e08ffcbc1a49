"""Compiled libraries: loaded in this process, prebuilt, cached, or built on demand.

The file name of a library in the cache contains two hashes: of all its sources (the key), and of
the bytes of the file. The second hash detects an incomplete file before it is loaded, which could
crash the process; no second file is needed for it. Files are created with `os.replace` only, so
that a process that is killed leaves no incomplete library. If several processes need the same
library, one builds it and the others wait.

The wheel `casadi-ik-kernels` (tools/build_kernels.py) contains prebuilt libraries of shipped
robots. They are identified by their recipe, so that they can be used without a compiler.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.util
import os
import platform
import re
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import casadi as ca

from casadi_ik.compile.cache import (
    is_private_file,
    os_reason,
    search_path,
    temporary_build_dir,
    temporary_folder,
    warn_once,
)
from casadi_ik.compile.cancellation import (
    ForkSafeLock,
    interrupt_afterwards,
    is_cached_only,
    is_virtual,
    stop_if_cancelled,
)
from casadi_ik.compile.codegen import Stages, library_source, row_major
from casadi_ik.compile.compiler import (
    Compiler,
    UnloadableError,
    announce,
    find_compiler,
    warn_no_compiler,
)
from casadi_ik.compile.graphs import package_sources
from casadi_ik.files.writing import remove_stale

PREBUILT_PACKAGE = "casadi_ik_kernels"
"""Package of prebuilt libraries."""

BUILD_WAIT = 120.0
"""Time to wait for another process that builds the same library [s]."""

KEY = re.compile("[0-9a-f]{32}")

text_listeners: list[Callable[[str, str], None]] = []
"""Callbacks that receive the prebuilt name and the text of every library
(tools/build_kernels.py)."""

_lock = ForkSafeLock()
_loaded: dict[str, ctypes.CDLL] = {}


class NotCachedError(Exception):
    """Error for a library that is not cached and may not be built."""


def load_function(
    name: str,
    build: Callable[[], ca.Function | Stages],
    driver: str,
    symbol: str,
    recipe: str = "",
    lanes: int = 1,
    wide: bool = False,
) -> ctypes.CDLL | None:
    """Load the compiled library of a function and its runtime; see `load_library`.

    Args:
        name: Name of the library file.
        build: Builder of the function.
        driver: C text of the runtime with its constants.
        symbol: Name of the exported C function.
        recipe: Recipe of the function (`graphs.recipe`), "" if it is unknown.
        lanes: Number of lanes.
        wide: True if the machine has wide registers.
    """

    def text() -> str:
        return library_source(row_major(build()), driver, lanes, wide)

    form = f"{recipe} {lanes} {wide} {driver}" if recipe else ""
    return load_library(name, text, symbol, form)


def load_library(
    name: str, text: Callable[[], str], symbol: str, recipe: str = ""
) -> ctypes.CDLL | None:
    """Load a compiled library from this process, prebuilt, from disk, or build it.

    Args:
        name: Name of the library file.
        text: Builder of its C text.
        symbol: Name of an exported C function.
        recipe: Recipe of the text, "" if it is unknown. A library with this recipe is used without
            building the text.

    Returns:
        The library; None without a compiler or without disk space (with one warning).

    Raises:
        KernelError: There is no C code, or compiling failed.
        NotCachedError: The library is not cached and may not be built (`cached_only`).
    """
    if is_virtual():
        return None
    # The hash distinguishes names with the same first 100 characters.
    short = name[:100]
    prebuilt_name = f"{short}-{_hash(recipe)}" if recipe else ""
    with _lock:
        if prebuilt_name and (library := _load_prebuilt(prebuilt_name, symbol)) is not None:
            return library
        compiler = find_compiler()
        if compiler is None:
            warn_no_compiler()
            return None
        key_file = f"{short}-{_key(compiler, *_graph_versions(), recipe)}.key"
        folders = search_path()
        for directory in folders if recipe else ():
            if (library := _load_by_recipe(directory, short, key_file, symbol)) is not None:
                return library
        if is_cached_only():
            raise NotCachedError(name)
        with interrupt_afterwards():
            source = text()
        for listener in text_listeners:
            listener(prebuilt_name, source)
        key = _key(compiler, source)
        library = _loaded.get(key) or _load_or_build(
            folders, f"{short}-{key}", source, compiler, symbol
        )
        if library is None:
            return None
        _loaded[key] = library
        for directory in folders if recipe else ():
            _remember_key(directory / key_file, key)
        return library


@cache
def _graph_versions() -> tuple[str, str]:
    """Return the versions of the libraries that build graphs; reading them takes 1 ms."""
    return ca.CasadiMeta.version(), version("numpy")


def _key(compiler: Compiler, *parts: str) -> str:
    """Return a hash of everything that a library is built from, 32 hexadecimal digits."""
    return _hash(platform.system(), platform.machine(), compiler.identity, *parts)


def _hash(*parts: str) -> str:
    digest = hashlib.sha256()
    for part in parts:
        # The length separates the parts.
        digest.update(f"{len(part)}:".encode())
        digest.update(part.encode())
    return digest.hexdigest()[:32]


@cache
def prebuilt_folder() -> Path | None:
    """Return the folder of libraries prebuilt from these sources; None if there are none."""
    spec = importlib.util.find_spec(PREBUILT_PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(spec.submodule_search_locations[0])
    try:
        made_for = (folder / "made_for").read_text(encoding="ascii").strip()
    except OSError:
        made_for = ""
    if made_for == package_sources():
        return folder
    warnings.warn(
        f"casadi-ik-kernels was built for another version than casadi-ik {version('casadi-ik')}: "
        "its kernels are not used",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _load_prebuilt(name: str, symbol: str) -> ctypes.CDLL | None:
    """Load a prebuilt library; None if there is none."""
    if name in _loaded:
        return _loaded[name]
    folder = prebuilt_folder()
    path = None if folder is None else folder / f"{name}.so"
    if path is None or not path.is_file():
        return None
    try:
        library = ctypes.CDLL(str(path))
    except OSError:
        return None
    if not hasattr(library, symbol):
        return None
    _loaded[name] = library
    return library


def _load_by_recipe(directory: Path, name: str, key_file: str, symbol: str) -> ctypes.CDLL | None:
    """Load the library whose key is stored for a recipe; None if there is none."""
    path = directory / key_file
    try:
        key = path.read_text(encoding="ascii") if is_private_file(path) else ""
    except (OSError, ValueError):
        return None
    if not KEY.fullmatch(key):
        return None
    library = _loaded.get(key) or _load_from(directory, f"{name}-{key}", symbol)
    if library is not None:
        _loaded[key] = library
    return library


def _remember_key(path: Path, key: str) -> None:
    """Store the key of a recipe; a failure is ignored, because the library can be built again."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(key, encoding="ascii")
        part.chmod(0o600)
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _load_from(directory: Path, stem: str, symbol: str) -> ctypes.CDLL | None:
    """Load a library by its key if it is complete and has the symbol; remove incomplete ones."""
    for path in directory.glob(f"{stem}-*.so"):
        try:
            if not is_private_file(path):
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


def _load_or_build(
    folders: list[Path], stem: str, source: str, compiler: Compiler, symbol: str
) -> ctypes.CDLL | None:
    """Load a library from disk, or compile it into the first usable folder; None without one."""
    problems: dict[Path, OSError | UnloadableError] = {}
    library = None

    def load_from_disk() -> ctypes.CDLL | None:
        return next(filter(None, (_load_from(folder, stem, symbol) for folder in folders)), None)

    if (library := load_from_disk()) is not None:
        return library
    announce(stem.rpartition("-")[0], len(source))
    for folder in chain(folders, temporary_folder(folders)):
        try:
            remove_stale(folder, "build-*", 1)
            remove_stale(folder, ".*.part", -2)
            remove_stale(folder, ".*.lock")
            with _exclusive_build(folder / f".{stem}.lock"):
                library = load_from_disk() or _compile(folder, stem, source, compiler, symbol)
            break
        except (OSError, UnloadableError) as error:
            problems[folder] = error
    for folder, error in problems.items():
        if library is None and isinstance(error, UnloadableError):
            raise error
        warn_once(str(folder), f"cannot be used: {os_reason(error)}")
    if library is None:
        warn_no_compiler("the libraries cannot be stored")
    return library


@contextlib.contextmanager
def _exclusive_build(path: Path) -> Iterator[None]:
    """Wait while another process builds the same library.

    Windows and some file systems have no such locks; two processes may then build the same library,
    which is harmless. A process that is killed releases its lock.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    until = time.monotonic() + BUILD_WAIT
    with path.open("w", encoding="ascii") as file:
        while time.monotonic() < until:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                pass
            except OSError:
                break  # a file system without locks: both may build
            stop_if_cancelled()
            time.sleep(0.05)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _compile(
    directory: Path, stem: str, source: str, compiler: Compiler, symbol: str
) -> ctypes.CDLL:
    """Compile a library into a directory.

    Raises:
        OSError: The directory is not writable or full.
        KernelError: Compiling failed, or the result is not a library.
    """
    with temporary_build_dir(directory) as folder:
        text, file = folder / "kernel.c", folder / "kernel.so"
        text.write_text(source, encoding="utf-8")
        compiler.build(text, file)
        # Load the library before other processes see it, because they might remove it.
        try:
            library = ctypes.CDLL(str(file))
            library[symbol]
        except (OSError, AttributeError) as error:
            raise UnloadableError(
                f"compiler {compiler} succeeded, but the library cannot be loaded "
                f"(set CC to another compiler, or CC=none to use none): {error}"
            ) from error
        file.chmod(0o700)
        file.replace(directory / f"{stem}-{_content_hash(file)}.so")
    return library
