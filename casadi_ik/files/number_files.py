"""Readers for untrusted arrays, meshes and point clouds; sizes are checked before decompression."""

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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError, MissingExtraError, optional_import
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
"""Exceptions that numpy and zipfile raise for damaged or encrypted files."""


def check_unpacked_size(location: str, size: int, max_size: int) -> None:
    """Refuse data that need more memory than allowed.

    Args:
        location: File and key, for the message.
        size: Uncompressed size [bytes].
        max_size: Largest allowed size [bytes].

    Raises:
        DescriptionError: The data are larger.
    """
    allowed = scaled_limit(max_size)
    if size > allowed:
        raise DescriptionError(
            f"{location}: unpacks to {size} bytes; expected at most {allowed} {RAISE_HINT}"
        )


def npz_names(path: Path) -> list[str] | None:
    """Return the names of the arrays of an npz file, or None if the file cannot be read."""
    try:
        with zipfile.ZipFile(path) as members:
            return [name.removesuffix(".npy") for name in members.namelist()]
    except (OSError, *READ_ERRORS):
        return None


def read_npz(path: Path, max_size: int) -> dict[str, Array]:
    """Read all arrays of a file without executing anything in it.

    Args:
        path: The file.
        max_size: Largest uncompressed size [bytes], 8 per number.

    Raises:
        DescriptionError: The file cannot be read, is damaged or is not an npz file, is too large,
            or contains anything but arrays of numbers.
    """
    arrays: dict[str, Array] = {}
    size = 0
    try:
        path.open("rb").close()
        if not zipfile.is_zipfile(path):
            raise DescriptionError(f"{path}: not an npz file")
        with zipfile.ZipFile(path) as members:
            unpacked = sum(member.file_size for member in members.infolist())
            check_unpacked_size(str(path), unpacked, max_size)
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                array = archive[name]
                if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
                    kind = array.dtype if isinstance(array, np.ndarray) else "bytes"
                    raise DescriptionError(
                        f"{path}: {name}: found values of type {kind}, expected numbers"
                    )
                size += 8 * array.size
                check_unpacked_size(str(path), size, max_size)
                arrays[name] = array.astype(np.float64)
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (*READ_ERRORS, KeyError) as error:
        raise DescriptionError(f"{path}: damaged: {error}") from error
    return arrays


MESH_FORMATS = (".stl", ".obj", ".ply", ".dae", ".off", ".glb")
"""File name extensions of supported meshes."""

APPEARANCE_TAGS = ("library_images", "library_effects", "library_materials", "bind_material")
"""COLLADA elements that describe the appearance of a mesh."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """The triangles of a mesh file that have the same colour.

    Attributes:
        points: (k, 3) vertices.
        triangles: (t, 3) rows of `points`.
        color: Colour "#rrggbb"; "" if the file states none.
    """

    points: Array
    triangles: NDArray[np.int64]
    color: str = ""


def hex_color(channels: Sequence[float]) -> str:
    """Return a colour "#rrggbb" of channels between 0 and 1: red, green, blue, and others."""
    return "#" + "".join(f"{round(255 * min(max(c, 0.0), 1.0)):02x}" for c in channels[:3])


def read_mesh(path: Path, location: str) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices (k, 3) and triangles (t, 3) of a mesh file, its parts combined.

    The arguments and exceptions are those of `read_mesh_parts`.
    """
    parts = read_mesh_parts(path, location)
    offsets = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
    triangles = [part.triangles + offset for part, offset in zip(parts, offsets, strict=True)]
    return np.concatenate([part.points for part in parts]), np.concatenate(triangles)


def read_mesh_parts(path: Path, location: str) -> list[MeshPart]:
    """Return the parts of a mesh file, with the colours that a COLLADA file states.

    Vertices that no triangle uses are dropped.

    Args:
        path: STL, OBJ, PLY, DAE, OFF or GLB.
        location: File and key that name the mesh, for the message.

    Raises:
        DescriptionError: The file does not exist, has no triangles, or is too large.
        MissingExtraError: The package that reads meshes is not installed.
    """
    if not path.is_file():
        raise DescriptionError(f"{location}: no such file {str(path)!r}")
    kind = path.suffix.lower()
    if not location.endswith(path.name):
        location = f"{location}: {path.name}"
    if kind not in MESH_FORMATS:
        raise DescriptionError(
            f"{location}: found {kind!r}, expected one of {', '.join(MESH_FORMATS)}"
        )
    data = read_bytes(path, location, scaled_limit(LIMITS.mesh_bytes), RAISE_HINT)
    if not data or data.lstrip()[:20].lower().startswith(WEB_PAGE):
        problem = "is a web page" if data else "has 0 bytes"
        raise DescriptionError(f"{location}: the file {problem}; expected a mesh")
    try:
        parts = _parse_mesh(data, kind[1:])
    except MissingExtraError:
        raise
    except Exception as error:  # libraries raise exceptions of any type for damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DescriptionError(f"{location}: cannot be read: {reason}") from error
    count = sum(len(part.triangles) for part in parts)
    if count > scaled_limit(LIMITS.mesh_faces):
        hint = raise_hint(count, LIMITS.mesh_faces)
        expected = f"at most {scaled_limit(LIMITS.mesh_faces)} {hint}"
        raise DescriptionError(f"{location}: found {count} triangles, expected {expected}")
    if not count:
        is_cut = kind == ".stl" and len(data) < _stl_size(data)
        problem = f": the file ends after {len(data)} of {_stl_size(data)} bytes" if is_cut else ""
        raise DescriptionError(f"{location}: the mesh is empty{problem}; expected triangles")
    bound = LIMITS.mesh_coordinate
    if not all((np.abs(part.points) <= bound).all() for part in parts):
        raise DescriptionError(
            f"{location}: a vertex is not finite or beyond {bound:g}; expected finite coordinates"
        )
    return parts


STL_HEADER, STL_FACE = 84, 50
"""Sizes of the header of a binary STL file, which ends with the number of triangles, and of a
triangle [bytes]."""

WEB_PAGE = b"<!doctype html", b"<html"
"""Starts of a web page, which a failed download leaves in place of a file."""


def _stl_size(data: bytes) -> int:
    """Return the size that the header of a binary STL file states [bytes]; 0 without a header."""
    if len(data) < STL_HEADER:
        return 0
    return STL_HEADER + STL_FACE * int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")


def _parse_mesh(data: bytes, kind: str) -> list[MeshPart]:
    """Return the parts of a mesh file without unused vertices."""
    with warnings.catch_warnings(), np.errstate(all="ignore"), _silent("trimesh.util"):
        warnings.simplefilter("ignore")
        raw_parts = _read_collada(data) if kind == "dae" else _read_trimesh(data, kind)
    parts = []
    for vertices, faces, color in raw_parts:
        # Files may keep vertices of triangles that were deleted.
        indices, numbers = np.unique(np.asarray(faces, dtype=np.int64), return_inverse=True)
        if len(indices) and not 0 <= indices[0] <= indices[-1] < len(vertices):
            raise ValueError("a triangle refers to a vertex that does not exist")
        points = np.asarray(vertices, dtype=np.float64)[indices]
        if len(indices):
            parts.append(MeshPart(points, numbers.reshape(-1, 3), color))
    return parts


@contextlib.contextmanager
def _silent(logger: str) -> Iterator[None]:
    """Suppress a library's log messages about damaged files; errors of the package replace them."""
    log = logging.getLogger(logger)
    previous, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = previous


def _read_trimesh(data: bytes, kind: str) -> list[tuple[Any, Any, str]]:
    """Return vertices, faces and colour of each part of a mesh file that trimesh reads."""
    with optional_import("meshes"):
        import trimesh

    if kind == "stl" and STL_HEADER < _stl_size(data) < len(data):
        data = data[: _stl_size(data)]  # some programs append their own data
    library: Any = trimesh
    scene = library.load_scene(io.BytesIO(data), file_type=kind, process=False, skip_materials=True)
    return [(mesh.vertices, mesh.faces, "") for mesh in scene.dump() if hasattr(mesh, "faces")]


def _read_collada(data: bytes) -> list[tuple[Any, Any, str]]:
    """Return the geometries of a COLLADA scene in metres, with the poses of the scene applied."""
    meshes = _collada_geometries(data, strict=True)
    if meshes is None:  # an error in the appearance must not make the geometry unreadable
        root = ElementTree.fromstring(data)
        for parent in list(root.iter()):
            for child in list(parent):
                if child.tag.rpartition("}")[2] in APPEARANCE_TAGS:
                    parent.remove(child)
        meshes = _collada_geometries(ElementTree.tostring(root), strict=False)
    return meshes or []


def _collada_geometries(data: bytes, strict: bool) -> list[tuple[Any, Any, str]] | None:
    """Return the geometries of a COLLADA scene; None if it has an error and `strict` is True."""
    with optional_import("COLLADA meshes"):
        import collada

    library: Any = collada
    try:
        document = library.Collada(io.BytesIO(data), ignore=[library.common.DaeError])
    except Exception:
        if strict:
            return None
        raise
    if strict and document.errors:
        return None
    unit = document.assetInfo.unitmeter or 1.0
    meshes: list[tuple[Any, Any, str]] = []
    for geometry in document.scene.objects("geometry") if document.scene else ():
        for primitive in geometry.primitives():
            faces = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
            if isinstance(faces, library.triangleset.BoundTriangleSet) and faces.vertex is not None:
                color = _collada_color(primitive.material)
                meshes.append((unit * faces.vertex, faces.vertex_index, color))
    return meshes


def _collada_color(material: Any) -> str:
    """Return the diffuse colour of a COLLADA material; "" if it is missing or a texture."""
    diffuse = getattr(getattr(material, "effect", None), "diffuse", None)
    return hex_color(diffuse) if isinstance(diffuse, tuple) and len(diffuse) >= 3 else ""


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
class _Header:
    """The header of a PLY or PCD file.

    Attributes:
        fields: Name, type and number of values of each field of a point.
        count: Number of points.
        form: "ascii", a byte order ("<" or ">"), or `COMPRESSED`.
    """

    fields: list[tuple[str, str, int]]
    count: int
    form: str


def read_points(path: Path, location: str) -> Array:
    """Read the finite points (k, 3) of a file, in the unit of the file.

    Args:
        path: ``.npy``, ``.npz`` (a single array, or one called ``points``): (k, 3), (H, W, 3) of a
            depth camera, or more columns, whose first three are used; ``.ply`` and ``.pcd``
            (text, binary or compressed); ``.xyz``, ``.txt``, ``.csv``: x, y and z in the first
            three columns, or in the columns that a header line names.
        location: File and key, for the message.

    Raises:
        DescriptionError: The file does not exist, is damaged, or holds no points.
    """
    readers: dict[str, Callable[[Path], Array]] = {
        ".npy": _npy,
        ".npz": _npz,
        ".ply": lambda file: _read_with_header(file, _read_ply_header),
        ".pcd": lambda file: _read_with_header(file, _read_pcd_header),
        **dict.fromkeys((".xyz", ".txt", ".csv"), _table),
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        suffixes = ", ".join(readers)
        raise DescriptionError(
            f"{location}: found {path.name!r}, expected a name that ends in {suffixes}"
        )
    if not path.is_file():
        raise DescriptionError(f"{location}: no such file {str(path)!r}")
    try:
        if path.stat().st_size > scaled_limit(LIMITS.cloud_bytes):
            raise ValueError(
                f"found more than {scaled_limit(LIMITS.cloud_bytes)} bytes {RAISE_HINT}"
            )
        points = reader(path)
    except DescriptionError as error:
        raise DescriptionError(f"{location}: {error}") from error
    except OSError as error:
        raise DescriptionError(f"{location}: {path.name}: {error.strerror or error}") from error
    except (*READ_ERRORS, TypeError, LookupError, StopIteration) as error:
        reason = " ".join(str(error).split())
        raise DescriptionError(f"{location}: {path.name} cannot be read: {reason}") from error
    return finite_points(points, f"{location}: {path.name}")


def finite_points(points: np.ndarray, location: str) -> Array:
    """Return the finite rows of points (k, 3); depth cameras mark rows without a distance by NaN.

    Raises:
        DescriptionError: The array has another shape or type, or no finite row.
    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        description = f"{points.dtype} of shape {points.shape}"
        raise DescriptionError(f"{location}: found {description}, expected numbers (k, 3)")
    finite = np.asarray(points[np.isfinite(points).all(axis=1)], dtype=np.float64)
    if not len(finite):
        raise DescriptionError(f"{location}: found no points, expected at least one")
    return finite


def _checked_count(count: int) -> int:
    max_count = scaled_limit(LIMITS.cloud_points)
    if not 0 <= count <= max_count:
        raise ValueError(f"found {count} points, expected at most {max_count} {RAISE_HINT}")
    return count


MAX_COLUMNS = 16
"""Largest number of columns of a point array: x, y, z, then colours, normals, intensities."""


def _npy(path: Path) -> Array:
    # A memory map neither allocates memory nor unpickles objects.
    array = np.lib.format.open_memmap(path, mode="r")
    return _coordinates(array)


def _coordinates(array: np.ndarray) -> Array:
    """Return the points (k, 3) of an array of points or of an image of points."""
    if array.dtype.names is not None and set("xyz") <= set(array.dtype.names):
        array = np.stack([array[axis] for axis in "xyz"], axis=-1)
    if array.ndim in (2, 3) and 3 <= array.shape[-1] <= MAX_COLUMNS:
        _checked_count(array.size // array.shape[-1])
        array = array[..., :3].reshape(-1, 3)
    return np.asarray(array)


def _npz(path: Path) -> Array:
    arrays = read_npz(path, 24 * LIMITS.cloud_points)
    if len(arrays) > 1 and "points" not in arrays:
        raise ValueError(f"found {', '.join(arrays)}, expected one array, or one called points")
    return _coordinates(arrays["points"] if "points" in arrays else next(iter(arrays.values())))


def _table(path: Path) -> Array:
    with path.open("rb") as stream:
        return _read_columns(stream, _columns_of_header(stream), None)


def _columns_of_header(stream: IO[bytes]) -> list[int]:
    """Skip the header line of a table, if there is one, and return the columns of x, y and z."""
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
    # The line is a header or the number of points. Comments are skipped with the table.
    is_comment = line.lstrip().startswith((b"#", b"//"))
    if (words and not numbers and not is_comment) or len(numbers) == 1:
        return [0, 1, 2]
    stream.seek(start)
    return [0, 1, 2]


def _read_columns(stream: IO[bytes], columns: list[int], count: int | None) -> Array:
    """Return columns of a table whose numbers are separated by spaces, commas or semicolons."""
    blanks = bytes.maketrans(b",;", b"  ")
    rows = (line.translate(blanks) for line in stream)
    max_rows = scaled_limit(LIMITS.cloud_points) + 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the caller reports empty files
        points = np.loadtxt(rows, comments=["#", "//"], usecols=columns, max_rows=max_rows, ndmin=2)
    _checked_count(len(points))
    if count is not None and len(points) < count:
        raise ValueError(f"found {len(points)} points, expected {count}")
    return points[:count].reshape(-1, 3)


def _read_with_header(path: Path, read_header: Callable[[IO[bytes]], _Header]) -> Array:
    """Return the points (k, 3) of a PLY or PCD file."""
    with path.open("rb") as stream:
        header = read_header(stream)
        names = [name for name, _, _ in header.fields]
        columns = [names.index(axis) if axis in names else -1 for axis in "xyz"]
        if min(columns) < 0:
            raise ValueError(f"found {' '.join(names)}, expected x, y and z")
        if header.form == "ascii":
            starts = np.cumsum([0, *(count for _, _, count in header.fields)])
            return _read_columns(stream, starts[columns].tolist(), header.count)
        if header.form == COMPRESSED:
            return _read_compressed(stream, header, columns)
        row = np.dtype(
            [
                (f"f{i}", f"{header.form}{kind}", count)
                for i, (_, kind, count) in enumerate(header.fields)
            ]
        )
        data = stream.read(row.itemsize * header.count)
        if len(data) < row.itemsize * header.count:
            raise ValueError(f"ends after {len(data) // row.itemsize} of {header.count} points")
        rows = np.frombuffer(data, row)
        return np.stack([rows[f"f{i}"].reshape(-1).astype(np.float64) for i in columns], axis=1)


def _read_compressed(stream: IO[bytes], header: _Header, columns: list[int]) -> Array:
    """Return the points of compressed data, which store all values of a field contiguously.

    Raises:
        ValueError: The data are damaged, or their size differs from the header.
    """
    packed_size, size = struct.unpack("<II", stream.read(8))
    kinds = [np.dtype((f"<{kind}", (count,))) for _, kind, count in header.fields]
    if size != header.count * sum(kind.itemsize for kind in kinds):
        raise ValueError(f"unpacks to {size} bytes, not to {header.count} points")
    check_unpacked_size("compressed data", size, LIMITS.cloud_bytes)
    data = unpack_lzf(stream.read(packed_size), size)
    starts = np.cumsum([0, *(header.count * kind.itemsize for kind in kinds)])
    values = [np.frombuffer(data, kinds[i], header.count, int(starts[i])) for i in columns]
    return np.stack([column.reshape(-1).astype(np.float64) for column in values], axis=1)


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """Decompress LZF data, as in PCD files.

    A control byte below 32 is followed by that many bytes plus one, which are copied. Any other
    control byte and the following ones encode the length and the distance of a copy from the
    output.

    Raises:
        ValueError: The data are damaged, or decompress to another size.
    """
    data, position = bytearray(), 0
    try:
        while position < len(packed):
            control = packed[position]
            position += 1
            if control < 32:
                data += packed[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[position]
                position += 1
            start = len(data) - ((control & 31) << 8) - packed[position] - 1
            position, length = position + 1, length + 2
            if start < 0 or len(data) + length > size:
                raise ValueError("the compressed data are damaged")
            # The copy may overlap its source, which then repeats.
            source = bytes(data[start : start + length])
            data += (source * (length // len(source) + 1))[:length]
    except IndexError as error:
        raise ValueError("the compressed data end too early") from error
    if len(data) != size:
        raise ValueError(f"unpacks to {len(data)} bytes, expected {size}")
    return bytes(data)


def _read_words(stream: IO[bytes]) -> list[str]:
    return stream.readline(1000).decode("ascii").split()


def _read_ply_header(stream: IO[bytes]) -> _Header:
    """Return the header of a PLY file; vertices must be its first element."""
    if _read_words(stream) != ["ply"]:
        raise ValueError("is not a PLY file")
    forms = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}
    header, elements = _Header([], 0, ""), 0
    for _ in range(LIMITS.cloud_head):
        match _read_words(stream):
            case ["format", form, _]:
                header.form = forms[form]
            case ["element", name, count]:
                elements += 1
                if elements == 1 and name != "vertex":
                    raise ValueError(f"begins with {name}, expected vertex first")
                header.count = _checked_count(int(count)) if elements == 1 else header.count
            case ["property", "list", *_] if elements == 1:
                raise ValueError("a vertex has lists, expected numbers")
            case ["property", kind, name] if elements == 1:
                header.fields.append((name, PLY_TYPES[kind], 1))
            case ["end_header"]:
                return header
            case _:
                pass
    raise ValueError("the header has no end")


def _read_pcd_header(stream: IO[bytes]) -> _Header:
    """Return the header of a PCD file."""
    entries: dict[str, list[str]] = {}
    for _ in range(LIMITS.cloud_head):
        words = _read_words(stream)
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
        if "DATA" in entries:
            break
    else:
        raise ValueError("is not a PCD file")
    form = entries["DATA"][0]
    if form not in ("ascii", "binary", COMPRESSED):
        raise ValueError(f"DATA: found {form}, expected ascii, binary or {COMPRESSED}")
    names = entries["FIELDS"]
    counts = [int(count) for count in entries.get("COUNT", ["1"] * len(names))]
    if not all(0 < count <= 1000 for count in counts):
        raise ValueError(f"COUNT: found {counts}, expected 1 to 1000")
    types = zip(entries["TYPE"], entries["SIZE"], strict=True)
    kinds = [f"{kind.lower()}{size}" for kind, size in types]
    count = int(entries["POINTS"][0] if "POINTS" in entries else entries["WIDTH"][0])
    fields = list(zip(names, kinds, counts, strict=True))
    return _Header(fields, _checked_count(count), "<" if form == "binary" else form)
