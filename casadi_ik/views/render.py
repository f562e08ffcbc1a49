"""A small z-buffer renderer: solids seen by a parallel camera, as an image.

Matplotlib's own 3D axes sort whole polygons by depth, which goes wrong where a finger wraps around
an object. Here every pixel is decided for itself, four samples each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import matplotlib.colors as mcolors
import numpy as np
from numpy.typing import NDArray

from casadi_ik.views.camera import Camera
from casadi_ik.views.floor import floor_image
from casadi_ik.views.rasterizer import corner_weights, rasterize
from casadi_ik.views.solids import Solid

Array = NDArray[np.float64]

SAMPLES = 2
"""Samples per pixel along each side."""

CREASE = np.cos(np.deg2rad(35.0))
"""Faces that meet at a sharper angle keep an edge; others are shaded as one smooth surface."""

LIGHT = np.array([-0.45, 0.70, 0.60])
"""Towards the lamp: right, up and towards the viewer."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Solids that are opaque to one another.

    Attributes:
        solids: The solids.
        opacity: Of this layer over what lies behind it.
        ghost: Its opacity where an earlier layer hides it.
        fading: Whether it fades out towards the edges of the image.
    """

    solids: Sequence[Solid]
    opacity: float = 1.0
    ghost: float = 0.0
    fading: bool = False


def render(camera: Camera, layers: Sequence[Layer], floor: float | None = None) -> Array:
    """An image (h, w, 3) of values in 0..1, on white.

    Args:
        camera: Where from.
        layers: Drawn one over the other.
        floor: Height of a floor with the shadow of the first layer [m]; None for no floor.
    """
    width, height = camera.pixels
    fine = replace(camera, pixels=(width * SAMPLES, height * SAMPLES))
    image = np.ones((height * SAMPLES, width * SAMPLES, 3))
    nearest = np.full(image.shape[:2], np.inf)
    if floor is not None and layers:
        coarse = floor_image(camera, layers[0].solids, floor)
        image *= coarse.repeat(SAMPLES, axis=0).repeat(SAMPLES, axis=1)[..., None]
    for layer in layers:
        if not layer.solids:
            continue
        seen, color, depth = _surface(fine, layer.solids)
        opacity = np.where(depth < nearest[seen], layer.opacity, layer.ghost)
        if layer.fading:
            opacity *= _inwards(seen, nearest.shape)
        image[seen] += opacity[:, None] * (color - image[seen])
        if layer.opacity == 1.0:
            nearest[seen] = np.minimum(nearest[seen], depth)
    steps = [(i, j) for i in range(SAMPLES) for j in range(SAMPLES)]
    return np.mean([image[i::SAMPLES, j::SAMPLES] for i, j in steps], axis=0)


def _surface(
    camera: Camera, solids: Sequence[Solid]
) -> tuple[tuple[NDArray[np.int64], ...], Array, Array]:
    """Where solids are seen (rows and columns of k pixels), their colour (k, 3) and depth (k,)."""
    corners = np.concatenate([solid.vertices[solid.faces] for solid in solids])
    normals = np.concatenate([_corner_normals(solid) for solid in solids])
    count = [len(solid.faces) for solid in solids]
    colors = np.repeat([mcolors.to_rgb(solid.color) for solid in solids], count, axis=0)
    owner = np.repeat(np.arange(len(solids)), count)

    front = np.flatnonzero(_face_normals(corners) @ camera.towards > 0)
    screen = camera.project(corners[front])
    face, depth = rasterize(screen, camera.pixels)
    seen = np.nonzero(face >= 0)
    weights = corner_weights(screen, face[seen], *seen)
    found = front[face[seen]]
    normal = sum(weights[:, i, None] * normals[found, i] for i in range(3))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    color = _shaded(camera, colors[found], normal)
    parts = np.full(face.shape, -1)
    parts[seen] = owner[found]
    line = _outline(parts, depth, 0.004 * camera.height)[seen]
    return seen, color * (1 - 0.35 * line[:, None]), depth[seen]


def _inwards(seen: tuple[NDArray[np.int64], ...], shape: tuple[int, ...]) -> Array:
    """(k,) 0 at the edges of the image, 1 further in."""
    parts = [
        np.clip(np.minimum(index, size - 1 - index) / (0.15 * size), 0.0, 1.0)
        for index, size in zip(seen, shape, strict=True)
    ]
    return parts[0] * parts[1]


def _shaded(camera: Camera, color: Array, normal: Array) -> Array:
    """Colour under a lamp and a bright sky."""
    axes = np.stack([camera.right, camera.up, camera.towards])
    lamp = LIGHT @ axes / np.linalg.norm(LIGHT)
    halfway = lamp + camera.towards
    halfway /= np.linalg.norm(halfway)
    diffuse = np.maximum(normal @ lamp, 0.0)
    sky = 0.5 + 0.5 * normal[:, 2]
    rim = np.maximum(normal @ camera.towards, 0.0)
    gloss = np.maximum(normal @ halfway, 0.0) ** 40
    light = 0.40 + 0.22 * sky + 0.16 * rim + 0.38 * diffuse
    return np.clip(color * light[:, None] + 0.20 * gloss[:, None], 0.0, 1.0)


def _outline(parts: NDArray[np.int64], depth: Array, jump: float) -> Array:
    """1 where a part ends or its depth jumps, else 0: a fine line that sets parts apart."""
    line = np.zeros(parts.shape)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            change = np.diff(parts, axis=axis) != 0
            step = np.diff(depth, axis=axis)
            # The line belongs to the nearer side.
            before = [slice(None)] * 2
            after = [slice(None)] * 2
            before[axis], after[axis] = slice(None, -1), slice(1, None)
            line[tuple(before)][(change & (step >= 0)) | (step > jump)] = 1
            line[tuple(after)][(change & (step < 0)) | (step < -jump)] = 1
    return line


def _face_normals(corners: Array) -> Array:
    """(t, 3) normals, as long as twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _corner_normals(solid: Solid) -> Array:
    """(t, 3, 3) normals at the corners: of all faces around the vertex that are no crease apart."""
    areas = _face_normals(solid.vertices[solid.faces])
    units = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-15)
    vertex = solid.faces.reshape(-1)
    order = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=len(solid.vertices))
    first = np.cumsum(count) - count
    # Every pair of corners that share a vertex.
    many = count[vertex]
    mine = np.repeat(np.arange(len(vertex)), many)
    nth = np.arange(len(mine)) - np.repeat(np.cumsum(many) - many, many)
    theirs = order[first[vertex[mine]] + nth]
    smooth = np.einsum("px,px->p", units[mine // 3], units[theirs // 3]) > CREASE
    total = np.zeros((len(vertex), 3))
    np.add.at(total, mine[smooth], areas[theirs[smooth] // 3])
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-15)
    return total.reshape(-1, 3, 3)
