"""Grasp records of solved hands, with the open hand before and the squeezing hand after."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.planning.touch.candidates import Generator
from casadi_ik.planning.touch.hands import HandCandidates

OPENINGS = (0.025, 0.015, 0.008)
"""Openings of the pregrasp: distances of the fingertips from the object [m].

The first collision-free one is used.
"""

SQUEEZE_DEPTH = 5e-3
"""Mean penetration of the fingertips at the posture `Grasp.squeeze` [m]."""

RETREAT = 0.06
"""Distance between the palms of grasp and pregrasp [m]."""


def grasp_records(
    generator: Generator, hands: HandCandidates, q: Array, pose: Array, forces: Array
) -> list[Grasp]:
    """Return the grasps of solved hands, with the open hand before and the squeezing hand after.

    Args:
        generator: Generator of the candidates.
        hands: Hands at the configurations, with their contacts.
        q: (k, n) configurations.
        pose: (4, 4) pose of the object in the base frame.
        forces: (k, f, 3) forces on the object, base frame.
    """
    table, robot = generator.table, generator.table.robot
    assert hands.contacts is not None
    is_ball = table.radii > 0
    points, normals = robot.contacts(q)
    centers = points - table.radii[:, None] * normals
    directions = np.nan_to_num(hands.contacts.direction) @ pose[:3, :3].T
    contact_points = np.where(is_ball[:, None], centers + table.radii[:, None] * directions, points)
    palms = robot.palm(q)
    palm_forces, palm_offsets = (
        np.einsum("kfi,kij->kfj", vectors, palms[:, :3, :3])
        for vectors in (forces, contact_points - centers)
    )
    squeezed = table.squeezed(hands, palm_offsets, palm_forces, SQUEEZE_DEPTH)
    opened, is_open = hands.hand.copy(), np.zeros(len(hands), dtype=bool)
    for opening in OPENINGS:
        rows = np.flatnonzero(~is_open)
        if len(rows):
            trial = table.opened(hands.rows(rows), opening)
            is_free = generator.hand_check(trial)
            opened[rows[is_free]], is_open[rows[is_free]] = trial.hand[is_free], True
    motors = [robot.actuators[i] for i in table.motors]
    stem = Path(generator.surface.object.name).stem
    grasps = []
    for i in range(len(hands)):
        contacts = {}
        for j in np.flatnonzero(hands.touches[i]):
            ball = directions[i, j] if is_ball[j] else None
            contacts[robot.fingers[j]] = Contact(contact_points[i, j], normals[i, j], ball=ball)
        retreated = palms[i].copy()
        center = np.mean([contact.point for contact in contacts.values()], axis=0)
        offset = retreated[:3, 3] - center
        retreated[:3, 3] += RETREAT * offset / max(float(np.linalg.norm(offset)), 1e-9)
        posture, open_posture, squeezing_posture = (
            dict(zip(motors, positions[i].tolist(), strict=True))
            for positions in (hands.hand, opened, squeezed)
        )
        pregrasp = Grasp(robot=robot.name, palm=retreated, posture=open_posture)
        grasps.append(
            Grasp(
                contacts,
                robot=robot.name,
                name=f"{stem} {'+'.join(contacts)}",
                object=generator.surface.name,
                object_pose=pose,
                posture=posture,
                pregrasp=pregrasp if is_open[i] else None,
                squeeze=Grasp(robot=robot.name, palm=palms[i], posture=squeezing_posture),
            )
        )
    return grasps
