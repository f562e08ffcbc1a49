"""Strength of grasps, many at once, and their robustness to errors of the object's pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import SLICE, run_cancellable
from casadi_ik.compile.codegen import c_struct
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.joints import Actuator
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.candidates import Candidates
from casadi_ik.planning.touch.hand_table import HandTable
from casadi_ik.planning.touch.library import touch_library
from casadi_ik.planning.touch.surface import Surface

if TYPE_CHECKING:
    from casadi_ik.planning.touch.grasps import FoundGrasp

EDGES = 8
"""Edges of the pyramid inscribed in a friction cone."""

DIRECTIONS = np.concatenate([np.eye(6), -np.eye(6)])
"""(12, 6) wrenches: forces along and torques about the axes, in both directions."""

FORCES = [0, 1, 2, 6, 7, 8]
"""Rows of `DIRECTIONS` that are forces."""

GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""

USUAL = (0.2, 18.0)
"""Default mass [kg] and squeeze [N] of the displacement that reduces a load."""

CLOSED = 1e-4
"""Load from which a grasp counts as force-closed [N/N]."""

STEPS, ENOUGH = 50, 1e-9
"""Maximum iterations of a linear program, and the mean of x z below which it ends."""


def generators(
    points: Array,
    normals: Array,
    mu: float | Array,
    center: Array,
    length: float,
    patch: float = 0.005,
) -> Array:
    """Return wrenches of soft fingers with a normal force of 1: the edges of the friction cones.

    Args:
        points: (k, c, 3) contacts [m].
        normals: (k, c, 3) unit, into the object.
        mu: Friction coefficient, or (k, c) of each contact.
        center: (3,) reference point of torques [m].
        length: Length by which torques are divided [m].
        patch: Radius of a pad's contact patch [m]: it resists a torque of 2/3 mu patch about its
            normal (Coulomb friction under even pressure).

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
    friction = np.broadcast_to(mu, (k, c))[..., None, None]
    force = np.concatenate([normal + friction * along, normal, normal], axis=-2)
    torque = np.cross((points - center)[..., None, :], force) / length
    spin = 2 / 3 * friction[..., 0] * patch / length * normals
    torque[..., -2, :] += spin
    torque[..., -1, :] -= spin
    return np.concatenate([force, torque], axis=-1).reshape(k, c * (EDGES + 2), 6).swapaxes(1, 2)


def narrowed(mu: float, spread: Array) -> Array:
    """Return friction coefficients of cones that lie within those about all normals of a contact.

    Args:
        mu: Friction coefficient.
        spread: (...) largest angle between the axis of the cone and these normals [rad].
    """
    coefficients: Array = np.tan(np.maximum(np.arctan(mu) - spread, 1e-3))
    return coefficients


def loads(wrenches: Array, directions: Array = DIRECTIONS) -> Array:
    """Return the largest s with -s d = W x, x >= 0, sum x <= 1: the load held by 1 N of squeeze.

    Args:
        wrenches: (k, 6, g) edges of the friction cones.
        directions: (d, 6) directions of the load.

    Returns:
        (k, d) loads [N per N]; 0 for directions in which nothing is held.
    """
    return np.maximum(_solved(wrenches, directions)[..., -2], 0.0)


def closed(wrenches: Array) -> Array:
    """Return (k,) loads against the mean of the wrenches (k, 6, g), above 0 for force closure.

    Only with force closure can all wrenches have positive weights and be in balance. This takes
    one linear program; `loads` takes twelve.
    """
    return np.maximum(_solved(wrenches, wrenches.mean(axis=2)[:, None])[:, 0, -2], 0.0)


def loads_and_squeezes(wrenches: Array) -> tuple[Array, Array]:
    """Return the loads of `DIRECTIONS`, and balanced forces that best resist any pull.

    The forces are the mean of those that hold the same load in six directions with the least
    squeeze: as these loads cancel, the object is at rest.

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
    """Compliance of a grasp; values of the study `touch_hold`.

    Attributes:
        springs: Stiffness of revolute and of prismatic motors [N m/rad, N/m].
        far: Displacement of the object that halves a load [m].
        turned: Rotation of the object that halves a load [rad].
        spin: Rotation at which the torsional friction of a pad is used up [rad].
        flat: Radius of the ball by which a plane pad is modelled [m].
        contact: Compliance of a contact [m/N].
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
    """Strength of k grasps of c contacts.

    Attributes:
        load: (k,) load held in the worst of six directions by friction, reduced by the object's
            displacement [N/N].
        closure: (k,) load held in the worst of `DIRECTIONS` [N/N].
        forces: (k, c, 3) forces on the object at rest; their normal components sum to 1 N.
        most: (k,) largest squeeze for which the efforts of the motors suffice [N].
    """

    load: Array
    closure: Array
    forces: Array
    most: Array

    def hold(self, hold: tuple[float, float] | None) -> Bools:
        """Return (k,) True for force-closed grasps that hold a mass [kg] with a squeeze [N]."""
        is_held: Bools = self.closure > CLOSED
        if hold is None:
            return is_held
        return is_held & (self.load * np.minimum(hold[1], self.most) >= hold[0] * GRAVITY)


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
    """Return the strength of grasps that hold a mass [kg] with a squeeze [N] (None: `USUAL`).

    Args:
        wrenches: (k, 6, c * (EDGES + 2)) from `generators`.
        arms: (k, c, 3) contacts from the centre of the object [m].
        normals: (k, c, 3) unit, into the object.
        radii: (k, c) radii of pads [m]; 0 for planes.
        jacobians: (k, c, 3, m) derivatives of contacts by motors.
        motors: The m motors.
        mu: Friction coefficient.
        hold: Mass [kg] and squeeze [N] for which the displacement is computed.
    """
    mass, squeeze = USUAL if hold is None else hold
    direction_loads, forces = loads_and_squeezes(wrenches)
    torques = np.abs(np.einsum("kcim,kci->km", jacobians, forces))
    efforts = np.array([motor.effort for motor in motors])
    most = (efforts / np.maximum(torques, 1e-12)).min(axis=1)
    springs = np.array([GIVE.springs[motor.unit == "m"] for motor in motors])
    pressed = np.minimum(squeeze, most)[:, None, None] * forces
    stiff = np.maximum(stiffnesses(arms, normals, pressed, radii, jacobians, springs, mu), 0.0)
    # The displacement is a share of the one that halves the load.
    load = direction_loads[:, FORCES].min(axis=1) * stiff / (stiff + mass * GRAVITY / GIVE.far)
    return Strengths(load, direction_loads.min(axis=1), forces, most)


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
    """Return the least stiffness of grasps (k,) [N/m] to displacement and rotation of the object.

    Motors are springs, and pads are balls that roll on the object without sliding: as it rotates,
    the contact moves, and the squeeze rotates it further or back (Cutkosky and Kao 1989, with flat
    faces and fingertips that do not rotate). Below 0 the object rolls out of the hand.

    Args:
        arms: (k, c, 3) contacts from the middle of the object [m].
        normals: (k, c, 3) unit, into the object.
        forces: (k, c, 3) on the object at rest [N].
        radii: (k, c) of pads [m]; 0 of planes.
        jacobians: (k, c, 3, m) of contacts over motors.
        springs: (m,) stiffness of motors [N m/rad or N/m].
        mu: Friction coefficient.
        patch: Radius of a contact patch [m].
        give: Compliance of contacts.
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
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    return np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)


LoadJob = c_struct("load_job", driver="touch")

COLUMN = 14 * 4
"""Numbers of a column that four programs work on (runtime/touch.c)."""


def _solved(wrenches: Array, directions: Array) -> Array:
    """Return (k, d, g + 2) x, s and slack of the linear programs of `loads`, by compiled code.

    Directions are common to all grasps, (d, 6), or specific to each, (k, d, 6).

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
    run_cancellable("loads", _entry(), job)
    return solved


@cache
def _entry() -> Any:
    return touch_library()["casadi_ik_loads"]


OPEN, FAR, PLACES = 0.020, 0.020, 33
"""Travel of fingertips before and beyond their contacts [m], and number of positions on it."""

STEEP = float(np.deg2rad(45.0))
"""A plane pad that leans more does not touch with its face [rad]."""


def robustness(
    robot: ArmHand,
    surface: Surface,
    entry: FoundGrasp,
    mu: float,
    offsets: Array,
    hold: tuple[float, float] | None = None,
) -> float:
    """Return the share of displacements of the object at which the hand still closes on it.

    The palm is where it was planned, and the fingers of the grasp close from 20 mm before their
    contacts, each until it touches or is 20 mm beyond. The hand closes if the resulting contacts
    resist any small force and torque. Fingers that share a motor are treated independently.

    Args:
        robot: The robot.
        surface: Surface of the object.
        entry: The grasp.
        mu: Friction coefficient.
        offsets: (k, 4, 4) displacements of the object, in its frame.
        hold: Mass [kg] that the contacts have to hold, and the squeeze [N]; None: they have to be
            force-closed.
    """
    table, pose = HandTable.of(robot), entry.grasp.known_pose
    assert pose is not None
    palm = inverse(pose) @ robot.palm(entry.q)
    hand = entry.q[table.motors][None]
    used = np.array([[name in entry.grasp.contacts for name in robot.fingers]])
    hands = Candidates(palm[None], hand, used)
    path = np.concatenate(
        [table.opened(hands, float(back)).hand for back in np.linspace(OPEN, -FAR, PLACES)]
    )
    points, normals, linear, angular = table.at(path)
    touching = np.flatnonzero(used[0])
    # (s, c, 3, m) in the planned frame of the object.
    linear, angular = (palm[:3, :3] @ part[:, touching] for part in (linear, angular))
    motors = [robot.description.actuators[i] for i in table.motors]
    # (s, c, 3) in the planned frame of the object, then (k, s, c, 3) in the displaced ones.
    points = points[:, touching] @ palm[:3, :3].T + palm[:3, 3]
    normals = normals[:, touching] @ palm[:3, :3].T
    inverse_offsets = np.linalg.inv(offsets)
    tips = np.einsum("kij,scj->ksci", inverse_offsets[:, :3, :3], points)
    tips += inverse_offsets[:, None, None, :3, 3]
    faces = np.einsum("kij,scj->ksci", inverse_offsets[:, :3, :3], normals)
    height = surface.foot(tips)[0] - table.radii[touching]
    within = height <= 0
    first = within.argmax(axis=1)  # (k, c)
    touches = within.any(axis=1) & (first > 0)
    # The position before the contact or the one after it, whichever is nearer to the surface.
    previous = np.maximum(first - 1, 0)
    nearer = np.abs(_at(height, previous)) < np.abs(_at(height, first))
    position = np.where(nearer, previous, first)
    contacts = surface.nearest(_at(tips, position))
    inward = -contacts.normal
    lean = np.arccos(np.clip((_at(faces, position) * inward).sum(axis=-1), -1, 1))
    touches &= lean < STEEP + table.roll[touching]
    is_closed = np.zeros(len(offsets), dtype=bool)
    for row_of in np.unique(touches, axis=0):
        rows = np.flatnonzero((touches == row_of).all(axis=1))
        if row_of.sum() < 2:
            continue
        at, fingers = position[rows][:, row_of], np.flatnonzero(row_of)
        points, normals = (part[rows][:, row_of] for part in (contacts.point, inward))
        friction = narrowed(mu, contacts.spread[rows][:, row_of])
        radii = np.broadcast_to(table.radii[touching[fingers]], at.shape)
        rotations = inverse_offsets[rows, None, :3, :3]
        jacobians = rotations @ linear[at, fingers]
        jacobians += np.cross(
            rotations @ angular[at, fingers], (radii[..., None] * normals)[..., None], axis=2
        )
        length = surface.size / 2
        strength = strengths(
            generators(points, normals, friction, surface.middle, length),
            points - surface.middle,
            normals,
            radii,
            jacobians,
            motors,
            mu,
            hold,
        )
        is_closed[rows] = strength.hold(hold)
    return float(is_closed.mean())


def _at(values: NDArray[Any], places: NDArray[np.intp]) -> NDArray[Any]:
    """Return values (k, s, c, ...) at positions (k, c) of the second axis, (k, c, ...)."""
    k, c = places.shape
    return values[np.arange(k)[:, None], places, np.arange(c)]


def offsets(position: float, angle: float, samples: int, seed: int, middle: Array) -> Array:
    """Return (k, 4, 4) displacements by a distance [m] and an angle [rad] in random directions.

    Args:
        position: Distance [m].
        angle: Angle of the rotation about the centre of the object [rad].
        samples: Number of displacements, k.
        seed: Seed of the directions.
        middle: (3,) centre of the object [m].
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
