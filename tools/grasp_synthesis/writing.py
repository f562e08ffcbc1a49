"""A grasp as a file in the format of `casadi_ik.model.load_grasp`."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping

import numpy as np

from casadi_ik.files.arrays import Array
from grasp_synthesis.clearance import Clearance
from grasp_synthesis.hand import FINGERS, ROBOT, ArmHand
from grasp_synthesis.placement import Placement
from grasp_synthesis.posture import Pinch
from grasp_synthesis.recipes import Recipe


def barrett_text(
    hand: ArmHand, recipe: Recipe, pinch: Pinch, placement: Placement, gaps: Clearance, seed: int
) -> str:
    """Return the text of the file of a Barrett grasp."""
    palm, points, normals, _, _ = hand.evaluate(placement.arm, pinch.posture)
    header = [
        made_by("make_grasps.py", seed, recipe.name, ROBOT),
        f"Pinched: {recipe.part}.",
        f"Scene: {recipe.scene}; the home configuration of the arm looks to -x, and so does this.",
        "The place is the first of several drawn at random that enhanced-dls solves from home, if "
        "any: an example, not a measurement.",
        placed_at(placement.arm),
        f"Friction coefficient needed for the squeeze: {abs(pinch.friction):.3f}. Gaps: palm "
        f"{1e3 * gaps.palm:.1f} mm, phalanges {1e3 * gaps.fingers:.1f} mm, finger to finger "
        f"{1e3 * gaps.between:.1f} mm.",
    ]
    posture = [
        f"  {name}: {_number(value)}  # {np.rad2deg(value):.3f} deg"
        for name, value in zip(hand.hand_names, pinch.posture, strict=True)
    ]
    contacts = {
        finger: {"point": points[i], "normal": normals[i]} for i, finger in enumerate(FINGERS)
    }
    pose = palm @ pinch.object_in_palm
    return grasp_text(header, ROBOT, recipe.name, recipe.scene, pose, posture, contacts)


def made_by(script: str, seed: int, item: str, robot: str) -> str:
    """Return the first line of a file."""
    return (
        f"Made by tools/{script} --seed {seed} from models/objects/{item}.yaml and "
        f"the robot {robot}. Rerun it instead of editing."
    )


def placed_at(arm: Array) -> str:
    """Return the line about the arm [rad]."""
    degrees = np.rad2deg(arm).round(2) + 0.0
    return "Placed with the arm at " + ", ".join(f"{d:.2f}" for d in degrees) + " deg."


def grasp_text(
    header: Iterable[str],
    robot: str,
    item: str,
    scene: str,
    pose: Array,
    posture: Iterable[str],
    contacts: Mapping[str, Mapping[str, Array]],
) -> str:
    """Return the text of the file, with twelve decimals, so that the contacts stay exact.

    Args:
        header: Comments.
        robot: Name of the robot.
        item: Name of the object.
        scene: How it is held, in words.
        pose: (4, 4) the object in the base frame.
        posture: Lines, one per actuator of the hand.
        contacts: By finger and key what is (3,): point [m], normal, ball.
    """
    lines = [
        line
        for text in header
        for line in textwrap.wrap(text, 98, initial_indent="# ", subsequent_indent="#   ")
    ]
    lines += [
        f"robot: {robot}",
        f'description: "{item.replace("_", " ").capitalize()}, {scene}."',
        "object:",
        f"  name: {item}",
        f"  pose: {{xyz: {_row(pose[:3, 3])},",
        f"         rpy: {_row(rpy(pose[:3, :3]))}}}",
        "posture:",
        *posture,
        "contacts:",
    ]
    for finger, contact in contacts.items():
        lines += [f"  {finger}:", *(f"    {key}: {_row(value)}" for key, value in contact.items())]
    return "\n".join(lines) + "\n"


def rpy(rotation: Array) -> Array:
    """Roll, pitch, yaw about the fixed axes (URDF) of a rotation matrix."""
    cosine = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], cosine)
    if cosine < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def _row(values: Iterable[float]) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _number(value: float) -> str:
    return f"{value:.12f}" if abs(value) > 5e-13 else "0.0"
