"""Cache folder of compiled libraries, and the check that it can be trusted.

Libraries are loaded into the process: a user who can write a library can run code in it. A folder
is trusted if it and all its parents belong to the user or to root, and other users cannot write
into them. A parent may be sticky (/tmp), because only owners can move its entries. The check
resolves symbolic links, and only the resolved path is used afterwards. Systems without file owners
(Windows) keep caches in the profile of the user, without a check.
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
    """Warning that the cache folder cannot be used; kernels are stored in a temporary folder."""


_warned: set[str] = set()


def cache_directory() -> Path:
    """Return the path of the cache folder, which may be unusable.

    It is `CASADI_IK_CACHE`, otherwise `casadi_ik` in `XDG_CACHE_HOME`, otherwise in the cache
    folder of the platform (`~/.cache`, `~/Library/Caches`, `%LOCALAPPDATA%`), otherwise a temporary
    folder.

    Raises:
        OSError: The path is relative and the working directory is missing, or there is no
            temporary folder.
    """
    if configured := os.environ.get("CASADI_IK_CACHE"):
        return Path(configured).absolute()
    if xdg := os.environ.get("XDG_CACHE_HOME"):
        return Path(xdg).absolute() / "casadi_ik"
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "casadi_ik"
    try:
        home = Path.home()
    except RuntimeError:
        return user_temp_dir()
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "casadi_ik"


def trusted_cache() -> Path | None:
    """Create the cache and return its resolved path; warn and return None if it cannot be used.

    A folder that can be read but not written can be used.
    """
    location = "the folder for compiled kernels"
    try:
        directory = cache_directory()
        location = str(directory)
        _make_private(directory)
        real = Path(os.path.realpath(directory, strict=True))
        problem = untrusted_reason(real)
        if not problem:
            # Read only one entry: the cache may have tens of thousands of files.
            with os.scandir(real) as entries:
                next(entries, None)
            return real
    except (OSError, ValueError) as error:
        problem = f"cannot be used: {os_reason(error)}"
    warn_once(location, problem)
    return None


def user_temp_dir() -> Path:
    """Create and return the private folder of the user for temporary files.

    Raises:
        OSError: The folder cannot be created, or other users could write into it.
    """
    user = f"-{os.getuid()}" if _has_owners() else ""
    directory = Path(tempfile.gettempdir(), f"casadi_ik{user}")
    _make_private(directory)
    real = Path(os.path.realpath(directory, strict=True))
    if problem := untrusted_reason(real):
        raise PermissionError(errno.EPERM, problem, str(real))
    return real


def warn_once(location: str, problem: str) -> None:
    """Warn once per process that compiled kernels cannot be stored in a folder."""
    if location in _warned:
        return
    _warned.add(location)
    warnings.warn(
        f"{location[:200]}: {problem}; kernels are stored in a temporary folder "
        "(set CASADI_IK_CACHE to another folder)",
        CacheWarning,
        stacklevel=2,
    )


def os_reason(error: Exception) -> str:
    """Return the reason of an operating system error."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def untrusted_reason(real: Path) -> str:
    """Return the reason why a folder cannot be trusted; "" for a trusted folder.

    Args:
        real: An absolute path without symbolic links.

    Raises:
        OSError: The folder cannot be read.
    """
    if not _has_owners():
        return ""
    for folder in (real, *real.parents):
        info = folder.lstat()
        prefix = "" if folder == real else f"{folder} "
        if not stat.S_ISDIR(info.st_mode):
            return f"{prefix}is not a folder"
        if problem := _other_writers(info, sticky=folder != real):
            return f"{prefix}{problem}"
    return ""


def is_private_file(path: Path) -> bool:
    """Return True for a regular file of the user or root that other users cannot write."""
    try:
        info = path.lstat()
    except (OSError, ValueError):
        return False
    return stat.S_ISREG(info.st_mode) and not (_has_owners() and _other_writers(info, sticky=False))


def _has_owners() -> bool:
    return hasattr(os, "getuid")


def _other_writers(info: os.stat_result, sticky: bool) -> str:
    """Return which other users could change a file or folder; "" for none.

    Args:
        info: Status of the file or folder.
        sticky: True if a sticky folder is acceptable.
    """
    if info.st_uid not in (os.getuid(), 0) and not (sticky and _is_overflow_owner(info.st_uid)):
        return f"belongs to another user (uid {info.st_uid})"
    is_sticky = sticky and info.st_mode & stat.S_ISVTX
    if info.st_mode & stat.S_IWOTH and not is_sticky:
        return "can be written by every user"
    if info.st_mode & stat.S_IWGRP and not is_sticky and not (sticky and _is_private_group(info)):
        return f"can be written by a group of users (gid {info.st_gid})"
    return ""


@cache
def _is_overflow_owner(owner: int) -> bool:
    """Return True for the user id that a container shows for unmapped owners, including root.

    Parent folders of such owners (/, /home) count as folders of the system.
    """
    try:
        overflow_owner = int(Path("/proc/sys/kernel/overflowuid").read_text(encoding="ascii"))
        mapped = Path("/proc/self/uid_map").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return False
    return owner == overflow_owner and mapped != ["0", "0", str(2**32 - 1)]


def _is_private_group(info: os.stat_result) -> bool:
    """Return True if the owner is the only member of the group (user private groups)."""
    import grp
    import pwd

    try:
        group, owner = grp.getgrgid(info.st_gid), pwd.getpwuid(info.st_uid)
    except KeyError:
        return False
    return owner.pw_gid == info.st_gid and set(group.gr_mem) <= {owner.pw_name}


def _make_private(directory: Path) -> None:
    """Create a folder and its parents with permissions for the user alone."""
    missing = []
    while not directory.is_dir():
        if directory.is_symlink() or directory.exists():
            raise NotADirectoryError(errno.ENOTDIR, "a file has this path", str(directory))
        missing.append(directory)
        directory = directory.parent
    for folder in reversed(missing):
        folder.mkdir(mode=0o700, exist_ok=True)


@contextlib.contextmanager
def temporary_build_dir(directory: Path) -> Iterator[Path]:
    """Create a folder for the files of one compilation, and remove it afterwards.

    Only this block removes the folder; a forked child that exits earlier does not.

    Raises:
        OSError: The folder cannot be created.
    """
    folder = Path(tempfile.mkdtemp(prefix=f"build-{os.getpid()}-", dir=directory))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def search_path() -> list[Path]:
    """Return the folders to search: the cache, and a temporary folder if it is not writable."""
    directory = trusted_cache()
    info = [] if directory is None else [directory]
    writable = directory is not None and os.access(directory, os.W_OK)
    return info if writable else [*info, *temporary_folder(info)]


def temporary_folder(excluded: list[Path]) -> Iterator[Path]:
    """Yield the temporary folder if it can be used and is not excluded."""
    try:
        directory = user_temp_dir()
    except OSError as error:
        warn_once("a temporary folder", f"cannot be used: {os_reason(error)}")
        return
    if directory not in excluded:
        yield directory
