"""Pictures side by side: several solutions of a grasp, the best grasps of an object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from os import PathLike

import numpy as np
from matplotlib.figure import Figure

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import View, close_view, placed, scene_of, whole_view
from casadi_ik.app.pictures.charts import DPI, new_figure, save_picture
from casadi_ik.app.pictures.pictures import fill, panel, pixels_of
from casadi_ik.app.pictures.scene3d import Image, Stage, one_at_a_time, over, points_of
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.planning.touch.grasps import FoundGrasp
from casadi_ik.solve.solution import Alternative

CELL = (3.3, 3.4)
"""Width and height of one of them, its title included [inch]."""

HEAD = 0.6
"""Height of the title of all [inch]."""

Draw = Callable[[Stage, tuple[int, int]], Image]
"""What fills a stage and gives an image (h, w, 3) of so many pixels."""


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
    """Draw several solutions of a grasp side by side, all seen from the same place.

    Args:
        robot: The robot that was solved for.
        alternatives: The solutions, at least one.
        grasp: The question; if it names an object that has a description, that is drawn too.
        path: PNG file to write, if any.
        columns: Pictures in a row.
        view: Azimuth and elevation [rad] of the camera; None: chosen for the first solution.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        DescriptionError: The description of the object is malformed.
        InputError: No solution, or the grasp has a finger that the robot has not.
    """
    if not alternatives:
        raise InputError("alternatives: found none, expected at least one")
    first = alternatives[0].q
    seen = view or whole_view(robot.contacts(first)[0].mean(axis=0), close_view(robot, first))
    everything = points_of([one for found in alternatives for one in placed(robot, found.q)])

    def draw(found: Alternative) -> Draw:
        def drawn(stage: Stage, pixels: tuple[int, int]) -> Image:
            fill(stage, robot, found.q, grasp, dict.fromkeys(robot.fingers, palette.MET))
            stage.aim(seen, everything, pixels, (0.03, 0.03))
            return over(1.0, stage.shoot())

        return drawn

    cells = [(_bent(found), draw(found)) for found in alternatives]
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
    """Draw the best grasps that `Solver.grasps_of` has found side by side, each from its side.

    Args:
        robot: The robot that they were found for.
        found: The grasps, best first, at least one.
        path: PNG file to write, if any.
        scene: What stands about, drawn where it is near.
        most: How many are drawn at most.
        columns: Pictures in a row.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        InputError: No grasp.
    """
    if not len(found):
        raise InputError("found: there is no grasp to draw, expected at least one")

    def draw(one: FoundGrasp) -> Draw:
        def drawn(stage: Stage, pixels: tuple[int, int]) -> Image:
            colors = dict.fromkeys(robot.fingers, palette.MET)
            groups = fill(stage, robot, one.q, one.grasp, colors, floor=False)
            if scene is not None:
                stage.add("scene", scene_of(scene, one.grasp.object))
            seen = points_of(groups["hand"] + groups["object"])
            stage.aim(close_view(robot, one.q), seen, pixels, (0.04, 0.04))
            image = over(1.0, stage.shoot("scene"), 0.35) if scene is not None else 1.0
            image = over(image, stage.shoot("wrist"), 0.3)
            image = over(image, stage.shoot("hand", "object", "marks"))
            return over(image, stage.shoot("marks"), 0.5)

        return drawn

    cells = [(_words(number, one), draw(one)) for number, one in enumerate(found[:most], 1)]
    name = found[0].grasp.name.partition(" ")[0]
    more = f", the best {most}" if len(found) > most else ""
    return _grid(cells, columns, f"{len(found)} grasps of {name} · {robot.name}{more}", dpi, path)


def _grid(
    cells: Sequence[tuple[str, Draw]],
    columns: int,
    title: str,
    dpi: float,
    path: str | PathLike[str] | None,
) -> Figure:
    """Pictures in rows, each below its words, all below a title if there is one."""
    columns = min(columns, len(cells))
    rows, head = -(-len(cells) // columns), HEAD if title else 0.0
    height = rows * CELL[1] + head
    figure, share = new_figure(columns * CELL[0], height, dpi), CELL[1] / height
    for number, (words, draw) in enumerate(cells):
        row, column = divmod(number, columns)
        box = (column / columns, (rows - row - 1) * share, 1 / columns, 0.85 * share)
        with one_at_a_time, closing(Stage()) as stage:
            axes = panel(figure, box, draw(stage, pixels_of(figure, box)))
        axes.set_title(words, color=palette.INK, fontsize=9)
    if title:
        figure.text(0.02, 1 - 0.5 * head / height, title, size=13, weight="bold", va="center")
    if path is not None:
        save_picture(figure, path)
    return figure


def _bent(found: Alternative) -> str:
    """How the arm is bent, and how far its elbow may swing."""
    branch = found.branch
    if branch is None:
        return f"hand posture {found.posture + 1}"
    pairs = (("shoulder", branch.shoulder), ("elbow", branch.elbow), ("wrist", branch.wrist))
    signs = ", ".join(f"{name} {'+' if sign > 0 else '−'}" for name, sign in pairs)
    if branch.swivel is None:
        return signs
    start, end = branch.swivel
    return f"{signs}\nelbow swings {np.rad2deg(end - start):.0f}°"


def _words(number: int, one: FoundGrasp) -> str:
    room = "" if one.clearance is None else f" · clearance {1e3 * one.clearance:.1f} mm"
    return f"{number}. load {one.load:.2f} N/N{room}\n{', '.join(one.grasp.contacts)}"
