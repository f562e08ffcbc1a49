"""Objects to be grasped: a shape with its mass from a description with sources, or a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import Struct, read
from casadi_ik.files.shipped import resolve_description
from casadi_ik.files.units import Factor, Mass
from casadi_ik.model.mesh_shape import BODY_FORMATS, MeshShape, load_mesh_shape
from casadi_ik.model.parts import require_source
from casadi_ik.model.shapes import Mesh, Shape


class MassEntry(Struct, frozen=True):
    """A mass and its source.

    Attributes:
        value: Mass [kg].
        source: Tags of `sources`.
    """

    value: Mass
    source: str


class MeshFileEntry(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    tag_field="kind",
    tag="mesh",
    kw_only=True,
):
    """A body bounded by triangles; collision checks take its pieces as convex.

    Attributes:
        source: Tags of `sources` for the numbers.
        file: Mesh, or meshes that form one body; relative to the object's file.
        scale: Factor from the unit of the files to metres.
    """

    source: str
    file: str | list[str]
    scale: Factor = 1.0

    def check(self) -> str:
        """Return the problem of the numbers as "key: found, expected", or ""."""
        return "" if self.file else "file: found none, expected at least one"


class ObjectFile(Struct, frozen=True):
    """An object: ``models/objects/*.yaml``.

    Attributes:
        name: Name.
        description: Description in one sentence.
        frame: Location of its frame, in words; z points up when the object stands.
        shape: Shape, centred in the object's frame; a mesh keeps the frame of its file.
        mass: Mass and its source.
        sources: Sources of numbers by tag.
    """

    name: str
    description: str
    frame: str
    shape: Shape | MeshFileEntry
    mass: MassEntry
    sources: dict[str, str]


@dataclass(frozen=True)
class GraspObject:
    """A graspable object.

    Attributes:
        name: Name of the description.
        description: Description in one sentence.
        frame: Location of the object frame, in words; z points up when the object stands.
        shape: Primitive, centred in the object frame, or mesh in the frame of its file.
        mass: Mass [kg]; NaN if unknown.
        sources: Sources of the numbers by tag.
    """

    name: str
    description: str
    frame: str
    shape: Shape | MeshShape
    mass: float
    sources: dict[str, str]

    def signed_distance(self, points: ArrayLike) -> Array:
        """Return the distances (k,) of points (k, 3) to the surface [m], negative inside."""
        return self.shape.signed_distance(points)

    def normal(self, points: ArrayLike) -> Array:
        """Return the unit outward surface normals (k, 3) nearest to points (k, 3)."""
        return self.shape.normal(points)

    def mesh(self, resolution: int = 32) -> Mesh:
        """Return vertices (v, 3) [m] and triangles (t, 3) in the object frame, for drawing."""
        return self.shape.mesh(resolution)


def load_object(name_or_path: str | Path) -> GraspObject:
    """Load an object.

    Args:
        name_or_path: A shipped name (`shipped_names("objects")`), the path of a YAML file, or the
            path of a mesh in metres or of a URDF: ``mug.obj``; ``mug.obj@0.08`` scales it by that
            factor, and ``body.stl,handle.stl`` are one body.

    Raises:
        UnknownNameError: No shipped object has that name.
        DescriptionError: The file is missing or malformed; the message names file and key.
    """
    if is_mesh_name(name_or_path):
        return _object_from_mesh(str(name_or_path))
    path = resolve_description(name_or_path, "objects")
    entry, _ = read(path, ObjectFile)
    problem = entry.shape.check()
    if problem:
        raise DescriptionError(f"{path}: shape.{problem}")
    for key, tags in (("shape", entry.shape.source), ("mass", entry.mass.source)):
        require_source(tags, entry.sources, f"{path}: {key}.source")
    shape = entry.shape
    if isinstance(shape, MeshFileEntry):
        names = [shape.file] if isinstance(shape.file, str) else shape.file
        files = [path.parent / Path(name).expanduser() for name in names]
        shape = load_mesh_shape(files, shape.scale, f"{path}: shape.file")
    return GraspObject(
        entry.name, entry.description, entry.frame, shape, entry.mass.value, entry.sources
    )


def is_mesh_name(name: str | Path) -> bool:
    """Return True if an object's name consists of paths of meshes or URDFs."""
    files, _, _ = _split_mesh_name(str(name))
    return all(file.lower().endswith(BODY_FORMATS) for file in files)


def _split_mesh_name(name: str) -> tuple[list[str], str, str]:
    """Return the files, "@" or "", and the scale factor after it."""
    files, separator, factor = name.rpartition("@")
    if not separator or "/" in factor:
        files, separator, factor = name, "", "1"
    return files.split(","), separator, factor


def _object_from_mesh(name: str) -> GraspObject:
    """Return the object of mesh files with a scale, written as `load_object` accepts them."""
    files, _, factor = _split_mesh_name(name)
    try:
        scale = float(factor)
    except ValueError:
        scale = np.nan
    if not 0 < scale < np.inf:
        raise DescriptionError(f"{name}: found factor {factor!r}, expected a number > 0")
    shape = load_mesh_shape([Path(file).expanduser() for file in files], scale, name)
    return GraspObject(name, "A mesh.", "that of the mesh", shape, np.nan, {})
