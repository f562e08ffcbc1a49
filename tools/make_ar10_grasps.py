"""Compute the built-in grasps of the AR10 hand: fingertip pinches, held by Baxter's right arm.

Run it again whenever an object, the hand or the recipes change::

    python tools/make_ar10_grasps.py               # all into models/grasps
    python tools/make_ar10_grasps.py --only cup

A pad is a point with a normal, and the fingers do not spread: index and middle finger can only
press on the same cylinder, and never exactly on the same ball. So cylinders are pinched by thumb,
index and middle finger, balls by thumb and index. The pinch is taken that needs least friction
among those that keep the axes of phalanges clear of the object and in which the robot's shapes
touch nothing but what they hold, with the table there as well.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from grasp_synthesis.clearing import MARGIN, cleared, surroundings
from grasp_synthesis.fingertip_pinch import TipPinch, TipPinchProblem
from grasp_synthesis.holding import Scene, hold
from grasp_synthesis.writing import grasp_text, made_by, placed_at

import casadi_ik as ik
from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.files.arrays import Array
from casadi_ik.files.shipped import models_folder
from casadi_ik.model.objects import GraspObject, load_object

ROBOT, ROOT = "baxter_ar10", "hand_base"
ALL, TWO = {"thumb": 1, "index": -1, "middle": -1}, {"thumb": 1, "index": -1}
PHALANX_GAP = 0.005  # [m] from a phalanx's axis to the object, but for the last, which touches
PALM_GAP = 0.010  # [m] from the plane of the knuckles, y = 7.2 mm in the hand's root frame
KNUCKLES = 0.0072  # [m]
EDGE = 0.005  # [m] smallest distance of a contact from an edge
POSITION_BOUNDS = np.array([-0.15, 0.02, 0.03]), np.array([0.10, 0.15, 0.25])
"""Corners of the object positions in the root frame of the hand [m]."""

# The object's y axis, where the thumb presses, lies between the hand's y and -z; its z along -x,
# so that the little finger is below when the object stands.
_TILT = np.deg2rad(63.0)
AXES = (
    (0.0, np.sin(_TILT), np.cos(_TILT)),
    (0.0, np.cos(_TILT), -np.sin(_TILT)),
    (-1.0, 0.0, 0.0),
)

# Torso frame: x forward, y left, z up. Assumption: a table at z = 0.
LOW, HIGH = np.array([0.55, -0.55, 0.15]), np.array([0.85, -0.10, 0.40])
ABOVE = 0.10
PLACES = 4
"""Maximum number of placements of a pinch until one is collision-free."""


@dataclass(frozen=True)
class Recipe:
    """Object of a pinch and its orientation.

    Attributes:
        name: The object.
        sides: By touching finger the side of the object.
        up: Object axis that points up in the scene; None for balls.
    """

    name: str
    sides: dict[str, int]
    up: tuple[float, float, float] | None = None


RECIPES = (
    Recipe("cup", ALL, (0.0, 0.0, 1.0)),
    Recipe("mug", ALL, (0.0, 0.0, 1.0)),
    Recipe("tomato_soup_can", ALL, (0.0, 0.0, 1.0)),
    Recipe("golf_ball", TWO),
    Recipe("orange", TWO),
    Recipe("tennis_ball", TWO),
)


def main(arguments: list[str] | None = None) -> int:
    """Write the grasps; return 0 if all were found."""
    parser = argparse.ArgumentParser(description="Compute the shipped grasps of the AR10.")
    parser.add_argument("--only", choices=[r.name for r in RECIPES], help="one object")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--starts", type=int, default=20, help="random starts per pinch")
    parser.add_argument("--out", type=Path, default=models_folder() / "grasps")
    options = parser.parse_args(arguments)
    robot, missing = ik.load_robot(ROBOT), 0
    for index, recipe in enumerate(RECIPES):
        if options.only not in (None, recipe.name):
            continue
        rng = np.random.default_rng([options.seed, index])
        text = make(robot, recipe, rng, options.starts, options.seed)
        if text is None:
            print(f"{recipe.name}: no grasp found")
            missing += 1
        else:
            (options.out / f"ar10_{recipe.name}.yaml").write_text(text, encoding="utf-8")
    return min(missing, 1)


def make(
    robot: ik.ArmHand, recipe: Recipe, rng: np.random.Generator, starts: int, seed: int
) -> str | None:
    """Return the text of a grasp file; None if no grasp was found."""
    item, description = load_object(recipe.name), robot.description
    scene = Scene(LOW, HIGH, recipe.up, ABOVE)
    self_check = SceneCheck(robot, ik.Scene(margin=MARGIN))
    table = SceneCheck(robot, ik.load_scene("table"))
    problem = TipPinchProblem(
        description, ROOT, item, recipe.sides, AXES, 0, EDGE, idle(robot), POSITION_BOUNDS
    )
    for candidate in problem.solve(rng, starts):
        palm, fingers = gaps(robot, item, recipe.sides, candidate)
        if candidate.residual > 1e-9 or palm < PALM_GAP or fingers < PHALANX_GAP:
            continue
        pinch = cleared(self_check, recipe.name, recipe.sides, candidate, rng)
        if pinch is None:
            continue
        for _ in range(PLACES):
            q = hold(description, ROOT, pinch, scene, rng)
            if q is None:
                continue
            if surroundings(table, recipe.name, recipe.sides, pinch, q).free(q[None])[0]:
                print(
                    f"{recipe.name}: friction {pinch.friction:.3f}, gaps [mm] palm "
                    f"{1e3 * palm:.1f}, phalanges {1e3 * fingers:.1f}"
                )
                return text_of(robot, recipe, pinch, q, (palm, fingers), seed)
    return None


def idle(robot: ik.ArmHand) -> Array:
    """Return (n,) the arm at zero and the hand at home, where unconstrained fingers stay."""
    q = robot.home.copy()
    q[list(robot.description.arm_actuators)] = 0.0
    return q


def gaps(
    robot: ik.ArmHand, item: GraspObject, touching: dict[str, int], pinch: TipPinch
) -> tuple[float, float]:
    """Return the smallest gaps [m]: object to plane of knuckles, axes of phalanges to object.

    The last phalanx of a finger that touches is tangent to the object and left out; the object is
    round, so nothing else of it can be inside.
    """
    links = robot.links(pinch.q)
    hand = np.linalg.inv(links[ROOT])
    pose = pinch.object_in_hand
    children = {joint.name: joint.child for joint in robot.description.movable}
    points, _ = robot.contacts(pinch.q)
    samples = []
    for finger, tip in zip(robot.description.fingers, points, strict=True):
        line = [links[children[name]][:3, 3] for name in finger.joints]
        if finger.name not in touching:
            line.append(tip)
        for a, b in pairwise(line):
            samples.append(a + np.linspace(0, 1, 41)[:, None] * (b - a))
    points_in_object = np.concatenate(samples) @ hand[:3, :3].T + hand[:3, 3]
    distances = item.signed_distance((points_in_object - pose[:3, 3]) @ pose[:3, :3])
    vertices = item.mesh(96)[0] @ pose[:3, :3].T + pose[:3, 3]
    return float(vertices[:, 1].min() - KNUCKLES), float(distances.min())


def text_of(
    robot: ik.ArmHand,
    recipe: Recipe,
    pinch: TipPinch,
    q: Array,
    clear: tuple[float, float],
    seed: int,
) -> str:
    """Return the text of the file."""
    pose_text = "held upright" if recipe.up else "held"
    scene = f"{pose_text} in front of Baxter's right side"
    palm, fingers = (1e3 * gap for gap in clear)
    header = [
        made_by("make_ar10_grasps.py", seed, recipe.name, ROBOT),
        f"Pinched: by {', '.join(recipe.sides)}, the other fingers are free.",
        f"Scene: {scene}; base frame is the torso's. Assumption: a table at z = 0.",
        placed_at(q[list(robot.description.arm_actuators)]),
        f"Friction coefficient needed for the squeeze: {pinch.friction:.3f}. Gaps: object to the "
        f"plane of the knuckles {palm:.1f} mm, axes of the phalanges to the object "
        f"{fingers:.1f} mm.",
    ]
    posture = [
        f"  {name}: {value:.12f}  # {1e3 * value:.3f} mm"
        for name, value in zip(robot.actuators, q, strict=True)
        if robot.description.actuators[robot.actuators.index(name)].part == "hand"
    ]
    points, normals = robot.contacts(q)
    rows = [robot.fingers.index(finger) for finger in recipe.sides]
    contacts = {robot.fingers[i]: {"point": points[i], "normal": normals[i]} for i in rows}
    pose = robot.links(q)[ROOT] @ pinch.object_in_hand
    return grasp_text(header, ROBOT, recipe.name, scene, pose, posture, contacts)


if __name__ == "__main__":
    sys.exit(main())
