"""Shapes of links as triangles, in the links' frames, as far as a file and its meshes are there."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.units import warn_of_large_mesh
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import read_mesh
from casadi_ik.model.sandbox import package_folders
from casadi_ik.model.shapes import box_mesh, capsule_mesh, circle, prism_mesh
from casadi_ik.model.xml_tree import (
    Element,
    RobotTree,
    collides,
    mjcf_pose,
    origin_pose,
    parse_numbers,
    simple_geom,
    simple_shape,
)

AROUND = 24
"""Points around an axis."""

Triangles = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Surface:
    """A shape.

    Attributes:
        points: (k, 3) corners [m].
        triangles: (t, 3) rows of them.
    """

    points: Array
    triangles: Triangles

    def moved(self, pose: Array) -> Surface:
        """The same shape in another frame, in which its own has a (4, 4) pose."""
        return Surface(self.points @ pose[:3, :3].T + pose[:3, 3], self.triangles)

    def simplified(self, max_triangles: int, cells: int) -> Surface:
        """Return the shape with fewer triangles if it has more than `max_triangles`.

        The points in a cell of a grid become one of them, so that a point moves by no more than
        the diagonal of a cell.

        Args:
            max_triangles: Number of triangles up to which the shape stays as it is.
            cells: Number of cells along the longest edge of the bounding box.
        """
        if len(self.triangles) <= max_triangles:
            return self
        rows, numbers = clusters(self.points, cells)
        a, b, c = numbers[self.triangles].T
        triangles = np.stack([a, b, c], axis=1)[(a != b) & (b != c) & (c != a)]
        return Surface(self.points[rows], triangles)

    def centroid(self) -> Array:
        """(3,) mean of the surface by area."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        middle = (a + b + c) / 3
        total = float(areas.sum())
        return areas @ middle / total if total > 0 else self.points.mean(axis=0)

    def facing(self, point: Array, radius: float, normal: Array) -> Array:
        """(3,) unit mean normal of what is near a point and faces roughly that way."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        areas = np.cross(b - a, c - a) / 2
        near = np.linalg.norm((a + b + c) / 3 - point, axis=1) <= radius
        ways = areas[near]
        cosines = ways @ normal / np.maximum(np.linalg.norm(ways, axis=1), 1e-30)
        # Whichever way a mesh winds its triangles.
        total = (
            ways[np.abs(cosines) > 0.3] * np.sign(cosines[np.abs(cosines) > 0.3])[:, None]
        ).sum(axis=0)
        length = float(np.linalg.norm(total))
        return total / length if length > 0 else normal

    def hit(self, start: Array, direction: Array) -> Array | None:
        """(3,) where a ray first meets the shape; None: it passes."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        ab, ac = b - a, c - a
        across = np.cross(direction, ac)
        volume = np.einsum("ij,ij->i", ab, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = start - a
            u = np.einsum("ij,ij->i", away, across) / volume
            turned = np.cross(away, ab)
            v = turned @ direction / volume
            along = np.einsum("ij,ij->i", turned, ac) / volume
            inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (along > 0)
        found = along[inside & np.isfinite(along)]
        return start + float(found.min()) * direction if len(found) else None


def clusters(points: Array, cells: int) -> tuple[Triangles, Triangles]:
    """Group points by the cells of a grid.

    Args:
        points: (k, 3) points [m].
        cells: Number of cells along the longest edge of their bounding box.

    Returns:
        (c,) row of the outermost point of each occupied cell, and (k,) the number of the cell that
        each point is in.
    """
    low = points.min(axis=0)
    cell = max(float(np.ptp(points, axis=0).max()) / cells, 1e-12)
    key = ((points - low) / cell).astype(np.int64) @ np.array([1, 2 * cells, 4 * cells**2])
    inward = -((points - points.mean(axis=0)) ** 2).sum(axis=1)
    order = np.lexsort((inward, key))
    starts = np.ones(len(order), bool)
    starts[1:] = np.diff(key[order]) != 0
    numbers = np.empty(len(points), np.int64)
    numbers[order] = np.cumsum(starts) - 1
    return order[starts], numbers


def together(surfaces: list[Surface]) -> Surface | None:
    """Several shapes as one; None of none."""
    if not surfaces:
        return None
    counts = np.cumsum([0, *(len(one.points) for one in surfaces[:-1])])
    triangles = [one.triangles + n for one, n in zip(surfaces, counts, strict=True)]
    return Surface(np.concatenate([one.points for one in surfaces]), np.concatenate(triangles))


def link_surfaces(
    tree: RobotTree, links: Collection[str], seen: bool = False
) -> tuple[dict[str, Surface], list[str]]:
    """Shapes of a file's links: those for collisions, else those that are seen.

    Args:
        tree: The file.
        links: Those that are wanted: fine meshes take a second each.
        seen: Whether those that are seen are wanted instead.

    Returns:
        By link its shape in its frame; and what is not there, a line each.
    """
    if tree.model is not None:
        found = _of_mjcf(*tree.model, seen)
        return {link: found[link] for link in links if link in found}, []
    assert tree.element is not None
    missing = Missing(tree.path)
    found: dict[str, Surface] = {}
    for kind in ("visual", "collision") if seen else ("collision", "visual"):
        rest = [link for link in links if link not in found]
        found |= _of_urdf(tree.element, kind, rest, missing)
    return found, missing.lines()


class Missing:
    """Meshes that are not there, or cannot be read."""

    def __init__(self, path: Path) -> None:
        """Of a robot's file."""
        self.path = path
        self._packages: dict[str, list[str]] = {}
        self._files: list[str] = []
        self._broken: list[str] = []

    def absent(self, name: str) -> None:
        """There is no such mesh."""
        scheme, _, inside = name.partition("://")
        package = inside.partition("/")[0] if scheme in PACKAGED else ""
        if package and not any(package_folders(package, self.path)):
            self._packages.setdefault(package, []).append(name)
        else:
            self._files.append(name)

    def broken(self, reason: str) -> None:
        """A mesh cannot be read."""
        self._broken.append(reason)

    def lines(self) -> list[str]:
        """What to say: a line for each package, one for all other files, one for each fault."""
        found = [
            f"{self.path.name}: package {name!r} is not found ({_counted(meshes)}): name the "
            "folder that holds it in the environment, ROS_PACKAGE_PATH=FOLDER casadi-ik import ..."
            for name, meshes in self._packages.items()
        ]
        if self._files:
            found.append(f"{self.path.name}: there is no such file ({_counted(self._files)})")
        return found + list(dict.fromkeys(self._broken))


def _counted(meshes: list[str]) -> str:
    """Meshes by their number and the first one's name."""
    once = list(dict.fromkeys(meshes))
    return f"mesh {once[0]!r}" if len(once) == 1 else f"{len(once)} meshes, one is {once[0]!r}"


def _of_urdf(
    element: Element, kind: str, links: Collection[str], missing: Missing
) -> dict[str, Surface]:
    found: dict[str, Surface] = {}
    for link in element.findall("link"):
        name = link.get("name", "")
        if name in links:
            parts = [_of_element(one, missing) for one in link.findall(kind)]
            whole = together([one for one in parts if one is not None])
            if whole is not None:
                found[name] = whole
    return found


def _of_element(shape: Element, missing: Missing) -> Surface | None:
    """An element ``collision`` or ``visual`` in its link's frame."""
    mesh, simple, pose = shape.find("geometry/mesh"), simple_shape(shape), origin_pose(shape)
    surface = None
    if mesh is not None:
        surface = _of_mesh(mesh, missing)
    elif simple is not None:
        surface = simple_surface(simple[0], np.array(simple[1]))
    return None if surface is None or pose is None else surface.moved(pose)


def _of_mesh(element: Element, missing: Missing) -> Surface | None:
    name = element.get("filename", "")
    place = mesh_file(name, missing.path)
    if place is None:
        missing.absent(name)
        return None
    scale = parse_numbers(element.get("scale", "1 1 1"))
    try:
        points, triangles = read_mesh(place, missing.path.name)
    except DescriptionError as error:
        missing.broken(str(error))
        return None
    if len(triangles) > LIMITS.link_triangles:
        triangles = triangles[:0]
    if len(scale) != 3 or max(map(abs, scale)) > LIMITS.mesh_coordinate:
        missing.broken(f"{missing.path.name}: mesh {name!r}: scale: expected three finite numbers")
        return None
    warn_of_large_mesh(points * scale, f"{missing.path.name}: mesh {name!r}")
    return Surface(points * scale, triangles)


PACKAGED = ("package", "model")
"""Schemes of meshes that are named by their package."""


def mesh_file(name: str, path: Path) -> Path | None:
    """Where a mesh is that a URDF names; packages are looked for above the file."""
    scheme, _, inside = name.partition("://")
    if scheme not in PACKAGED:
        places = [path.parent / name.removeprefix("file://")]
    else:
        package, _, rest = inside.partition("/")
        places = [one / rest for found in package_folders(package, path) for one in found]
    return next((place for place in places if place.is_file()), None)


def simple_surface(kind: str, size: Array) -> Surface:
    """A box by its edges, a sphere, or a capsule or cylinder along z by radius and length [m]."""
    if kind == "box":
        return Surface(*box_mesh(size / 2))
    if kind == "cylinder":
        return Surface(*prism_mesh(size[0] * circle(AROUND), size[1]))
    return Surface(*capsule_mesh(size[0], size[1] / 2 if kind == "capsule" else 0.0, AROUND))


def _of_mjcf(mujoco: Any, model: Any, seen: bool) -> dict[str, Surface]:
    by_body: dict[int, list[tuple[bool, Surface]]] = {}
    for geom in range(model.ngeom):
        surface = _of_geom(mujoco, model, geom)
        if surface is None:
            continue
        pose = mjcf_pose(mujoco, model.geom_pos[geom], model.geom_quat[geom])
        parts = by_body.setdefault(int(model.geom_bodyid[geom]), [])
        parts.append((collides(model, geom), surface.moved(pose)))
    found: dict[str, Surface] = {}
    for body, parts in by_body.items():
        chosen = [one for solid, one in parts if solid != seen] or [one for _, one in parts]
        whole = together(chosen)
        if whole is not None:
            found[model.body(body).name or f"body_{body}"] = whole
    return found


def _of_geom(mujoco: Any, model: Any, geom: int) -> Surface | None:
    kind, simple = int(model.geom_type[geom]), simple_geom(mujoco, model, geom)
    if simple is not None:
        return simple_surface(simple[0], np.array(simple[1]))
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        ball = simple_surface("sphere", np.ones(1))
        return Surface(ball.points * model.geom_size[geom], ball.triangles)
    if kind != mujoco.mjtGeom.mjGEOM_MESH:
        return None
    mesh = int(model.geom_dataid[geom])
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    first, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    points = np.array(model.mesh_vert[start : start + count], dtype=float)
    return Surface(points, np.array(model.mesh_face[first : first + faces], dtype=np.int64))
