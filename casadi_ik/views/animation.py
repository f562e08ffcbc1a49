"""A motion to a grasp in moving pictures: the whole robot, and the hand from close by."""

from __future__ import annotations

import io
from contextlib import closing
from os import PathLike
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import PictureError
from casadi_ik.files.writing import written_whole
from casadi_ik.grasps import Grasp
from casadi_ik.motion.motion import Motion
from casadi_ik.views.captions import MET_COLOR
from casadi_ik.views.marks import contact_marks
from casadi_ik.views.obstacles import in_scene, scene_solids
from casadi_ik.views.robot_body import robot_body
from casadi_ik.views.scene import OBJECT, SCENE, object_solids
from casadi_ik.views.shapes import Solid
from casadi_ik.views.stage import Image, Stage, over
from casadi_ik.views.viewpoint import close_view, whole_view

WHOLE, CLOSE = (420, 420), (340, 420)
"""Width and height of the two panels [pixels]."""

PER_SECOND = 12
"""Pictures of a second, at most."""

LONGEST = 90
"""Pictures of a motion, at most: a longer one has fewer of a second."""

REST = 1.5
"""How long the last picture stays [s]."""

COLORS = 96
"""Of the palette that all pictures share."""

AROUND = 0.11
"""What is nearer than this to the fingertips at the end is in the close-up [m]."""


def draw_motion(
    motion: Motion,
    grasp: Grasp,
    path: str | PathLike[str],
    scene: Scene | None = None,
) -> int:
    """Draw a motion in real time as a GIF.

    Args:
        motion: The motion.
        grasp: What it leads to; if it names an object that has a description, that is drawn too.
        path: The file; it is there when it is complete.
        scene: What stands about the robot.

    Returns:
        How many pictures there are.

    Raises:
        PictureError: The file cannot be written, or there is no OpenGL to draw with.
        DescriptionError: The description of the object is malformed.
    """
    seconds = float(motion.times[-1])
    count = int(np.clip(np.ceil(PER_SECOND * seconds), 2, LONGEST))
    times = np.linspace(0.0, seconds, count)
    q = np.stack([np.interp(times, motion.times, column) for column in motion.q.T], axis=1)
    shot = _shot(motion, q, grasp, scene)
    last = round(1e3 * REST)
    step = max(round(1e3 * seconds / (count - 1)), 20)
    try:
        with written_whole(Path(path)) as part:
            part.write_bytes(_gif(shot, [*[step] * (count - 1), last]))
    except OSError as error:
        reason = error.strerror or str(error)
        raise PictureError(f"{path}: cannot write the picture: {reason}") from error
    return count


def _shot(motion: Motion, q: Array, grasp: Grasp, scene: Scene | None) -> list[Image]:
    """Images (h, w, 3) of postures (k, n)."""
    robot, end = motion.robot, q[-1]
    placed = [solid for row in q[:: max(len(q) // 8, 1)] for part in _body(motion, row)
              for solid in part]  # fmt: skip
    there = object_solids(grasp)
    tips = robot.contacts(end)[0]
    near = tips.mean(axis=0) + AROUND * np.vstack([np.eye(3), -np.eye(3)])
    marks = contact_marks(robot, end, grasp, dict.fromkeys(robot.fingers, MET_COLOR))
    found = []
    with closing(Stage()) as stage:
        foot = robot.links(q[0])[robot.description.root]
        stage.add_floor(float(foot[2, 3]), placed[:1] + there)
        stage.add("object", there, OBJECT)
        stage.add("marks", marks)
        if scene is not None:
            about = in_scene(scene, grasp)
            stage.add("scene", scene_solids(about, foot[:3, 3], grasp.object), SCENE)
        view = close_view(robot, end)
        far = whole_view(tips.mean(axis=0), view)
        for row in q:
            arm, hand = _body(motion, row)
            stage.replace("arm", arm)
            stage.replace("hand", hand)
            panels = []
            for seen, points, pixels in (
                (far, _points(placed + there), WHOLE),
                (view, np.vstack([near, _points(there or marks)]), CLOSE),
            ):
                stage.aim(seen, points, pixels, (0.04, 0.04))
                panels.append(np.clip(over(1.0, stage.shoot()), 0.0, 1.0))
            found.append(np.concatenate(panels, axis=1))
    return found


def _body(motion: Motion, q: Array) -> tuple[list[Solid], list[Solid]]:
    return robot_body(motion.robot, q)


def _points(solids: list[Solid]) -> Array:
    return np.concatenate([mesh.points for mesh, _ in solids])


def _gif(images: list[Image], milliseconds: list[int]) -> bytes:
    """Images as a GIF whose pictures share the palette of first, middle and last."""
    whole = [Pillow.fromarray(np.round(255 * image).astype(np.uint8)) for image in images]
    width, height = whole[0].size
    some = [whole[0], whole[len(whole) // 2], whole[-1]]
    sheet = Pillow.new("RGB", (width, height * len(some)))
    for i, one in enumerate(some):
        sheet.paste(one, (0, i * height))
    palette = sheet.quantize(COLORS)
    frames = [one.quantize(palette=palette, dither=Pillow.Dither.NONE) for one in whole]
    written = io.BytesIO()
    frames[0].save(
        written,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=milliseconds,
        loop=0,
        optimize=False,
        disposal=1,
    )
    return written.getvalue()
