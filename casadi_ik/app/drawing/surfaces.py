"""Shapes that things are drawn with: rods, drums, arrows, rings, meshes; care of meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from trimesh import Trimesh
from trimesh.creation import revolve, torus
from trimesh.graph import smooth_shade

from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.surfaces import Surface, together
from casadi_ik.model.shapes import capsule_mesh

AROUND = 32
"""Points around an axis."""


def facing(point: Array, normal: Array, like: Array | None = None) -> Array:
    """(4, 4) pose at a point whose x axis is a direction, otherwise turned as little as may be.

    Args:
        point: (3,) [m].
        normal: (3,) any length but zero.
        like: (3, 3) what it is turned from; None: the base frame.
    """
    x = normal / np.linalg.norm(normal)
    axes = (np.eye(3) if like is None else like).T
    sides = [axis - x * (x @ axis) for axis in axes[[1, 2, 0]]]
    y = next(side for side in sides if np.linalg.norm(side) >= 1e-3)
    y /= np.linalg.norm(y)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, y, np.cross(x, y), point])
    return pose


def upright(point: Array, axis: Array) -> Array:
    """(4, 4) pose at a point whose z axis is a direction (3,)."""
    return facing(point, axis)[:, [1, 2, 0, 3]]


@dataclass(frozen=True, eq=False)
class Shape:
    """A shape by its numbers, or as triangles.

    Attributes:
        kind: One of `KINDS`, or "mesh".
        size: Its numbers [m], as the function of its kind takes them.
        pose: (4, 4) of its own frame, along whose z axis it is turned.
        mesh: Triangles in its own frame, of a mesh.
    """

    kind: str
    size: tuple[float, ...] = ()
    pose: Array = field(default_factory=lambda: np.eye(4))
    mesh: Surface | None = None

    @cached_property
    def surface(self) -> Surface:
        """Triangles that wind outwards."""
        own = KINDS[self.kind](*self.size) if self.mesh is None else self.mesh
        return own.moved(self.pose)

    def moved(self, pose: Array) -> Shape:
        """The same in another frame, in which its own has a (4, 4) pose."""
        return replace(self, pose=pose @ self.pose)


def mesh_of(surface: Surface) -> Shape:
    """Triangles as a shape."""
    return Shape("mesh", mesh=surface)


def ball(radius: float, center: ArrayLike = (0.0, 0.0, 0.0)) -> Shape:
    """A ball."""
    pose = np.eye(4)
    pose[:3, 3] = center
    return Shape("capsule", (radius, 0.0), pose)


def rod(start: Array, end: Array, radius: float) -> Shape:
    """A tube with round ends between two points."""
    length = float(np.linalg.norm(end - start))
    if length < 1e-9:
        return ball(radius, start)
    return Shape("capsule", (radius, length), upright((start + end) / 2, end - start))


def drum(center: Array, axis: Array, radius: float, length: float) -> Shape:
    """A cylinder with rounded edges about a point."""
    return Shape("drum", (radius, length), upright(center, axis))


def arrow(start: Array, direction: Array, length: float, width: float) -> Shape:
    """An arrow whose shaft is `width` thick."""
    return Shape("arrow", (length, width), upright(start, direction))


def ring(center: Array, axis: Array, radius: float, width: float) -> Shape:
    """A thin ring about an axis through its centre."""
    return Shape("ring", (radius, width), upright(center, axis))


def _made(mesh: Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _turned(profile: ArrayLike) -> Surface:
    """A closed body about z of a profile (m, 2): radius and height, from below to above [m]."""
    rows = np.asarray(profile, dtype=float)
    axis = rows[[0, -1]] * [0.0, 1.0]
    return _made(revolve(np.vstack([axis[0], rows, axis[1]]), sections=AROUND))


def _drum(radius: float, length: float) -> Surface:
    edge = 0.12 * min(radius, length)
    bow = edge * np.sin(np.linspace(0, np.pi / 2, 5))
    rise = np.column_stack([radius - edge + bow, -length / 2 + edge - bow[::-1]])
    return _turned(np.concatenate([rise, rise[::-1] * [1, -1]]))


def _arrow(length: float, width: float) -> Surface:
    tip = min(0.45 * length, 3.2 * width)
    shaft, head = width / 2, 1.35 * width
    profile = [(shaft, 0), (shaft, length - tip), (head, length - tip), (1e-3 * head, length)]
    return _turned(profile)


KINDS: dict[str, Callable[..., Surface]] = {
    "capsule": lambda radius, length: Surface(*capsule_mesh(radius, length / 2, AROUND)),
    "drum": _drum,
    "arrow": _arrow,
    "ring": lambda radius, width: _made(torus(radius, width / 2, 2 * AROUND, 12)),
}
"""Of shapes by their numbers: capsule (radius, length without the caps), drum (radius, length),
arrow (length, width of its shaft), ring (radius, width)."""


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Several surfaces as one."""
    whole = together(list(surfaces))
    assert whole is not None
    return whole


def sharp(body: Surface, degrees: float = 35.0) -> Surface:
    """The same with points doubled where faces meet at an edge, as smooth shading needs it.

    Args:
        body: The surface.
        degrees: Faces that meet at a larger angle meet at an edge.
    """
    return _made(smooth_shade(Trimesh(body.points, body.triangles), angle=np.deg2rad(degrees)))


def coarser(body: Surface, most: int = 3000) -> Surface:
    """A surface with no more than about so many triangles: points of a cell become one."""
    size = float(np.ptp(body.points, axis=0).max()) / 256 if len(body.points) else 0.0
    while len(body.triangles) > most:
        cells = np.round(body.points / size).astype(np.int64)
        _, first, of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        triangles = of.reshape(-1)[body.triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (a != c)]
        body = Surface(body.points[first], np.unique(triangles, axis=0))
        size *= 1.4
    return body
