"""Pictures of robots: at the contacts of a grasp, in motion; pads of hands."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from os import PathLike

import numpy as np
import pyvista as pv
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike
from PIL import Image as Pillow

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    View,
    close_view,
    contact_marks,
    lowest,
    nearest_pair,
    object_of,
    palm_places,
    placed,
    scene_of,
    target_place,
    whole_view,
    with_object,
)
from casadi_ik.app.drawing.surfaces import arrow, ball
from casadi_ik.app.pictures.charts import DARK, DPI, LIGHT, Ground, new_figure, save_picture
from casadi_ik.app.pictures.scene3d import Image, Stage, one_at_a_time, over, points_of
from casadi_ik.collision.clearance import closest_points
from casadi_ik.collision.scene import Scene
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.motion.motion import Motion
from casadi_ik.solve.solution import Solution

SIZE = (12.0, 6.6)
"""Of a picture with two panels [inch]."""

Box = tuple[float, float, float, float]
"""Left, bottom, width and height of a panel, as parts of its picture."""

WHOLE: Box = (0.0, 0.06, 0.40, 0.82)
CLOSE: Box = (0.40, 0.06, 0.60, 0.82)

OPACITY = {"object": 0.5, "scene": 0.45, "touching": 0.35}
"""Of groups that are seen through; marks that something hides are half seen."""


def draw_solution(
    robot: ArmHand,
    solution: Solution,
    grasp: Grasp,
    path: str | PathLike[str] | None = None,
    *,
    scene: Scene | None = None,
    view: View | None = None,
    dpi: float = DPI,
    dark: bool = False,
) -> Figure:
    """Draw the answer to a grasp.

    Args:
        robot: The robot that was solved for.
        solution: The answer.
        grasp: The question; if it names an object that has a description, that is drawn too.
        path: PNG file to write, if any.
        scene: What stood about the robot: that is drawn too, and of the pair that is nearest to
            touching the way between them in red; their shapes as well if they do touch.
        view: Azimuth and elevation [rad] from which the close-up is seen; None: chosen so that
            the fingertips are well apart.
        dpi: Dots per inch.
        dark: For a dark page.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        DescriptionError: The description of the object is malformed.
        InputError: The grasp has a finger that the robot has not.
    """
    ground = DARK if dark else LIGHT
    figure = new_figure(*SIZE, dpi, ground)
    paper = np.array(palette.rgb(ground.paper), np.float32) / 255
    colors = {
        finger: palette.MET if verdict.ok else palette.MISSED
        for finger, verdict in solution.contacts.items()
    }
    q = solution.q
    with one_at_a_time, closing(Stage()) as stage:
        groups = fill(stage, robot, q, grasp, colors)
        if scene is not None:
            _surround(stage, robot, solution, grasp, scene)
        view = view or close_view(robot, q)
        pixels = pixels_of(figure, WHOLE)
        everything = points_of([one for group in groups.values() for one in group])
        stage.aim(whole_view(_middle(robot, q, grasp), view), everything, pixels, (0.03, 0.10))
        image = over(paper, stage.shoot("floor"), _inwards(pixels))
        image = over(image, stage.shoot(*groups, "scene", "nearest", "touching"))
        panel(figure, WHOLE, over(image, stage.shoot("marks", "nearest"), 0.45))

        # What reaches further than this from the palm need not be in the close-up.
        palms = palm_places(robot, q)
        things = groups["object"] + groups["marks"]
        near = [one for one in things if _distances(one, palms).max() < 0.35]
        pixels = pixels_of(figure, CLOSE)
        stage.aim(view, points_of(groups["hand"] + near), pixels, (0.17, 0.02))
        # The arm is pale: it may stand in the way.
        image = over(paper, stage.shoot("wrist"), 0.3 * _inwards(pixels))
        image = over(image, stage.shoot("hand", "object", "marks", "nearest", "touching"))
        axes = panel(figure, CLOSE, over(image, stage.shoot("marks", "nearest"), 0.45))
        seen = stage.project(robot.contacts(q)[0])
    asked = grasp.contacts or robot.fingers  # of a palm that is given all fingers follow
    told = {
        finger: (
            _errors(verdict.position_error, verdict.angle_error),
            palette.MET if verdict.ok else palette.MISSED,
        )
        for finger, verdict in solution.contacts.items()
    }
    spots = {one: place for one, place in zip(robot.fingers, seen, strict=True) if one in asked}
    _label(axes, spots, 0.12, ground, told)
    _add_title(figure, solution, grasp, ground)
    _add_legend(figure, solution, grasp, bool(groups["object"]), scene is not None, ground)
    if path is not None:
        save_picture(figure, path)
    return figure


def show(
    robot: ArmHand, q: ArrayLike, grasp: Grasp | None = None, *, window: bool = True
) -> pv.Plotter:
    """Open a window in which a robot can be looked at from all sides.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m].
        grasp: Contacts and object to be shown too.
        window: Whether to open it, until it is closed; else only the plotter is made.

    Returns:
        The plotter, e.g. for its `export_gltf`.

    Raises:
        PictureError: There is no OpenGL to draw with.
        InputError: Bad q, or the grasp has a finger that the robot has not.
    """
    with one_at_a_time:
        stage = Stage(off_screen=not window)
        groups = fill(stage, robot, q, grasp, dict.fromkeys(robot.fingers, palette.INK))
        view = whole_view(robot.contacts(q)[0].mean(axis=0), close_view(robot, q))
        everything = points_of([one for group in groups.values() for one in group])
        stage.aim(view, everything, (1200, 900), (0.05, 0.05))
    if window:
        stage.plotter.show(auto_close=False)
    return stage.plotter


def draw_motion(
    motion: Motion,
    grasp: Grasp,
    path: str | PathLike[str],
    scene: Scene | None = None,
) -> int:
    """Draw a motion in real time as a GIF: the whole robot, and the hand from close by.

    Args:
        motion: The motion.
        grasp: What it leads to; if it names an object that has a description, that is drawn too.
        path: The file; it is there when it is complete.
        scene: What stands about the robot.

    Returns:
        How many pictures there are: twelve a second, fewer in a motion of more than 7.5 s.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        DescriptionError: The description of the object is malformed.
    """
    seconds = float(motion.times[-1])
    count = int(np.clip(np.ceil(12 * seconds), 2, 90))
    times = np.linspace(0.0, seconds, count)
    q = np.stack([np.interp(times, motion.times, column) for column in motion.q.T], axis=1)
    step = max(round(1e3 * seconds / (count - 1)), 20)
    pictures = _shots(motion.robot, q, grasp, scene)
    save_picture(
        animated(pictures, [*[step] * (count - 1), 1500], 128), path
    )  # the last one stays [ms]
    return count


def _shots(robot: ArmHand, q: Array, grasp: Grasp, scene: Scene | None) -> list[Image]:
    """Images (h, w, 3) of postures (k, n)."""
    end, sizes = q[-1], ((420, 420), (340, 420))
    around = 0.15 * np.vstack([np.eye(3), -np.eye(3)])
    passed = [one for row in q[:: max(len(q) // 8, 1)] for one in placed(robot, row)]
    there = _object(grasp)
    tips = robot.contacts(end)[0]
    marks = contact_marks(robot, end, grasp, dict.fromkeys(robot.fingers, palette.MET))
    found = []
    with one_at_a_time, closing(Stage()) as stage:
        every = points_of(passed + there)
        stage.add("object", there, OPACITY["object"])
        stage.add("marks", marks)
        if scene is not None:
            about = scene_of(with_object(scene, grasp), grasp.object)
            stage.add("scene", about, OPACITY["scene"])
        view = close_view(robot, end)
        whole, floor = whole_view(tips.mean(axis=0), view), lowest(robot)
        for row in q:
            shown = placed(robot, row)
            stage.replace("robot", shown)
            stage.add_floor(floor, shown + there, every, texels=512)
            hand = (robot.contacts(row)[0].mean(axis=0) + palm_places(robot, row).mean(axis=0)) / 2
            panels = []
            for where, points, pixels in (
                (whole, every, sizes[0]),
                (view, hand + around, sizes[1]),
            ):
                stage.aim(where, points, pixels, (0.04, 0.04))
                panels.append(np.clip(over(1.0, stage.shoot()), 0.0, 1.0))
            found.append(np.concatenate(panels, axis=1))
    return found


def animated(images: Sequence[Image], milliseconds: Sequence[int], colors: int = 96) -> bytes:
    """Images (h, w, 3) as a GIF; all share a palette, in which every colour of ours has shades."""
    whole = [
        Pillow.fromarray(np.round(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8))
        for image in images
    ]
    width, height = whole[0].size
    some = [whole[0], whole[len(whole) // 2], whole[-1]]
    ours = [
        "#ffffff",
        palette.ARM,
        palette.HAND,
        palette.PAD,
        palette.OBJECT,
        palette.TARGET,
        palette.MET,
    ]
    sheet = Pillow.new("RGB", (width, height * len(some) + 24 * len(ours)))
    for i, one in enumerate(some):
        sheet.paste(one, (0, i * height))
    for i, color in enumerate(ours):
        shades = np.linspace(0.45, 1.2, width)[None, :, None] * np.array(palette.rgb(color))
        shaded = np.repeat(np.clip(shades, 0, 255).astype(np.uint8), 24, axis=0)
        sheet.paste(Pillow.fromarray(shaded), (0, height * len(some) + 24 * i))
    shared = sheet.quantize(colors)
    # The paper keeps its very colour, or a page would show the picture's edge.
    entries = np.reshape(shared.getpalette() or [], (-1, 3))
    paper = np.array(whole[0].getpixel((width - 1, 0)))
    entries[np.abs(entries - paper).sum(axis=1).argmin()] = paper
    shared.putpalette(entries.ravel().tolist())
    frames = [one.quantize(palette=shared, dither=Pillow.Dither.NONE) for one in whole]
    written = io.BytesIO()
    frames[0].save(
        written,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=list(milliseconds),
        loop=0,
        optimize=False,
        disposal=1,
    )
    return written.getvalue()


def draw_pads(
    robot: ArmHand, path: str | PathLike[str] | None = None, *, dpi: float = DPI
) -> Figure:
    """Draw the hands of a robot at home from two sides, with a mark at every pad.

    Args:
        robot: The robot.
        path: PNG file to write, if any.
        dpi: Dots per inch.

    Returns:
        The figure, which belongs to no pyplot window.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
    """
    whole, sides = robot.description, robot.description.sides
    hands = [ArmHand(whole.side(side.name)) for side in sides] or [robot]
    figure = new_figure(SIZE[0], SIZE[1] * len(hands), dpi)
    for i, hand in enumerate(reversed(hands)):
        _pads_of(figure, hand, i / len(hands), 0.88 / len(hands))
    for i, hand in enumerate(hands):
        top = 1.0 - i / len(hands)
        at, ink = top - 0.045 / len(hands), palette.INK
        figure.text(0.02, at, hand.name, size=15, weight="bold", color=ink, va="center")
        note = (
            "pads and their outward normals; the thumb is yellow; seen from two sides, palm's z up"
        )
        figure.text(0.02, top - 0.09 / len(hands), note, size=10, color=palette.FAINT, va="center")
    if path is not None:
        save_picture(figure, path)
    return figure


def _pads_of(figure: Figure, robot: ArmHand, bottom: float, height: float) -> None:
    """Draw a hand with its pads from two sides, on a part of a figure as wide as that."""
    # In the palm frame, whose z is up and whose y goes to the thumb.
    back = inverse(robot.palm(robot.home))
    hand = [
        replace(one.at(back), color=palette.HAND)
        for one in placed(robot, robot.home)
        if one.role == "hand"
    ]
    size = float(np.ptp(points_of(hand), axis=0).max())
    frames, marks = back @ robot.contact_frames(robot.home), []
    for name, frame in zip(robot.fingers, frames, strict=True):
        color = palette.TARGET if name == robot.description.named_thumb else palette.MET
        point, normal = frame[:3, 3], frame[:3, 0]
        marks.append(Drawable(name, ball(0.014 * size, point), color))
        marks.append(Drawable(name, arrow(point, normal, 0.16 * size, 0.012 * size), color))
    for left, turn in ((0.0, 25.0), (0.5, 115.0)):
        box = (left, bottom, 0.5, height)
        pixels = pixels_of(figure, box)
        with one_at_a_time, closing(Stage()) as stage:
            stage.add("hand", hand, orient=robot.description.path is not None)
            stage.add("marks", marks)
            view = float(np.deg2rad(turn)), float(np.deg2rad(20.0))
            stage.aim(view, points_of(hand + marks), pixels, (0.12, 0.04))
            # Pads are seen through the hand.
            image = over(over(1.0, stage.shoot("hand")), stage.shoot("marks"), 0.55)
            image = over(image, stage.shoot("hand", "marks"), 0.45)
            places = stage.project(frames[:, :3, 3])
        axes = panel(figure, box, image)
        _label(axes, dict(zip(robot.fingers, places, strict=True)), 0.06)


# What is on a picture.


def fill(
    stage: Stage,
    robot: ArmHand,
    q: ArrayLike,
    grasp: Grasp | None,
    colors: Mapping[str, str],
    floor: bool = True,
) -> dict[str, list[Drawable]]:
    """Put robot, object and contacts on the stage, and give them back by group.

    Args:
        stage: Where.
        robot: The robot.
        q: (n,) where it is [rad or m].
        grasp: What is asked; None: nothing.
        colors: Of what is reached, by finger.
        floor: Whether there is a floor below the robot.
    """
    body, palms = placed(robot, q), palm_places(robot, q)
    groups: dict[str, list[Drawable]] = {"arm": [], "wrist": [], "hand": []}
    for one in body:  # the close-up shows what is no further than this from the palm
        near = one.role == "arm" and _distances(one, palms).min() < 0.10
        groups["wrist" if near else "arm" if one.role == "arm" else "hand"].append(one)
    groups["object"] = _object(grasp) if grasp else []
    groups["marks"] = contact_marks(robot, q, grasp, colors) if grasp else []
    for name, members in groups.items():
        stage.add(name, members, OPACITY.get(name, 1.0))
    if floor:
        stage.add_floor(lowest(robot), body)
    return groups


def _surround(stage: Stage, robot: ArmHand, solution: Solution, grasp: Grasp, scene: Scene) -> None:
    """Put what stands about on the stage, and what is nearest to touching."""
    whole = with_object(scene, grasp)
    stage.add("scene", scene_of(whole, grasp.object), OPACITY["scene"])
    pair = solution.closest
    if pair is not None and np.isfinite(solution.q).all():
        found = closest_points(robot, solution.q, whole, pair)
        if found is not None:
            stage.add("nearest", nearest_pair(found))
            touching = [] if solution.success else nearest_pair(found, touching=True)
            stage.add("touching", touching, OPACITY["touching"])


def _object(grasp: Grasp) -> list[Drawable]:
    """The object, if there is a description of it and its place is given."""
    pose, found = grasp.known_pose, object_of(grasp.object)
    return [] if found is None or pose is None else [found.at(pose)]


def _middle(robot: ArmHand, q: ArrayLike, grasp: Grasp) -> Array:
    """(3,) amid the contacts asked for [m]."""
    grasp.arrays(robot.fingers)
    tips = dict(zip(robot.fingers, robot.contacts(q)[0], strict=True))
    places = [target_place(contact, tips[name]) for name, contact in grasp.contacts.items()]
    return np.mean(places or list(tips.values()), axis=0)


def _distances(one: Drawable, places: Array) -> Array:
    """(v,) of its vertices from the nearest of places (k, 3)."""
    return np.linalg.norm(one.surface.points[:, None] - places, axis=2).min(axis=1)


def _inwards(pixels: tuple[int, int]) -> Image:
    """(h, w, 1) 0 at the edges of an image, 1 further in."""
    x, y = (np.linspace(0, 1, size, dtype=np.float32) for size in pixels)
    x, y = (np.clip(np.minimum(v, 1 - v) / 0.15, 0, 1) for v in (x, y))
    return y[:, None, None] * x[:, None]


def pixels_of(figure: Figure, box: Box) -> tuple[int, int]:
    """Width and height of a part of a figure."""
    width, height = figure.get_size_inches() * figure.dpi
    return round(width * box[2]), round(height * box[3])


def panel(figure: Figure, box: Box, image: Image) -> Axes:
    """An image on a part of a figure."""
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.imshow(np.clip(image, 0.0, 1.0))
    return axes


# What is written on it.


def _label(
    axes: Axes,
    places: Mapping[str, Array],
    step: float,
    ground: Ground = LIGHT,
    below: Mapping[str, tuple[str, str]] | None = None,
) -> None:
    """The fingers' names at the edges of a picture, a line from each to its place.

    Args:
        axes: With the picture.
        places: (2,) by finger [pixel].
        step: Between two names, as a part of the picture's height.
        ground: What the picture is drawn on.
        below: What is said below a name, and its colour.
    """
    height, width = axes.images[0].get_size()
    middle = float(np.median([x for x, _ in places.values()]))
    lowest = {"left": -np.inf, "right": -np.inf}
    for finger, (x, y) in sorted(places.items(), key=lambda item: float(item[1][1])):
        side = "right" if x > middle else "left"
        level = lowest[side] = max(y, lowest[side] + step * height, 0.67 * step * height)
        edge, shoulder = (0.985, 0.825) if side == "right" else (0.015, 0.175)
        above = {"ha": side, "va": "bottom", "size": 11, "color": ground.ink, "weight": "bold"}
        axes.text(edge * width, level - 0.006 * height, finger, **above)
        if below is not None:
            said, color = below[finger]
            look = {"ha": side, "va": "top", "size": 9.5, "color": color}
            axes.text(edge * width, level + 0.006 * height, said, **look)
        line = [edge * width, shoulder * width, x], [level, level, y]
        axes.plot(*line, color=ground.faint, lw=0.8, alpha=0.8)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)


def _errors(position: float, angle: float) -> str:
    parts = [] if np.isnan(position) else [f"{1e3 * position:.2f} mm"]
    return "  ".join(parts if np.isnan(angle) else [*parts, f"{np.rad2deg(angle):.2f}°"])


def _add_title(figure: Figure, solution: Solution, grasp: Grasp, ground: Ground) -> None:
    """What was asked, how it ended, and the largest errors."""
    worst = [
        np.nanmax([getattr(verdict, name) for verdict in solution.contacts.values()] + [0.0])
        for name in ("position_error", "angle_error")
    ]
    what = f"{grasp.name} · {solution.robot}" if grasp.name else solution.robot
    large = {"size": 16, "weight": "bold", "va": "center"}
    figure.text(0.02, 0.945, what, color=ground.ink, **large)
    color = palette.MET if solution.success else palette.MISSED
    figure.text(0.98, 0.945, solution.status.name, color=color, ha="right", **large)
    limits = "" if solution.limits_ok else " · beyond a limit"
    how = f"{solution.method} · {solution.iterations} iterations"
    how += f" · largest errors {_errors(*worst)}{limits}"
    figure.text(0.02, 0.90, how, size=11, color=ground.faint, va="center")


def _add_legend(
    figure: Figure,
    solution: Solution,
    grasp: Grasp,
    has_object: bool,
    has_scene: bool,
    ground: Ground,
) -> None:
    """What the arrows mean."""
    states = {verdict.ok for verdict in solution.contacts.values()}
    handles: list[Line2D | Patch] = [_mark(palette.TARGET, _asked(grasp), 4.5)]
    if True in states:
        handles.append(_mark(palette.MET, "reached, within tolerance", 2.0))
    if False in states:
        handles.append(_mark(palette.MISSED, "reached, out of tolerance", 2.0))
    if has_object:
        handles.append(Patch(color=palette.OBJECT, label="object"))
    if has_scene and solution.closest is not None and solution.clearance is not None:
        pair = " and ".join(solution.closest)
        label = f"nearest: {pair}, {1e3 * solution.clearance:.1f} mm"
        handles.append(Line2D([], [], color=palette.NEAREST, lw=3.0, label=label))
    style = {"frameon": False, "fontsize": 10, "labelcolor": ground.ink}
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), **style)


def _asked(grasp: Grasp) -> str:
    """What the marks of a target are."""
    if grasp.palm is not None:
        return "asked for: palm and posture"
    contacts = grasp.contacts.values()
    placed = [contact for contact in contacts if not np.isnan(contact.point[0])]
    marks = {
        "contact": any(c.line is None and c.plane is None for c in placed),
        "line (rod)": any(c.line is not None for c in placed),
        "plane (ring)": any(c.plane is not None for c in placed),
        "pad normal": any(c.normal is not None for c in contacts),
        "second axis (shorter)": any(c.tangent is not None for c in contacts),
    }
    return "asked for: " + ", ".join(name for name, there in marks.items() if there)


def _mark(color: str, label: str, width: float) -> Line2D:
    return Line2D([], [], color=color, lw=width, marker="o", markersize=6, label=label)
