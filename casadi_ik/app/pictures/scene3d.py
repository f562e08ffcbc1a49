"""Rendering by PyVista: lights, a floor with a soft shadow, a parallel camera."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import closing
from typing import cast

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike, NDArray

from casadi_ik.app.drawing.drawables import Drawable, View, view_axes
from casadi_ik.errors import PictureError
from casadi_ik.files.arrays import Array

Image = NDArray[np.floating]
"""(h, w, channels) Values in 0..1."""

LIGHTS = (
    ((-0.45, 0.70, 0.60), "camera light", 0.42),
    ((0.0, 0.0, 1.0), "camera light", 0.20),
    ((0.0, 0.0, 1.0), "scene light", 0.14),
)
"""Position, frame and intensity of the lights: lamp, headlight, sky."""

MATERIAL = {"ambient": 0.46, "diffuse": 1.0, "specular": 0.35, "specular_power": 40.0}


render_lock = threading.Lock()
"""Lock around rendering, because OpenGL contexts are not thread-safe."""


class Scene3D:
    """Groups of drawables on a white background.

    Args:
        off_screen: Render without a window.

    Attributes:
        plotter: The PyVista plotter.

    Raises:
        PictureError: OpenGL is not available.
    """

    def __init__(self, off_screen: bool = True) -> None:
        # Without an X server VTK prints a warning and falls back to EGL or OSMesa.
        with pv.vtk_verbosity("off"):
            self.plotter = pv.Plotter(off_screen=off_screen, lighting="none")
            assert self.plotter.render_window is not None
            self._window = self.plotter.render_window
            if off_screen:
                self._window.Initialize()
                if not self._window.IsCurrent():  # rendering would abort the process
                    raise PictureError("cannot draw: no OpenGL (on Linux: install libegl1)")
        for position, kind, intensity in LIGHTS:
            light = pv.Light(position=position, light_type=kind, intensity=intensity)
            self.plotter.add_light(light)
        self.plotter.background_color = pv.Color("white")
        self.plotter.enable_anti_aliasing("ssaa")
        self._groups: dict[str, list[pv.Actor]] = {}

    def close(self) -> None:
        """Release the plotter."""
        self.plotter.close()

    def add(
        self, group: str, drawables: Sequence[Drawable], opacity: float = 1.0, orient: bool = False
    ) -> None:
        """Add a group of drawables.

        Args:
            group: Name of the group.
            drawables: Drawables in the base frame.
            opacity: Opacity, 0 to 1.
            orient: Orient the triangles outwards first.
        """
        options = {"opacity": opacity, "culling": "back", "render": False, **MATERIAL}
        actors = [
            self.plotter.add_mesh(_smooth_mesh(drawable, orient), color=drawable.color, **options)
            for drawable in drawables
        ]
        for actor in actors:
            actor.prop.interpolation = "Phong"
        self._groups[group] = actors

    def replace(self, group: str, drawables: Sequence[Drawable], opacity: float = 1.0) -> None:
        """Replace the drawables of a group."""
        for actor in self._groups.pop(group, []):
            self.plotter.renderer.remove_actor(actor, render=False)
        self.add(group, drawables, opacity)

    def add_floor(
        self,
        height: float,
        drawables: Sequence[Drawable],
        extent: Array | None = None,
        dark: bool = False,
        texels: int = 1024,
    ) -> None:
        """Add a floor that fades out, with a grid and the soft shadow of drawables.

        Args:
            height: Height of the floor [m].
            drawables: Drawables that cast the shadow.
            extent: (k, 3) Points that the floor extends below [m]; None: vertices of the drawables.
            dark: Use a floor for dark backgrounds.
            texels: Size of the floor's texture along each side.
        """
        points, grid = vertices_of(drawables) if extent is None else extent, 0.25
        low, high = points.min(axis=0), points.max(axis=0)
        center = np.array([*(low + high)[:2] / 2, height])
        radius = 0.35 + float(np.linalg.norm(high[:2] - low[:2])) / 2
        with closing(Scene3D()) as top_view:
            top_view.plotter.disable_anti_aliasing()  # the image is blurred below
            top_view.add("above", drawables)
            square = center + radius * np.array([[-1, -1, 0], [1, 1, 0]])
            top_view.aim((-np.pi / 2, np.pi / 2), square, (texels, texels))
            shadow_image = pv.ImageData(dimensions=(texels, texels, 1))
            shadow_image["shadow"] = top_view.render()[..., 3].ravel()
        blurred = cast("pv.ImageData", shadow_image.gaussian_smooth(std_dev=9.0, radius_factor=2.5))
        shadow = np.reshape(blurred.point_data["shadow"], (texels, texels))

        x, y = np.meshgrid(*[((np.arange(texels) + 0.5) / texels * 2 - 1) * radius] * 2)
        fade = np.clip(1.6 * (1 - np.hypot(x, y) / radius), 0.0, 1.0)
        distances = [
            np.abs((v / grid + 0.5) % 1 - 0.5) * grid for v in (x + center[0], y - center[1])
        ]
        line = np.clip(1.5 - np.minimum(*distances) / (1.2 * radius / texels + 0.0012), 0.0, 1.0)
        texture = np.zeros((texels, texels, 4), dtype=np.uint8)
        if dark:
            texture[..., :3] = 255
            alpha = fade * (0.05 + 0.09 * line) * (1 - 0.75 * shadow)
        else:
            alpha = 1 - (1 - 0.26 * shadow) * (1 - fade * (0.035 + 0.10 * line))
        texture[..., 3] = np.round(255 * alpha)
        plane = pv.Plane(center=center, i_size=2 * radius, j_size=2 * radius)
        options = {"texture": pv.Texture(texture), "lighting": False, "render": False}
        for actor in self._groups.pop("floor", []):
            self.plotter.renderer.remove_actor(actor, render=False)
        self._groups["floor"] = [self.plotter.add_mesh(plane, **options)]

    def aim(
        self,
        view: View,
        points: ArrayLike,
        pixels: tuple[int, int],
        margin: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Point the camera.

        Args:
            view: Viewing direction.
            points: (k, 3) Points that the image contains [m].
            pixels: Width and height of the image.
            margin: Margins as fractions of width and height.
        """
        axes = view_axes(view)
        projected = np.asarray(points, dtype=float) @ axes.T
        low, high = projected.min(axis=0), projected.max(axis=0)
        width, height = (high - low)[:2] / (1 - 2 * np.array(margin))
        self._window.SetSize(*pixels)
        camera, center = self.plotter.camera, (low + high) / 2 @ axes
        camera.focal_point, camera.position, camera.up = center, center + 10 * axes[2], axes[1]
        camera.parallel_projection = True
        camera.parallel_scale = max(height, width * pixels[1] / pixels[0]) / 2

    def project(self, points: ArrayLike) -> Array:
        """Return pixel coordinates (k, 2) of points (k, 3): x to the right, y down."""
        size = np.array(self.plotter.window_size)
        camera = self.plotter.camera
        matrix = camera.GetCompositeProjectionTransformMatrix(size[0] / size[1], -1.0, 1.0)
        normalised = pv.Transform(matrix).apply(np.asarray(points, dtype=float))
        return (normalised[:, :2] * [1, -1] + 1) / 2 * size

    def render(self, *groups: str) -> Image:
        """Return an image (h, w, 4) of the named groups, or of all if none is named.

        The colours are blended with white.
        """
        for name, actors in self._groups.items():
            for actor in actors:
                actor.visibility = not groups or name in groups
        self.plotter.renderer.ResetCameraClippingRange()
        self.plotter.render()
        image = self.plotter.screenshot(None, transparent_background=True, return_img=True)
        return np.asarray(image, dtype=np.float32) / np.float32(255)


def _smooth_mesh(drawable: Drawable, orient: bool) -> pv.PolyData:
    """Return the mesh of a drawable with normals that are smooth except at sharp edges."""
    mesh = pv.PolyData.from_regular_faces(drawable.surface.points, drawable.surface.triangles)
    if orient:
        mesh.clean(inplace=True)
    mesh.compute_normals(
        split_vertices=True, feature_angle=35.0, auto_orient_normals=orient, inplace=True
    )
    return mesh


def vertices_of(drawables: Sequence[Drawable]) -> Array:
    """Return the (k, 3) vertices of drawables."""
    return np.concatenate([drawable.surface.points for drawable in drawables])


def composite(background: Image | float, layer: Image, opacity: Image | float = 1.0) -> Image:
    """Blend an image (h, w, 4) of `Scene3D.render` over a background (h, w, 3)."""
    alpha = layer[..., 3:]
    return background + opacity * (layer[..., :3] - (1 - alpha) - alpha * background)
