"""npy files and files of torch with pickled objects in them, read without running what they say.

A pickle is a program. Here it may build plain containers, texts and numbers, and numpy arrays,
types and scalars: whatever else it names is refused, and of numpy's own machinery nothing runs that
it could hand over anything to: arrays are put together from their bytes here.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Literal
from zipfile import ZipFile, is_zipfile

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import READ_ERRORS, check_unpacked_size

TYPES = re.compile(r"^[<>|=]?([biufcSUO]\d{0,5}|b1|\?)$")
"""Element types that arrays may have."""


class Packed:
    """An array of a pickle: its elements are there once it has been told them.

    Attributes:
        value: The array of numbers or texts; None where it holds objects.
        items: The objects, in order.
        shape: Of the array.
    """

    def __init__(self) -> None:
        self.value: np.ndarray | None = None
        self.items: list[Any] = []
        self.shape: tuple[int, ...] = ()

    def __setstate__(self, state: Any) -> None:
        """Take version, shape, type, order and elements."""
        _, shape, kind, by_columns, data = state
        if not (isinstance(kind, _Kind) and all(isinstance(n, int) and n >= 0 for n in shape)):
            raise pickle.UnpicklingError("an array without a type or a shape")
        self.shape, count = tuple(shape), math.prod(shape)
        if kind.holds_objects:
            if not isinstance(data, list) or len(data) != count:
                raise pickle.UnpicklingError("an array of objects that are not there")
            self.items = data
            return
        self.value = array_of(data, kind.dtype, self.shape, bool(by_columns))


class _Kind:
    """The element type of an array."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("a type without an order of bytes")
        self.text = order + self.text.lstrip("<>|=")

    @property
    def holds_objects(self) -> bool:
        return "O" in self.text

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.text)


def _kind(text: Any, *_: Any) -> _Kind:
    if not (isinstance(text, str) and TYPES.match(text)):
        raise pickle.UnpicklingError(f"arrays of type {text!r}")
    return _Kind(text)


def array_of(data: Any, dtype: np.dtype[Any], shape: tuple[int, ...], by_columns: bool) -> Any:
    """An array of bytes, which have to be as many as it needs."""
    if not isinstance(data, bytes) or len(data) != math.prod(shape) * dtype.itemsize:
        raise pickle.UnpicklingError("an array whose bytes are not as many as its shape says")
    flat = np.frombuffer(data, dtype) if data else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if by_columns else "C").copy()


def _scalar(kind: Any, data: Any) -> Any:
    if not isinstance(kind, _Kind) or kind.holds_objects:
        raise pickle.UnpicklingError("a scalar without a type")
    return array_of(data, kind.dtype, (), False).item()


def _rebuilt(_: Any, shape: Any, __: Any) -> Packed:
    if shape != (0,):
        raise pickle.UnpicklingError("an array in another way than numpy writes it")
    return Packed()


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any) -> Packed:
    packed = Packed()
    held = bytes(data.raw()) if isinstance(data, pickle.PickleBuffer) else bytes(data)
    packed.__setstate__((1, shape, kind, order == "F", held))
    return packed


def _encoded(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError("a text in an odd encoding")
    return text.encode("latin1")


class Named:
    """What a pickle may name, and call if it is something to call; it cannot be changed."""

    __slots__ = ("_does",)

    def __init__(self, does: Callable[..., Any] | None = None) -> None:
        self._does = does

    def __call__(self, *arguments: Any) -> Any:
        """What it does, if anything."""
        if self._does is None:
            raise pickle.UnpicklingError("a call of an array's class")
        return self._does(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("a change of what builds arrays")


ALLOWED: dict[str, Named] = {
    "ndarray": Named(),
    "dtype": Named(_kind),
    "_reconstruct": Named(_rebuilt),
    "scalar": Named(_scalar),
    "_frombuffer": Named(_from_buffer),
}
"""What of numpy a pickle may name, by its last name, and what it gets."""


ENCODED = Named(_encoded)
"""How pickles of Python 2 write bytes."""


class Reader(pickle.Unpickler):
    """Of pickles that hold arrays of numpy, containers, texts and numbers."""

    def find_class(self, module: str, name: str) -> Any:
        """What a pickle names."""
        if module.split(".")[0] == "numpy" and name in ALLOWED:
            return ALLOWED[name]
        if (module, name) == ("_codecs", "encode"):
            return ENCODED
        raise pickle.UnpicklingError(f"{module}.{name}")

    def persistent_load(self, pid: Any) -> Any:
        """What a pickle says is somewhere else."""
        raise pickle.UnpicklingError(f"things kept elsewhere: {pid}")


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """What goes wrong with a file, in one line.

    Args:
        path: The file.
        kind: What it should be.

    Raises:
        DescriptionError: It cannot be read, is too large, damaged, or names what it may not.
    """
    try:
        size = path.stat().st_size
        check_unpacked_size(str(path), size, LIMITS.dataset_bytes)
        yield
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror or error}") from error
    except pickle.UnpicklingError as error:
        raise DescriptionError(
            f"{path}: its pickle holds {_line(error)}, expected arrays, containers, texts and "
            "numbers only"
        ) from error
    except (*READ_ERRORS, AttributeError, KeyError, IndexError, TypeError) as error:
        raise DescriptionError(f"{path}: damaged, expected {kind}: {_line(error)}") from error


def read_npy(path: Path) -> Any:
    """What an npy file holds.

    Args:
        path: The file.

    Returns:
        An array of numbers; or what was pickled: dictionaries, lists, texts, numbers and `Packed`
        arrays. A single object in an array without dimensions comes out by itself.

    Raises:
        DescriptionError: It cannot be read, is damaged, or its pickle names anything else than
            arrays, containers, texts and numbers.
    """
    with reading(path, "an npy file"), path.open("rb") as file:
        return _content(path, file)


def _content(path: Path, file: BinaryIO) -> Any:
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise DescriptionError(f"{path}: found npy version {version}, expected 1.0 or 2.0")
    shape, by_columns, dtype = read(file)
    rest = file.read()
    if not dtype.hasobject:
        return array_of(rest, dtype, shape, by_columns)
    found = Reader(io.BytesIO(rest)).load()
    if isinstance(found, Packed) and found.value is None:
        return found.items[0] if found.shape == () else found.items
    return found


def _line(error: Exception) -> str:
    """What it says, in one line."""
    return " ".join(str(error).split())


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


class _Storage(Named):
    """What a raw file holds."""

    __slots__ = ("text",)

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text


def _rebuilt_tensor(numbers: Any, first: Any, shape: Any, apart: Any, *_: Any) -> Packed:
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


REBUILD, ORDERED = Named(_rebuilt_tensor), Named(_ordered)


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
            return _Storage(KINDS[name])
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
        if not isinstance(kind, _Storage) or not isinstance(key, str):
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
            check_unpacked_size(str(path), size, LIMITS.dataset_bytes)
            held = [n for n in archive.namelist() if n.count("/") <= 1 and n.endswith("data.pkl")]
            if not held:
                raise DescriptionError(f"{path}: data.pkl: missing, expected a file of torch.save")
            return _TorchReader(archive, held[0].removesuffix("data.pkl")).load()
