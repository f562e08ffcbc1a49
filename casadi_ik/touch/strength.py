"""How well contacts hold an object: loads per newton of squeeze, for many grasps at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from casadi_ik.arrays import Array, Bools
from casadi_ik.kernels.cancellation import SLICE, drive
from casadi_ik.kernels.codegen import c_struct
from casadi_ik.robots.description import Actuator
from casadi_ik.touch.hand_table import touch_library

EDGES = 8
"""Edges of the pyramid within a friction cone."""

DIRECTIONS = np.concatenate([np.eye(6), -np.eye(6)])
"""(12, 6) wrenches: forces along and torques about the axes, both ways."""

FORCES = [0, 1, 2, 6, 7, 8]
"""Those of them that are forces."""

GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""

USUAL = (0.2, 18.0)
"""Mass [kg] and squeeze [N] for which stiffness counts where none are said."""

CLOSED = 1e-4
"""Load from which a grasp counts as force-closed [N/N]."""

STEPS, ENOUGH = 50, 1e-9
"""Most iterations of a linear program, and the mean of x z that is followed by the last."""


def generators(
    points: Array, normals: Array, mu: float, center: Array, length: float, patch: float = 0.005
) -> Array:
    """Wrenches of soft fingers with a normal force of 1: the edges of their friction cones.

    Args:
        points: (k, c, 3) contacts [m].
        normals: (k, c, 3) unit, into the object.
        mu: Friction coefficient.
        center: (3,) about which torques are [m].
        length: By which torques are divided [m].
        patch: Radius of a pad's contact patch [m]: it holds 2/3 mu patch about its normal
            (Coulomb friction under even pressure).

    Returns:
        (k, 6, c * (EDGES + 2)).
    """
    k, c = points.shape[:2]
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(normals, first)
    angle = 2 * np.pi * np.arange(EDGES) / EDGES
    along = first[..., None, :] * np.cos(angle)[:, None]
    along = along + second[..., None, :] * np.sin(angle)[:, None]
    normal = normals[..., None, :]
    force = np.concatenate([normal + mu * along, normal, normal], axis=-2)
    torque = np.cross((points - center)[..., None, :], force) / length
    spin = 2 / 3 * mu * patch / length * normals
    torque[..., -2, :] += spin
    torque[..., -1, :] -= spin
    return np.concatenate([force, torque], axis=-1).reshape(k, c * (EDGES + 2), 6).swapaxes(1, 2)


def loads(wrenches: Array, directions: Array = DIRECTIONS) -> Array:
    """Largest s with -s d = W x, x >= 0, sum x <= 1: what a squeeze of 1 N holds against d.

    Args:
        wrenches: (k, 6, g) of the cones' edges.
        directions: (d, 6).

    Returns:
        (k, d) loads [N per N]; 0 where nothing is held.
    """
    return np.maximum(_solved(wrenches, directions)[..., -2], 0.0)


def closed(wrenches: Array) -> Array:
    """(k,) loads against the mean of the wrenches (k, 6, g): above 0 if a grasp is force-closed.

    Only then all of them can be above 0 and in balance. One program tells it, not twelve as by
    `loads`.
    """
    return np.maximum(_solved(wrenches, wrenches.mean(axis=2)[:, None])[:, 0, -2], 0.0)


def loads_and_squeezes(wrenches: Array) -> tuple[Array, Array]:
    """The loads of `DIRECTIONS`, and forces at rest from which a grasp is best pulled any way.

    These are the mean of what holds as much against each of six forces with least squeeze: as
    those cancel, the object is at rest.

    Args:
        wrenches: (k, 6, c * (EDGES + 2)) from `generators`.

    Returns:
        (k, 12) loads [N per N], and (k, c, 3) forces on the object; their normal parts sum to 1 N.
    """
    k, _, g = wrenches.shape
    every = _solved(wrenches, DIRECTIONS)
    solved = every[:, FORCES]
    shares = (solved[..., :g] / np.maximum(solved[..., g : g + 1], 1e-12)).sum(axis=1)
    shares /= shares.sum(axis=1, keepdims=True)
    forces = wrenches[:, :3] * shares[:, None]
    forces = forces.reshape(k, 3, g // (EDGES + 2), EDGES + 2).sum(axis=-1).swapaxes(1, 2)
    return np.maximum(every[..., g], 0.0), forces


@dataclass(frozen=True)
class GiveParameters:
    """How a grasp gives way when the object is pulled; those of the study `touch_hold`.

    Attributes:
        springs: Of motors that turn and that slide [N m/rad, N/m].
        far: What the object may move [m] ...
        turned: ... and turn [rad].
        spin: Turn after which a pad's friction about its normal is used up [rad].
        flat: Radius of the ball that a plane counts as [m].
        contact: Compliance of a contact itself [m/N].
    """

    springs: tuple[float, float] = (3.0, 2000.0)
    far: float = 0.020
    turned: float = float(np.deg2rad(30.0))
    spin: float = float(np.deg2rad(3.0))
    flat: float = 0.010
    contact: float = 2e-5


GIVE = GiveParameters()


@dataclass(frozen=True, eq=False)
class Strengths:
    """How well grasps hold: k of them, of c contacts.

    Attributes:
        load: (k,) what the worst of six directions holds by friction, less by how far the object
            gives way [N/N].
        closure: (k,) what the worst of `DIRECTIONS` holds.
        forces: (k, c, 3) on the object at rest; their normal parts sum to 1 N.
        most: (k,) largest squeeze for which motors' efforts suffice [N].
    """

    load: Array
    closure: Array
    forces: Array
    most: Array

    def hold(self, hold: tuple[float, float] | None) -> Bools:
        """(k,) which are force-closed, and hold a mass [kg] with a squeeze [N] if that is said."""
        held: Bools = self.closure > CLOSED
        if hold is None:
            return held
        return held & (self.load * np.minimum(hold[1], self.most) >= hold[0] * GRAVITY)


def strengths(
    wrenches: Array,
    arms: Array,
    normals: Array,
    radii: Array,
    jacobians: Array,
    motors: Sequence[Actuator],
    mu: float,
    hold: tuple[float, float] | None,
) -> Strengths:
    """How well grasps hold a mass [kg] with a squeeze [N] (None: `USUAL`).

    Args:
        wrenches: (k, 6, c * (EDGES + 2)) from `generators`.
        arms: (k, c, 3) contacts from the middle of the object [m].
        normals: (k, c, 3) unit, into the object.
        radii: (k, c) of pads [m]; 0 of planes.
        jacobians: (k, c, 3, m) of contacts over motors.
        motors: The m motors.
        mu: Friction coefficient.
        hold: Mass [kg] and squeeze [N] for which the object's giving way counts.
    """
    mass, squeeze = USUAL if hold is None else hold
    found, forces = loads_and_squeezes(wrenches)
    torques = np.abs(np.einsum("kcim,kci->km", jacobians, forces))
    efforts = np.array([motor.effort for motor in motors])
    most = (efforts / np.maximum(torques, 1e-12)).min(axis=1)
    springs = np.array([GIVE.springs[motor.unit == "m"] for motor in motors])
    pressed = np.minimum(squeeze, most)[:, None, None] * forces
    stiff = np.maximum(stiffnesses(arms, normals, pressed, radii, jacobians, springs, mu), 0.0)
    # What the object gives way by is a part of what it may.
    load = found[:, FORCES].min(axis=1) * stiff / (stiff + mass * GRAVITY / GIVE.far)
    return Strengths(load, found.min(axis=1), forces, most)


def stiffnesses(
    arms: Array,
    normals: Array,
    forces: Array,
    radii: Array,
    jacobians: Array,
    springs: Array,
    mu: float,
    patch: float = 0.005,
    give: GiveParameters = GIVE,
) -> Array:
    """Least stiffness of grasps (k,) [N/m] against moving, and turning about their middle.

    Motors are springs, and pads are balls that roll on the object without sliding: as it turns, the
    contact moves on, and the squeeze turns it further or back (Cutkosky and Kao 1989, with faces
    flat and fingertips that do not turn). Below 0 the object rolls out of the hand.

    Args:
        arms: (k, c, 3) contacts from the middle of the object [m].
        normals: (k, c, 3) unit, into the object.
        forces: (k, c, 3) on the object at rest [N].
        radii: (k, c) of pads [m]; 0 of planes.
        jacobians: (k, c, 3, m) of contacts over motors.
        springs: (m,) of motors [N m/rad or N/m].
        mu: Friction coefficient.
        patch: Radius of a contact patch [m].
        give: What motors and contacts give.
    """
    k, c, _, m = jacobians.shape
    length = give.far / give.turned  # of a turn that counts as a metre
    compliant = (jacobians / springs).reshape(k, 3 * c, m)
    compliant = compliant @ jacobians.reshape(k, 3 * c, m).swapaxes(1, 2)
    compliant += give.contact * np.eye(3 * c)
    eye = np.broadcast_to(np.eye(3), (k, c, 3, 3))
    moved = np.concatenate([eye, -cross_matrices(arms) / length], axis=-1).reshape(k, 3 * c, 6)
    stiff = moved.swapaxes(1, 2) @ np.linalg.solve(compliant, moved)
    pressed = np.maximum((forces * normals).sum(axis=-1), 0.0)
    spin = 2 / 3 * mu * patch / give.spin * pressed
    turning = np.einsum("kc,kci,kcj->kij", spin, normals, normals)
    # The contact moves by (turn) x (arm + radius normal), and the force with it.
    behind = arms + np.where(radii > 0, radii, give.flat)[..., None] * normals
    turning -= (cross_matrices(forces) @ cross_matrices(behind)).sum(axis=1)
    stiff[:, 3:, 3:] += turning / length**2
    least: Array = np.linalg.eigvalsh((stiff + stiff.swapaxes(1, 2)) / 2)[:, 0].astype(float)
    return least


def cross_matrices(vectors: Array) -> Array:
    """(..., 3, 3) matrices of the cross product."""
    return np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)


LoadJob = c_struct("load_job", driver="touch")

COLUMN = 14 * 4
"""Numbers of a column that four programs work on (drivers/touch.c)."""


def _solved(wrenches: Array, directions: Array) -> Array:
    """(k, d, g + 2) x, s and slack of the linear programs of `loads`, by compiled code.

    Directions are the same for all, (d, 6), or their own, (k, d, 6).

    Raises:
        UnsupportedError: There is no compiler.
    """
    k, _, g = wrenches.shape
    d = directions.shape[-2]
    solved = np.empty((k, d, g + 2))
    arrays = {
        "wrenches": np.ascontiguousarray(wrenches),
        "directions": np.ascontiguousarray(np.broadcast_to(directions, (k, d, 6))),
        "solved": solved,
        "work": np.empty((g + 2) * COLUMN),
    }
    job = LoadJob(
        **{name: array.ctypes.data for name, array in arrays.items()},
        enough=ENOUGH,
        edges=g,
        each=d,
        steps=STEPS,
        count=k * d,
        slice=SLICE,
    )
    drive("loads", _entry(), job)
    return solved


@cache
def _entry() -> Any:
    return touch_library()["casadi_ik_loads"]
