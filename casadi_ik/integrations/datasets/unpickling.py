"""Readers of npy and torch files with pickled objects that execute no code of the file.

A pickle is a program. These readers allow it to build only plain containers, texts, numbers, and
NumPy arrays, data types and scalars; every other name is refused. NumPy's own reconstruction
functions are replaced by stubs, so that arrays are built here, from their bytes.
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

DTYPE_PATTERN = re.compile(r"^[<>|=]?([biufcSUO]\d{0,5}|b1|\?)$")
"""Allowed data types of arrays."""


class PickledArray:
    """An array in a pickle.

    Attributes:
        array: The array of numbers or texts; None if it holds objects.
        objects: The objects of an array of objects, in order.
        shape: Shape of the array.
    """

    def __init__(self) -> None:
        self.array: np.ndarray | None = None
        self.objects: list[Any] = []
        self.shape: tuple[int, ...] = ()

    def __setstate__(self, state: Any) -> None:
        """Set version, shape, data type, order and elements."""
        _, shape, dtype, is_column_major, data = state
        if not (
            isinstance(dtype, _DtypeStub) and all(isinstance(n, int) and n >= 0 for n in shape)
        ):
            raise pickle.UnpicklingError("an array without a data type or a shape")
        self.shape, count = tuple(shape), math.prod(shape)
        if dtype.holds_objects:
            if not isinstance(data, list) or len(data) != count:
                raise pickle.UnpicklingError("an array of objects with missing objects")
            self.objects = data
            return
        self.array = array_from_bytes(data, dtype.dtype, self.shape, bool(is_column_major))


class _DtypeStub:
    """The data type of an array in a pickle."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __setstate__(self, state: Any) -> None:
        byte_order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if byte_order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("a data type without a byte order")
        self.text = byte_order + self.text.lstrip("<>|=")

    @property
    def holds_objects(self) -> bool:
        """True if the elements are Python objects."""
        return "O" in self.text

    @property
    def dtype(self) -> np.dtype[Any]:
        """NumPy data type."""
        return np.dtype(self.text)


def _make_dtype(text: Any, *_: Any) -> _DtypeStub:
    if not (isinstance(text, str) and DTYPE_PATTERN.match(text)):
        raise pickle.UnpicklingError(f"arrays of type {text!r}")
    return _DtypeStub(text)


def array_from_bytes(
    data: Any, dtype: np.dtype[Any], shape: tuple[int, ...], is_column_major: bool
) -> Any:
    """Return the array with the given bytes, whose number must match the shape."""
    if not isinstance(data, bytes) or len(data) != math.prod(shape) * dtype.itemsize:
        raise pickle.UnpicklingError("an array whose number of bytes does not match its shape")
    flat = np.frombuffer(data, dtype) if data else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if is_column_major else "C").copy()


def _make_scalar(dtype: Any, data: Any) -> Any:
    if not isinstance(dtype, _DtypeStub) or dtype.holds_objects:
        raise pickle.UnpicklingError("a scalar without a data type")
    return array_from_bytes(data, dtype.dtype, (), False).item()


def _make_empty_array(_: Any, shape: Any, __: Any) -> PickledArray:
    if shape != (0,):
        raise pickle.UnpicklingError("an array in a form that NumPy does not write")
    return PickledArray()


def _array_from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> PickledArray:
    array = PickledArray()
    raw = bytes(data.raw()) if isinstance(data, pickle.PickleBuffer) else bytes(data)
    array.__setstate__((1, shape, dtype, order == "F", raw))
    return array


def _encode(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError("a text in an unexpected encoding")
    return text.encode("latin1")


class AllowedGlobal:
    """An immutable stub for a global name that a pickle may use, and call if it is a function."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any] | None = None) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        """Call the function of the stub."""
        if self._function is None:
            raise pickle.UnpicklingError("a call of the class of an array")
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("a change of a function that builds arrays")


NUMPY_GLOBALS: dict[str, AllowedGlobal] = {
    "ndarray": AllowedGlobal(),
    "dtype": AllowedGlobal(_make_dtype),
    "_reconstruct": AllowedGlobal(_make_empty_array),
    "scalar": AllowedGlobal(_make_scalar),
    "_frombuffer": AllowedGlobal(_array_from_buffer),
}
"""Stubs of the names in any NumPy module that a pickle may use."""


ENCODE = AllowedGlobal(_encode)
"""Stub of the function with which pickles of Python 2 write bytes."""


class RestrictedUnpickler(pickle.Unpickler):
    """An unpickler for NumPy arrays, containers, texts and numbers."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the stub of a global name; refuse every other name."""
        if module.split(".")[0] == "numpy" and name in NUMPY_GLOBALS:
            return NUMPY_GLOBALS[name]
        if (module, name) == ("_codecs", "encode"):
            return ENCODE
        raise pickle.UnpicklingError(f"{module}.{name}")

    def persistent_load(self, pid: Any) -> Any:
        """Refuse a reference to data outside the pickle."""
        raise pickle.UnpicklingError(f"a reference to external data: {pid}")


@contextmanager
def readable_file(path: Path, kind: str) -> Iterator[None]:
    """Check the size of a file, and turn errors of reading it into one-line messages.

    Args:
        path: The file.
        kind: Expected kind of file, for messages.

    Raises:
        DescriptionError: The file cannot be read, is too large or damaged, or uses a forbidden
            name.
    """
    try:
        size = path.stat().st_size
        check_unpacked_size(str(path), size, LIMITS.dataset_bytes)
        yield
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror or error}") from error
    except pickle.UnpicklingError as error:
        raise DescriptionError(
            f"{path}: its pickle contains {_one_line(error)}; expected only arrays, containers, "
            "texts and numbers"
        ) from error
    except (*READ_ERRORS, AttributeError, KeyError, IndexError, TypeError) as error:
        raise DescriptionError(
            f"{path}: file is damaged; expected {kind}: {_one_line(error)}"
        ) from error


def read_npy(path: Path) -> Any:
    """Return the content of an npy file.

    Returns:
        An array of numbers, or the pickled object: dictionaries, lists, texts, numbers and
        `PickledArray` objects. A single object in an array without dimensions is returned directly.

    Raises:
        DescriptionError: The file cannot be read, is damaged, or its pickle contains anything but
            arrays, containers, texts and numbers.
    """
    with readable_file(path, "an npy file"), path.open("rb") as file:
        return _npy_content(path, file)


def _npy_content(path: Path, file: BinaryIO) -> Any:
    """Return the content of an npy file with pickled objects."""
    version = np.lib.format.read_magic(file)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read_header is None:
        raise DescriptionError(f"{path}: found npy version {version}, expected 1.0 or 2.0")
    shape, is_column_major, dtype = read_header(file)
    data = file.read()
    if not dtype.hasobject:
        return array_from_bytes(data, dtype, shape, is_column_major)
    content = RestrictedUnpickler(io.BytesIO(data)).load()
    if isinstance(content, PickledArray) and content.array is None:
        return content.objects[0] if content.shape == () else content.objects
    return content


def _one_line(error: Exception) -> str:
    """Return the message of an error in one line."""
    return " ".join(str(error).split())


STORAGE_TYPES = {
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
"""NumPy data type by class of a torch storage."""


class _StorageType(AllowedGlobal):
    """A stub of a class of torch storages: the raw data that tensors view."""

    __slots__ = ("dtype_text",)

    def __init__(self, dtype_text: str) -> None:
        super().__init__()
        self.dtype_text = dtype_text


def _rebuild_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> PickledArray:
    """Return a tensor as a view of its storage."""
    layout = (offset, *shape, *strides) if isinstance(storage, np.ndarray) else (-1,)
    is_layout = all(type(number) is int and number >= 0 for number in layout)
    if len(shape) != len(strides) or not is_layout:
        raise pickle.UnpicklingError("a tensor without storage, shape or strides")
    tensor = PickledArray()
    tensor.shape = tuple(shape)
    if not math.prod(shape):
        tensor.array = np.zeros(shape, storage.dtype)
        return tensor
    last = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
    if last >= len(storage) or math.prod(shape) > len(storage):
        raise pickle.UnpicklingError("a tensor that is larger than its storage")
    byte_strides = tuple(stride * storage.itemsize for stride in strides)
    tensor.array = np.lib.stride_tricks.as_strided(
        storage[offset:], shape, byte_strides, writeable=False
    )
    return tensor


def _make_dict(pairs: Any = ()) -> dict[Any, Any]:
    return dict(pairs)


REBUILD_TENSOR, ORDERED_DICT = AllowedGlobal(_rebuild_tensor), AllowedGlobal(_make_dict)


class _TorchUnpickler(RestrictedUnpickler):
    """An unpickler for the file `data.pkl` of a torch archive."""

    def __init__(self, archive: ZipFile, folder: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{folder}data.pkl")))
        self._archive, self._folder = archive, folder
        entry = f"{folder}byteorder"
        is_big_endian = entry in archive.namelist() and archive.read(entry) == b"big"
        self._byte_order: Literal[">", "<"] = ">" if is_big_endian else "<"
        self._storages: dict[str, np.ndarray] = {}

    def find_class(self, module: str, name: str) -> Any:
        """Return the stub of a global name; refuse every other name."""
        if module == "torch" and name in STORAGE_TYPES:
            return _StorageType(STORAGE_TYPES[name])
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return REBUILD_TENSOR
        if (module, name) == ("collections", "OrderedDict"):
            return ORDERED_DICT
        return super().find_class(module, name)

    def persistent_load(self, pid: Any) -> np.ndarray:
        """Return the storage of a tensor as an array."""
        if not (isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage"):
            raise pickle.UnpicklingError("a reference to external data that is not a storage")
        _, storage_type, key, _, count = pid
        if not isinstance(storage_type, _StorageType) or not isinstance(key, str):
            raise pickle.UnpicklingError("a tensor with an unknown storage")
        if key not in self._storages:
            data = self._archive.read(f"{self._folder}data/{key}")
            dtype = np.dtype(storage_type.dtype_text).newbyteorder(self._byte_order)
            if type(count) is not int or len(data) != count * dtype.itemsize:
                raise pickle.UnpicklingError("a storage whose size does not match its count")
            self._storages[key] = np.frombuffer(data, dtype)
        return self._storages[key]


def read_torch(path: Path) -> Any:
    """Return the content of a file of `torch.save`, with tensors as `PickledArray` objects.

    Raises:
        DescriptionError: The file cannot be read, is damaged, was written by a torch before 1.6, or
            contains anything but tensors, containers, texts and numbers.
    """
    with readable_file(path, "a file of torch.save"):
        with path.open("rb") as file:
            magic = file.read(2)
        if not is_zipfile(path):
            if magic[:1] == pickle.PROTO:
                raise DescriptionError(
                    f"{path}: found the format before torch 1.6, expected its zip format; convert "
                    f"the file with torch.save(torch.load({path.name!r}), {path.name!r})"
                )
            raise DescriptionError(f"{path}: file is not a zip file; expected a file of torch.save")
        with ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            check_unpacked_size(str(path), size, LIMITS.dataset_bytes)
            pickles = [
                name
                for name in archive.namelist()
                if name.count("/") <= 1 and name.endswith("data.pkl")
            ]
            if not pickles:
                raise DescriptionError(f"{path}: data.pkl: missing; expected a file of torch.save")
            return _TorchUnpickler(archive, pickles[0].removesuffix("data.pkl")).load()
