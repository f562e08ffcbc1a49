"""Draw the animation of the README: an object is dragged, and arm and hand follow.

    python tools/hero.py --out docs

writes a file for light and one for dark pages. Every frame is a solve that starts from the
configuration of the previous frame.
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

FULL_SIZE, INSET_SIZE, INSET_TOP = (470, 400), (290, 290), 55
"""Sizes of the view of the robot and of the close-up, and top of the latter [pixels]."""

FRAME_COUNT, SECONDS = 68, 6.3
"""Number of frames, and duration [s]."""

SWAY = np.array([0.09, -0.15, 0.12])
"""Amplitude of the translation of the object [m]."""

TURN = 0.3
"""Amplitude of the rotation of the object about the vertical [rad]."""


def path(grasp: ik.Grasp) -> list[ik.Grasp]:
    """Return the grasp along a path of its object, slow at both ends."""
    in_frame, start = grasp.in_object_frame(), grasp.known_pose
    assert start is not None
    grasps = []
    for angle in -0.8 * np.pi * np.cos(np.linspace(0.0, np.pi, FRAME_COUNT // 2 + 1)):
        pose = start.copy()
        c, s = np.cos(TURN * np.sin(angle)), np.sin(TURN * np.sin(angle))
        pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ start[:3, :3]
        offset = [np.sin(2 * angle), np.sin(angle), 0.5 - 0.5 * np.cos(angle)]
        pose[:3, 3] += SWAY * offset
        grasps.append(in_frame.at(pose))
    return grasps


def pictures(
    robot: ik.ArmHand, grasps: list[ik.Grasp], configurations: Array
) -> tuple[list[Image], list[Image]]:
    """Return images (h, w, 3) for light and for dark pages."""
    cup = object_drawable(GRASP)
    assert cup is not None
    robots = [bodies_at(robot, q) for q in configurations]
    workspace = corner_points([drawable for body in robots[::3] for drawable in body])
    positions = np.array(
        [drawable.known_pose[:3, 3] for drawable in grasps if drawable.known_pose is not None]
    )
    close_up = close_view(robot, configurations[0])
    far_view = overview(positions.mean(axis=0), close_up)
    inset_points = 0.135 * np.vstack([np.eye(3), -np.eye(3)])
    frames: tuple[list[Image], list[Image]] = ([], [])
    with closing(Scene3D()) as stage:
        for grasp, body, position in zip(grasps, robots, positions, strict=True):
            pose = grasp.known_pose
            assert pose is not None
            is_far = [
                np.linalg.norm(drawable.surface.points - position, axis=1).min() > 0.3
                for drawable in body
            ]
            stage.replace(
                "robot", [drawable for drawable, off in zip(body, is_far, strict=True) if not off]
            )
            stage.replace(
                "far", [drawable for drawable, off in zip(body, is_far, strict=True) if off]
            )
            stage.replace("object", [cup.transformed(pose)], 0.6)
            marks = [
                drawable
                for contact in grasp.contacts.values()
                for drawable in target_marks(contact, contact.point, 1.2)
            ]
            stage.replace("marks", marks)
            stage.aim(far_view, workspace, FULL_SIZE, (0.02, 0.04))
            layers, tip = _layers(stage, "far"), stage.project(position[None])[0]
            floors = []
            for dark in (False, True):
                stage.add_floor(0.0, [*body, cup.transformed(pose)], workspace, dark, texels=512)
                stage.aim(far_view, workspace, FULL_SIZE, (0.02, 0.04))
                floors.append(stage.render("floor"))
            stage.aim(close_up, inset_points + position, INSET_SIZE)
            inset, second = _layers(stage), stage.project(position[None])[0]
            for images, floor, color in zip(frames, floors, PAPERS, strict=True):
                paper = np.array(palette.rgb(color), np.float32) / 255
                left = pointed(_composed(composite(paper, floor), layers), tip)
                right = pointed(_composed(paper, inset), second)
                image = np.empty((FULL_SIZE[1], FULL_SIZE[0] + INSET_SIZE[0], 3), np.float32)
                image[:] = paper
                image[:, : FULL_SIZE[0]] = left
                image[INSET_TOP : INSET_TOP + INSET_SIZE[1], FULL_SIZE[0] :] = _rounded(
                    right, paper
                )
                images.append(image)
    return frames


PAPERS = ("#ffffff", palette.DARK_PAPER)


def _layers(stage: Scene3D, *groups: str) -> tuple[Image, Image]:
    return stage.render("robot", "object", "marks", *groups), stage.render("marks")


def _composed(below: Image, layers: tuple[Image, Image]) -> Image:
    """Return an image with semi-transparent marks where other things hide them."""
    return composite(composite(below, layers[0]), layers[1], 0.5)


def _rounded(image: Image, paper: Array) -> Image:
    """Crop an image to a circle with a thin rim."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    distance = np.hypot(x - (width - 1) / 2, y - (height - 1) / 2) - 0.485 * width
    rim = np.array(palette.rgb(palette.FAINT), np.float32) / 255
    disc = np.clip(0.5 - distance, 0, 1)[..., None].astype(np.float32)
    on_rim = np.clip(1.5 - np.abs(distance), 0, 1)[..., None].astype(np.float32)
    return on_rim * rim + (1 - on_rim) * (disc * image + (1 - disc) * paper)


def pointed(image: Image, position: Array) -> Image:
    """Draw a mouse pointer with its tip at a position (2,) [pixels]."""
    outline = np.array([[0, 0], [0, 17], [4, 13], [7, 20], [10, 19], [7, 12], [12.5, 12]])
    canvas = Pillow.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
    large = canvas.resize((4 * canvas.width, 4 * canvas.height))
    shape = [tuple(4 * (position + 1.3 * corner)) for corner in outline]
    ImageDraw.Draw(large).polygon(shape, fill="#ffffff", outline="#20262d", width=5)
    return np.asarray(large.resize(canvas.size), np.float32) / 255


def main(arguments: list[str] | None = None) -> None:
    """Solve, draw and write both animations."""
    parser = argparse.ArgumentParser(description="The animation of the README.")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    options = parser.parse_args(arguments)
    robot = ik.load_robot(ROBOT)
    solver, grasps = ik.Solver(robot), path(ik.load_grasp(GRASP))
    q, solutions = robot.home, []
    for grasp in grasps:
        solution = solver.solve(grasp, q0=q)
        if not solution.success:
            raise SystemExit(f"{GRASP}: {solution.status.name}")
        q = solution.q
        solutions.append(q)
    step = np.rad2deg(np.abs(np.diff(solutions, axis=0)).max())
    print(f"{len(grasps)} solves, the largest step {step:.0f} deg")
    # The second half is the reversed path.
    configurations = np.array(solutions + solutions[-2:0:-1])
    grasps += grasps[-2:0:-1]
    for name, images in zip(
        ("light", "dark"), pictures(robot, grasps, configurations), strict=True
    ):
        file = options.out / f"hero_{name}.gif"
        pause = round(1e3 * SECONDS / FRAME_COUNT / 10) * 10
        save_picture(encode_gif(images, [pause] * FRAME_COUNT, 128), file)
        print(file, file.stat().st_size)


if __name__ == "__main__":
    main()
