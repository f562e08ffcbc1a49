"""Objects to be grasped: a primitive shape with its mass, from a file that names its sources."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import Struct, read
from casadi_ik.files.shipped import resolve
from casadi_ik.files.units import Mass
from casadi_ik.grasps.meshes import Mesh
from casadi_ik.grasps.shapes import Shape


class MassEntry(Struct, frozen=True):
    """A mass [kg] and where it is from.

    Attributes:
        value: [kg].
        source: Tags of `sources`.
    """

    value: Mass
    source: str


class ObjectFile(Struct, frozen=True):
    """An object: ``models/objects/*.yaml``.

    Attributes:
        name: What it is called.
        description: One sentence.
        frame: Where its frame is, in words; z points up when it stands.
        shape: Centred in its frame.
        mass: And where that is from.
        sources: Where numbers are from, by tag.
    """

    name: str
    description: str
    frame: str
    shape: Shape
    mass: MassEntry
    sources: dict[str, str]


@dataclass(frozen=True)
class GraspObject:
    """A graspable object.

    Attributes:
        name: Of the description.
        description: One sentence.
        frame: Where the object frame is, in words; its z points up when the object stands.
        shape: The primitive, centred in the object frame.
        mass: [kg].
        sources: Where the numbers come from, by tag.
    """

    name: str
    description: str
    frame: str
    shape: Shape
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
        name_or_path: A shipped name (`shipped_names("objects")`) or the path of a YAML file.

    Raises:
        UnknownNameError: No shipped object has that name.
        DescriptionError: The file is missing or malformed; the message names file and key.
    """
    path = resolve(name_or_path, "objects")
    entry, _ = read(path, ObjectFile)
    problem = entry.shape.check()
    if problem:
        raise DescriptionError(f"{path}: shape.{problem}")
    if not 0 < entry.mass.value < np.inf:
        raise DescriptionError(
            f"{path}: mass.value: found {entry.mass.value}, expected a positive finite mass"
        )
    for key, tags in (("shape", entry.shape.source), ("mass", entry.mass.source)):
        _known_source(tags, entry.sources, f"{path}: {key}.source")
    return GraspObject(
        entry.name, entry.description, entry.frame, entry.shape, entry.mass.value, entry.sources
    )


def _known_source(tags: str, sources: dict[str, str], where: str) -> None:
    names = tags.replace(",", " ").split()
    if not names:
        raise DescriptionError(f"{where}: is empty; every number needs its source")
    for tag in names:
        if tag not in sources:
            raise DescriptionError(f"{where}: unknown tag {tag!r}; sources: {', '.join(sources)}")
