"""Grids of pictures: several solutions of a grasp, the best grasps of an object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from os import PathLike

import numpy as np
from matplotlib.figure import Figure

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import View, bodies_at, close_view, overview, scene_drawables
from casadi_ik.app.pictures.charts import DPI, new_figure, save_picture
from casadi_ik.app.pictures.pictures import add_grasp, add_image, pixel_size
from casadi_ik.app.pictures.scene3d import Image, Scene3D, composite, render_lock, vertices_of
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.planning.touch.found_grasps import FoundGrasp
from casadi_ik.solve.solution import Alternative

CELL_SIZE = (3.3, 3.4)
"""Width and height of a picture with its caption [inch]."""

TITLE_HEIGHT = 0.6
"""Height of the title of the figure [inch]."""

Renderer = Callable[[Scene3D, tuple[int, int]], Image]
"""Function that fills a scene and returns an image (h, w, 3) of the given size."""


def draw_alternatives(
    robot: ArmHand,
    alternatives: Sequence[Alternative],
    grasp: Grasp,
    path: str | PathLike[str] | None = None,
    *,
    columns: int = 4,
    view: View | None = None,
    dpi: float = DPI,
) -> Figure:
    """Draw several solutions of a grasp, all from the same view.

    Args:
        robot: Robot of the solutions.
        alternatives: At least one solution.
        grasp: The grasp; its object is drawn if it has a description.
        path: PNG file to write; None: none.
        columns: Number of columns.
        view: Azimuth and elevation of the camera [rad]; None: chosen for the first solution.
        dpi: Dots per inch.

    Returns:
        The figure, without a pyplot window.

    Raises:
        PictureError: The file cannot be written, or OpenGL is not available.
        DescriptionError: The description of the object is malformed.
        InputError: There is no solution, or the grasp names an unknown finger.
    """
    if not alternatives:
        raise InputError("alternatives: found none; expected at least one")
    first = alternatives[0].q
    camera_view = view or overview(robot.contacts(first)[0].mean(axis=0), close_view(robot, first))
    points = vertices_of(
        [body for alternative in alternatives for body in bodies_at(robot, alternative.q)]
    )

    def renderer(alternative: Alternative) -> Renderer:
        def render(scene3d: Scene3D, pixels: tuple[int, int]) -> Image:
            add_grasp(
                scene3d, robot, alternative.q, grasp, dict.fromkeys(robot.fingers, palette.MET)
            )
            scene3d.aim(camera_view, points, pixels, (0.03, 0.03))
            return composite(1.0, scene3d.render())

        return render

    cells = [(_branch_caption(alternative), renderer(alternative)) for alternative in alternatives]
    return _grid(cells, columns, "", dpi, path)


def draw_grasps(
    robot: ArmHand,
    found: Sequence[FoundGrasp],
    path: str | PathLike[str] | None = None,
    *,
    scene: Scene | None = None,
    most: int = 9,
    columns: int = 3,
    dpi: float = DPI,
) -> Figure:
    """Draw the best grasps of `Solver.grasps_of`, each from the view that shows its contacts best.

    Args:
        robot: Robot of the grasps.
        found: At least one grasp, the best first.
        path: PNG file to write; None: none.
        scene: Obstacles; None: none are drawn.
        most: Maximum number of grasps drawn.
        columns: Number of columns.
        dpi: Dots per inch.

    Returns:
        The figure, without a pyplot window.

    Raises:
        PictureError: The file cannot be written, or OpenGL is not available.
        InputError: There is no grasp.
    """
    if not len(found):
        raise InputError("found: no grasps; expected at least one")

    def renderer(candidate: FoundGrasp) -> Renderer:
        def render(scene3d: Scene3D, pixels: tuple[int, int]) -> Image:
            colors = dict.fromkeys(robot.fingers, palette.MET)
            groups = add_grasp(scene3d, robot, candidate.q, candidate.grasp, colors, floor=False)
            if scene is not None:
                scene3d.add("scene", scene_drawables(scene, candidate.grasp.object))
            points = vertices_of(groups["hand"] + groups["object"])
            scene3d.aim(close_view(robot, candidate.q), points, pixels, (0.04, 0.04))
            image = composite(1.0, scene3d.render("scene"), 0.35) if scene is not None else 1.0
            image = composite(image, scene3d.render("wrist"), 0.3)
            image = composite(image, scene3d.render("hand", "object", "marks"))
            return composite(image, scene3d.render("marks"), 0.5)

        return render

    cells = [
        (_grasp_caption(rank, candidate), renderer(candidate))
        for rank, candidate in enumerate(found[:most], 1)
    ]
    name = found[0].grasp.name.partition(" ")[0]
    suffix = f", the best {most}" if len(found) > most else ""
    return _grid(cells, columns, f"{len(found)} grasps of {name} · {robot.name}{suffix}", dpi, path)


def _grid(
    cells: Sequence[tuple[str, Renderer]],
    columns: int,
    title: str,
    dpi: float,
    path: str | PathLike[str] | None,
) -> Figure:
    """Draw pictures in rows, each with a caption, below an optional title."""
    columns = min(columns, len(cells))
    rows, title_height = -(-len(cells) // columns), TITLE_HEIGHT if title else 0.0
    height = rows * CELL_SIZE[1] + title_height
    figure, cell_share = new_figure(columns * CELL_SIZE[0], height, dpi), CELL_SIZE[1] / height
    for index, (caption, render) in enumerate(cells):
        row, column = divmod(index, columns)
        box = (column / columns, (rows - row - 1) * cell_share, 1 / columns, 0.85 * cell_share)
        with render_lock, closing(Scene3D()) as scene3d:
            axes = add_image(figure, box, render(scene3d, pixel_size(figure, box)))
        axes.set_title(caption, color=palette.INK, fontsize=9)
    if title:
        figure.text(
            0.02, 1 - 0.5 * title_height / height, title, size=13, weight="bold", va="center"
        )
    if path is not None:
        save_picture(figure, path)
    return figure


def _branch_caption(alternative: Alternative) -> str:
    """Return the arm branch and the range of the swivel angle in words."""
    branch = alternative.branch
    if branch is None:
        return f"hand posture {alternative.posture + 1}"
    pairs = (("shoulder", branch.shoulder), ("elbow", branch.elbow), ("wrist", branch.wrist))
    signs = ", ".join(f"{name} {'+' if sign > 0 else '−'}" for name, sign in pairs)
    if branch.swivel is None:
        return signs
    start, end = branch.swivel
    return f"{signs}\nswivel range {np.rad2deg(end - start):.0f}°"


def _grasp_caption(rank: int, grasp: FoundGrasp) -> str:
    clearance = "" if grasp.clearance is None else f" · clearance {1e3 * grasp.clearance:.1f} mm"
    return f"{rank}. load {grasp.load:.2f} N/N{clearance}\n{', '.join(grasp.grasp.contacts)}"
