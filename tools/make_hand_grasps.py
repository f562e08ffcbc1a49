"""Compute the built-in grasps of hands on a Panda: for each object, the one with the highest load.

Run it again whenever an object, a hand or `Solver.grasps_of` changes::

    python tools/make_hand_grasps.py                                  # all into models/grasps
    python tools/make_hand_grasps.py --only allegro_cup

The object floats above the table. `Solver.grasps_of` computes grasps at several positions and yaw
angles. Of those with a pregrasp, with fingertips away from edges and with enough clearance, the one
that holds most per newton of grip force is refined by `Solver.solve`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from grasp_synthesis.writing import grasp_text, made_by, placed_at

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.files.shipped import models_folder
from casadi_ik.model.objects import GraspObject, load_object
from casadi_ik.model.shapes import Box, Cylinder, EllipticCylinder

HANDS = {
    "allegro": ("allegro_right", ("tomato_soup_can", "mug", "cup")),
    "leap": ("leap", ("tomato_soup_can", "mustard_bottle", "bleach_cleanser")),
    "shadow": ("shadow", ("tomato_soup_can", "cup", "orange")),
    "dex3": ("unitree_dex3", ("tomato_soup_can", "tennis_ball", "sugar_box")),
    "robotiq_3f": ("robotiq_3f", ("mustard_bottle", "potted_meat_can", "bleach_cleanser")),
    "panda_hand": ("panda_hand", ("mustard_bottle", "tomato_soup_can", "sugar_box")),
    "robotiq_2f85": (
        "robotiq_2f85",
        ("potted_meat_can", "tomato_soup_can", "mustard_bottle", "tennis_ball"),
    ),
}
"""Hand and objects, by the first word of the name of a file."""

PLACES = ([0.45, -0.2, 0.35], [0.5, 0.15, 0.35])
"""Positions of objects in the base frame [m]: x forward, y left, z up."""

YAWS = (0.0, 2.1, 4.2)
LIMIT = 200
"""Yaw angles [rad], and number of grasps for each position and yaw."""

CLEAR = 0.0015
"""Smallest clearance [m]."""

BOX_EDGE, RIM = 0.010, 0.0045
"""Smallest distance of a contact to the edges of a box and to the ends of a cylinder [m]."""

STEPS = 60
"""Maximum number of projections to the surface."""

EXACT = ik.Tolerance(1e-9, 1e-9)


def main(arguments: list[str] | None = None) -> int:
    """Write the grasps; return 0 if all were found."""
    names = {f"{hand}_{item}": (hand, item) for hand in HANDS for item in HANDS[hand][1]}
    parser = argparse.ArgumentParser(description="Compute the shipped grasps of catalogue hands.")
    parser.add_argument("--only", choices=sorted(names), help="one file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=models_folder() / "grasps")
    options = parser.parse_args(arguments)
    missing = 0
    for name in [options.only] if options.only else names:
        hand, item = names[name]
        text = make(f"panda+{HANDS[hand][0]}", item, options.seed)
        if text is None:
            print(f"{name}: no grasp found")
            missing += 1
        else:
            (options.out / f"{name}.yaml").write_text(text, encoding="utf-8")
    return min(missing, 1)


def make(robot: str, name: str, seed: int) -> str | None:
    """Return the text of a grasp file; None if no grasp was found."""
    arm_hand, item, table = ik.load_robot(robot), load_object(name), ik.load_scene("table")
    solver, surface = ik.Solver(arm_hand, scene=table), ik.load_surface(name)
    exact = ik.Solver(arm_hand, scene=table, tolerance=EXACT)
    candidates: list[tuple[Any, Array]] = []
    for place, yaw in product(PLACES, YAWS):
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        pose[:3, 3] = place
        grasps = solver.grasps_of(surface, pose, limit=LIMIT, seed=seed)
        candidates += [
            (grasp, pose) for grasp in grasps if grasp.pregrasp and (grasp.clearance or 0) > CLEAR
        ]
    for grasp, pose in sorted(candidates, key=lambda entry: -entry[0].load):
        contacts: dict[str, dict[str, Any]] = dict(on_surface(arm_hand, item, grasp, pose))
        if len(contacts) < len(grasp.grasp.contacts):
            continue
        targets = {finger: ik.Contact(**contact) for finger, contact in contacts.items()}
        solution = exact.solve(
            ik.Grasp(targets, object=name, object_pose=pose), q0=grasp.q, prefer="q0"
        )
        if not solution.success:
            continue
        normals = arm_hand.contacts(solution.q)[1]
        for finger, contact in contacts.items():
            contact["normal"] = normals[arm_hand.fingers.index(finger)]
        print(
            f"{robot}, {name}: load {grasp.load:.3f} N/N, clearance {1e3 * grasp.clearance:.1f} mm"
        )
        return text_of(arm_hand, name, seed, pose, solution.q, contacts, grasp.load)
    return None


def on_surface(
    robot: ik.ArmHand, item: GraspObject, grasp: Any, pose: Array
) -> Iterator[tuple[str, dict[str, Array]]]:
    """Yield finger, nearest point of the surface and normal for contacts away from edges."""
    fingers = list(grasp.grasp.contacts)
    points = [
        (contact.point - pose[:3, 3]) @ pose[:3, :3] for contact in grasp.grasp.contacts.values()
    ]
    points = [project_to_surface(item, point) for point in points]
    balls = [robot.description.finger(finger).radius > 0 for finger in fingers]
    if not any(balls) and len(points) == 2:
        points = opposed_points(item, points[0])
    for finger, point, ball in zip(fingers, points, balls, strict=True):
        if edge_distance(item, point) >= 0:
            inward = -pose[:3, :3] @ surface_normal(item, point)
            place = pose[:3, :3] @ point + pose[:3, 3]
            yield finger, {"point": place, "ball" if ball else "normal": inward}


def opposed_points(item: GraspObject, point: Array) -> list[Array]:
    """Return two opposed points of the surface, as rigid jaws need.

    Alternately follows the inward normal through the object, which converges to its narrowest
    place.
    """
    opposite = point
    for _ in range(STEPS):
        normal = surface_normal(item, opposite)
        point, opposite = opposite, project_to_surface(item, opposite - 1e-6 * normal, normal)
        if np.linalg.norm(normal + surface_normal(item, opposite)) < 1e-13:
            break
    return [point, opposite]


def project_to_surface(item: GraspObject, point: Array, line: Array | None = None) -> Array:
    """Return the nearest point of the surface [m], or the one on a line from an inner point."""
    for _ in range(STEPS):
        distance = item.signed_distance(point[None])[0]
        if abs(distance) < 1e-14:
            break
        point = point + distance * (-surface_normal(item, point) if line is None else line)
    return point


def surface_normal(item: GraspObject, point: Array) -> Array:
    """Return the (3,) outward normal of the surface."""
    return item.normal(point[None])[0]


def edge_distance(item: GraspObject, point: Array) -> float:
    """Return the distance of a point of the surface to the nearest edge, minus the minimum [m]."""
    if isinstance(item.shape, Cylinder | EllipticCylinder):
        return float(item.shape.height / 2 - abs(point[2]) - RIM)
    if isinstance(item.shape, Box):
        return float(np.sort(np.asarray(item.shape.size) / 2 - np.abs(point))[1] - BOX_EDGE)
    return float("inf")


def text_of(
    robot: ik.ArmHand,
    name: str,
    seed: int,
    pose: Array,
    q: Array,
    contacts: dict[str, dict[str, Array]],
    load: float,
) -> str:
    """Return the text of a grasp file."""
    description, scene = robot.description, "held upright in front of the arm"
    header = [
        made_by("make_hand_grasps.py", seed, name, robot.name),
        f"Held: by {', '.join(contacts)}, any other finger is free.",
        f"Scene: {scene}; base frame is the arm's. Assumption: a table at z = 0.",
        placed_at(q[list(description.arm_actuators)]),
        f"Load with a friction coefficient of 0.5: {load:.3f} N per newton of squeeze.",
    ]
    hand = set(description.hand_actuators)
    # Keeps the twelve written decimals within limits.
    q = np.clip(q, np.ceil(1e12 * robot.lower) / 1e12, np.floor(1e12 * robot.upper) / 1e12)
    posture = [
        f"  {grasp.name}: {value:.12f}  # "
        + (f"{np.rad2deg(value):.3f} deg" if grasp.unit == "rad" else f"{1e3 * value:.3f} mm")
        for i, (grasp, value) in enumerate(zip(description.actuators, q, strict=True))
        if i in hand
    ]
    return grasp_text(header, robot.name, name, scene, pose, posture, contacts)


if __name__ == "__main__":
    sys.exit(main())
