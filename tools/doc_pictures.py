"""Pictures of the documentation that no single command makes.

A scene's post passed and not; eight arm-hands in a row; a grasp that no posture meets; a humanoid
that holds a box::

    python tools/doc_pictures.py --out docs --only scene pairs unreachable humanoid
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
from casadi_ik.app.drawing.surfaces import ball
from casadi_ik.app.pictures.charts import new_figure, save_picture
from casadi_ik.app.pictures.scene3d import Image, Scene3D, composite, corner_points
from casadi_ik.collision.clearance import closest_points
from casadi_ik.files.arrays import Array

PAIRS = (
    ("kuka_lwr_barrett", "LWR 4+ · Barrett"),
    ("panda+allegro_right", "Panda · Allegro"),
    ("ur5e+shadow", "UR5e · Shadow"),
    ("xarm6+leap", "xArm 6 · LEAP"),
    ("iiwa14+schunk_svh", "iiwa 14 · SVH"),
    ("kinova_gen3+robotiq_3f", "Gen3 · Robotiq 3F"),
    ("sawyer+unitree_dex3", "Sawyer · Dex3"),
    ("baxter_ar10", "Baxter · AR10"),
)

POST = {
    "table": {"kind": "box", "size": [2.0, 2.0, 0.04], "xyz": [0, 0, -0.02]},
    "post": {"kind": "cylinder", "radius": 0.04, "length": 1.0},
}


def shot(
    robot: ik.ArmHand,
    q: Array,
    view: View,
    pixels: tuple[int, int],
    grasp: ik.Grasp | None = None,
    scene: ik.Scene | None = None,
    pair: tuple[str, str] | None = None,
) -> Image:
    """A robot with what it grasps and what stands about it, on white."""
    body = bodies_at(robot, q)
    thing = None if grasp is None else object_drawable(grasp.object)
    pose = None if grasp is None else grasp.known_pose
    things = [] if thing is None or pose is None else [thing.transformed(pose)]
    with closing(Scene3D()) as stage:
        stage.add("robot", body)
        stage.add("object", things, 0.6)
        if grasp is not None:
            marks = [one for c in grasp.contacts.values() for one in target_marks(c, c.point)]
            stage.add("object marks", marks)
        around = [] if scene is None else scene_drawables(scene, "table")
        stage.add("scene", around)
        if scene is not None and pair is not None:
            found = closest_points(robot, q, scene, pair)
            if found is not None:
                stage.add("touching", clearance_marks(found, show_shapes=True), 0.6)
        stage.add_floor(ground_height(robot, scene), body + things + around)
        stage.aim(view, corner_points(body + things + around), pixels, (0.03, 0.03))
        return np.clip(composite(1.0, stage.render()), 0.0, 1.0)


def panels(images: list[Image], titles: list[str], size: tuple[float, float]) -> Figure:
    """Images in a row, each with a title below."""
    figure = new_figure(*size, dpi=100)
    for i, (image, title) in enumerate(zip(images, titles, strict=True)):
        axes = figure.add_axes((i / len(images), 0.1, 1 / len(images), 0.9))
        axes.set_axis_off()
        axes.imshow(image)
        middle = (i + 0.5) / len(images)
        figure.text(middle, 0.05, title, ha="center", va="center", size=10, color=palette.INK)
    return figure


def scene(path: Path) -> None:
    """A post that the arm passes through, and that it goes around."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    free = ik.Solver(robot).solve(grasp)
    # Where the forearm is without it.
    elbow, wrist = (robot.links(free.q)[f"lwr_link_{i}"][:3, 3] for i in (4, 6))
    middle = 0.6 * elbow + 0.4 * wrist
    post = POST["post"] | {"xyz": [*middle[:2].tolist(), 0.5]}
    about = ik.Scene(POST | {"post": post}, margin=0.02, name="post")
    kept = ik.Solver(robot, scene=about).solve(grasp)
    print("scene", free.status.name, kept.status.name, f"{1e3 * (kept.clearance or 0):.0f} mm")
    toward = float(np.arctan2(middle[1], middle[0]))
    view = (toward + np.deg2rad(100.0), float(np.deg2rad(38.0)))
    clear = ik.Solver(robot, scene=about).check(free.q, grasp)
    hit = None if clear is None else clear.pair(0)
    images = [
        shot(robot, free.q, view, (460, 480), grasp, about, hit),
        shot(robot, kept.q, view, (460, 480), grasp, about),
    ]
    titles = ["without the scene: the arm is in the post", "with the scene: it goes around"]
    save_picture(panels(images, titles, (9.2, 5.3)), path)


def pairs(path: Path) -> None:
    """Eight arm-hands at home."""
    images, titles = [], []
    for name, title in PAIRS:
        robot = ik.load_robot(name)
        tip = robot.contacts(robot.home)[0].mean(axis=0)
        view = (float(np.arctan2(tip[1], tip[0]) - np.deg2rad(62.0)), float(np.deg2rad(16.0)))
        images.append(shot(robot, robot.home, view, (170, 230)))
        titles.append(title)
    save_picture(panels(images, titles, (13.6, 2.55)), path)


def unreachable(path: Path) -> None:
    """A grasp that no posture meets: how far the wrist can be, the nearest posture, the reason."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    pose = grasp.known_pose
    assert pose is not None
    away = pose.copy()
    away[:3, 3] += [-0.35, 0.05, 0.05]
    far = grasp.in_object_frame().at(away)
    solution = ik.Solver(robot).solve(far)
    assert solution.diagnosis is not None
    q, lines = solution.diagnosis.q, solution.diagnosis.lines
    print("unreachable", solution.status.name, lines)
    links = robot.links(q)
    shoulder, elbow, wrist = (links[f"lwr_link_{i}"][:3, 3] for i in (2, 4, 6))
    reach = float(np.linalg.norm(elbow - shoulder) + np.linalg.norm(wrist - elbow))
    body = bodies_at(robot, q)
    thing = object_drawable(far.object)
    assert thing is not None
    things = [thing.transformed(away)]
    marks = [one for c in far.contacts.values() for one in target_marks(c, c.point)]
    view, pixels = overview(away[:3, 3], close_view(robot, q)), (1000, 520)
    shell = [Drawable("reach", ball(reach, shoulder), palette.MISSED)]
    with closing(Scene3D()) as stage:
        stage.add("robot", body)
        stage.add("object", things, 0.6)
        stage.add("marks", marks)
        stage.add("reach", shell, 0.10)
        stage.add_floor(0.0, body + things)
        stage.aim(view, corner_points(body + things), pixels, (0.12, 0.06))
        image = np.clip(composite(1.0, stage.render()), 0.0, 1.0)
        ends = stage.project(np.array([wrist, away[:3, 3]]))
    figure = new_figure(10.0, 6.4, dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 0.82))
    axes.set_axis_off()
    axes.imshow(image)
    note = {"xycoords": "data", "textcoords": "offset points", "size": 10, "color": palette.INK}
    line = {"arrowstyle": "-", "color": palette.FAINT, "lw": 0.8}
    axes.annotate("as far as the wrist gets", ends[0], (-40, -70), arrowprops=line, **note)
    axes.annotate("where the cup is", ends[1], (-30, 60), arrowprops=line, **note)
    figure.text(
        0.02, 0.955, "UNREACHABLE", size=16, weight="bold", color=palette.MISSED, va="center"
    )
    for i, text in enumerate(lines[:3]):
        figure.text(0.02, 0.905 - 0.038 * i, text, size=10, color=palette.INK, va="center")
    save_picture(figure, path)


def humanoid(path: Path) -> None:
    """A G1 that holds a box, wherever both hands reach it; contacts as in notebook 10."""
    robot, size = ik.load_robot("g1+dex3"), np.array([0.07, 0.40, 0.04])
    contacts: dict[str, ik.Contact] = {}
    for side, y in (("left", 1), ("right", -1)):
        contacts[f"{side}_thumb"] = ik.Contact([0, 0.14 * y, size[2] / 2], [0, 0, -1])
        contacts[f"{side}_middle"] = ik.Contact([0, 0.16 * y, -size[2] / 2], [0, 0, 1])
        contacts[f"{side}_index"] = ik.Contact([0, 0.12 * y, -size[2] / 2], [0, 0, 1])
    about = ik.Scene({"box": {"kind": "box", "size": size.tolist()}})
    free = ik.Free((0.28, -0.02, 0.08, 0, 0, 0), (0.42, 0.02, 0.25, 0, 0, 0))
    solver = ik.Solver(robot, scene=about)
    held = solver.solve(ik.Grasp(contacts, object="box", object_pose=free))
    pose = held.object_pose
    assert held.success
    assert pose is not None
    grasp = ik.Grasp(contacts, object="box", object_pose=np.eye(4)).at(pose)
    views = [(float(np.deg2rad(angle)), float(np.deg2rad(14.0))) for angle in (38.0, -52.0)]
    there = about.moved("box", pose)
    images = [shot(robot, held.q, view, (460, 560), grasp, there) for view in views]
    save_picture(panels(images, ["from the left", "from the right"], (9.2, 5.6)), path)


def main(arguments: list[str] | None = None) -> None:
    """Draw what is asked for."""
    every = {"scene": scene, "pairs": pairs, "unreachable": unreachable, "humanoid": humanoid}
    parser = argparse.ArgumentParser(description="Pictures of the documentation.")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    parser.add_argument("--only", nargs="*", default=tuple(every), choices=every, help="which")
    options = parser.parse_args(arguments)
    for name in options.only:
        file = options.out / f"{name}.png"
        every[name](file)
        print(file, file.stat().st_size)


if __name__ == "__main__":
    main()
