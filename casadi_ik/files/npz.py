"""Arrays in npz files of somebody: their size is known before they are unpacked."""

from __future__ import annotations

import lzma
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import RAISED, limit

UNREADABLE = (
    ValueError,
    EOFError,
    MemoryError,
    NotImplementedError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)
"""What numpy and zipfile were seen to raise on a damaged or encrypted member."""


def refuse_giants(where: str, size: int, most: int) -> None:
    """Refuse what takes more memory than it should.

    Args:
        where: File and key, for the message.
        size: Bytes that it unpacks to.
        most: How many it may have.

    Raises:
        DescriptionError: It has more.
    """
    if size > limit(most):
        raise DescriptionError(
            f"{where}: unpacks to {size} bytes, expected at most {limit(most)} {RAISED}"
        )


def read_npz(path: Path, most: int) -> dict[str, Array]:
    """All arrays of a file; nothing in it is ever executed.

    Args:
        path: The file.
        most: Bytes that it may unpack to, eight for every number.

    Raises:
        DescriptionError: It cannot be read, is no npz file or damaged, unpacks to more, or holds
            anything else than arrays of numbers.
    """
    found: dict[str, Array] = {}
    size = 0
    try:
        path.open("rb").close()
        if not zipfile.is_zipfile(path):
            raise DescriptionError(f"{path}: not an npz file")
        with zipfile.ZipFile(path) as members:
            refuse_giants(str(path), sum(one.file_size for one in members.infolist()), most)
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                array = archive[name]
                if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
                    kind = array.dtype if isinstance(array, np.ndarray) else "bytes"
                    raise DescriptionError(
                        f"{path}: {name}: found values of type {kind}, expected numbers"
                    )
                size += 8 * array.size
                refuse_giants(str(path), size, most)
                found[name] = array.astype(np.float64)
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (*UNREADABLE, KeyError) as error:
        raise DescriptionError(f"{path}: damaged: {error}") from error
    return found
