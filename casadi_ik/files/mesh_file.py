"""Triangles of somebody's mesh, read by trimesh: what is broken ends in one line."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import LIMITS, RAISED, limit
from casadi_ik.files.reading import read_bytes

FORMATS = (".stl", ".obj", ".ply", ".dae", ".off", ".glb")
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
    if kind not in FORMATS:
        raise DescriptionError(f"{where}: found {kind!r}, expected one of {', '.join(FORMATS)}")
    data = read_bytes(path, where, limit(LIMITS.mesh_bytes), RAISED)
    try:
        points, triangles = _parsed(data, kind[1:])
    except Exception as error:  # whatever a broken file leads a reader into
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DescriptionError(f"{where}: cannot be read: {reason}") from error
    if len(triangles) > limit(LIMITS.mesh_faces):
        most = f"at most {limit(LIMITS.mesh_faces)} {RAISED}"
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
