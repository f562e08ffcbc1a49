"""Files that torch writes, read without torch, and without running what they say.

Since its version 1.6 `torch.save` writes a zip: `data.pkl` with everything but numbers, whose
tensors say which of the raw files in `data/` theirs are in, from where on, and how far apart rows
and columns are (torch/serialization.py, `_save`; torch/_utils.py, `_rebuild_tensor_v2`).
"""

from __future__ import annotations

import io
import math
import pickle
from pathlib import Path
from typing import Any, Literal
from zipfile import ZipFile, is_zipfile

import numpy as np

from casadi_ik.datasets.unpickling import MOST, Named, Packed, Reader, reading
from casadi_ik.errors import DescriptionError
from casadi_ik.files.npz import refuse_giants

KINDS = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
"""What a raw file holds, by what torch calls it."""


class _Kind(Named):
    """What a raw file holds."""

    __slots__ = ("text",)

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text


def _rebuilt(numbers: Any, first: Any, shape: Any, apart: Any, *_: Any) -> Packed:
    """A tensor: which numbers of a raw file."""
    ends = (first, *shape, *apart) if isinstance(numbers, np.ndarray) else (-1,)
    if len(shape) != len(apart) or not all(type(one) is int and one >= 0 for one in ends):
        raise pickle.UnpicklingError("a tensor without numbers, shape or strides")
    packed = Packed()
    packed.shape = tuple(shape)
    if not math.prod(shape):
        packed.value = np.zeros(shape, numbers.dtype)
        return packed
    last = first + sum((n - 1) * step for n, step in zip(shape, apart, strict=True))
    if last >= len(numbers) or math.prod(shape) > len(numbers):
        raise pickle.UnpicklingError("a tensor that is larger than its numbers")
    steps = tuple(step * numbers.itemsize for step in apart)
    packed.value = np.lib.stride_tricks.as_strided(numbers[first:], shape, steps, writeable=False)
    return packed


def _ordered(pairs: Any = ()) -> dict[Any, Any]:
    return dict(pairs)


REBUILD, ORDERED = Named(_rebuilt), Named(_ordered)


class _TorchReader(Reader):
    """Of `data.pkl`."""

    def __init__(self, archive: ZipFile, folder: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{folder}data.pkl")))
        self._archive, self._folder = archive, folder
        said = f"{folder}byteorder"
        big = said in archive.namelist() and archive.read(said) == b"big"
        self._order: Literal[">", "<"] = ">" if big else "<"
        self._read: dict[str, np.ndarray] = {}

    def find_class(self, module: str, name: str) -> Any:
        """What a pickle names."""
        if module == "torch" and name in KINDS:
            return _Kind(KINDS[name])
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return REBUILD
        if (module, name) == ("collections", "OrderedDict"):
            return ORDERED
        return super().find_class(module, name)

    def persistent_load(self, pid: Any) -> np.ndarray:
        """The numbers of a raw file."""
        if not (isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage"):
            raise pickle.UnpicklingError("things kept elsewhere that are no tensor's numbers")
        _, kind, key, _, count = pid
        if not isinstance(kind, _Kind) or not isinstance(key, str):
            raise pickle.UnpicklingError("a tensor of unknown numbers")
        if key not in self._read:
            data = self._archive.read(f"{self._folder}data/{key}")
            dtype = np.dtype(kind.text).newbyteorder(self._order)
            if type(count) is not int or len(data) != count * dtype.itemsize:
                raise pickle.UnpicklingError("a tensor whose numbers are not as many as it says")
            self._read[key] = np.frombuffer(data, dtype)
        return self._read[key]


def read_torch(path: Path) -> Any:
    """What a file of `torch.save` holds: containers, texts, numbers and tensors as `Packed` arrays.

    Args:
        path: The file.

    Raises:
        DescriptionError: It cannot be read, is damaged, was written by a torch before 1.6, or
            names anything else than tensors, containers, texts and numbers.
    """
    with reading(path, "a file of torch.save"):
        with path.open("rb") as file:
            begins = file.read(2)
        if not is_zipfile(path):
            if begins[:1] == pickle.PROTO:
                raise DescriptionError(
                    f"{path}: found the format before torch 1.6, expected its zip; where torch is: "
                    f"torch.save(torch.load({path.name!r}), {path.name!r})"
                )
            raise DescriptionError(f"{path}: found no zip, expected a file of torch.save")
        with ZipFile(path) as archive:
            size = sum(one.file_size for one in archive.infolist())
            refuse_giants(str(path), size, MOST)
            held = [n for n in archive.namelist() if n.count("/") <= 1 and n.endswith("data.pkl")]
            if not held:
                raise DescriptionError(f"{path}: data.pkl: missing, expected a file of torch.save")
            return _TorchReader(archive, held[0].removesuffix("data.pkl")).load()
