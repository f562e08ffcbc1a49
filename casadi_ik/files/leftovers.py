"""What killed processes left behind, told by the number of a process in its name and by its age."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from pathlib import Path

HOUR, DAY = 3600.0, 86400.0


def tidy(folder: Path, pattern: str, word: int | None = None) -> None:
    """Remove files and folders that a process made and cannot have use for any more.

    That is so if the process is gone and nothing was written for an hour: it could run on another
    machine that shares the folder, so its number alone does not count. Without a number it takes
    a day. What cannot be removed stays.

    Args:
        folder: Where to look.
        pattern: Names (`Path.glob`).
        word: Which word of the name, parted by "-" and ".", is the number of the process.
    """
    for path in folder.glob(pattern):
        with contextlib.suppress(OSError, IndexError):
            number = "" if word is None else path.name.replace(".", "-").split("-")[word]
            patience = HOUR if number.isdigit() else DAY
            if (number.isdigit() and _alive(int(number))) or _age(path) < patience:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def _age(path: Path) -> float:
    """Seconds since something in it was last written."""
    inside = path.iterdir() if path.is_dir() and not path.is_symlink() else ()
    return time.time() - max(item.lstat().st_mtime for item in (path, *inside))


def _alive(process: int) -> bool:
    """Whether a process of that number runs here; so it is said where that cannot be found out."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True
