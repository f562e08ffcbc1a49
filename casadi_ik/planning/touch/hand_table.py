"""Table of a hand: postures of its fingers, opposing pairs of fingertips, Jacobians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.collision.model import pair_table
from casadi_ik.collision.scene import Scene
from casadi_ik.compile.cancellation import SLICE, run_cancellable
from casadi_ik.compile.codegen import c_struct, define, driver_text
from casadi_ik.compile.function_kernel import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.errors import UnsupportedError, optional_import
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.se3 import skew
from casadi_ik.model.description import RobotDescription
from casadi_ik.planning.touch.hands import HandCandidates, touch_library
from casadi_ik.planning.touch.surface import NEIGHBOURS

BINS = 20
"""Number of bins of the compiled driver's statistics of collision-free trials."""


@dataclass(frozen=True)
class HandTableParameters:
    """Resolution of the table of a hand.

    Attributes:
        postures: Number of postures of each finger, for each value of the shared motors.
        shared: Number of values of the motors that several fingers share.
        facing: Two fingertips oppose each other if both normals are within this angle of the line
            between them [rad]; ball pads may exceed it by `roll`.
        roll: Additional lean permitted for a ball pad [rad].
        cell: Edge of a cell of distances [m].
        angle_cell: Edge of a cell of angles [rad].
        pairs: Maximum number of pairs.
    """

    postures: int = 512
    shared: int = 12
    facing: float = float(np.deg2rad(48.0))
    roll: float = float(np.deg2rad(25.0))
    cell: float = 4e-3
    angle_cell: float = float(np.deg2rad(12.0))
    pairs: int = 200_000


class HandTable:
    """Postures of a hand's fingers and the pairs among them that oppose each other.

    Attributes:
        robot: The robot.
        motors: Indices in q of the motors that move fingers.
        q: (s, n, m) positions of these motors, for s values of the shared ones.
        radii: (f,) radii of ball pads [m], 0 for planes.
        roll: (f,) additional lean permitted for each pad [rad]; 0 for planes.
        points: (s, n, f, 3) centres of ball pads, contact points of plane pads, palm frame [m].
        pairs: (p, 4) opposing pairs of thumb and another finger: index of the shared value,
            finger, posture of the thumb, posture of the finger.
        depths: (p,) distances between the midpoints of these pads and the palm frame [m].
        shapes: Capsules of the postures; None before the first call of `shape`.
        normals: (s, n, f, 3) outward pad normals in the palm frame.
    """

    def __init__(
        self, robot: ArmHand, seed: int = 0, parameters: HandTableParameters | None = None
    ) -> None:
        """Sample the postures (Sobol points) and sort the pairs by distance and angles."""
        self.parameters = parameters = parameters or HandTableParameters()
        description = robot.description
        if len(robot.fingers) < 2:
            raise UnsupportedError(
                f"robot {robot.name!r} has one finger, expected two or more that oppose each other"
            )
        self.robot = robot
        self.of_finger = {name: description.finger_actuators(name) for name in robot.fingers}
        users = [i for finger_motors in self.of_finger.values() for i in finger_motors]
        self.motors = np.array(sorted(set(users)), dtype=np.intp)
        shared = np.array([users.count(i) > 1 for i in self.motors])
        self.kernel = hand_kernel(description)
        self.thumb = robot.fingers.index(robot.thumb)
        self.shapes: HandShapes | None = None
        self.radii = np.array([description.finger(name).radius for name in robot.fingers])
        self.roll = np.where(self.radii > 0, parameters.roll, 0.0)
        self.palm = robot.palm(robot.home)
        # A gripper whose fingers share all motors has one posture for each value of these.
        count = 1 if shared.all() else parameters.postures
        values = parameters.postures if shared.all() else parameters.shared if shared.any() else 1
        lower, upper = robot.lower[self.motors], robot.upper[self.motors]
        self.q = np.tile(lower + _sobol(len(lower), count, seed) * (upper - lower), (values, 1, 1))
        if shared.any():
            common = _sobol(int(shared.sum()), values, seed + 1)
            self.q[:, :, shared] = (lower[shared] + common * (upper - lower)[shared])[:, None]
        points, normals, _, _ = self.pads(self.q.reshape(-1, len(self.motors)))
        shape = (values, count, len(robot.fingers), 3)
        self.points, self.normals = points.reshape(shape), normals.reshape(shape)
        self._sort_pairs()

    @classmethod
    def for_robot(cls, robot: ArmHand) -> HandTable:
        """Return the table of a robot, computed once per process."""
        if robot not in _TABLES:
            _TABLES[robot] = cls(robot)
        return _TABLES[robot]

    def copy_finger(self, hand: Array, rows: NDArray[np.intp], posture: Array, finger: int) -> None:
        """Copy the positions of a finger's motors from postures into rows of `hand`, in place."""
        finger_motors = self.of_finger[self.robot.fingers[finger]]
        columns = np.flatnonzero(np.isin(self.motors, finger_motors))
        hand[np.ix_(rows, columns)] = posture[:, columns]

    def opened(self, hands: HandCandidates, opening: float) -> HandCandidates:
        """Return hands whose fingertips are moved away from the object.

        Args:
            hands: Hands whose fingertips touch the object.
            opening: Distance from the object [m]; negative: into it.
        """
        hand = hands.hand
        lower, upper = self.robot.lower[self.motors], self.robot.upper[self.motors]
        for _ in range(4):
            _, normals, linear, _ = self.pads(hand)
            rows = (linear * hands.touches[..., None, None]).reshape(
                len(hand), -1, len(self.motors)
            )
            goal = (-0.25 * opening * normals * hands.touches[..., None]).reshape(len(hand), -1)
            square = rows.swapaxes(1, 2) @ rows + 1e-5 * np.eye(len(self.motors))
            step = np.linalg.solve(square, rows.swapaxes(1, 2) @ goal[..., None])[..., 0]
            hand = np.clip(hand + step, lower, upper)
        return replace(hands, hand=hand)

    def squeezed(
        self, hands: HandCandidates, contact_offsets: Array, forces: Array, penetration: float
    ) -> Array:
        """Return postures (k, m) in which motors of equal stiffness exert the forces.

        The motors advance in proportion to the torques of the forces.

        Args:
            hands: Hands whose fingertips touch the object.
            contact_offsets: (k, f, 3) contact points relative to the pad centres, palm frame [m].
            forces: (k, f, 3) forces on the object, palm frame; 0 for fingers without contact [N].
            penetration: Mean advance of the fingertips into the object [m].
        """
        _, _, linear, angular = self.pads(hands.hand)
        linear = linear + np.cross(angular, contact_offsets[..., None], axis=2)
        torque = np.einsum("kfim,kfi->km", linear, forces)
        advance = np.einsum("kfim,km,kfi->k", linear, torque, forces)
        advance /= np.linalg.norm(forces, axis=2).sum(axis=1)
        step = penetration / np.maximum(advance, 1e-9)[:, None] * torque
        lower, upper = self.robot.lower[self.motors], self.robot.upper[self.motors]
        return np.clip(hands.hand + step, lower, upper)

    def configuration(self, hands: Array) -> Array:
        """Return configurations (k, n) with postures (k, m) and the arm at home."""
        q = np.tile(self.robot.home, (len(hands), 1))
        q[:, self.motors] = hands
        return q

    def pads(self, hands: Array) -> tuple[Array, Array, Array, Array]:
        """Return the pads of postures (k, m) and their Jacobians, in the palm frame.

        Returns:
            Centres of ball pads or contact points of plane pads (k, f, 3) [m], outward normals
            (k, f, 3), and Jacobians (k, f, 3, m) of these points and of the rotations with respect
            to the fingers' motors.
        """
        f, m = len(self.robot.fingers), len(self.motors)
        flat = self.kernel(self.configuration(hands))
        points, normals = (values.reshape(-1, f, 3) for values in flat[:2])
        linear, angular = (values.reshape(-1, f, 3, m) for values in flat[2:])
        return points, normals, linear, angular

    def _sort_pairs(self) -> None:
        """Find pairs of postures of the thumb and another finger that oppose each other."""
        robot, parameters = self.robot, self.parameters
        thumb = self.thumb
        pair_blocks, keys = [], []
        min_cosines = np.cos(parameters.facing + self.roll)
        for share in range(len(self.q)):
            a, n = self.points[share, :, thumb], self.normals[share, :, thumb]
            for finger in range(len(robot.fingers)):
                if finger == thumb:
                    continue
                b, o = self.points[share, :, finger], self.normals[share, :, finger]
                direction = b[None] - a[:, None]
                length = np.linalg.norm(direction, axis=-1)
                direction /= np.maximum(length, 1e-9)[..., None]
                first = np.einsum("ijk,ik->ij", direction, n)
                second = -np.einsum("ijk,jk->ij", direction, o)
                i, j = np.nonzero((first > min_cosines[thumb]) & (second > min_cosines[finger]))
                pair_blocks.append(
                    np.stack([np.full(len(i), share), np.full(len(i), finger), i, j], axis=1)
                )
                keys.append(self.key(length[i, j], first[i, j], second[i, j]))
        pairs, key = np.concatenate(pair_blocks), np.concatenate(keys)
        if len(pairs) > parameters.pairs:
            sample = np.random.default_rng(0).choice(len(pairs), parameters.pairs, replace=False)
            pairs, key = pairs[sample], key[sample]
        order = np.argsort(key, kind="stable")
        self.pairs, self._keys = pairs[order], key[order]
        share, finger, a, b = self.pairs.T
        middles = (self.points[share, a, thumb] + self.points[share, b, finger]) / 2
        self.depths = np.linalg.norm(middles, axis=1)

    def shape(self, check: SceneCheck) -> HandShapes:
        """Return the capsules of the postures; the first call also removes pairs that collide."""
        if self.shapes is None:
            self.shapes = shapes = HandShapes.for_table(self, check)
            share, finger, a, b = self.pairs.T
            word = shapes.separate[share, self.thumb, finger, a, b // 64]
            is_clear = shapes.is_clear[share, a, self.thumb] & shapes.is_clear[share, b, finger]
            is_valid = is_clear & ((word >> (b % 64).astype(np.uint64)) & 1).astype(bool)
            self.pairs, self._keys, self.depths = (
                np.ascontiguousarray(column[is_valid])
                for column in (self.pairs, self._keys, self.depths)
            )
        return self.shapes

    def key(self, length: Array, first: Array, second: Array) -> NDArray[np.int64]:
        """Return the cells of pairs.

        Args:
            length: Distances between the two points [m].
            first: Cosines between the first normal and the line through the points.
            second: Cosines between the second normal and that line.
        """
        parameters = self.parameters
        angle_cells = [
            np.minimum(np.arccos(np.clip(c, -1, 1)) / parameters.angle_cell, 99).astype(np.int64)
            for c in (first, second)
        ]
        return (
            (length / parameters.cell).astype(np.int64) * 100 + angle_cells[0]
        ) * 100 + angle_cells[1]

    def cells(self, key: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the first pair of each cell and the number of its pairs."""
        first = np.searchsorted(self._keys, key, "left")
        return first, np.searchsorted(self._keys, key, "right") - first


@dataclass(frozen=True, eq=False)
class HandShapes:
    """Capsules of a hand in the postures of its table, in the palm frame, fingers first.

    Attributes:
        links: (c + d,) link of each capsule.
        numbers: (c + d,) index of each capsule in the robot's collision model.
        capsules: (s, n, c, 6) start of each finger segment and vector to its end [m].
        fixed: (d, 6) start and vector of the segments of the palm [m].
        lengths: (c + d,) lengths of the segments [m].
        first: (f + 1,) first capsule of each finger.
        pads: (c,) 1 for capsules that may touch the object.
        is_clear: (s, n, f) True for fingers that collide neither with themselves nor with the palm.
        separate: (s, f, f, n, words) bit set of the collision-free postures of the second finger
            that do not collide with a posture of the first.
        crossing: (x, 4) pairs of capsules of two fingers that must not collide: finger, capsule,
            finger, capsule.
        min_distances: (x,) minimum distances between the segments of these pairs [m].
    """

    links: tuple[str, ...]
    numbers: NDArray[np.intp]
    capsules: Array
    fixed: Array
    lengths: Array
    first: NDArray[np.int64]
    pads: NDArray[np.int64]
    is_clear: Bools
    separate: NDArray[np.uint64]
    crossing: NDArray[np.int64]
    min_distances: Array

    @classmethod
    def for_table(cls, table: HandTable, check: SceneCheck) -> HandShapes:
        """Compute the capsules, and which postures of two fingers do not collide.

        Args:
            table: Table of the hand.
            check: Collision check of the robot; its scene is not used.
        """
        model, robot = check.model, table.robot
        (s, n, _), f = table.q.shape, len(robot.fingers)
        owner = [_finger_of(table, link) for link in model.links]
        ignored_links = {
            link for link in model.links if link in model.moving or model.is_fixed(link)
        }
        finger_capsules = [[i for i, k in enumerate(owner) if k == finger] for finger in range(f)]
        palm_capsules = [
            i for i, k in enumerate(owner) if k is None and model.links[i] not in ignored_links
        ]
        numbers = np.concatenate([*finger_capsules, palm_capsules]).astype(np.intp)
        count = len(numbers) - len(palm_capsules)
        q = table.configuration(table.q.reshape(s * n, -1))
        (capsule_poses,) = check.kernel.shape_poses(q)
        segments = capsule_poses.reshape(s * n, -1)[:, : 6 * len(owner)].reshape(s * n, -1, 6)[
            :, numbers
        ]
        rotation, middle, half_segment = table.palm[:3, :3], segments[..., :3], segments[..., 3:]
        start = (middle - half_segment - table.palm[:3, 3]) @ rotation
        palm_segments = np.concatenate([start, 2 * half_segment @ rotation], axis=-1)
        links = tuple(model.links[i] for i in numbers)
        first = np.cumsum([0, *map(len, finger_capsules)])
        self_pairs = pair_table(model, Scene(), ())
        pads = [
            links[i] in check.finger_bodies[robot.fingers[k]]
            for k in range(f)
            for i in range(first[k], first[k + 1])
        ]
        fingers = np.array(
            [-1 if k is None else k for k in owner] + [-1] * self_pairs.n_robot_solids
        )
        pairs, is_relevant = fingers[self_pairs.pairs], np.isin(self_pairs.pairs[:, 0], numbers)
        is_relevant &= np.isin(self_pairs.pairs[:, 1], numbers) | (
            self_pairs.pairs[:, 1] >= len(owner)
        )
        joins_fingers = is_relevant & (pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])
        single_finger_pairs = self_pairs.select(is_relevant & ~joins_fingers)
        clear = check.kernel.all_distances(q, np.zeros((0, 12)), single_finger_pairs) >= 0
        is_clear = np.stack(
            [
                clear[:, (fingers[single_finger_pairs.pairs] == k).any(axis=1)].all(axis=1)
                for k in range(f)
            ],
            1,
        ).reshape(s, n, f)
        position_of = np.zeros(len(fingers), dtype=np.int64)
        position_of[numbers] = range(len(numbers))
        a, b = self_pairs.pairs[joins_fingers].T
        words = -(-n // 64)
        padded = np.zeros((s, f, 64 * words), dtype=bool)
        padded[..., :n] = is_clear.swapaxes(1, 2)
        bits = np.packbits(padded, axis=-1, bitorder="little").view(np.uint64)
        hand_shapes = cls(
            links,
            numbers,
            np.ascontiguousarray(palm_segments[:, :count].reshape(s, n, count, 6)),
            np.ascontiguousarray(palm_segments[0, count:]),
            2 * model.half_lengths[numbers],
            first,
            np.array(pads, dtype=np.int64),
            is_clear,
            np.tile(bits[:, None, :, None], (1, f, 1, n, 1)),
            np.ascontiguousarray(
                np.stack([fingers[a], position_of[a], fingers[b], position_of[b]], axis=1)
            ),
            model.radii[a] + model.radii[b] + self_pairs.offsets[joins_fingers],
        )
        run_cancellable("touch", touch_library()["casadi_ik_apart"], TouchJob(**hand_shapes.job))
        return hand_shapes

    @property
    def job(self) -> dict[str, Any]:
        """Fields of a `TouchJob` that describe the hand."""
        s, n, c, _ = self.capsules.shape
        arrays = {
            "capsules": self.capsules,
            "palm_capsules": self.fixed,
            "lengths": self.lengths,
            "first": self.first,
            "may_touch": self.pads,
            "separate": self.separate,
            "crossing": self.crossing,
            "min_distances": self.min_distances,
        }
        return {name: array.ctypes.data for name, array in arrays.items()} | {
            "shares": s,
            "postures": n,
            "words": self.separate.shape[-1],
            "n_fingers": self.separate.shape[1],
            "n_capsules": c,
            "n_palm_capsules": len(self.fixed),
            "n_crossing": len(self.crossing),
            "slice": SLICE,
        }


def _finger_of(table: HandTable, link: str) -> int | None:
    """Return the index of the finger that has or moves a link; None if there is none."""
    robot = table.robot.description
    joints = {joint.name for joint in robot.chain(link)}
    n_common = [len(joints.intersection(finger.joints)) for finger in robot.fingers]
    if max(n_common):
        return int(np.argmax(n_common))
    motors = robot.links_moved
    moving_fingers = [name for name in robot.finger_names if link in motors(table.of_finger[name])]
    return robot.finger_names.index(moving_fingers[0]) if moving_fingers else None


TouchJob = c_struct("touch_job", {"3": 3, "4": 4, "BINS": BINS}, "touch")
SnapJob = c_struct("snap_job", driver="snap")


_TABLES: WeakKeyDictionary[ArmHand, HandTable] = WeakKeyDictionary()


def hand_kernel(robot: RobotDescription) -> FunctionKernel:
    """Return the kernel of pads in the palm frame and their Jacobians by the fingers' motors."""
    motors = sorted({i for name in robot.finger_names for i in robot.finger_actuators(name)})
    f, m, n = len(robot.finger_names), len(motors), len(robot.actuators)
    name = ca.Function.fix_name(f"{robot.name}_hand_contacts")

    def build() -> ca.Function:
        q = ca.SX.sym("q", n)
        moving = actuated(robot, q)
        palm = moving.kinematics.palm
        rows: list[list[ca.SX]] = [[], [], [], []]
        for finger in robot.finger_names:
            point, normal = moving.kinematics.contact(finger)
            linear, angular = moving.contact_jacobian(finger, motors)
            # The centre of a ball pad is a radius behind the contact point.
            offset = robot.finger(finger).radius * normal
            linear = linear + skew(offset) @ angular
            rows[0].append(palm.inverse_apply(point - offset).T)
            rows[1].append((palm.rotation.T @ normal).T)
            rows[2].append(palm.rotation.T @ linear)
            rows[3].append(palm.rotation.T @ angular)
        outputs = [ca.densify(ca.vertcat(*blocks)) for blocks in rows]
        return ca.Function(name, [q], outputs, ["q"], ["points", "normals", "linear", "angular"])

    shapes = ((f, 3), (f, 3), (3 * f, m), (3 * f, m))
    graph = FunctionGraph(name, build, {"q": (n, 1)}, shapes, recipe(name, robot))
    sizes = {"N_Q": n, "N_F": f, "N_M": m, "NEIGHBOURS": NEIGHBOURS}
    return FunctionKernel(graph, driver=define(sizes) + driver_text("snap"))


def _sobol(dimensions: int, count: int, seed: int) -> Array:
    """Return scrambled Sobol points (count, dimensions) in [0, 1]."""
    power = int(np.ceil(np.log2(max(count, 2))))
    with optional_import("grasp synthesis"):
        qmc: Any = import_module("scipy.stats").qmc
    return qmc.Sobol(dimensions, rng=seed).random_base2(power)[:count]


def rigid_transforms(rotation: Array, origin: Array) -> Array:
    """Return poses (..., 4, 4) from rotations (..., 3, 3) and origins (..., 3)."""
    pose = np.zeros((*origin.shape[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, origin, 1.0
    return pose
