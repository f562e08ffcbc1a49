"""Shapes of links as triangles, in the links' frames, as far as a file and its meshes are there."""

from __future__ import annotations

import os
from collections.abc import Collection
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.robots.robot_files.mjcf_file import mujoco_model
from casadi_ik.robots.robot_files.read import robot_element
from casadi_ik.robots.robot_files.urdf_file import bare, pinocchio, silent

AROUND = 24
"""Points around an axis."""

MOST_TRIANGLES = 200_000
"""Of one link; of a finer mesh only the points are kept."""

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


def together(surfaces: list[Surface]) -> Surface | None:
    """Several shapes as one; None of none."""
    if not surfaces:
        return None
    counts = np.cumsum([0, *(len(one.points) for one in surfaces[:-1])])
    triangles = [one.triangles + n for one, n in zip(surfaces, counts, strict=True)]
    return Surface(np.concatenate([one.points for one in surfaces]), np.concatenate(triangles))


def link_surfaces(path: Path, links: Collection[str]) -> tuple[dict[str, Surface], list[str]]:
    """Shapes of a file's links: those for collisions, else those that are seen.

    Args:
        path: The file.
        links: Those that are wanted: fine meshes take a second each.

    Returns:
        By link its shape in its frame; and what is not there: a line each.

    Raises:
        DescriptionError: The file cannot be read.
        MissingExtraError: What reads it is not installed.
    """
    element = robot_element(path)
    if element.tag == "mujoco":
        found = _of_mjcf(path)
        return {link: found[link] for link in links if link in found}, []
    missing: list[str] = []
    found = _of_urdf(element, path, "collision", links, missing)
    rest = [link for link in links if link not in found]
    found |= _of_urdf(element, path, "visual", rest, missing)
    return found, list(dict.fromkeys(missing))


def _of_urdf(
    element: ElementTree.Element, path: Path, kind: str, links: Collection[str], missing: list[str]
) -> dict[str, Surface]:
    plain = bare(element)
    for ours, theirs in zip(plain.findall("link"), element.findall("link"), strict=True):
        if ours.get("name") not in links:
            continue
        for shape in theirs.findall(kind):
            copy = deepcopy(shape)
            mesh = copy.find("geometry/mesh")
            if mesh is not None:
                place = mesh_file(mesh.get("filename", ""), path)
                if place is None:
                    missing.append(f"{path.name}: no mesh {mesh.get('filename')!r}")
                    continue
                mesh.set("filename", str(place))
            for look in copy.findall("material"):
                copy.remove(look)
            ours.append(copy)
    module = pinocchio()
    text = ElementTree.tostring(plain, encoding="unicode")
    wanted = module.GeometryType.COLLISION if kind == "collision" else module.GeometryType.VISUAL
    with silent() as said:
        try:
            model = module.buildModelFromXML(text)
            shapes = module.buildGeomFromUrdfString(model, text, wanted)
        except (ValueError, RuntimeError) as error:
            missing.append(f"{path.name}: its {kind} shapes cannot be read: {said() or error}")
            return {}
    by_link: dict[str, list[Surface]] = {}
    for one in shapes.geometryObjects:
        frame = model.frames[one.parentFrame]
        pose = (frame.placement.inverse() * one.placement).homogeneous
        surface = _of_coal(one.geometry)
        if surface is not None:
            by_link.setdefault(frame.name, []).append(surface.moved(pose))
    return {link: one for link, parts in by_link.items() if (one := together(parts)) is not None}


def mesh_file(name: str, path: Path) -> Path | None:
    """Where a mesh is that a URDF names; packages are looked for above the file."""
    for scheme in ("package://", "model://"):
        if name.startswith(scheme):
            inside = name.removeprefix(scheme)
            package, _, rest = inside.partition("/")
            places = [parent / inside for parent in path.resolve().parents]
            places += [p / rest for p in path.resolve().parents if p.name == package]
            known = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
            places += [Path(folder) / inside for folder in known if folder]
            break
    else:
        places = [path.parent / name.removeprefix("file://")]
    return next((place for place in places if place.is_file()), None)


def _of_coal(shape: Any) -> Surface | None:
    kind = type(shape).__name__
    if kind == "Box":
        return box_shape(np.asarray(shape.halfSide))
    if kind in ("Sphere", "Capsule", "Cylinder"):
        return round_shape(float(shape.radius), float(getattr(shape, "halfLength", 0.0)), kind)
    if not hasattr(shape, "vertices") or not hasattr(shape, "num_tris"):
        return None
    points = np.asarray(shape.vertices())
    if shape.num_tris > MOST_TRIANGLES:
        return Surface(points, np.zeros((0, 3), dtype=np.int64))
    corners = map(shape.tri_indices, range(shape.num_tris))
    triangles = [(one[0], one[1], one[2]) for one in corners]
    return Surface(points, np.array(triangles, dtype=np.int64).reshape(-1, 3))


def box_shape(half: Array) -> Surface:
    """A box about the origin by half its edges (3,)."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Surface(corners.astype(float), np.array(triangles, dtype=np.int64))


def round_shape(radius: float, half: float, kind: str) -> Surface:
    """A sphere, or a capsule or cylinder along z."""
    if kind == "Cylinder":
        profile = np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]])
    else:
        angles = np.linspace(-np.pi / 2, np.pi / 2, AROUND // 2 + 1)
        profile = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        profile[:, 1] += np.where(angles < 0, -half, half)
    turns = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    rings = [
        np.column_stack([r * np.cos(turns), r * np.sin(turns), np.full(AROUND, z)])
        for r, z in profile
    ]
    i, j = np.meshgrid(np.arange(len(rings) - 1), np.arange(AROUND), indexing="ij")
    a, b = i * AROUND + j, i * AROUND + (j + 1) % AROUND
    c, d = a + AROUND, b + AROUND
    triangles = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    return Surface(np.concatenate(rings), triangles)


def _of_mjcf(path: Path) -> dict[str, Surface]:
    mujoco, model = mujoco_model(path)
    by_body: dict[int, list[tuple[bool, Surface]]] = {}
    for geom in range(model.ngeom):
        surface = _of_geom(mujoco, model, geom)
        if surface is None:
            continue
        pose, flat = np.eye(4), np.empty(9)
        mujoco.mju_quat2Mat(flat, model.geom_quat[geom])
        pose[:3, :3], pose[:3, 3] = flat.reshape(3, 3), model.geom_pos[geom]
        solid = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        body = int(model.geom_bodyid[geom])
        by_body.setdefault(body, []).append((solid, surface.moved(pose)))
    found: dict[str, Surface] = {}
    for body, parts in by_body.items():
        chosen = [one for solid, one in parts if solid] or [one for _, one in parts]
        whole = together(chosen)
        if whole is not None:
            found[model.body(body).name or f"body_{body}"] = whole
    return found


def _of_geom(mujoco: Any, model: Any, geom: int) -> Surface | None:
    kind, size = int(model.geom_type[geom]), np.array(model.geom_size[geom])
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_BOX:
        return box_shape(size)
    if kind == types.mjGEOM_SPHERE:
        return round_shape(size[0], 0.0, "Sphere")
    if kind == types.mjGEOM_CAPSULE:
        return round_shape(size[0], size[1], "Capsule")
    if kind == types.mjGEOM_CYLINDER:
        return round_shape(size[0], size[1], "Cylinder")
    if kind == types.mjGEOM_ELLIPSOID:
        ball = round_shape(1.0, 0.0, "Sphere")
        return Surface(ball.points * size, ball.triangles)
    if kind != types.mjGEOM_MESH:
        return None
    mesh = int(model.geom_dataid[geom])
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    first, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    points = np.array(model.mesh_vert[start : start + count], dtype=float)
    return Surface(points, np.array(model.mesh_face[first : first + faces], dtype=np.int64))


def checked_surfaces(path: Path, links: Collection[str]) -> tuple[dict[str, Surface], list[str]]:
    """`link_surfaces`; where they cannot be had at all, none and the reason."""
    try:
        return link_surfaces(path, links)
    except DescriptionError as error:
        return {}, [str(error)]
