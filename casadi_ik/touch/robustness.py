"""How grasps bear that the object is not quite where it was thought to be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.grasps.pose import inverse
from casadi_ik.touch.candidates import Candidates
from casadi_ik.touch.hand_table import HandTable
from casadi_ik.touch.strength import generators, strengths
from casadi_ik.touch.surface import Surface

if TYPE_CHECKING:
    from casadi_ik.touch.grasps import FoundGrasp

OPEN, FAR, PLACES = 0.020, 0.020, 33
"""Fingertips come from so far before contacts, go on so far beyond [m]; places between."""

STEEP = float(np.deg2rad(45.0))
"""A flat pad that leans more does not touch with its face [rad]."""


def robustness(
    robot: ArmHand,
    surface: Surface,
    one: FoundGrasp,
    mu: float,
    offsets: Array,
    hold: tuple[float, float] | None = None,
) -> float:
    """The share of places of the object at which the hand still closes on it.

    The palm is where it was to be, and the fingers of the grasp close from 20 mm before their
    contacts, each until it touches or is 20 mm beyond. It is closed if the contacts that there are
    then hold any small force and torque. Fingers that share a motor are looked at one by one.

    Args:
        robot: The robot.
        surface: The object's.
        one: The grasp.
        mu: Friction coefficient.
        offsets: (k, 4, 4) where the object is really, in the frame in which it was thought to be.
        hold: Mass [kg], and the squeeze [N] with which it has to be held; None: it is enough that
            the contacts are force-closed.
    """
    table, pose = HandTable.of(robot), one.grasp.known_pose
    assert pose is not None
    palm = inverse(pose) @ robot.palm(one.q)
    hand = one.q[table.motors][None]
    used = np.array([[name in one.grasp.contacts for name in robot.fingers]])
    same = Candidates(palm[None], hand, used)
    way = np.concatenate(
        [table.opened(same, float(back)).hand for back in np.linspace(OPEN, -FAR, PLACES)]
    )
    points, normals, linear, angular = table.at(way)
    which = np.flatnonzero(used[0])
    # (s, c, 3, m) in the frame in which the object was thought to be.
    linear, angular = (palm[:3, :3] @ part[:, which] for part in (linear, angular))
    motors = [robot.description.actuators[i] for i in table.motors]
    # (s, c, 3) where the object was thought to be, then (k, s, c, 3) where it is.
    points = points[:, which] @ palm[:3, :3].T + palm[:3, 3]
    normals = normals[:, which] @ palm[:3, :3].T
    seen = np.linalg.inv(offsets)
    tips = np.einsum("kij,scj->ksci", seen[:, :3, :3], points) + seen[:, None, None, :3, 3]
    faces = np.einsum("kij,scj->ksci", seen[:, :3, :3], normals)
    height, sample = surface.foot(tips)
    height = height - table.radii[which]
    within = height <= 0
    first = within.argmax(axis=1)  # (k, c)
    touches = within.any(axis=1) & (first > 0)
    # The place before it touches or the one after: that which is nearer to the surface.
    before = np.maximum(first - 1, 0)
    nearer = np.abs(_at(height, before)) < np.abs(_at(height, first))
    there = np.where(nearer, before, first)
    samples = _at(sample, there)
    inward = -surface.faces[samples]
    lean = np.arccos(np.clip((_at(faces, there) * inward).sum(axis=-1), -1, 1))
    touches &= lean < STEEP + table.roll[which]
    closed = np.zeros(len(offsets), dtype=bool)
    for row_of in np.unique(touches, axis=0):
        rows = np.flatnonzero((touches == row_of).all(axis=1))
        if row_of.sum() < 2:
            continue
        chosen, at, own = samples[rows][:, row_of], there[rows][:, row_of], np.flatnonzero(row_of)
        points, normals = surface.points[chosen], -surface.faces[chosen]
        radii = np.broadcast_to(table.radii[which[own]], chosen.shape)
        turns = seen[rows, None, :3, :3]
        jacobians = turns @ linear[at, own]
        jacobians += np.cross(
            turns @ angular[at, own], (radii[..., None] * normals)[..., None], axis=2
        )
        length = surface.size / 2
        found = strengths(
            generators(points, normals, mu, surface.middle, length),
            points - surface.middle,
            normals,
            radii,
            jacobians,
            motors,
            mu,
            hold,
        )
        closed[rows] = found.hold(hold)
    return float(closed.mean())


def _at(values: NDArray[Any], places: NDArray[np.intp]) -> NDArray[Any]:
    """(k, c, ...) values (k, s, c, ...) at places (k, c)."""
    k, c = places.shape
    return values[np.arange(k)[:, None], places, np.arange(c)]


def offsets(position: float, angle: float, samples: int, seed: int, middle: Array) -> Array:
    """(k, 4, 4) displacements by a distance [m] and an angle [rad] in random directions.

    Args:
        position: How far the object is off [m].
        angle: How far it is turned, about its middle [rad].
        samples: How many, k.
        seed: Of the directions.
        middle: (3,) of the object [m].
    """
    rng = np.random.default_rng(seed)
    ways, axes = rng.normal(size=(2, samples, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    x, y, z = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T
    skew = np.zeros((samples, 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -z, y, -x
    skew -= skew.swapaxes(1, 2)
    found = np.tile(np.eye(4), (samples, 1, 1))
    found[:, :3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    found[:, :3, 3] = position * ways + middle - found[:, :3, :3] @ middle
    return found
