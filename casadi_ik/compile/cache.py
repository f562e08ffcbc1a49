"""The folder for compiled libraries, and whose files are loaded from it.

A library is loaded into the process, so whoever can write one here can run code as the user. A
folder counts as trusted if it and every folder above it belong to the user or to root and nobody
else can write into them; of a folder above, a sticky one (/tmp) is enough, since what it holds
can be moved by its owner only. What is checked is the real path, links followed, and only that
path is used afterwards. Systems without owners of files (Windows) keep caches in the user's
profile, and nothing is checked there.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path


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


def places() -> list[Path]:
    """Folders to look into: the cache, and a temporary one where that cannot be written."""
    directory = trusted_cache()
    found = [] if directory is None else [directory]
    writable = directory is not None and os.access(directory, os.W_OK)
    return found if writable else [*found, *temporary(found)]


def temporary(others: list[Path]) -> Iterator[Path]:
    """The temporary folder, if it can be used and is not among others."""
    try:
        directory = private_directory()
    except OSError as error:
        warn_once("a temporary folder", f"cannot be used: {reason(error)}")
        return
    if directory not in others:
        yield directory
