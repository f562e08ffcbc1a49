"""A grasp as a file in the format of `casadi_ik.grasps.load_grasp`."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from grasp_synthesis.clearance import Clearance
from grasp_synthesis.hand import FINGERS, ROBOT, ArmHand
from grasp_synthesis.placement import Placement
from grasp_synthesis.posture import Pinch
from grasp_synthesis.recipes import Recipe

Array = NDArray[np.float64]


def grasp_text(
    hand: ArmHand, recipe: Recipe, pinch: Pinch, placement: Placement, gaps: Clearance, seed: int
) -> str:
    """The file's text; twelve decimals, so that the contacts stay exact."""
    palm, points, normals, _, _ = hand.evaluate(placement.arm, pinch.posture)
    pose = palm @ pinch.object_in_palm
    degrees = np.rad2deg(placement.arm)
    header = [
        f"Made by studies/make_grasps.py --seed {seed} from models/objects/{recipe.name}.yaml and "
        f"the robot {ROBOT}. Rerun it instead of editing.",
        f"Pinched: {recipe.part}.",
        f"Scene: {recipe.scene}; the home configuration of the arm looks to -x, and so does this.",
        "The place is the first of several drawn at random that enhanced-dls solves from home, if "
        "any: an example, not a measurement.",
        "Placed with the arm at " + ", ".join(f"{d:.2f}" for d in degrees.round(2) + 0.0) + " deg.",
        f"Friction coefficient needed for the squeeze: {abs(pinch.friction):.3f}. Gaps: palm "
        f"{1e3 * gaps.palm:.1f} mm, phalanges {1e3 * gaps.fingers:.1f} mm, finger to finger "
        f"{1e3 * gaps.between:.1f} mm.",
    ]
    lines = [
        line
        for text in header
        for line in textwrap.wrap(text, 98, initial_indent="# ", subsequent_indent="#   ")
    ]
    lines += [
        f"robot: {ROBOT}",
        f'description: "{recipe.name.replace("_", " ").capitalize()}, {recipe.scene}."',
        "object:",
        f"  name: {recipe.name}",
        f"  pose: {{xyz: {_row(pose[:3, 3])},",
        f"         rpy: {_row(rpy(pose[:3, :3]))}}}",
        "posture:",
    ]
    for name, value in zip(hand.hand_names, pinch.posture, strict=True):
        lines.append(f"  {name}: {_number(value)}  # {np.rad2deg(value):.3f} deg")
    lines.append("contacts:")
    for finger, point, normal in zip(FINGERS, points, normals, strict=True):
        lines += [f"  {finger}:", f"    point: {_row(point)}", f"    normal: {_row(normal)}"]
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
