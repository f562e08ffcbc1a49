"""The animation at the top of the README: a grasped object is dragged, arm and hand follow.

Two files, for light and for dark pages::

    python tools/hero.py --out docs

Every picture is a solve of its own: the grasp where the object is, from where the robot stands.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

import casadi_ik as ik
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    bodies_at,
    close_view,
    object_drawable,
    overview,
    target_marks,
)
from casadi_ik.app.pictures.charts import save_picture
from casadi_ik.app.pictures.pictures import encode_gif
from casadi_ik.app.pictures.scene3d import Image, Scene3D, composite, corner_points
from casadi_ik.files.arrays import Array

ROBOT, GRASP = "kuka_lwr_barrett", "cup"

WHOLE, CLOSE, BESIDE = (470, 400), (290, 290), 55
"""Of the robot and of the hand from close by [pixels]; how far the second is below the top."""

PICTURES, SECONDS = 68, 6.3
"""Of a round."""

SWAY = np.array([0.09, -0.15, 0.12])
"""How far the object goes to either side of where the grasp has it [m]."""

TURN = 0.3
"""By how much it turns about the vertical to either side [rad]."""


def path(grasp: ik.Grasp) -> list[ik.Grasp]:
    """The grasp along a way of its object, slow at both ends."""
    alone, start = grasp.in_object_frame(), grasp.known_pose
    assert start is not None
    found = []
    for angle in -0.8 * np.pi * np.cos(np.linspace(0.0, np.pi, PICTURES // 2 + 1)):
        pose = start.copy()
        c, s = np.cos(TURN * np.sin(angle)), np.sin(TURN * np.sin(angle))
        pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ start[:3, :3]
        way = [np.sin(2 * angle), np.sin(angle), 0.5 - 0.5 * np.cos(angle)]
        pose[:3, 3] += SWAY * way
        found.append(alone.at(pose))
    return found


def pictures(
    robot: ik.ArmHand, grasps: list[ik.Grasp], every_q: Array
) -> tuple[list[Image], list[Image]]:
    """Images (h, w, 3) for light and for dark pages."""
    thing = object_drawable(GRASP)
    assert thing is not None
    bodied = [bodies_at(robot, q) for q in every_q]
    about = corner_points([one for body in bodied[::3] for one in body])
    places = np.array([one.known_pose[:3, 3] for one in grasps if one.known_pose is not None])
    close = close_view(robot, every_q[0])
    whole = overview(places.mean(axis=0), close)
    near = 0.135 * np.vstack([np.eye(3), -np.eye(3)])
    found: tuple[list[Image], list[Image]] = ([], [])
    with closing(Scene3D()) as stage:
        for grasp, body, place in zip(grasps, bodied, places, strict=True):
            pose = grasp.known_pose
            assert pose is not None
            far = [np.linalg.norm(one.surface.points - place, axis=1).min() > 0.3 for one in body]
            stage.replace("robot", [one for one, off in zip(body, far, strict=True) if not off])
            stage.replace("far", [one for one, off in zip(body, far, strict=True) if off])
            stage.replace("object", [thing.transformed(pose)], 0.6)
            marks = [
                one
                for contact in grasp.contacts.values()
                for one in target_marks(contact, contact.point, 1.2)
            ]
            stage.replace("marks", marks)
            stage.aim(whole, about, WHOLE, (0.02, 0.04))
            layers, tip = _layers(stage, "far"), stage.project(place[None])[0]
            floors = []
            for dark in (False, True):
                stage.add_floor(0.0, [*body, thing.transformed(pose)], about, dark, texels=512)
                stage.aim(whole, about, WHOLE, (0.02, 0.04))
                floors.append(stage.render("floor"))
            stage.aim(close, near + place, CLOSE)
            inset, second = _layers(stage), stage.project(place[None])[0]
            for images, floor, color in zip(found, floors, PAPERS, strict=True):
                paper = np.array(palette.rgb(color), np.float32) / 255
                left = pointed(_composed(composite(paper, floor), layers), tip)
                right = pointed(_composed(paper, inset), second)
                image = np.empty((WHOLE[1], WHOLE[0] + CLOSE[0], 3), np.float32)
                image[:] = paper
                image[:, : WHOLE[0]] = left
                image[BESIDE : BESIDE + CLOSE[1], WHOLE[0] :] = _rounded(right, paper)
                images.append(image)
    return found


PAPERS = ("#ffffff", palette.DARK_PAPER)


def _layers(stage: Scene3D, *more: str) -> tuple[Image, Image]:
    return stage.render("robot", "object", "marks", *more), stage.render("marks")


def _composed(below: Image, layers: tuple[Image, Image]) -> Image:
    """Marks that something hides are half seen."""
    return composite(composite(below, layers[0]), layers[1], 0.5)


def _rounded(image: Image, paper: Array) -> Image:
    """An image in a circle with a thin rim."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    far = np.hypot(x - (width - 1) / 2, y - (height - 1) / 2) - 0.485 * width
    rim = np.array(palette.rgb(palette.FAINT), np.float32) / 255
    inside = np.clip(0.5 - far, 0, 1)[..., None].astype(np.float32)
    on_rim = np.clip(1.5 - np.abs(far), 0, 1)[..., None].astype(np.float32)
    return on_rim * rim + (1 - on_rim) * (inside * image + (1 - inside) * paper)


def pointed(image: Image, place: Array) -> Image:
    """An image with a mouse pointer whose tip is at a place (2,) [pixels]."""
    outline = np.array([[0, 0], [0, 17], [4, 13], [7, 20], [10, 19], [7, 12], [12.5, 12]])
    drawn = Pillow.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
    large = drawn.resize((4 * drawn.width, 4 * drawn.height))
    shape = [tuple(4 * (place + 1.3 * corner)) for corner in outline]
    ImageDraw.Draw(large).polygon(shape, fill="#ffffff", outline="#20262d", width=5)
    return np.asarray(large.resize(drawn.size), np.float32) / 255


def main(arguments: list[str] | None = None) -> None:
    """Solve, draw, write."""
    parser = argparse.ArgumentParser(description="The animation of the README.")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    options = parser.parse_args(arguments)
    robot = ik.load_robot(ROBOT)
    solver, grasps = ik.Solver(robot), path(ik.load_grasp(GRASP))
    q, found = robot.home, []
    for grasp in grasps:
        solution = solver.solve(grasp, q0=q)
        if not solution.success:
            raise SystemExit(f"{GRASP}: {solution.status.name}")
        q = solution.q
        found.append(q)
    step = np.rad2deg(np.abs(np.diff(found, axis=0)).max())
    print(f"{len(grasps)} solves, the largest step {step:.0f} deg")
    # And the same way back.
    every_q = np.array(found + found[-2:0:-1])
    grasps += grasps[-2:0:-1]
    for name, images in zip(("light", "dark"), pictures(robot, grasps, every_q), strict=True):
        file = options.out / f"hero_{name}.gif"
        pause = round(1e3 * SECONDS / PICTURES / 10) * 10
        save_picture(encode_gif(images, [pause] * PICTURES, 128), file)
        print(file, file.stat().st_size)


if __name__ == "__main__":
    main()
