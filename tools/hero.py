"""Draw the animation of the README: a cup is dragged, and arm and hand follow.

    python tools/hero.py --out docs

writes a file for light and one for dark pages. The cup is dragged behind a post, where another
branch of the arm is needed, and then out of reach. Every frame is a solve that starts from the
previous configuration; the caption states its status and its measured time. The robot has visual
meshes if the package `example-robot-data` is installed.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

import casadi_ik as ik
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import (
    bodies_at,
    object_drawable,
    scene_drawables,
    target_marks,
)
from casadi_ik.app.pictures.charts import save_picture
from casadi_ik.app.pictures.pictures import encode_gif
from casadi_ik.app.pictures.scene3d import Image, Scene3D, composite, vertices_of
from casadi_ik.files.arrays import Array

ROBOT, GRASP = "panda+allegro_right", "allegro_cup"

SCENE = ik.Scene(
    {"post": {"kind": "cylinder", "radius": 0.03, "length": 0.9, "xyz": [0.3, 0.05, 0.45]}}
)

FULL_SIZE, CLOSE_UP_SIZE, CAPTION_HEIGHT = (300, 340), (340, 340), 44
"""Sizes of the view of the robot and of the close-up, and height of the caption [pixels]."""

WAYPOINTS = {
    0: (0.55, 0.18),
    3: (0.55, 0.18),
    26: (0.55, -0.25),
    28: (0.55, -0.25),
    35: (1.25, -0.25),
}
"""Position of the cup in x and y [m] by frame; it moves smoothly between these frames."""

HEIGHT = 0.4
"""Height of the cup [m]."""

FRAME_COUNT, PAUSE = 44, 180
"""Number of frames, and duration of each [ms]."""

REPETITIONS = 3
"""Number of solves of a frame, of which the shortest time counts."""

CAPTION_FRAMES = 4
"""Number of frames that share a caption, so that it can be read; it states their median time."""

FULL_VIEW, CLOSE_UP_VIEW = (
    (np.deg2rad(-38.0), np.deg2rad(24.0)),
    (np.deg2rad(-112.0), np.deg2rad(14.0)),
)
"""Azimuth and elevation of both views [rad]."""


def path(grasp: ik.Grasp) -> list[ik.Grasp]:
    """Return the grasp with its object along the waypoints, slow at each of them."""
    in_frame, start = grasp.in_object_frame(), grasp.known_pose
    assert start is not None
    # Impossibility is proved for contacts with a point and a pad normal only.
    contacts = {
        finger: ik.Contact(contact.point, contact.normal)
        for finger, contact in in_frame.contacts.items()
    }
    in_frame = replace(in_frame, contacts=contacts)
    frames, positions = list(WAYPOINTS), np.array(list(WAYPOINTS.values()))
    grasps = []
    for frame in range(FRAME_COUNT):
        i = min(int(np.searchsorted(frames, frame, side="right")), len(frames) - 1)
        share = np.clip((frame - frames[i - 1]) / (frames[i] - frames[i - 1]), 0.0, 1.0)
        share = (1 - np.cos(np.pi * share)) / 2
        pose = start.copy()
        pose[:2, 3] = (1 - share) * positions[i - 1] + share * positions[i]
        pose[2, 3] = HEIGHT
        grasps.append(in_frame.at(pose))
    return grasps


def solve(robot: ik.ArmHand, grasps: list[ik.Grasp]) -> list[tuple[Array, ik.Status, float]]:
    """Return configuration, status and time [s] of each grasp, solved one after the other.

    The robot stays at the last solution while a target is not solved.
    """
    solver, q, frames = ik.Solver(robot, scene=SCENE), robot.home, []
    for grasp in grasps:
        solutions = [solver.solve(grasp, q0=q) for _ in range(REPETITIONS)]
        if solutions[0].success:
            q = solutions[0].q
        seconds = min(solution.time for solution in solutions)
        frames.append((q, solutions[0].status, seconds))
        print(f"{grasp.name} {solutions[0].status.name} {1e3 * seconds:.3f} ms")
    return frames


def captions(frames: list[tuple[Array, ik.Status, float]]) -> list[tuple[str, str]]:
    """Return text and colour of the caption of each frame."""
    texts: list[tuple[str, str]] = []
    for first in range(0, len(frames), CAPTION_FRAMES):
        group = frames[first : first + CAPTION_FRAMES]
        for _, status, _ in group:
            times = [seconds for _, group_status, seconds in group if group_status == status]
            micros = 1e6 * float(np.median(times))
            time = f"{micros:.0f} µs" if micros < 1000 else f"{1e-3 * micros:.1f} ms"
            proof = ", proved" if status == ik.Status.UNREACHABLE else ""
            color = palette.MET if status == ik.Status.SOLVED else palette.MISSED
            texts.append((f"{time} · {status.name}{proof}", color))
    return texts


def pictures(
    robot: ik.ArmHand, grasps: list[ik.Grasp], frames: list[tuple[Array, ik.Status, float]]
) -> tuple[list[Image], list[Image]]:
    """Return images (h, w, 3) for light and for dark pages."""
    cup, post = object_drawable("cup"), scene_drawables(SCENE)
    assert cup is not None
    robots = [bodies_at(robot, q) for q, _, _ in frames]
    swept = [drawable for body in robots[::4] for drawable in body]
    workspace = vertices_of([*swept, *post])
    close_up = 0.20 * np.vstack([np.eye(3), -np.eye(3)])
    images: tuple[list[Image], list[Image]] = ([], [])
    with closing(Scene3D()) as stage:
        stage.add("post", post)
        for grasp, body, caption in zip(grasps, robots, captions(frames), strict=True):
            pose = grasp.known_pose
            assert pose is not None
            placed = cup.transformed(pose)
            stage.replace("robot", body)
            stage.replace("object", [placed], 0.6)
            contacts = grasp.contacts.values()
            stage.replace(
                "marks",
                [mark for contact in contacts for mark in target_marks(contact, contact.point)],
            )
            position = pose[:3, 3]
            stage.aim(CLOSE_UP_VIEW, close_up + position, CLOSE_UP_SIZE)
            close_layers, close_tip = _layers(stage), stage.project(position[None])[0]
            stage.aim(FULL_VIEW, workspace, FULL_SIZE, (0.02, 0.04))
            full, tip = _layers(stage), stage.project(position[None])[0]
            for dark in (False, True):
                paper = np.array(palette.rgb(PAPERS[dark]), np.float32) / 255
                stage.add_floor(0.0, [*body, *post, placed], workspace, dark, texels=512)
                floor = composite(paper, stage.render("floor"))
                left = pointed(_composed(floor, full), tip)
                right = pointed(_composed(paper, close_layers), close_tip)
                views = np.concatenate([left, right], axis=1)
                images[dark].append(captioned(views, paper, *caption))
    return images


PAPERS = ("#ffffff", "#0d1117")
"""Backgrounds: those of light and dark pages of GitHub, so that no edge is visible."""


def _layers(stage: Scene3D) -> tuple[Image, Image]:
    return stage.render("robot", "post", "object", "marks"), stage.render("marks")


def _composed(below: Image, layers: tuple[Image, Image]) -> Image:
    """Return an image with semi-transparent marks where other things hide them."""
    return composite(composite(below, layers[0]), layers[1], 0.5)


def pointed(image: Image, position: Array) -> Image:
    """Draw a mouse pointer with its tip at a position (2,) [pixels]."""
    outline = np.array([[0, 0], [0, 17], [4, 13], [7, 20], [10, 19], [7, 12], [12.5, 12]])
    canvas = Pillow.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
    large = canvas.resize((4 * canvas.width, 4 * canvas.height))
    shape = [tuple(4 * (position + 1.3 * corner)) for corner in outline]
    ImageDraw.Draw(large).polygon(shape, fill="#ffffff", outline="#20262d", width=5)
    return np.asarray(large.resize(canvas.size), np.float32) / 255


def captioned(image: Image, paper: Array, text: str, color: str) -> Image:
    """Add a caption below an image."""
    strip = np.empty((CAPTION_HEIGHT, image.shape[1], 3), np.float32)
    strip[:] = paper
    canvas = Pillow.fromarray(
        np.round(255 * np.clip(np.vstack([image, strip]), 0, 1)).astype(np.uint8)
    )
    font_file = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans-Bold.ttf"
    font = ImageFont.truetype(str(font_file), 24)
    middle = (image.shape[1] / 2, image.shape[0] + 0.45 * CAPTION_HEIGHT)
    ImageDraw.Draw(canvas).text(middle, text, fill=color, font=font, anchor="mm")
    return np.asarray(canvas, np.float32) / 255


def main(arguments: list[str] | None = None) -> None:
    """Solve, draw and write both animations."""
    parser = argparse.ArgumentParser(description="The animation of the README.")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    options = parser.parse_args(arguments)
    robot = ik.load_robot(ROBOT)
    grasps = path(ik.load_grasp(GRASP))
    frames = solve(robot, grasps)
    for name, images in zip(("light", "dark"), pictures(robot, grasps, frames), strict=True):
        file = options.out / f"hero_{name}.gif"
        save_picture(encode_gif(images, [PAUSE] * FRAME_COUNT, 128), file)
        print(file, file.stat().st_size)


if __name__ == "__main__":
    main()
