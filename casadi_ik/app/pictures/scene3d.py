"""Pictures of drawables by PyVista: light, a floor with a soft shadow, a parallel camera."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import closing
from typing import cast

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike, NDArray

from casadi_ik.app.drawing.drawables import Drawable, View, axes_of
from casadi_ik.errors import PictureError
from casadi_ik.files.arrays import Array

Image = NDArray[np.floating]
"""(h, w, channels) of values in 0..1."""

LIGHTS = (
    ((-0.45, 0.70, 0.60), "camera light", 0.42),
    ((0.0, 0.0, 1.0), "camera light", 0.20),
    ((0.0, 0.0, 1.0), "scene light", 0.14),
)
"""Where from, in which frame, and how bright: a lamp, the viewer, the sky."""

MATERIAL = {"ambient": 0.46, "diffuse": 1.0, "specular": 0.35, "specular_power": 40.0}


one_at_a_time = threading.Lock()
"""Of pictures: OpenGL is no friend of threads."""


class Stage:
    """Groups of drawables on white.

    Args:
        off_screen: Whether no window will be opened.

    Attributes:
        plotter: What it is made with.

    Raises:
        PictureError: There is no OpenGL to draw with.
    """

    def __init__(self, off_screen: bool = True) -> None:
        # Without an X server VTK warns of that on stderr, and turns to EGL or OSMesa.
        with pv.vtk_verbosity("off"):
            self.plotter = pv.Plotter(off_screen=off_screen, lighting="none")
            assert self.plotter.render_window is not None
            self._window = self.plotter.render_window
            if off_screen:
                self._window.Initialize()
                if not self._window.IsCurrent():  # ... and to draw now would end the process
                    raise PictureError("cannot draw: no OpenGL (on Linux: install libegl1)")
        for position, kind, intensity in LIGHTS:
            light = pv.Light(position=position, light_type=kind, intensity=intensity)
            self.plotter.add_light(light)
        self.plotter.background_color = pv.Color("white")
        self.plotter.enable_anti_aliasing("ssaa")
        self._groups: dict[str, list[pv.Actor]] = {}

    def close(self) -> None:
        """Give back what was taken."""
        self.plotter.close()

    def add(
        self, group: str, drawables: Sequence[Drawable], opacity: float = 1.0, orient: bool = False
    ) -> None:
        """Put drawables on the stage.

        Args:
            group: What they belong to.
            drawables: In the base frame.
            opacity: 0 to 1.
            orient: Whether their triangles may wind either way.
        """
        look = {"opacity": opacity, "culling": "back", "render": False, **MATERIAL}
        actors = [
            self.plotter.add_mesh(_smooth(one, orient), color=one.color, **look)
            for one in drawables
        ]
        for actor in actors:
            actor.prop.interpolation = "Phong"
        self._groups[group] = actors

    def replace(self, group: str, drawables: Sequence[Drawable], opacity: float = 1.0) -> None:
        """Put other drawables in the place of a group."""
        for actor in self._groups.pop(group, []):
            self.plotter.renderer.remove_actor(actor, render=False)
        self.add(group, drawables, opacity)

    def add_floor(
        self,
        height: float,
        drawables: Sequence[Drawable],
        about: Array | None = None,
        dark: bool = False,
        texels: int = 1024,
    ) -> None:
        """A floor that fades out, with a grid and the soft shadow of drawables.

        Args:
            height: Of the floor [m].
            drawables: Of what the shadow is.
            about: (k, 3) above what it lies [m]; None: the drawables.
            dark: Whether it is paler than the ground about it.
            texels: Of its texture along each side.
        """
        points, grid = points_of(drawables) if about is None else about, 0.25
        low, high = points.min(axis=0), points.max(axis=0)
        middle = np.array([*(low + high)[:2] / 2, height])
        radius = 0.35 + float(np.linalg.norm(high[:2] - low[:2])) / 2
        with closing(Stage()) as sky:
            sky.plotter.disable_anti_aliasing()  # it gets blurred
            sky.add("above", drawables)
            square = middle + radius * np.array([[-1, -1, 0], [1, 1, 0]])
            sky.aim((-np.pi / 2, np.pi / 2), square, (texels, texels))
            above = pv.ImageData(dimensions=(texels, texels, 1))
            above["shadow"] = sky.shoot()[..., 3].ravel()
        soft = cast("pv.ImageData", above.gaussian_smooth(std_dev=9.0, radius_factor=2.5))
        shadow = np.reshape(soft.point_data["shadow"], (texels, texels))

        x, y = np.meshgrid(*[((np.arange(texels) + 0.5) / texels * 2 - 1) * radius] * 2)
        fade = np.clip(1.6 * (1 - np.hypot(x, y) / radius), 0.0, 1.0)
        off = [np.abs((v / grid + 0.5) % 1 - 0.5) * grid for v in (x + middle[0], y - middle[1])]
        line = np.clip(1.5 - np.minimum(*off) / (1.2 * radius / texels + 0.0012), 0.0, 1.0)
        texture = np.zeros((texels, texels, 4), dtype=np.uint8)
        if dark:
            texture[..., :3] = 255
            shade = fade * (0.05 + 0.09 * line) * (1 - 0.75 * shadow)
        else:
            shade = 1 - (1 - 0.26 * shadow) * (1 - fade * (0.035 + 0.10 * line))
        texture[..., 3] = np.round(255 * shade)
        plane = pv.Plane(center=middle, i_size=2 * radius, j_size=2 * radius)
        look = {"texture": pv.Texture(texture), "lighting": False, "render": False}
        for actor in self._groups.pop("floor", []):
            self.plotter.renderer.remove_actor(actor, render=False)
        self._groups["floor"] = [self.plotter.add_mesh(plane, **look)]

    def aim(
        self,
        view: View,
        points: ArrayLike,
        pixels: tuple[int, int],
        margin: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Point the camera.

        Args:
            view: Where from.
            points: (k, 3) what must be in the image [m].
            pixels: Width and height of the image.
            margin: What is left free on either side, as parts of width and height.
        """
        axes = axes_of(view)
        seen = np.asarray(points, dtype=float) @ axes.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        width, height = (high - low)[:2] / (1 - 2 * np.array(margin))
        self._window.SetSize(*pixels)
        camera, center = self.plotter.camera, (low + high) / 2 @ axes
        camera.focal_point, camera.position, camera.up = center, center + 10 * axes[2], axes[1]
        camera.parallel_projection = True
        camera.parallel_scale = max(height, width * pixels[1] / pixels[0]) / 2

    def project(self, points: ArrayLike) -> Array:
        """Pixel coordinates (k, 2) of points (k, 3): x to the right, y down."""
        size = np.array(self.plotter.window_size)
        camera = self.plotter.camera
        matrix = camera.GetCompositeProjectionTransformMatrix(size[0] / size[1], -1.0, 1.0)
        seen = pv.Transform(matrix).apply(np.asarray(points, dtype=float))
        return (seen[:, :2] * [1, -1] + 1) / 2 * size

    def shoot(self, *groups: str) -> Image:
        """An image (h, w, 4) of some groups, or all; its colours are those over white."""
        for name, actors in self._groups.items():
            for actor in actors:
                actor.visibility = not groups or name in groups
        self.plotter.renderer.ResetCameraClippingRange()
        self.plotter.render()
        image = self.plotter.screenshot(None, transparent_background=True, return_img=True)
        return np.asarray(image, dtype=np.float32) / np.float32(255)


def _smooth(one: Drawable, orient: bool) -> pv.PolyData:
    """Its surface, smooth but where its faces meet at a sharp angle."""
    mesh = pv.PolyData.from_regular_faces(one.surface.points, one.surface.triangles)
    if orient:
        mesh.clean(inplace=True)
    mesh.compute_normals(
        split_vertices=True, feature_angle=35.0, auto_orient_normals=orient, inplace=True
    )
    return mesh


def points_of(drawables: Sequence[Drawable]) -> Array:
    """(k, 3) corners of all of them."""
    return np.concatenate([one.surface.points for one in drawables])


def over(below: Image | float, layer: Image, opacity: Image | float = 1.0) -> Image:
    """An image (h, w, 3) under one of `Stage.shoot`."""
    alpha = layer[..., 3:]
    return below + opacity * (layer[..., :3] - (1 - alpha) - alpha * below)
