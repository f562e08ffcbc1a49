"""Robustness of grasps to errors of the object's pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.hand_table import HandTable
from casadi_ik.planning.touch.hands import HandCandidates
from casadi_ik.planning.touch.strength import friction_wrenches, grasp_strengths, narrowed_friction
from casadi_ik.planning.touch.surface import Surface

OPENING_TRAVEL, CLOSING_TRAVEL, PATH_POSITIONS = 0.020, 0.020, 33
"""Travel of fingertips before and beyond their contacts [m], and number of positions on it."""

MAX_FACE_LEAN = float(np.deg2rad(45.0))
"""Maximum lean at which a plane pad touches with its face [rad]."""


def robustness(
    robot: ArmHand,
    surface: Surface,
    grasp: Grasp,
    q: Array,
    mu: float,
    displacements: Array,
    hold: tuple[float, float] | None = None,
) -> float:
    """Return the fraction of object displacements at which the hand closes on the object.

    The palm stays at its planned pose. Each finger of the grasp closes from `OPENING_TRAVEL` before
    its contact until it touches or is `CLOSING_TRAVEL` beyond it. The hand closes if the resulting
    contacts resist any small force and torque. Fingers that share a motor are treated
    independently.

    Args:
        robot: The robot.
        surface: Surface of the object.
        grasp: The grasp, with the pose of the object.
        q: (n,) configuration of the grasp.
        mu: Friction coefficient.
        displacements: (k, 4, 4) displacements of the object, in its frame.
        hold: Mass [kg] that the contacts have to hold, and the squeeze [N]; None: the contacts
            have to be force-closed.
    """
    table, pose = HandTable.for_robot(robot), grasp.known_pose
    assert pose is not None
    palm = inverse(pose) @ robot.palm(q)
    hand = q[table.motors][None]
    touches = np.array([[name in grasp.contacts for name in robot.fingers]])
    hands = HandCandidates(palm[None], hand, touches)
    openings = np.linspace(OPENING_TRAVEL, -CLOSING_TRAVEL, PATH_POSITIONS)
    path = np.concatenate([table.opened(hands, float(opening)).hand for opening in openings])
    points, normals, linear, angular = table.pads(path)
    fingers = np.flatnonzero(touches[0])
    # Jacobians (s, c, 3, m) in the planned frame of the object.
    linear, angular = (palm[:3, :3] @ jacobian[:, fingers] for jacobian in (linear, angular))
    motors = [robot.description.actuators[i] for i in table.motors]
    # Points (s, c, 3) in the planned frame of the object, then (k, s, c, 3) in the displaced
    # frames.
    points = points[:, fingers] @ palm[:3, :3].T + palm[:3, 3]
    normals = normals[:, fingers] @ palm[:3, :3].T
    inverses = np.linalg.inv(displacements)
    tips = np.einsum("kij,scj->ksci", inverses[:, :3, :3], points)
    tips += inverses[:, None, None, :3, 3]
    faces = np.einsum("kij,scj->ksci", inverses[:, :3, :3], normals)
    height = surface.foot(tips)[0] - table.radii[fingers]
    penetrates = height <= 0
    first = penetrates.argmax(axis=1)  # (k, c)
    meets = penetrates.any(axis=1) & (first > 0)
    # Of the positions before and after the contact, take the one that is nearer to the surface.
    previous = np.maximum(first - 1, 0)
    previous_is_nearer = np.abs(_at_position(height, previous)) < np.abs(
        _at_position(height, first)
    )
    position = np.where(previous_is_nearer, previous, first)
    contacts = surface.nearest(_at_position(tips, position))
    inward = -contacts.normal
    lean = np.arccos(np.clip((_at_position(faces, position) * inward).sum(axis=-1), -1, 1))
    meets &= lean < MAX_FACE_LEAN + table.roll[fingers]
    is_closed = np.zeros(len(displacements), dtype=bool)
    # Displacements at which the same fingers touch are evaluated together.
    for pattern in np.unique(meets, axis=0):
        rows = np.flatnonzero((meets == pattern).all(axis=1))
        if pattern.sum() < 2:
            continue
        index, columns = position[rows][:, pattern], np.flatnonzero(pattern)
        points, normals = (values[rows][:, pattern] for values in (contacts.point, inward))
        friction = narrowed_friction(mu, contacts.normal_spread[rows][:, pattern])
        radii = np.broadcast_to(table.radii[fingers[columns]], index.shape)
        rotations = inverses[rows, None, :3, :3]
        jacobians = rotations @ linear[index, columns]
        jacobians += np.cross(
            rotations @ angular[index, columns], (radii[..., None] * normals)[..., None], axis=2
        )
        length = surface.size / 2
        strength = grasp_strengths(
            friction_wrenches(points, normals, friction, surface.middle, length),
            points - surface.middle,
            normals,
            radii,
            jacobians,
            motors,
            mu,
            hold,
        )
        is_closed[rows] = strength.holds(hold)
    return float(is_closed.mean())


def _at_position(values: NDArray[Any], position: NDArray[np.intp]) -> NDArray[Any]:
    """Return the values (k, c, ...) of (k, s, c, ...) at positions (k, c) of the second axis."""
    k, c = position.shape
    return values[np.arange(k)[:, None], position, np.arange(c)]


def random_displacements(
    position: float, angle: float, samples: int, seed: int, middle: Array
) -> Array:
    """Return (k, 4, 4) displacements by a distance and an angle in random directions.

    Args:
        position: Distance [m].
        angle: Angle of the rotation about the centre of the object [rad].
        samples: Number of displacements, k.
        seed: Seed of the directions.
        middle: (3,) centre of the object [m].
    """
    rng = np.random.default_rng(seed)
    directions, axes = rng.normal(size=(2, samples, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T
    skew = np.zeros((samples, 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -z, y, -x
    skew -= skew.swapaxes(1, 2)
    displacements = np.tile(np.eye(4), (samples, 1, 1))
    displacements[:, :3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    displacements[:, :3, 3] = position * directions + middle - displacements[:, :3, :3] @ middle
    return displacements
