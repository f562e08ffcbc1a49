"""Pictures of solutions and motions of robots, and of the pads of hands."""

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
    bodies_at,
    clearance_marks,
    close_view,
    contact_marks,
    ground_height,
    nearest_target_point,
    object_drawable,
    overview,
    palm_positions,
    scene_drawables,
    scene_with_object,
)
from casadi_ik.app.drawing.surfaces import arrow, ball
from casadi_ik.app.pictures.charts import DARK, DPI, LIGHT, ChartTheme, new_figure, save_picture
from casadi_ik.app.pictures.scene3d import Image, Scene3D, composite, render_lock, vertices_of
from casadi_ik.collision.clearance import closest_points
from casadi_ik.collision.scene import Scene
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.motion.motion import Motion
from casadi_ik.solve.solution import Solution

FIGURE_SIZE = (12.0, 6.6)
"""Size of a figure with two panels [inch]."""

Box = tuple[float, float, float, float]
"""Left, bottom, width and height of a panel as fractions of the figure."""

ROBOT_BOX: Box = (0.0, 0.06, 0.40, 0.82)
CLOSE_UP_BOX: Box = (0.40, 0.06, 0.60, 0.82)

OPACITY = {"object": 0.5, "scene": 0.45, "touching": 0.35}
"""Opacities of translucent groups."""


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
    """Draw the solution of a grasp: the whole robot, and a close-up of the hand.

    Args:
        robot: Robot of the solution.
        solution: The solution.
        grasp: The grasp; its object is drawn if it has a description.
        path: PNG file to write; None: none.
        scene: Obstacles; they are drawn with the distance of the closest pair of shapes, which is
            highlighted if it collides.
        view: Azimuth and elevation of the close-up [rad]; None: chosen to separate the fingertips.
        dpi: Dots per inch.
        dark: Use colours for a dark page.

    Returns:
        The figure, without a pyplot window.

    Raises:
        PictureError: The file cannot be written, or OpenGL is not available.
        DescriptionError: The description of the object is malformed.
        InputError: The grasp names a finger that the robot does not have.
    """
    theme = DARK if dark else LIGHT
    figure = new_figure(*FIGURE_SIZE, dpi, theme)
    paper = np.array(palette.rgb(theme.paper), np.float32) / 255
    colors = {
        finger: palette.MET if verdict.ok else palette.MISSED
        for finger, verdict in solution.contacts.items()
    }
    q = solution.q
    with render_lock, closing(Scene3D()) as scene3d:
        groups = add_grasp(scene3d, robot, q, grasp, colors)
        if scene is not None:
            _add_scene(scene3d, robot, solution, grasp, scene)
        view = view or close_view(robot, q)
        pixels = pixel_size(figure, ROBOT_BOX)
        points = vertices_of([drawable for group in groups.values() for drawable in group])
        scene3d.aim(overview(_target_center(robot, q, grasp), view), points, pixels, (0.03, 0.10))
        image = composite(paper, scene3d.render("floor"), _edge_fade(pixels))
        image = composite(image, scene3d.render(*groups, "scene", "nearest", "touching"))
        add_image(figure, ROBOT_BOX, composite(image, scene3d.render("marks", "nearest"), 0.45))

        # The close-up omits objects and marks that extend beyond 0.35 m of the palm.
        palms = palm_positions(robot, q)
        objects_and_marks = groups["object"] + groups["marks"]
        nearby = [
            drawable for drawable in objects_and_marks if _distances(drawable, palms).max() < 0.35
        ]
        pixels = pixel_size(figure, CLOSE_UP_BOX)
        scene3d.aim(view, vertices_of(groups["hand"] + nearby), pixels, (0.17, 0.02))
        # The arm is translucent because it may occlude the hand.
        image = composite(paper, scene3d.render("wrist"), 0.3 * _edge_fade(pixels))
        image = composite(image, scene3d.render("hand", "object", "marks", "nearest", "touching"))
        axes = add_image(
            figure, CLOSE_UP_BOX, composite(image, scene3d.render("marks", "nearest"), 0.45)
        )
        tip_pixels = scene3d.project(robot.contacts(q)[0])
    fingers = grasp.contacts or robot.fingers  # palm poses determine all fingers
    errors_by_finger = {
        finger: (
            _error_text(verdict.position_error, verdict.angle_error),
            palette.MET if verdict.ok else palette.MISSED,
        )
        for finger, verdict in solution.contacts.items()
    }
    pixel_of_finger = {
        finger: pixel
        for finger, pixel in zip(robot.fingers, tip_pixels, strict=True)
        if finger in fingers
    }
    _label(axes, pixel_of_finger, 0.12, theme, errors_by_finger)
    _add_title(figure, solution, grasp, theme)
    _add_legend(figure, solution, grasp, bool(groups["object"]), scene is not None, theme)
    if path is not None:
        save_picture(figure, path)
    return figure


def show(
    robot: ArmHand, q: ArrayLike, grasp: Grasp | None = None, *, window: bool = True
) -> pv.Plotter:
    """Open a window with an interactive view of a robot.

    Args:
        robot: The robot.
        q: (n,) Configuration [rad or m].
        grasp: Contacts and object that are drawn; None: none.
        window: Open the window and wait until it is closed; otherwise only make the plotter.

    Returns:
        The plotter, for example for its `export_gltf`.

    Raises:
        PictureError: OpenGL is not available.
        InputError: q is invalid, or the grasp names a finger that the robot does not have.
    """
    with render_lock:
        scene3d = Scene3D(off_screen=not window)
        groups = add_grasp(scene3d, robot, q, grasp, dict.fromkeys(robot.fingers, palette.INK))
        view = overview(robot.contacts(q)[0].mean(axis=0), close_view(robot, q))
        points = vertices_of([drawable for group in groups.values() for drawable in group])
        scene3d.aim(view, points, (1200, 900), (0.05, 0.05))
    if window:
        scene3d.plotter.show(auto_close=False)
    return scene3d.plotter


def draw_motion(
    motion: Motion,
    grasp: Grasp,
    path: str | PathLike[str],
    scene: Scene | None = None,
) -> int:
    """Draw a motion in real time as a GIF: the whole robot, and a close-up of the hand.

    Args:
        motion: The motion.
        grasp: Target of the motion; its object is drawn if it has a description.
        path: GIF file to write.
        scene: Obstacles; None: none are drawn.

    Returns:
        Number of frames: twelve per second, fewer for motions longer than 7.5 s.

    Raises:
        PictureError: The file cannot be written, or OpenGL is not available.
        DescriptionError: The description of the object is malformed.
    """
    seconds = float(motion.times[-1])
    count = int(np.clip(np.ceil(12 * seconds), 2, 90))
    times = np.linspace(0.0, seconds, count)
    q = np.stack([np.interp(times, motion.times, column) for column in motion.q.T], axis=1)
    step = max(round(1e3 * seconds / (count - 1)), 20)
    images = _motion_images(motion.robot, q, grasp, scene)
    save_picture(
        encode_gif(images, [*[step] * (count - 1), 1500], 128), path
    )  # the last one stays [ms]
    return count


def _motion_images(robot: ArmHand, q: Array, grasp: Grasp, scene: Scene | None) -> list[Image]:
    """Return images (h, w, 3) of configurations (k, n)."""
    end, sizes = q[-1], ((420, 420), (340, 420))
    hand_margin = 0.15 * np.vstack([np.eye(3), -np.eye(3)])
    swept_bodies = [body for row in q[:: max(len(q) // 8, 1)] for body in bodies_at(robot, row)]
    object_drawables = _object_drawables(grasp)
    tips = robot.contacts(end)[0]
    marks = contact_marks(robot, end, grasp, dict.fromkeys(robot.fingers, palette.MET))
    images = []
    with render_lock, closing(Scene3D()) as scene3d:
        points = vertices_of(swept_bodies + object_drawables)
        scene3d.add("object", object_drawables, OPACITY["object"])
        scene3d.add("marks", marks)
        if scene is not None:
            obstacles = scene_drawables(scene_with_object(scene, grasp), grasp.object)
            scene3d.add("scene", obstacles, OPACITY["scene"])
        view = close_view(robot, end)
        robot_view, floor = overview(tips.mean(axis=0), view), ground_height(robot)
        for row in q:
            bodies = bodies_at(robot, row)
            scene3d.replace("robot", bodies)
            scene3d.add_floor(floor, bodies + object_drawables, points, texels=512)
            hand = (
                robot.contacts(row)[0].mean(axis=0) + palm_positions(robot, row).mean(axis=0)
            ) / 2
            panels = []
            for camera_view, region, pixels in (
                (robot_view, points, sizes[0]),
                (view, hand + hand_margin, sizes[1]),
            ):
                scene3d.aim(camera_view, region, pixels, (0.04, 0.04))
                panels.append(np.clip(composite(1.0, scene3d.render()), 0.0, 1.0))
            images.append(np.concatenate(panels, axis=1))
    return images


def encode_gif(images: Sequence[Image], milliseconds: Sequence[int], colors: int = 96) -> bytes:
    """Encode images (h, w, 3) as a GIF with one palette, which has shades of all colours used."""
    frames = [
        Pillow.fromarray(np.round(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8))
        for image in images
    ]
    width, height = frames[0].size
    samples = [frames[0], frames[len(frames) // 2], frames[-1]]
    base_colors = [
        "#ffffff",
        palette.ARM,
        palette.HAND,
        palette.PAD,
        palette.OBJECT,
        palette.TARGET,
        palette.MET,
    ]
    sheet = Pillow.new("RGB", (width, height * len(samples) + 24 * len(base_colors)))
    for i, sample in enumerate(samples):
        sheet.paste(sample, (0, i * height))
    for i, color in enumerate(base_colors):
        shades = np.linspace(0.45, 1.2, width)[None, :, None] * np.array(palette.rgb(color))
        shaded = np.repeat(np.clip(shades, 0, 255).astype(np.uint8), 24, axis=0)
        sheet.paste(Pillow.fromarray(shaded), (0, height * len(samples) + 24 * i))
    shared_palette = sheet.quantize(colors)
    # The background keeps its exact colour; otherwise the edge of the picture is visible.
    entries = np.reshape(shared_palette.getpalette() or [], (-1, 3))
    colors_and_counts = np.unique(np.asarray(frames[0]).reshape(-1, 3), axis=0, return_counts=True)
    paper = colors_and_counts[0][colors_and_counts[1].argmax()].astype(int)
    paper_index = int(np.abs(entries - paper).sum(axis=1).argmin())
    entries[paper_index] = paper
    shared_palette.putpalette(entries.ravel().tolist())
    quantised = []
    for frame in frames:
        # Pillow assigns some other entry to a colour that is close to several.
        indices = np.array(frame.quantize(palette=shared_palette, dither=Pillow.Dither.NONE))
        indices[(np.asarray(frame) == paper).all(axis=2)] = paper_index
        image = Pillow.fromarray(indices)
        image.putpalette(entries.ravel().tolist())
        quantised.append(image)
    buffer = io.BytesIO()
    quantised[0].save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=quantised[1:],
        duration=list(milliseconds),
        loop=0,
        optimize=False,
        disposal=1,
    )
    return buffer.getvalue()


def draw_pads(
    robot: ArmHand, path: str | PathLike[str] | None = None, *, dpi: float = DPI
) -> Figure:
    """Draw the hands of a robot at home from two sides with their pads.

    Args:
        robot: The robot.
        path: PNG file to write; None: none.
        dpi: Dots per inch.

    Returns:
        The figure, without a pyplot window.

    Raises:
        PictureError: The file cannot be written, or OpenGL is not available.
    """
    description, sides = robot.description, robot.description.sides
    hands = [ArmHand(description.side(side.name)) for side in sides] or [robot]
    figure = new_figure(FIGURE_SIZE[0], FIGURE_SIZE[1] * len(hands), dpi)
    for i, hand in enumerate(reversed(hands)):
        _draw_hand_pads(figure, hand, i / len(hands), 0.88 / len(hands))
    for i, hand in enumerate(hands):
        top = 1.0 - i / len(hands)
        y, ink = top - 0.045 / len(hands), palette.INK
        figure.text(0.02, y, hand.name, size=15, weight="bold", color=ink, va="center")
        note = "pads and outward normals from two sides; thumb in yellow; the palm's z axis is up"
        figure.text(0.02, top - 0.09 / len(hands), note, size=10, color=palette.FAINT, va="center")
    if path is not None:
        save_picture(figure, path)
    return figure


def _draw_hand_pads(figure: Figure, robot: ArmHand, bottom: float, height: float) -> None:
    """Draw a hand with its pads from two sides in a full-width strip of a figure."""
    # Drawn in the palm frame: z is up, y points to the thumb.
    to_palm = inverse(robot.palm(robot.home))
    hand = [
        replace(drawable.transformed(to_palm), color=palette.HAND)
        for drawable in bodies_at(robot, robot.home)
        if drawable.role == "hand"
    ]
    size = float(np.ptp(vertices_of(hand), axis=0).max())
    frames, marks = to_palm @ robot.contact_frames(robot.home), []
    for name, frame in zip(robot.fingers, frames, strict=True):
        color = palette.TARGET if name == robot.description.named_thumb else palette.MET
        point, normal = frame[:3, 3], frame[:3, 0]
        marks.append(Drawable(name, ball(0.014 * size, point), color))
        marks.append(Drawable(name, arrow(point, normal, 0.16 * size, 0.012 * size), color))
    for x_offset, azimuth in ((0.0, 25.0), (0.5, 115.0)):
        box = (x_offset, bottom, 0.5, height)
        pixels = pixel_size(figure, box)
        with render_lock, closing(Scene3D()) as scene3d:
            scene3d.add("hand", hand, orient=robot.description.path is not None)
            scene3d.add("marks", marks)
            view = float(np.deg2rad(azimuth)), float(np.deg2rad(20.0))
            scene3d.aim(view, vertices_of(hand + marks), pixels, (0.12, 0.04))
            # Pads are visible through the hand.
            image = composite(composite(1.0, scene3d.render("hand")), scene3d.render("marks"), 0.55)
            image = composite(image, scene3d.render("hand", "marks"), 0.45)
            pad_pixels = scene3d.project(frames[:, :3, 3])
        axes = add_image(figure, box, image)
        _label(axes, dict(zip(robot.fingers, pad_pixels, strict=True)), 0.06)


# Content of pictures.


def add_grasp(
    scene3d: Scene3D,
    robot: ArmHand,
    q: ArrayLike,
    grasp: Grasp | None,
    colors: Mapping[str, str],
    floor: bool = True,
) -> dict[str, list[Drawable]]:
    """Add robot, object and contacts to a scene, and return the drawables by group.

    Args:
        scene3d: The scene.
        robot: The robot.
        q: (n,) Configuration [rad or m].
        grasp: The grasp; None: none.
        colors: Colours of the fingertip marks by finger.
        floor: Add a floor below the robot.
    """
    bodies, palms = bodies_at(robot, q), palm_positions(robot, q)
    groups: dict[str, list[Drawable]] = {"arm": [], "wrist": [], "hand": []}
    for drawable in bodies:  # the close-up shows arm links within 0.10 m of the palm
        is_near = drawable.role == "arm" and _distances(drawable, palms).min() < 0.10
        groups["wrist" if is_near else "arm" if drawable.role == "arm" else "hand"].append(drawable)
    groups["object"] = _object_drawables(grasp) if grasp else []
    groups["marks"] = contact_marks(robot, q, grasp, colors) if grasp else []
    for name, members in groups.items():
        scene3d.add(name, members, OPACITY.get(name, 1.0))
    if floor:
        scene3d.add_floor(ground_height(robot), bodies)
    return groups


def _add_scene(
    scene3d: Scene3D, robot: ArmHand, solution: Solution, grasp: Grasp, scene: Scene
) -> None:
    """Add the obstacles and the closest pair of shapes."""
    scene_with_target = scene_with_object(scene, grasp)
    scene3d.add("scene", scene_drawables(scene_with_target, grasp.object), OPACITY["scene"])
    pair = solution.closest
    if pair is not None and np.isfinite(solution.q).all():
        points = closest_points(robot, solution.q, scene_with_target, pair)
        if points is not None:
            scene3d.add("nearest", clearance_marks(points))
            shapes = [] if solution.success else clearance_marks(points, show_shapes=True)
            scene3d.add("touching", shapes, OPACITY["touching"])


def _object_drawables(grasp: Grasp) -> list[Drawable]:
    """Return the object if it has a description and a pose."""
    pose, object_shape = grasp.known_pose, object_drawable(grasp.object)
    return [] if object_shape is None or pose is None else [object_shape.transformed(pose)]


def _target_center(robot: ArmHand, q: ArrayLike, grasp: Grasp) -> Array:
    """Return the (3,) centre of the contacts of a grasp [m]."""
    grasp.arrays(robot.fingers)
    tips = dict(zip(robot.fingers, robot.contacts(q)[0], strict=True))
    points = [nearest_target_point(contact, tips[name]) for name, contact in grasp.contacts.items()]
    return np.mean(points or list(tips.values()), axis=0)


def _distances(drawable: Drawable, points: Array) -> Array:
    """Return the (v,) distances of vertices from the nearest of points (k, 3)."""
    return np.linalg.norm(drawable.surface.points[:, None] - points, axis=2).min(axis=1)


def _edge_fade(pixels: tuple[int, int]) -> Image:
    """Return weights (h, w, 1): 0 at the edges of an image, 1 in its interior."""
    x, y = (np.linspace(0, 1, size, dtype=np.float32) for size in pixels)
    x, y = (np.clip(np.minimum(v, 1 - v) / 0.15, 0, 1) for v in (x, y))
    return y[:, None, None] * x[:, None]


def pixel_size(figure: Figure, box: Box) -> tuple[int, int]:
    """Return width and height of a part of a figure [pixels]."""
    width, height = figure.get_size_inches() * figure.dpi
    return round(width * box[2]), round(height * box[3])


def add_image(figure: Figure, box: Box, image: Image) -> Axes:
    """Add an image to a part of a figure."""
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.imshow(np.clip(image, 0.0, 1.0))
    return axes


# Labels.


def _label(
    axes: Axes,
    pixel_of_finger: Mapping[str, Array],
    step: float,
    theme: ChartTheme = LIGHT,
    notes: Mapping[str, tuple[str, str]] | None = None,
) -> None:
    """Write the names of fingers at the edges of a picture, with leader lines.

    Args:
        axes: Axes with the picture.
        pixel_of_finger: (2,) End of the leader line by finger [pixels].
        step: Distance of names as a fraction of the height.
        theme: Colours of the text.
        notes: Text and colour of a note below each name; None: no notes.
    """
    height, width = axes.images[0].get_size()
    center = float(np.median([x for x, _ in pixel_of_finger.values()]))
    label_y = {"left": -np.inf, "right": -np.inf}
    for finger, (x, y) in sorted(pixel_of_finger.items(), key=lambda item: float(item[1][1])):
        side = "right" if x > center else "left"
        level = label_y[side] = max(y, label_y[side] + step * height, 0.67 * step * height)
        edge, shoulder = (0.985, 0.825) if side == "right" else (0.015, 0.175)
        style = {"ha": side, "va": "bottom", "size": 11, "color": theme.ink, "weight": "bold"}
        axes.text(edge * width, level - 0.006 * height, finger, **style)
        if notes is not None:
            note, color = notes[finger]
            style = {"ha": side, "va": "top", "size": 9.5, "color": color}
            axes.text(edge * width, level + 0.006 * height, note, **style)
        line = [edge * width, shoulder * width, x], [level, level, y]
        axes.plot(*line, color=theme.faint, lw=0.8, alpha=0.8)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)


def _error_text(position: float, angle: float) -> str:
    parts = [] if np.isnan(position) else [f"{1e3 * position:.2f} mm"]
    return "  ".join(parts if np.isnan(angle) else [*parts, f"{np.rad2deg(angle):.2f}°"])


def _add_title(figure: Figure, solution: Solution, grasp: Grasp, theme: ChartTheme) -> None:
    """Write the grasp, the status and the largest errors."""
    largest_errors = [
        np.nanmax([getattr(verdict, name) for verdict in solution.contacts.values()] + [0.0])
        for name in ("position_error", "angle_error")
    ]
    title = f"{grasp.name} · {solution.robot}" if grasp.name else solution.robot
    large = {"size": 16, "weight": "bold", "va": "center"}
    figure.text(0.02, 0.945, title, color=theme.ink, **large)
    color = palette.MET if solution.success else palette.MISSED
    figure.text(0.98, 0.945, solution.status.name, color=color, ha="right", **large)
    limits = "" if solution.limits_ok else " · limit exceeded"
    summary = f"{solution.method} · {solution.iterations} iterations"
    summary += f" · largest errors {_error_text(*largest_errors)}{limits}"
    figure.text(0.02, 0.90, summary, size=11, color=theme.faint, va="center")


def _add_legend(
    figure: Figure,
    solution: Solution,
    grasp: Grasp,
    has_object: bool,
    has_scene: bool,
    theme: ChartTheme,
) -> None:
    """Add a legend of the marks."""
    states = {verdict.ok for verdict in solution.contacts.values()}
    handles: list[Line2D | Patch] = [_legend_mark(palette.TARGET, _target_label(grasp), 4.5)]
    if True in states:
        handles.append(_legend_mark(palette.MET, "reached, within tolerance", 2.0))
    if False in states:
        handles.append(_legend_mark(palette.MISSED, "reached, out of tolerance", 2.0))
    if has_object:
        handles.append(Patch(color=palette.OBJECT, label="object"))
    if has_scene and solution.closest is not None and solution.clearance is not None:
        pair = " and ".join(solution.closest)
        label = f"clearance: {pair}, {1e3 * solution.clearance:.1f} mm"
        handles.append(Line2D([], [], color=palette.NEAREST, lw=3.0, label=label))
    style = {"frameon": False, "fontsize": 10, "labelcolor": theme.ink}
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), **style)


def _target_label(grasp: Grasp) -> str:
    """Return the legend entry of the target's marks."""
    if grasp.palm is not None:
        return "target: palm and posture"
    contacts = grasp.contacts.values()
    point_contacts = [contact for contact in contacts if not np.isnan(contact.point[0])]
    marks = {
        "contact": any(c.line is None and c.plane is None for c in point_contacts),
        "line (rod)": any(c.line is not None for c in point_contacts),
        "plane (ring)": any(c.plane is not None for c in point_contacts),
        "pad normal": any(c.normal is not None for c in contacts),
        "second axis (shorter)": any(c.tangent is not None for c in contacts),
    }
    return "target: " + ", ".join(name for name, is_present in marks.items() if is_present)


def _legend_mark(color: str, label: str, width: float) -> Line2D:
    return Line2D([], [], color=color, lw=width, marker="o", markersize=6, label=label)
