"""The file `casadi-ik batch` writes: arrays that grow block by block, then become one npz."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import numpy as np

from casadi_ik.cli.outputs import folder_of, write_output, writing
from casadi_ik.files.writing import tidy


class GrowingNpz:
    """Arrays that grow on disk and become one npz; inside `growing_npz`.

    Attributes:
        count: Rows so far, of every array.
    """

    def __init__(self, path: Path, option: str, folder: Path) -> None:
        self.count = 0
        self._path, self._option, self._folder = path, option, folder
        self._streams: dict[str, IO[bytes]] = {}
        self._rows: dict[str, np.ndarray] = {}

    def append(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Append rows to the arrays, always the same ones.

        Raises:
            OutputError: They cannot be written.
        """
        rows = len(next(iter(arrays.values())))
        with writing(self._path, self._option):
            for name, array in arrays.items():
                if name not in self._streams:
                    self._streams[name] = (self._folder / name).open("wb")
                    self._rows[name] = array[:0]
                    _head(self._streams[name], array, 0)
                self._streams[name].write(array.tobytes())
        self.count += rows

    def close(self) -> None:
        """Give every array its number of rows; what an interrupted append began is cut off."""
        with writing(self._path, self._option):
            for name, stream in self._streams.items():
                rows = self._rows[name]
                stream.seek(0)
                _head(stream, rows, self.count)
                size = rows.dtype.itemsize * int(np.prod(rows.shape[1:]))
                stream.truncate(stream.tell() + self.count * size)
                stream.close()

    def write(self) -> None:
        """Put the npz in its place.

        Raises:
            OutputError: It cannot be written.
        """
        self.close()

        def zipped(part: Path) -> None:
            with zipfile.ZipFile(part, "w") as archive:
                for name in self._streams:
                    archive.write(self._folder / name, f"{name}.npy")

        write_output(self._path, self._option, zipped)


@contextmanager
def growing_npz(path: Path, option: str) -> Iterator[GrowingNpz]:
    """An npz that appears when its arrays are complete; after Ctrl-C with the rows it had by then.

    Args:
        path: Where it shall stand.
        option: The option that asked for it.

    Raises:
        OutputError: It cannot be written; nothing is left behind.
    """
    with writing(path, option):
        tidy(folder_of(path), ".batch-*", 2)
        temporary = TemporaryDirectory(prefix=f".batch-{os.getpid()}-", dir=folder_of(path))
    with temporary as folder:
        arrays = GrowingNpz(path, option, Path(folder))
        try:
            yield arrays
        except KeyboardInterrupt:
            if arrays.count:
                arrays.write()
            raise
        except BaseException:
            arrays.close()
            raise
        arrays.write()


def _head(stream: IO[bytes], rows: np.ndarray, count: int) -> None:
    """The header of an array of `count` such rows; as long for any number of them."""
    header: dict[str, Any] = {
        "descr": np.lib.format.dtype_to_descr(rows.dtype),
        "fortran_order": False,
        "shape": (count, *rows.shape[1:]),
    }
    np.lib.format.write_array_header_1_0(stream, header)
