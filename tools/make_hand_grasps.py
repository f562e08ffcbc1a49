"""Compute the shipped grasps of catalogue hands: fingertip pinches, held out by a Panda.

Run it again whenever an object, a hand or the recipes change::

    python tools/make_hand_grasps.py                                  # all into models/grasps
    python tools/make_hand_grasps.py --only allegro_cup

The thumb presses against the two fingers after it. Where the object may be in the hand follows from
the pads of the hand half closed: amid them, its y axis (that the thumb presses along) from the
fingers to the thumb, its z axis along the row of fingers. A gripper's one finger is no row: there
z is across finger and palm, and the gripper opens by the object's width. The pinch is taken that
needs least friction among those that keep the axes of phalanges clear of the object and in which
the robot's shapes touch nothing but what they hold, with the table there as well.
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
from grasp_synthesis.jaw_pinch import jaw_pinches
from grasp_synthesis.writing import grasp_text, made_by, placed_at

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.files.shipped import models_folder
from casadi_ik.grasps import Box, EllipticCylinder, GraspObject, load_object
from casadi_ik.problem.clearance import SceneCheck

ARM = "panda"
HANDS = {
    "allegro": ("allegro_right", ("thumb", "index", "middle"), 0.030),
    "leap": ("leap", ("thumb", "index", "ring"), 0.060),
    "shadow": ("shadow", ("thumb", "index", "middle"), 0.022),
    "robotiq_3f": ("robotiq_3f", ("thumb", "finger_1", "finger_2"), 0.030),
    "panda_hand": ("panda_hand", ("left", "right"), 0.0),
    "robotiq_2f85": ("robotiq_2f85", ("left", "right"), 0.0),
}
"""By the first word of a file: the hand, the fingers that touch, the thumb first, and how far two
of them on the same side are apart at least [m]. Two neighbours of leap's fingers are too thick to
press side by side on what the thumb reaches: the middle one keeps aside."""

UP = (0.0, 0.0, 1.0)
UPRIGHT = {
    **dict.fromkeys(("tomato_soup_can", "cup", "mug", "mustard_bottle"), UP),
    **dict.fromkeys(("potted_meat_can", "bleach_cleanser", "sugar_box"), UP),
    **dict.fromkeys(("orange", "tennis_ball"), None),
}
"""By object the axis that points up; None for balls."""

ITEMS = {
    "allegro": ("tomato_soup_can", "mug", "cup"),
    "leap": ("tomato_soup_can", "mustard_bottle", "bleach_cleanser"),
    "shadow": ("tomato_soup_can", "cup", "orange"),
    "robotiq_3f": ("mustard_bottle", "potted_meat_can", "bleach_cleanser"),
    "panda_hand": ("mustard_bottle", "tomato_soup_can", "sugar_box"),
    "robotiq_2f85": ("potted_meat_can", "tomato_soup_can", "mustard_bottle", "tennis_ball"),
}
"""What each hand pinches. Four motors touch no ball with three exact pads."""

ROOM = 0.045  # [m] how far the object's middle may be from the middle of the pads
PHALANX_GAP = 0.008  # [m] from a phalanx's axis to the object, but for the last, which touches
EDGE = 0.0045  # [m] smallest distance of a contact from an edge
FRICTION = 0.8  # largest friction coefficient that a squeeze may need

# Base frame of the arm: x forward, y left, z up. Assumption: a table at z = 0.
LOW, HIGH = np.array([0.35, -0.30, 0.25]), np.array([0.60, 0.30, 0.50])
ABOVE = 0.10


@dataclass(frozen=True)
class Recipe:
    """One file.

    Attributes:
        hand: Key of `HANDS`.
        item: Name of the object.
    """

    hand: str
    item: str

    @property
    def name(self) -> str:
        """Of the file."""
        return f"{self.hand}_{self.item}"

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return f"{ARM}+{HANDS[self.hand][0]}"

    @property
    def sides(self) -> dict[str, int]:
        """By touching finger the side of the object that it presses."""
        thumb, *others = HANDS[self.hand][1]
        return {thumb: 1} | dict.fromkeys(others, -1)


RECIPES = tuple(Recipe(hand, item) for hand in HANDS for item in ITEMS[hand])


def main(arguments: list[str] | None = None) -> int:
    """Write the grasps; 0 when all were found."""
    parser = argparse.ArgumentParser(description="Compute the shipped grasps of catalogue hands.")
    parser.add_argument("--only", choices=[r.name for r in RECIPES], help="one file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--starts", type=int, default=100, help="random starts per pinch")
    parser.add_argument("--out", type=Path, default=models_folder() / "grasps")
    options = parser.parse_args(arguments)
    missing = 0
    for recipe in RECIPES:
        if options.only not in (None, recipe.name):
            continue
        rng = np.random.default_rng([options.seed, *recipe.name.encode()])
        text = make(ik.load_robot(recipe.robot), recipe, rng, options.starts, options.seed)
        if text is None:
            print(f"{recipe.name}: no grasp found")
            missing += 1
        else:
            (options.out / f"{recipe.name}.yaml").write_text(text, encoding="utf-8")
    return min(missing, 1)


def make(
    robot: ik.ArmHand, recipe: Recipe, rng: np.random.Generator, starts: int, seed: int
) -> str | None:
    """The text of one grasp file, or None if nothing was found."""
    item, description = load_object(recipe.item), robot.description
    root, still = description.palm_link, idle(robot)
    middle, axes = where(robot, recipe)
    _, touching, apart = HANDS[recipe.hand]
    gripper = len(touching) == 2
    # Along their x axis boxes are pinched, by hands also what is narrower the other way.
    along_x = isinstance(item.shape, Box if gripper else Box | EllipticCylinder)
    if along_x:
        axes = axes[[1, 0, 2]] * [[1], [-1], [1]]
    if gripper:
        pinches = jaw_pinches(robot, item, touching, axes, 1 - along_x, still, rng, starts)
    else:
        problem = TipPinchProblem(
            description,
            root,
            item,
            recipe.sides,
            axes.tolist(),
            0,
            EDGE,
            still,
            (middle - ROOM, middle + ROOM),
            apart,
        )
        pinches = problem.solve(rng, starts)
    alone = SceneCheck(robot, ik.Scene(margin=MARGIN))
    table = SceneCheck(robot, ik.load_scene("table"))
    for found in pinches:
        if found.residual > 1e-9 or found.friction > FRICTION:
            continue
        pinch = cleared(alone, recipe.item, recipe.sides, found, rng)
        if pinch is None or (gap := clear(robot, item, recipe.sides, pinch)) < PHALANX_GAP:
            continue
        q = hold(description, root, pinch, Scene(LOW, HIGH, UPRIGHT[recipe.item], ABOVE), rng)
        if q is None:
            continue
        if surroundings(table, recipe.item, recipe.sides, pinch, q).free(q[None])[0]:
            print(f"{recipe.name}: friction {pinch.friction:.3f}, phalanges {1e3 * gap:.1f} mm")
            return text_of(robot, recipe, pinch, q, gap, seed)
    return None


def idle(robot: ik.ArmHand) -> Array:
    """(n,) all at zero, or as near as limits permit: so fingers that do not touch are stretched."""
    return np.clip(0.0, robot.lower, robot.upper)


def where(robot: ik.ArmHand, recipe: Recipe) -> tuple[Array, Array]:
    """Middle of the pads (3,) [m] and the object's axes (3, 3), rows, in the hand's root frame."""
    q = robot.home
    root = robot.links(q)[robot.description.palm_link]
    points = (robot.contacts(q)[0] - root[:3, 3]) @ root[:3, :3]
    thumb, *others = (points[robot.fingers.index(name)] for name in recipe.sides)
    fingers = (others[0] + others[-1]) / 2
    y = thumb - fingers
    y = y / np.linalg.norm(y)
    # A finger alone is no row: then along the palm, across the fingers.
    z = others[-1] - others[0] if len(others) > 1 else root[:3, :3].T @ robot.palm(q)[:3, 0]
    z = z - y * (y @ z)
    z = z / np.linalg.norm(z)
    return (thumb + fingers) / 2, np.stack([np.cross(y, z), y, z])


def clear(robot: ik.ArmHand, item: GraspObject, touching: dict[str, int], pinch: TipPinch) -> float:
    """Smallest gap [m] between the object and the axes of the phalanges.

    The last phalanx of a finger that touches is left out.
    """
    links = robot.links(pinch.q)
    hand = np.linalg.inv(links[robot.description.palm_link])
    children = {joint.name: joint.child for joint in robot.description.movable}
    points, _ = robot.contacts(pinch.q)
    samples = []
    for finger, tip in zip(robot.description.fingers, points, strict=True):
        line = [links[children[name]][:3, 3] for name in finger.joints]
        if finger.name not in touching:
            line.append(tip)
        for a, b in pairwise(line):
            samples.append(a + np.linspace(0, 1, 41)[:, None] * (b - a))
    # Fingers that slide have no phalanges: then the palm's middle.
    samples = samples or [robot.palm(pinch.q)[None, :3, 3]]
    inside = np.concatenate(samples) @ hand[:3, :3].T + hand[:3, 3]
    pose = pinch.object_in_hand
    return float(item.signed_distance((inside - pose[:3, 3]) @ pose[:3, :3]).min())


def text_of(
    robot: ik.ArmHand, recipe: Recipe, pinch: TipPinch, q: Array, gap: float, seed: int
) -> str:
    """The file's text."""
    held = "held upright" if UPRIGHT[recipe.item] else "held"
    scene = f"{held} in front of the arm"
    header = [
        made_by("make_hand_grasps.py", seed, recipe.item, recipe.robot),
        f"Pinched: by {', '.join(recipe.sides)}, any other finger is free.",
        f"Scene: {scene}; base frame is the arm's. Assumption: a table at z = 0.",
        placed_at(q[list(robot.description.arm_actuators)]),
        f"Friction coefficient needed for the squeeze: {pinch.friction:.3f}. Gap: axes of the "
        f"phalanges to the object {1e3 * gap:.1f} mm.",
    ]
    hand = set(robot.description.hand_actuators)
    posture = [
        f"  {one.name}: {value:.12f}  # "
        + (f"{np.rad2deg(value):.3f} deg" if one.unit == "rad" else f"{1e3 * value:.3f} mm")
        for i, (one, value) in enumerate(zip(robot.description.actuators, q, strict=True))
        if i in hand
    ]
    points, normals = robot.contacts(q)
    rows = [robot.fingers.index(finger) for finger in recipe.sides]
    contacts = {robot.fingers[i]: (points[i], normals[i]) for i in rows}
    pose = robot.links(q)[robot.description.palm_link] @ pinch.object_in_hand
    return grasp_text(header, recipe.robot, recipe.item, scene, pose, posture, contacts)


if __name__ == "__main__":
    sys.exit(main())
