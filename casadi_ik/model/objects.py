"""Objects to be grasped: a shape with its mass, from a file that names its sources; or a mesh."""

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
from casadi_ik.model.parts import require_source
from casadi_ik.model.shapes import Mesh, MeshShape, Shape, load_mesh_shape
from casadi_ik.model.urdf_body import BODY_FORMATS


class MassEntry(Struct, frozen=True):
    """A mass [kg] and where it is from.

    Attributes:
        value: [kg].
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
    """A body bounded by triangles; its pieces are taken as convex where collisions are looked at.

    Attributes:
        source: Tags of the sources of its numbers.
        file: A mesh, or several that are one body; paths are counted from the object's file.
        scale: By what factor it is larger than they say, in metres.
    """

    source: str
    file: str | list[str]
    scale: Factor = 1.0

    def check(self) -> str:
        """What is wrong with the numbers, as "key: found, expected", or ""."""
        return "" if self.file else "file: found none, expected at least one"


class ObjectFile(Struct, frozen=True):
    """An object: ``models/objects/*.yaml``.

    Attributes:
        name: What it is called.
        description: One sentence.
        frame: Where its frame is, in words; z points up when it stands.
        shape: Centred in its frame; of a mesh the frame is the mesh's.
        mass: And where that is from.
        sources: Where numbers are from, by tag.
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
        name: Of the description.
        description: One sentence.
        frame: Where the object frame is, in words; its z points up when the object stands.
        shape: The primitive, centred in the object frame, or the mesh in its own.
        mass: [kg]; NaN where it is not known.
        sources: Where the numbers come from, by tag.
    """

    name: str
    description: str
    frame: str
    shape: Shape | MeshShape
    mass: float
    sources: dict[str, str]

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance of points (k, 3) of the object frame to the surface (k,) [m], < 0 inside."""
        return self.shape.signed_distance(points)

    def normal(self, points: ArrayLike) -> Array:
        """Unit outward surface normal (k, 3) nearest to points (k, 3) of the object frame."""
        return self.shape.normal(points)

    def mesh(self, resolution: int = 32) -> Mesh:
        """Vertices (v, 3) [m] and triangles (t, 3) in the object frame, for drawing."""
        return self.shape.mesh(resolution)


def load_object(name_or_path: str | Path) -> GraspObject:
    """Load an object.

    Args:
        name_or_path: A shipped name (`shipped_names("objects")`), the path of a YAML file, or that
            of a mesh in metres or of a URDF: ``mug.obj``; ``mug.obj@0.08`` is larger by that
            factor, and ``body.stl,handle.stl`` are one body.

    Raises:
        UnknownNameError: No shipped object has that name.
        DescriptionError: The file is missing or malformed; the message names file and key.
    """
    if is_mesh_name(name_or_path):
        return _of_mesh(str(name_or_path))
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
    """Return whether an object's name is that of meshes or URDFs."""
    files, _, _ = _mesh_words(str(name))
    return all(file.lower().endswith(BODY_FORMATS) for file in files)


def _mesh_words(name: str) -> tuple[list[str], str, str]:
    """Files, "@" or "", and the factor behind it."""
    files, at, factor = name.rpartition("@")
    if not at or "/" in factor:
        files, at, factor = name, "", "1"
    return files.split(","), at, factor


def _of_mesh(name: str) -> GraspObject:
    files, _, factor = _mesh_words(name)
    try:
        scale = float(factor)
    except ValueError:
        scale = np.nan
    if not 0 < scale < np.inf:
        raise DescriptionError(f"{name}: found factor {factor!r}, expected a number > 0")
    shape = load_mesh_shape([Path(one).expanduser() for one in files], scale, name)
    return GraspObject(name, "A mesh.", "that of the mesh", shape, np.nan, {})
