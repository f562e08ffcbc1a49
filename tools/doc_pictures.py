"""Draw the pictures of the documentation that no single command draws.

    python tools/doc_pictures.py --out docs --only contacts scene pairs unreachable humanoid
    python tools/doc_pictures.py --out docs --only arms hands bodies

The pictures show the frames of a contact, an obstacle with and without a scene, eight arm-hands, an
unreachable grasp, a humanoid that holds a box, and all built-in arms, hands and multi-arm robots.
Robots have the visual meshes that are on the machine (`casadi-ik meshes`).
"""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import casadi_ik as ik
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    Drawable,
    View,
    bodies_at,
    clearance_marks,
    close_view,
    ground_height,
    object_drawable,
    overview,
    scene_drawables,
    target_marks,
)
from casadi_ik.app.drawing.surfaces import arrow, ball
from casadi_ik.app.pictures.charts import new_figure, save_picture
from casadi_ik.app.pictures.scene3d import Image, Scene3D, composite, vertices_of
from casadi_ik.collision.clearance import closest_points
from casadi_ik.files.arrays import Array

PAIRS = (
    ("kuka_lwr_barrett", "LWR 4+ · Barrett"),
    ("panda+allegro_right", "Panda · Allegro"),
    ("ur5e+shadow", "UR5e · Shadow"),
    ("xarm7+inspire_rh56", "xArm 7 · Inspire"),
    ("iiwa14+schunk_svh", "iiwa 14 · SVH"),
    ("kinova_gen3+robotiq_3f", "Gen3 · Robotiq 3F"),
    ("sawyer+unitree_dex3", "Sawyer · Dex3"),
    ("baxter_ar10", "Baxter · AR10"),
)

POST = {
    "table": {"kind": "box", "size": [1.4, 1.0, 0.04], "xyz": [-0.45, 0, -0.02]},
    "post": {"kind": "cylinder", "radius": 0.04, "length": 1.0},
}


MODELS = Path(__file__).parents[1] / "models"

GALLERIES = {"arms": (7, (135, 175)), "hands": (5, (180, 170)), "bodies": (4, (225, 260))}
"""Number of columns and size of an image [pixels] of each gallery; folders of `models`."""

HANDS_OF_BODIES = {"two_ur10e": "two_ur10e+robotiq_2f85"}
"""Robots that stand for bodies whose file names no hand."""


def shot(
    robot: ik.ArmHand,
    q: Array,
    view: View,
    pixels: tuple[int, int],
    grasp: ik.Grasp | None = None,
    scene: ik.Scene | None = None,
    pair: tuple[str, str] | None = None,
) -> Image:
    """Return an image of a robot with its object, obstacles and the nearest pair, on white."""
    links, objects = bodies_at(robot, q), placed_object(grasp)
    obstacles = [] if scene is None else scene_drawables(scene, "table")
    with closing(Scene3D()) as stage:
        stage.add("robot", links)
        stage.add("object", objects, 0.6)
        if grasp is not None:
            stage.add("object marks", contact_targets(grasp))
        stage.add("scene", obstacles)
        if scene is not None and pair is not None:
            closest = closest_points(robot, q, scene, pair)
            if closest is not None:
                stage.add("nearest pair", clearance_marks(closest, show_shapes=True), 0.6)
        stage.add_floor(ground_height(robot, scene), links + objects + obstacles)
        stage.aim(view, vertices_of(links + objects + obstacles), pixels, (0.03, 0.03))
        return np.clip(composite(1.0, stage.render()), 0.0, 1.0)


def placed_object(grasp: ik.Grasp | None) -> list[Drawable]:
    """Return the drawable of the object of a grasp at its pose; none if either is unknown."""
    drawable = None if grasp is None else object_drawable(grasp.object)
    pose = None if grasp is None else grasp.known_pose
    return [] if drawable is None or pose is None else [drawable.transformed(pose)]


def contact_targets(grasp: ik.Grasp) -> list[Drawable]:
    """Return the marks of all contacts of a grasp."""
    contacts = grasp.contacts.values()
    return [mark for contact in contacts for mark in target_marks(contact, contact.point)]


def axes_of(name: str, pose: Array, length: float) -> list[Drawable]:
    """Return the x, y and z axes (red, green, blue) of a frame (4, 4)."""
    colors = ("#d62f3c", "#1f9d55", "#2f6db3")
    return [
        Drawable(f"{name} {i}", arrow(pose[:3, 3], pose[:3, i], length, 0.11 * length), color)
        for i, color in enumerate(colors)
    ]


def contacts(path: Path) -> None:
    """Draw the base frame, the palm frame and the contacts of a grasp, with labels."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    q = ik.Solver(robot).solve(grasp).q
    links, objects = bodies_at(robot, q), placed_object(grasp)
    palm, flange = robot.palm(q), robot.links(q)["lwr_flange"]
    points, normals = robot.contacts(q)
    view = close_view(robot, q)
    hand = [link for link in links if link.role != "arm"]
    panes = (
        (
            overview(palm[:3, 3], view),
            links,
            axes_of("base", np.eye(4), 0.28),
            (0.0, 0.0, 0.36, 1.0),
            (420, 580),
            [
                ("base frame", np.zeros(3), (24, -46)),
                ("arm", robot.links(q)["lwr_link_3"][:3, 3], (-60, 40)),
                ("hand", palm[:3, 3], (-30, 50)),
            ],
        ),
        (
            view,
            hand,
            axes_of("palm", palm, 0.045),
            (0.36, 0.0, 0.64, 1.0),
            (740, 580),
            [
                ("flange of the arm", flange[:3, 3], (90, 40)),
                ("palm frame", palm[:3, 3], (-190, 60)),
                ("pad", points[1], (105, 60)),
                ("contact point", points[0], (-150, -50)),
                ("normal, into the object", points[0] + 0.025 * normals[0], (-60, -100)),
            ],
        ),
    )
    figure = new_figure(10.4, 5.2, dpi=110)
    for camera, framed, axes_drawn, box, pixels, labels in panes:
        with closing(Scene3D()) as stage:
            stage.add("robot", framed, 0.8 if framed is hand else 1.0)
            stage.add("object", objects, 0.5)
            stage.add("object marks", contact_targets(grasp))
            stage.add("frame", axes_drawn)
            stage.aim(camera, vertices_of(framed + objects + axes_drawn), pixels, (0.10, 0.14))
            image = np.clip(composite(1.0, stage.render()), 0.0, 1.0)
            ends = stage.project(np.array([point for _, point, _ in labels]))
        axes = figure.add_axes(box)
        axes.set_axis_off()
        axes.imshow(image)
        for (text, _, offset), end in zip(labels, ends, strict=True):
            axes.annotate(
                text, end, offset, xycoords="data", textcoords="offset points", size=13,
                color=palette.INK, arrowprops={"arrowstyle": "-", "color": palette.FAINT},
            )  # fmt: skip
    save_picture(figure, path)


def panels(images: list[Image], titles: list[str], size: tuple[float, float]) -> Figure:
    """Return a figure with images in a row, each with a title below."""
    figure = new_figure(*size, dpi=100)
    for i, (image, title) in enumerate(zip(images, titles, strict=True)):
        axes = figure.add_axes((i / len(images), 0.1, 1 / len(images), 0.9))
        axes.set_axis_off()
        axes.imshow(image)
        middle = (i + 0.5) / len(images)
        figure.text(middle, 0.05, title, ha="center", va="center", size=10, color=palette.INK)
    return figure


def scene(path: Path) -> None:
    """Draw an obstacle that the arm passes through without a scene, and avoids with it."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    unobstructed = ik.Solver(robot).solve(grasp)
    # The post stands in the forearm of the solution without a scene.
    elbow, wrist = (robot.links(unobstructed.q)[f"lwr_link_{i}"][:3, 3] for i in (4, 6))
    forearm = 0.6 * elbow + 0.4 * wrist
    post = POST["post"] | {"xyz": [*forearm[:2].tolist(), 0.5]}
    obstacles = ik.Scene(POST | {"post": post}, margin=0.02, name="post")
    with_scene = ik.Solver(robot, scene=obstacles).solve(grasp)
    clearance = f"{1e3 * (with_scene.clearance or 0):.0f} mm"
    print("scene", unobstructed.status.name, with_scene.status.name, clearance)
    azimuth = float(np.arctan2(forearm[1], forearm[0]) + np.deg2rad(100.0))
    view = (azimuth, float(np.deg2rad(38.0)))
    check = ik.Solver(robot, scene=obstacles).check(unobstructed.q, grasp)
    colliding = None if check is None else check.pair(0)
    images = [
        shot(robot, unobstructed.q, view, (460, 480), grasp, obstacles, colliding),
        shot(robot, with_scene.q, view, (460, 480), grasp, obstacles),
    ]
    titles = ["without the scene: the arm is in the post", "with the scene: it goes around"]
    save_picture(panels(images, titles, (9.2, 5.3)), path)


def pairs(path: Path) -> None:
    """Draw eight arm-hands at home."""
    images, titles = [], []
    for name, title in PAIRS:
        robot = ik.load_robot(name)
        images.append(shot(robot, robot.home, gallery_view(robot), (170, 230)))
        titles.append(title)
    save_picture(panels(images, titles, (13.6, 2.55)), path)


def gallery(path: Path) -> None:
    """Draw all robots of a folder of `models` in their home configurations, with their names."""
    columns, pixels = GALLERIES[path.stem]
    names = sorted(file.stem for file in (MODELS / path.stem).glob("*.yaml"))
    rows = -(-len(names) // columns)
    width, height = 1 / columns, 1 / rows
    figure = new_figure(columns * pixels[0] / 100, rows * (pixels[1] / 100 + 0.25), dpi=100)
    for i, name in enumerate(names):
        robot = ik.load_robot(HANDS_OF_BODIES.get(name, name))
        left, bottom = i % columns * width, 1 - (i // columns + 1) * height
        label = 0.25 / (pixels[1] / 100 + 0.25) * height
        axes = figure.add_axes((left, bottom + label, width, height - label))
        axes.set_axis_off()
        axes.imshow(shot(robot, robot.home, gallery_view(robot), pixels))
        middle = (left + width / 2, bottom + label / 2)
        figure.text(*middle, name, ha="center", va="center", size=9, color=palette.INK)
    save_picture(figure, path)


def gallery_view(robot: ik.ArmHand) -> View:
    """Return azimuth and elevation from which a robot is seen from its side."""
    tip = robot.contacts(robot.home)[0].mean(axis=0)
    return (float(np.arctan2(tip[1], tip[0]) - np.deg2rad(62.0)), float(np.deg2rad(16.0)))


def unreachable(path: Path) -> None:
    """Draw an unreachable grasp: the reach of the wrist, the nearest configuration, the reason."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    pose = grasp.known_pose
    assert pose is not None
    far_pose = pose.copy()
    far_pose[:3, 3] += [-0.35, 0.05, 0.05]
    far_grasp = grasp.in_object_frame().at(far_pose)
    solution = ik.Solver(robot).solve(far_grasp)
    assert solution.diagnosis is not None
    q, lines = solution.diagnosis.q, solution.diagnosis.lines
    print("unreachable", solution.status.name, lines)
    links = robot.links(q)
    shoulder, elbow, wrist = (links[f"lwr_link_{i}"][:3, 3] for i in (2, 4, 6))
    reach = float(np.linalg.norm(elbow - shoulder) + np.linalg.norm(wrist - elbow))
    bodies, objects = bodies_at(robot, q), placed_object(far_grasp)
    view, pixels = overview(far_pose[:3, 3], close_view(robot, q)), (1000, 520)
    shell = [Drawable("reach", ball(reach, shoulder), palette.MISSED)]
    with closing(Scene3D()) as stage:
        stage.add("robot", bodies)
        stage.add("object", objects, 0.6)
        stage.add("marks", contact_targets(far_grasp))
        stage.add("reach", shell, 0.10)
        stage.add_floor(0.0, bodies + objects)
        stage.aim(view, vertices_of(bodies + objects), pixels, (0.12, 0.06))
        image = np.clip(composite(1.0, stage.render()), 0.0, 1.0)
        ends = stage.project(np.array([wrist, far_pose[:3, 3]]))
    figure = new_figure(10.0, 6.4, dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 0.82))
    axes.set_axis_off()
    axes.imshow(image)
    note = {"xycoords": "data", "textcoords": "offset points", "size": 10, "color": palette.INK}
    line = {"arrowstyle": "-", "color": palette.FAINT, "lw": 0.8}
    axes.annotate("reach of the wrist", ends[0], (-40, -70), arrowprops=line, **note)
    axes.annotate("cup", ends[1], (-30, 60), arrowprops=line, **note)
    figure.text(
        0.02, 0.955, "UNREACHABLE", size=16, weight="bold", color=palette.MISSED, va="center"
    )
    for i, text in enumerate(lines[:3]):
        figure.text(0.02, 0.905 - 0.038 * i, text, size=10, color=palette.INK, va="center")
    save_picture(figure, path)


def humanoid(path: Path) -> None:
    """Draw a G1 that holds a box at any pose that both hands reach; contacts as in notebook 10."""
    robot, size = ik.load_robot("g1+dex3"), np.array([0.07, 0.40, 0.04])
    contacts: dict[str, ik.Contact] = {}
    for side, y in (("left", 1), ("right", -1)):
        contacts[f"{side}_thumb"] = ik.Contact([0, 0.14 * y, size[2] / 2], [0, 0, -1])
        contacts[f"{side}_middle"] = ik.Contact([0, 0.16 * y, -size[2] / 2], [0, 0, 1])
        contacts[f"{side}_index"] = ik.Contact([0, 0.12 * y, -size[2] / 2], [0, 0, 1])
    obstacles = ik.Scene({"box": {"kind": "box", "size": size.tolist()}})
    free = ik.Free((0.28, -0.02, 0.08, 0, 0, 0), (0.42, 0.02, 0.25, 0, 0, 0))
    solver = ik.Solver(robot, scene=obstacles)
    solution = solver.solve(ik.Grasp(contacts, object="box", object_pose=free))
    pose = solution.object_pose
    assert solution.success
    assert pose is not None
    grasp = ik.Grasp(contacts, object="box", object_pose=np.eye(4)).at(pose)
    views = [(float(np.deg2rad(angle)), float(np.deg2rad(14.0))) for angle in (38.0, -52.0)]
    placed = obstacles.moved("box", pose)
    images = [shot(robot, solution.q, view, (460, 560), grasp, placed) for view in views]
    save_picture(panels(images, ["from the left", "from the right"], (9.2, 5.6)), path)


def main(arguments: list[str] | None = None) -> None:
    """Draw the pictures that the command line names."""
    pictures = {
        "contacts": contacts,
        "scene": scene,
        "pairs": pairs,
        "unreachable": unreachable,
        "humanoid": humanoid,
        **dict.fromkeys(GALLERIES, gallery),
    }
    parser = argparse.ArgumentParser(description="Pictures of the documentation.")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="output folder")
    parser.add_argument(
        "--only", nargs="*", default=tuple(pictures), choices=pictures, help="names of pictures"
    )
    options = parser.parse_args(arguments)
    for name in options.only:
        file = options.out / ("gallery" if name in GALLERIES else "") / f"{name}.png"
        pictures[name](file)
        print(file, file.stat().st_size)


if __name__ == "__main__":
    main()
