"""Pinches whose hand touches nothing but the object, and that with its pads alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

import casadi_ik as ik
from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.files.arrays import Array
from casadi_ik.solve.target_builder import TargetBuilder, tolerances_by_finger
from grasp_synthesis.fingertip_pinch import TipPinch

MARGIN = 0.5e-3  # [m] that everything is apart at least
IDLE = 400  # random postures of the fingers that do not touch, behind the usual ones


def surroundings(
    check: SceneCheck, item: str, touching: Iterable[str], pinch: TipPinch, q: Array
) -> CollisionQuery:
    """Return the scene of a pinch at q (n,): everything that it must not touch."""
    robot = check.robot
    points, normals = robot.contacts(q)
    rows = [(name, robot.fingers.index(name)) for name in touching]
    pose = robot.links(q)[robot.description.palm_link] @ pinch.object_in_hand
    grasp = ik.Grasp(
        {name: ik.Contact(points[i], normals[i]) for name, i in rows},
        object=item,
        object_pose=pose,
    )
    builder = TargetBuilder(robot, tolerances_by_finger(None, robot.fingers))
    return check.collision_query(builder.from_grasps([grasp])).rows(np.zeros(1, dtype=np.intp))


def cleared(
    check: SceneCheck,
    item: str,
    touching: Iterable[str],
    pinch: TipPinch,
    rng: np.random.Generator,
) -> TipPinch | None:
    """Return the pinch with collision-free idle fingers; None if there are none.

    Args:
        check: The robot in an empty scene.
        item: Name of the object.
        touching: Fingers that touch it.
        pinch: Found without a thought of collisions.
        rng: Source of places for the other fingers, behind where they are and home.
    """
    robot, named = check.robot, list(touching)
    around = surroundings(check, item, named, pinch, pinch.q).hand_pairs
    hand = set(robot.description.hand_actuators)
    busy = {i for name in named for i in robot.description.finger_actuators(name)}
    idle = sorted(hand - busy)
    trial = np.tile(pinch.q, (IDLE + 2, 1))
    trial[1, idle] = robot.home[idle]
    trial[2:, idle] = robot.random(rng, IDLE)[:, idle]
    free = np.flatnonzero(around.free(trial))
    return replace(pinch, q=trial[free[0]]) if len(free) else None
