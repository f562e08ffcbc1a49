"""Strength of many grasps: loads within friction, forces to squeeze with, and stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from casadi_ik.compile.cancellation import SLICE, run_cancellable
from casadi_ik.compile.codegen import c_struct
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.model.joints import Actuator
from casadi_ik.planning.touch.hands import touch_library

EDGES = 8
"""Number of edges of the pyramid inscribed in a friction cone."""

DIRECTIONS = np.concatenate([np.eye(6), -np.eye(6)])
"""(12, 6) wrenches: forces along and torques about the axes, in both directions."""

FORCES = [0, 1, 2, 6, 7, 8]
"""Rows of `DIRECTIONS` that are forces."""

GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""

NOMINAL_HOLD = (0.2, 18.0)
"""Default mass [kg] and squeeze [N] for the displacement that reduces a load."""

MIN_CLOSURE_LOAD = 1e-4
"""Minimum load of a force-closed grasp [N/N]."""

MAX_LP_ITERATIONS, LP_GAP = 50, 1e-9
"""Maximum iterations of a linear program, and the mean complementarity x z at which it ends."""

PATCH_RADIUS = 0.005
"""Radius of a pad's contact patch [m].

The patch resists a torque of 2/3 mu `PATCH_RADIUS` per unit normal force about its normal (Coulomb
friction under uniform pressure).
"""


def friction_wrenches(
    points: Array,
    normals: Array,
    mu: float | Array,
    center: Array,
    length: float,
) -> Array:
    """Return the edges of the friction cones of soft fingers, as wrenches per unit normal force.

    Args:
        points: (k, c, 3) contacts [m].
        normals: (k, c, 3) unit, into the object.
        mu: Friction coefficient, or (k, c) coefficients by contact.
        center: (3,) reference point of torques [m].
        length: Length by which torques are divided [m].

    Returns:
        (k, 6, c * (EDGES + 2)) force and torque / length of each edge.
    """
    k, c = points.shape[:2]
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(normals, first)
    angle = 2 * np.pi * np.arange(EDGES) / EDGES
    tangents = first[..., None, :] * np.cos(angle)[:, None]
    tangents = tangents + second[..., None, :] * np.sin(angle)[:, None]
    normal = normals[..., None, :]
    friction = np.broadcast_to(mu, (k, c))[..., None, None]
    force = np.concatenate([normal + friction * tangents, normal, normal], axis=-2)
    torque = np.cross((points - center)[..., None, :], force) / length
    spin = 2 / 3 * friction[..., 0] * PATCH_RADIUS / length * normals
    torque[..., -2, :] += spin
    torque[..., -1, :] -= spin
    return np.concatenate([force, torque], axis=-1).reshape(k, c * (EDGES + 2), 6).swapaxes(1, 2)


def narrowed_friction(mu: float, normal_spread: Array) -> Array:
    """Return the friction coefficients of cones inside the cones about all normals of a contact.

    Args:
        mu: Friction coefficient.
        normal_spread: (...) maximum angle between the axis of the cone and these normals [rad].
    """
    coefficients: Array = np.tan(np.maximum(np.arctan(mu) - normal_spread, 1e-3))
    return coefficients


def loads(wrenches: Array, directions: Array = DIRECTIONS) -> Array:
    """Return the maximum s with -s d = W x, x >= 0, sum x <= 1: the load held by 1 N of squeeze.

    Args:
        wrenches: (k, 6, g) edges of the friction cones.
        directions: (d, 6) directions of the load.

    Returns:
        (k, d) loads [N/N]; 0 in directions in which the grasp holds no load.
    """
    return np.maximum(_solve_programs(wrenches, directions)[..., -2], 0.0)


def closure_load(wrenches: Array) -> Array:
    """Return (k,) loads in the direction of the mean of the wrenches (k, 6, g).

    The load is positive if and only if the grasp is force-closed: only then a combination of all
    wrenches with positive weights is zero. This test takes one linear program, `loads` twelve.
    """
    return np.maximum(_solve_programs(wrenches, wrenches.mean(axis=2)[:, None])[:, 0, -2], 0.0)


def loads_and_forces(wrenches: Array) -> tuple[Array, Array]:
    """Return the loads in `DIRECTIONS`, and the forces in balance that best resist any pull.

    The forces are the mean of those that hold the same load in each of six directions with the
    minimum squeeze. As these loads cancel, the object is at rest.

    Args:
        wrenches: (k, 6, c * (EDGES + 2)) from `friction_wrenches`.

    Returns:
        (k, 12) loads [N/N], and (k, c, 3) forces on the object, whose normal components sum to 1 N.
    """
    k, _, g = wrenches.shape
    programs = _solve_programs(wrenches, DIRECTIONS)
    pulls = programs[:, FORCES]
    shares = (pulls[..., :g] / np.maximum(pulls[..., g : g + 1], 1e-12)).sum(axis=1)
    shares /= shares.sum(axis=1, keepdims=True)
    forces = wrenches[:, :3] * shares[:, None]
    forces = forces.reshape(k, 3, g // (EDGES + 2), EDGES + 2).sum(axis=-1).swapaxes(1, 2)
    return np.maximum(programs[..., g], 0.0), forces


@dataclass(frozen=True)
class ComplianceParameters:
    """Compliance of a grasp. Source: study `touch_hold`.

    Attributes:
        motor_stiffness: Stiffness of revolute and of prismatic motors [N m/rad, N/m].
        halving_displacement: Displacement of the object that halves a load [m].
        halving_rotation: Rotation of the object that halves a load [rad].
        slip_rotation: Rotation at which the torsional friction of a pad saturates [rad].
        plane_radius: Radius of the ball that models a plane pad [m].
        contact_compliance: Compliance of a contact [m/N].
    """

    motor_stiffness: tuple[float, float] = (3.0, 2000.0)
    halving_displacement: float = 0.020
    halving_rotation: float = float(np.deg2rad(30.0))
    slip_rotation: float = float(np.deg2rad(3.0))
    plane_radius: float = 0.010
    contact_compliance: float = 2e-5


COMPLIANCE = ComplianceParameters()


@dataclass(frozen=True, eq=False)
class GraspStrengths:
    """Strength of k grasps of c contacts.

    Attributes:
        load: (k,) load held by friction in the worst of six directions, reduced by the
            displacement of the object [N/N].
        closure: (k,) load held in the worst of `DIRECTIONS` [N/N].
        forces: (k, c, 3) forces on the object at rest; their normal components sum to 1 N.
        max_squeeze: (k,) maximum squeeze within the efforts of the motors [N].
    """

    load: Array
    closure: Array
    forces: Array
    max_squeeze: Array

    def holds(self, hold: tuple[float, float] | None) -> Bools:
        """Return (k,) True for force-closed grasps that hold a mass [kg] with a squeeze [N]."""
        is_closed: Bools = self.closure > MIN_CLOSURE_LOAD
        if hold is None:
            return is_closed
        return is_closed & (self.load * np.minimum(hold[1], self.max_squeeze) >= hold[0] * GRAVITY)


def grasp_strengths(
    wrenches: Array,
    arms: Array,
    normals: Array,
    radii: Array,
    jacobians: Array,
    motors: Sequence[Actuator],
    mu: float,
    hold: tuple[float, float] | None,
) -> GraspStrengths:
    """Return the strength of grasps.

    Args:
        wrenches: (k, 6, c * (EDGES + 2)) from `friction_wrenches`.
        arms: (k, c, 3) contacts relative to the centre of the object [m].
        normals: (k, c, 3) unit, into the object.
        radii: (k, c) radii of pads [m]; 0 for planes.
        jacobians: (k, c, 3, m) derivatives of the contacts with respect to the motors.
        motors: The m motors.
        mu: Friction coefficient.
        hold: Mass [kg] and squeeze [N] for which the displacement is computed; None:
            `NOMINAL_HOLD`.
    """
    mass, squeeze = NOMINAL_HOLD if hold is None else hold
    direction_loads, forces = loads_and_forces(wrenches)
    torques = np.abs(np.einsum("kcim,kci->km", jacobians, forces))
    efforts = np.array([motor.effort for motor in motors])
    max_squeeze = (efforts / np.maximum(torques, 1e-12)).min(axis=1)
    springs = np.array([COMPLIANCE.motor_stiffness[motor.unit == "m"] for motor in motors])
    squeezing = np.minimum(squeeze, max_squeeze)[:, None, None] * forces
    stiffness = np.maximum(
        stiffnesses(arms, normals, squeezing, radii, jacobians, springs, mu), 0.0
    )
    # A displacement of `halving_displacement` under the weight halves the load.
    weight = mass * GRAVITY
    load = direction_loads[:, FORCES].min(axis=1)
    load = load * stiffness / (stiffness + weight / COMPLIANCE.halving_displacement)
    return GraspStrengths(load, direction_loads.min(axis=1), forces, max_squeeze)


def stiffnesses(
    arms: Array,
    normals: Array,
    forces: Array,
    radii: Array,
    jacobians: Array,
    springs: Array,
    mu: float,
) -> Array:
    """Return (k,) minimum stiffness of grasps to displacement and rotation of the object [N/m].

    Motors are springs, and pads are balls that roll on the object without sliding: as the object
    rotates, the contact moves, and the squeeze amplifies or opposes the rotation (Cutkosky and Kao
    1989, with flat faces and fingertips that do not rotate). With a negative stiffness the object
    rolls out of the hand.

    Args:
        arms: (k, c, 3) contacts relative to the centre of the object [m].
        normals: (k, c, 3) unit, into the object.
        forces: (k, c, 3) forces on the object at rest [N].
        radii: (k, c) radii of pads [m]; 0 for planes.
        jacobians: (k, c, 3, m) derivatives of the contacts with respect to the motors.
        springs: (m,) stiffness of motors [N m/rad or N/m].
        mu: Friction coefficient.
    """
    k, c, _, m = jacobians.shape
    # Rotations are scaled by this length, so that all entries of a stiffness are in N/m.
    length = COMPLIANCE.halving_displacement / COMPLIANCE.halving_rotation
    flexibility = (jacobians / springs).reshape(k, 3 * c, m)
    flexibility = flexibility @ jacobians.reshape(k, 3 * c, m).swapaxes(1, 2)
    flexibility += COMPLIANCE.contact_compliance * np.eye(3 * c)
    eye = np.broadcast_to(np.eye(3), (k, c, 3, 3))
    contact_motion = np.concatenate([eye, -cross_matrices(arms) / length], axis=-1)
    contact_motion = contact_motion.reshape(k, 3 * c, 6)
    stiffness = contact_motion.swapaxes(1, 2) @ np.linalg.solve(flexibility, contact_motion)
    pressure = np.maximum((forces * normals).sum(axis=-1), 0.0)
    torsion = 2 / 3 * mu * PATCH_RADIUS / COMPLIANCE.slip_rotation * pressure
    rotational = np.einsum("kc,kci,kcj->kij", torsion, normals, normals)
    # The contact moves by rotation x (arm + radius normal), and the force with it.
    centers = arms + np.where(radii > 0, radii, COMPLIANCE.plane_radius)[..., None] * normals
    rotational -= (cross_matrices(forces) @ cross_matrices(centers)).sum(axis=1)
    stiffness[:, 3:, 3:] += rotational / length**2
    symmetric = (stiffness + stiffness.swapaxes(1, 2)) / 2
    minimum: Array = np.linalg.eigvalsh(symmetric)[:, 0].astype(float)
    return minimum


def cross_matrices(vectors: Array) -> Array:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    return np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)


LoadJob = c_struct("load_job", driver="loads")

COLUMN_SIZE = 14 * 4
"""Number of scalars in a column of four concurrent linear programs (runtime/loads.c)."""


def _solve_programs(wrenches: Array, directions: Array) -> Array:
    """Return (k, d, g + 2) x, s and slack of the linear programs of `loads`.

    Args:
        wrenches: (k, 6, g) edges of the friction cones.
        directions: (d, 6) directions for all grasps, or (k, d, 6) directions by grasp.

    Raises:
        UnsupportedError: There is no compiler.
    """
    k, _, g = wrenches.shape
    d = directions.shape[-2]
    solutions = np.empty((k, d, g + 2))
    arrays = {
        "wrenches": np.ascontiguousarray(wrenches),
        "directions": np.ascontiguousarray(np.broadcast_to(directions, (k, d, 6))),
        "solutions": solutions,
        "work": np.empty((g + 2) * COLUMN_SIZE),
    }
    job = LoadJob(
        **{name: array.ctypes.data for name, array in arrays.items()},
        gap=LP_GAP,
        edges=g,
        n_directions=d,
        max_steps=MAX_LP_ITERATIONS,
        count=k * d,
        slice=SLICE,
    )
    run_cancellable("loads", _entry(), job)
    return solutions


@cache
def _entry() -> Any:
    return touch_library()["casadi_ik_loads"]
