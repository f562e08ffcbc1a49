"""Numbers in files of somebody: arrays, triangles, points. What they unpack to is known first."""

from __future__ import annotations

import contextlib
import io
import logging
import lzma
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS, RAISE_HINT, raise_hint, scaled_limit
from casadi_ik.files.reading import read_bytes

READ_ERRORS = (
    ValueError,
    EOFError,
    MemoryError,
    NotImplementedError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    struct.error,
    zlib.error,
    lzma.LZMAError,
)
"""What numpy and zipfile were seen to raise on a damaged or encrypted member."""


def check_unpacked_size(where: str, size: int, most: int) -> None:
    """Refuse what takes more memory than it should.

    Args:
        where: File and key, for the message.
        size: Bytes that it unpacks to.
        most: How many it may have.

    Raises:
        DescriptionError: It has more.
    """
    if size > scaled_limit(most):
        raise DescriptionError(
            f"{where}: unpacks to {size} bytes, expected at most {scaled_limit(most)} {RAISE_HINT}"
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
            check_unpacked_size(str(path), sum(one.file_size for one in members.infolist()), most)
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                array = archive[name]
                if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
                    kind = array.dtype if isinstance(array, np.ndarray) else "bytes"
                    raise DescriptionError(
                        f"{path}: {name}: found values of type {kind}, expected numbers"
                    )
                size += 8 * array.size
                check_unpacked_size(str(path), size, most)
                found[name] = array.astype(np.float64)
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (*READ_ERRORS, KeyError) as error:
        raise DescriptionError(f"{path}: damaged: {error}") from error
    return found


MESH_FORMATS = (".stl", ".obj", ".ply", ".dae", ".off", ".glb")
"""Names' ends of what is read."""

LOOKS = ("library_images", "library_effects", "library_materials", "bind_material")
"""Elements of COLLADA that say what colour a mesh has."""


def read_mesh(path: Path, where: str) -> tuple[Array, NDArray[np.int64]]:
    """Corners (k, 3) and triangles (t, 3) of a mesh's file, its parts together; without triangles.

    Args:
        path: STL, OBJ, PLY, DAE, OFF or GLB.
        where: File and key that name it, for the message.

    Raises:
        DescriptionError: There is no such file, no mesh in it, or it is larger than any robot's.
    """
    if not path.is_file():
        raise DescriptionError(f"{where}: no such file {str(path)!r}")
    kind = path.suffix.lower()
    where = f"{where}: {path.name}"
    if kind not in MESH_FORMATS:
        raise DescriptionError(
            f"{where}: found {kind!r}, expected one of {', '.join(MESH_FORMATS)}"
        )
    data = read_bytes(path, where, scaled_limit(LIMITS.mesh_bytes), RAISE_HINT)
    try:
        points, triangles = _parsed(data, kind[1:])
    except Exception as error:  # whatever a broken file leads a reader into
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DescriptionError(f"{where}: cannot be read: {reason}") from error
    if len(triangles) > scaled_limit(LIMITS.mesh_faces):
        hint = raise_hint(len(triangles), LIMITS.mesh_faces)
        most = f"at most {scaled_limit(LIMITS.mesh_faces)} {hint}"
        raise DescriptionError(f"{where}: found {len(triangles)} triangles, expected {most}")
    if not len(points):
        raise DescriptionError(f"{where}: is an empty mesh, expected triangles")
    most = LIMITS.mesh_coordinate
    if not (np.abs(points) <= most).all():
        raise DescriptionError(f"{where}: has corners that are not finite, or beyond {most:g}")
    return points, triangles


def _parsed(data: bytes, kind: str) -> tuple[Array, NDArray[np.int64]]:
    with warnings.catch_warnings(), np.errstate(all="ignore"), _silent("trimesh.util"):
        warnings.simplefilter("ignore")
        parts = _of_collada(data) if kind == "dae" else _of_others(data, kind)
    points, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for corners, faces in parts:
        # What no triangle has is no part of the mesh: files keep what was once there.
        kept, numbers = np.unique(np.asarray(faces, dtype=np.int64), return_inverse=True)
        if len(kept) and not 0 <= kept[0] <= kept[-1] < len(corners):
            raise ValueError("triangles of corners that are not there")
        points.append(np.asarray(corners, dtype=np.float64)[kept])
        triangles.append(numbers.reshape(-1, 3) + count)
        count += len(kept)
    return np.concatenate(points), np.concatenate(triangles)


@contextlib.contextmanager
def _silent(logger: str) -> Iterator[None]:
    """Keep what a library logs of broken files: what is said of them is ours."""
    log = logging.getLogger(logger)
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


def _of_others(data: bytes, kind: str) -> list[tuple[Any, Any]]:
    import trimesh

    library: Any = trimesh
    found = library.load_scene(io.BytesIO(data), file_type=kind, process=False, skip_materials=True)
    return [(one.vertices, one.faces) for one in found.dump() if hasattr(one, "faces")]


def _of_collada(data: bytes) -> list[tuple[Any, Any]]:
    """Its geometries as its scene places them, in metres, whichever way it calls up."""
    import collada

    library: Any = collada
    root = ElementTree.fromstring(data)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag.rpartition("}")[2] in LOOKS:  # of which a fault would cost the mesh
                parent.remove(child)
    plain = io.BytesIO(ElementTree.tostring(root))
    document = library.Collada(plain, ignore=[library.common.DaeError])
    unit = document.assetInfo.unitmeter or 1.0
    found: list[tuple[Any, Any]] = []
    for geometry in document.scene.objects("geometry") if document.scene else ():
        for one in geometry.primitives():
            some = one.triangleset() if hasattr(one, "triangleset") else one
            if isinstance(some, library.triangleset.BoundTriangleSet) and some.vertex is not None:
                found.append((unit * some.vertex, some.vertex_index))
    return found


PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


COMPRESSED = "binary_compressed"
"""Name of compressed data in a PCD file."""


@dataclass
class _Head:
    """What the head of a PLY or PCD file says.

    Attributes:
        fields: Name, type and number of values of each field of a point.
        count: How many points there are.
        form: "ascii", the order of bytes ("<" or ">"), or `COMPRESSED`.
    """

    fields: list[tuple[str, str, int]]
    count: int
    form: str


def read_points(path: Path, where: str) -> Array:
    """(k, 3) points of a file [as it has them]; those of no distance (NaN) are left out.

    Args:
        path: ``.npy``, ``.npz`` (an array alone, or called ``points``): (k, 3), (H, W, 3) as a
            depth camera has it, or more columns, of which the first three are taken; ``.ply`` and
            ``.pcd`` (text, binary or compressed); ``.xyz``, ``.txt``, ``.csv``: x, y and z in the
            first three columns, or where a header line has these names.
        where: File and key, for the message.

    Raises:
        DescriptionError: There is no such file, it is damaged, or no file of points.
    """
    readers: dict[str, Callable[[Path], Array]] = {
        ".npy": _npy,
        ".npz": _npz,
        ".ply": lambda file: _headed(file, _ply_head),
        ".pcd": lambda file: _headed(file, _pcd_head),
        **dict.fromkeys((".xyz", ".txt", ".csv"), _table),
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(readers)
        raise DescriptionError(f"{where}: found {path.name!r}, expected a name ending in {known}")
    if not path.is_file():
        raise DescriptionError(f"{where}: no such file {str(path)!r}")
    try:
        if path.stat().st_size > scaled_limit(LIMITS.cloud_bytes):
            raise ValueError(
                f"found more than {scaled_limit(LIMITS.cloud_bytes)} bytes {RAISE_HINT}"
            )
        found = reader(path)
    except DescriptionError as error:
        raise DescriptionError(f"{where}: {error}") from error
    except OSError as error:
        raise DescriptionError(f"{where}: {path.name}: {error.strerror or error}") from error
    except (*READ_ERRORS, TypeError, LookupError, StopIteration) as error:
        reason = " ".join(str(error).split())
        raise DescriptionError(f"{where}: {path.name} cannot be read: {reason}") from error
    return finite_points(found, f"{where}: {path.name}")


def finite_points(points: np.ndarray, where: str) -> Array:
    """Points (k, 3) that are numbers; a camera's rows without a distance are left out.

    Raises:
        DescriptionError: Another shape, no numbers, or none is left.
    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        found = f"{points.dtype} of shape {points.shape}"
        raise DescriptionError(f"{where}: found {found}, expected numbers (k, 3)")
    kept = np.asarray(points[np.isfinite(points).all(axis=1)], dtype=np.float64)
    if not len(kept):
        raise DescriptionError(f"{where}: found no points, expected at least one")
    return kept


def _at_most(count: int) -> int:
    max_count = scaled_limit(LIMITS.cloud_points)
    if not 0 <= count <= max_count:
        raise ValueError(f"found {count} points, expected at most {max_count} {RAISE_HINT}")
    return count


MOST_COLUMNS = 16
"""Most numbers of a point in an array: x, y, z, then colours, normals, intensities and the like."""


def _npy(path: Path) -> Array:
    array = np.lib.format.open_memmap(path, mode="r")  # reserves nothing, unpickles nothing
    return _coordinates(array)


def _coordinates(array: np.ndarray) -> Array:
    """Return the points (k, 3) of an array of points or of an image of points."""
    if array.dtype.names is not None and set("xyz") <= set(array.dtype.names):
        array = np.stack([array[axis] for axis in "xyz"], axis=-1)
    if array.ndim in (2, 3) and 3 <= array.shape[-1] <= MOST_COLUMNS:
        _at_most(array.size // array.shape[-1])
        array = array[..., :3].reshape(-1, 3)
    return np.asarray(array)


def _npz(path: Path) -> Array:
    arrays = read_npz(path, 24 * LIMITS.cloud_points)
    if len(arrays) > 1 and "points" not in arrays:
        raise ValueError(f"found {', '.join(arrays)}, expected one array, or one called points")
    return _coordinates(arrays["points"] if "points" in arrays else next(iter(arrays.values())))


def _table(path: Path) -> Array:
    with path.open("rb") as stream:
        return _numbers(stream, _columns_of_header(stream), None)


def _columns_of_header(stream: IO[bytes]) -> list[int]:
    """Pass over the header line of a table, if it has one, and return the columns of x, y and z."""
    start = stream.tell()
    line = stream.readline(10_000).removeprefix(b"\xef\xbb\xbf")
    words = line.decode("latin-1").replace(",", " ").replace(";", " ").split()
    names = [word.strip("\"'#/ ").lower() for word in words if word.strip("\"'#/ ")]
    if set("xyz") <= set(names):
        return [names.index(axis) for axis in "xyz"]
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    # A header, or the number of points alone; comments are passed over with the table.
    is_comment = line.lstrip().startswith((b"#", b"//"))
    if (words and not numbers and not is_comment) or len(numbers) == 1:
        return [0, 1, 2]
    stream.seek(start)
    return [0, 1, 2]


def _numbers(stream: IO[bytes], columns: list[int], count: int | None) -> Array:
    """Return columns of a table with blanks, commas or semicolons between its numbers."""
    blanks = bytes.maketrans(b",;", b"  ")
    rows, most = (line.translate(blanks) for line in stream), scaled_limit(LIMITS.cloud_points) + 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # nothing in it: told by the caller
        found = np.loadtxt(rows, comments=["#", "//"], usecols=columns, max_rows=most, ndmin=2)
    _at_most(len(found))
    if count is not None and len(found) < count:
        raise ValueError(f"found {len(found)} points, expected {count}")
    return found[:count].reshape(-1, 3)


def _headed(path: Path, read_head: Callable[[IO[bytes]], _Head]) -> Array:
    with path.open("rb") as stream:
        head = read_head(stream)
        names = [name for name, _, _ in head.fields]
        places = [names.index(axis) if axis in names else -1 for axis in "xyz"]
        if min(places) < 0:
            raise ValueError(f"found {' '.join(names)}, expected x, y and z")
        if head.form == "ascii":
            before = np.cumsum([0, *(count for _, _, count in head.fields)])
            return _numbers(stream, before[places].tolist(), head.count)
        if head.form == COMPRESSED:
            return _by_field(stream, head, places)
        row = np.dtype(
            [
                (f"f{i}", f"{head.form}{kind}", count)
                for i, (_, kind, count) in enumerate(head.fields)
            ]
        )
        data = stream.read(row.itemsize * head.count)
        if len(data) < row.itemsize * head.count:
            raise ValueError(f"ends after {len(data) // row.itemsize} of {head.count} points")
        rows = np.frombuffer(data, row)
        return np.stack([rows[f"f{i}"].reshape(-1).astype(np.float64) for i in places], axis=1)


def _by_field(stream: IO[bytes], head: _Head, places: list[int]) -> Array:
    """Return the points of compressed data: all values of a field follow one another.

    Raises:
        ValueError: The data are damaged, or unpack to another size than the head announces.
    """
    packed_size, size = struct.unpack("<II", stream.read(8))
    kinds = [np.dtype((f"<{kind}", (count,))) for _, kind, count in head.fields]
    if size != head.count * sum(kind.itemsize for kind in kinds):
        raise ValueError(f"unpacks to {size} bytes, not to {head.count} points")
    check_unpacked_size("its data", size, LIMITS.cloud_bytes)
    data = unpack_lzf(stream.read(packed_size), size)
    starts = np.cumsum([0, *(head.count * kind.itemsize for kind in kinds)])
    columns = [np.frombuffer(data, kinds[i], head.count, int(starts[i])) for i in places]
    return np.stack([column.reshape(-1).astype(np.float64) for column in columns], axis=1)


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """Unpack data of the LZF compression, which PCD files use.

    A byte below 32 announces that many bytes plus one as they are. Any other byte and the next
    ones are the length and the distance of bytes that are copied from what is already unpacked.

    Raises:
        ValueError: The data are damaged, or unpack to another size.
    """
    data, place = bytearray(), 0
    try:
        while place < len(packed):
            control = packed[place]
            place += 1
            if control < 32:
                data += packed[place : place + control + 1]
                place += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[place]
                place += 1
            start = len(data) - ((control & 31) << 8) - packed[place] - 1
            place, length = place + 1, length + 2
            if start < 0 or len(data) + length > size:
                raise ValueError("its compressed data are damaged")
            # A copy may overlap its own source: then the source repeats.
            source = bytes(data[start : start + length])
            data += (source * (length // len(source) + 1))[:length]
    except IndexError as error:
        raise ValueError("its compressed data end too early") from error
    if len(data) != size:
        raise ValueError(f"unpacks to {len(data)} bytes, expected {size}")
    return bytes(data)


def _lines(stream: IO[bytes]) -> list[str]:
    return stream.readline(1000).decode("ascii").split()


def _ply_head(stream: IO[bytes]) -> _Head:
    if _lines(stream) != ["ply"]:
        raise ValueError("no PLY file")
    forms = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}
    head, elements = _Head([], 0, ""), 0
    for _ in range(LIMITS.cloud_head):
        match _lines(stream):
            case ["format", form, _]:
                head.form = forms[form]
            case ["element", name, count]:
                elements += 1
                if elements == 1 and name != "vertex":
                    raise ValueError(f"begins with {name}, expected vertex first")
                head.count = _at_most(int(count)) if elements == 1 else head.count
            case ["property", "list", *_] if elements == 1:
                raise ValueError("a vertex has lists, expected numbers")
            case ["property", kind, name] if elements == 1:
                head.fields.append((name, PLY_TYPES[kind], 1))
            case ["end_header"]:
                return head
            case _:
                pass
    raise ValueError("its head has no end")


def _pcd_head(stream: IO[bytes]) -> _Head:
    said: dict[str, list[str]] = {}
    for _ in range(LIMITS.cloud_head):
        words = _lines(stream)
        if words and not words[0].startswith("#"):
            said[words[0].upper()] = words[1:]
        if "DATA" in said:
            break
    else:
        raise ValueError("no PCD file")
    form = said["DATA"][0]
    if form not in ("ascii", "binary", COMPRESSED):
        raise ValueError(f"its data are {form}, expected ascii, binary or {COMPRESSED}")
    names = said["FIELDS"]
    counts = [int(one) for one in said.get("COUNT", ["1"] * len(names))]
    if not all(0 < one <= 1000 for one in counts):
        raise ValueError(f"COUNT: found {counts}")
    kinds = [f"{kind.lower()}{size}" for kind, size in zip(said["TYPE"], said["SIZE"], strict=True)]
    count = int(said["POINTS"][0]) if "POINTS" in said else int(said["WIDTH"][0])
    fields = list(zip(names, kinds, counts, strict=True))
    return _Head(fields, _at_most(count), "<" if form == "binary" else form)
