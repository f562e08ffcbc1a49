"""What a hand's fingertips can do by themselves: postures, opposing pairs, Jacobians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.kernels.function_kernel import FunctionKernel
from casadi_ik.kernels.graphs import FunctionGraph, recipe
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import actuated

if TYPE_CHECKING:
    from casadi_ik.touch.candidates import Candidates


@dataclass(frozen=True)
class HandTableParameters:
    """How finely a hand is looked at.

    Attributes:
        postures: Of each finger, for each value of the motors that it shares with others.
        shared: Values of the motors that fingers share.
        facing: Two fingertips oppose each other if both normals are within this angle of the line
            between them [rad].
        cell: Edge of a cell of distances [m].
        turn: Edge of a cell of angles [rad].
        pairs: Most pairs that are kept.
    """

    postures: int = 512
    shared: int = 12
    facing: float = float(np.deg2rad(48.0))
    cell: float = 4e-3
    turn: float = float(np.deg2rad(12.0))
    pairs: int = 2_000_000


class HandTable:
    """Postures of a hand's fingers and the pairs among them that oppose each other.

    Attributes:
        robot: The robot.
        motors: Positions in q of the motors that move fingers.
        q: (s, n, m) positions of these motors, for s values of the shared ones.
        tips: By finger (s, n, 3) contact points in the palm frame [m].
        normals: By finger (s, n, 3) outward pad normals in the palm frame.
    """

    def __init__(
        self, robot: ArmHand, seed: int = 0, parameters: HandTableParameters | None = None
    ) -> None:
        """Draw the postures (Sobol' points) and sort the pairs by distance and angles."""
        self.parameters = chosen = parameters or HandTableParameters()
        description = robot.description
        if len(robot.fingers) < 2:
            raise UnsupportedError(
                f"robot {robot.name!r} has one finger, expected two or more that oppose each other"
            )
        self.robot = robot
        self.of_finger = {name: description.finger_actuators(name) for name in robot.fingers}
        users = [i for own in self.of_finger.values() for i in own]
        self.motors = np.array(sorted(set(users)), dtype=np.intp)
        shared = np.array([users.count(i) > 1 for i in self.motors])
        self.kernel = hand_kernel(description)
        self.palm = robot.palm(robot.home)
        # Where fingers share all motors (a gripper) a posture is a value of these.
        count = 1 if shared.all() else chosen.postures
        values = chosen.postures if shared.all() else chosen.shared if shared.any() else 1
        lower, upper = robot.lower[self.motors], robot.upper[self.motors]
        self.q = np.tile(lower + _sobol(len(lower), count, seed) * (upper - lower), (values, 1, 1))
        if shared.any():
            common = _sobol(int(shared.sum()), values, seed + 1)
            self.q[:, :, shared] = (lower[shared] + common * (upper - lower)[shared])[:, None]
        points, normals, _, _ = self.at(self.q.reshape(-1, len(self.motors)))
        shape = (values, count, len(robot.fingers), 3)
        self.points, self.normals = points.reshape(shape), normals.reshape(shape)
        self._sort_pairs()

    @classmethod
    def of(cls, robot: ArmHand) -> HandTable:
        """The table of a robot, made once per process."""
        if robot not in _TABLES:
            _TABLES[robot] = cls(robot)
        return _TABLES[robot]

    def opened(self, some: Candidates, opening: float) -> Candidates:
        """The same palms with fingertips moved back from what they touch [m]; negative: into it."""
        hand = some.hand
        lower, upper = self.robot.lower[self.motors], self.robot.upper[self.motors]
        for _ in range(4):
            _, normals, linear, _ = self.at(hand)
            rows = (linear * some.used[..., None, None]).reshape(len(hand), -1, len(self.motors))
            goal = (-0.25 * opening * normals * some.used[..., None]).reshape(len(hand), -1)
            square = rows.swapaxes(1, 2) @ rows + 1e-5 * np.eye(len(self.motors))
            step = np.linalg.solve(square, rows.swapaxes(1, 2) @ goal[..., None])[..., 0]
            hand = np.clip(hand + step, lower, upper)
        return replace(some, hand=hand)

    def squeezed(self, one: Candidates, forces: Array, inward: float) -> Array:
        """(m,) a hand whose motors go on in proportion to the torques of forces.

        So do motors that are held by equal springs: sent there, they exert these forces.

        Args:
            one: The hand as it touches.
            forces: (c, 3) of those fingertips on the object, palm frame.
            inward: How far fingertips would go, in the mean [m].
        """
        _, _, linear, _ = self.at(one.hand)
        rows = linear[0, one.used[0]]
        torque = np.einsum("cim,ci->m", rows, forces)
        size = np.linalg.norm(forces, axis=1)
        along = np.einsum("cim,m,ci->c", rows, torque, forces) / np.maximum(size, 1e-9)
        step = inward / max(float(along @ size / size.sum()), 1e-9) * torque
        lower, upper = self.robot.lower[self.motors], self.robot.upper[self.motors]
        return np.clip(one.hand[0] + step, lower, upper)

    def configuration(self, hands: Array) -> Array:
        """(k, n) configurations with hands (k, m), the arm at home."""
        q = np.tile(self.robot.home, (len(hands), 1))
        q[:, self.motors] = hands
        return q

    def at(self, hands: Array) -> tuple[Array, Array, Array, Array]:
        """Contacts of hands (k, m) in the palm frame.

        Returns:
            Points (k, f, 3) [m], outward normals (k, f, 3), and Jacobians (k, f, 3, m) of points
            and of rotations over the fingers' motors.
        """
        f, m = len(self.robot.fingers), len(self.motors)
        flat = self.kernel(self.configuration(hands))
        points, normals = (part.reshape(-1, f, 3) for part in flat[:2])
        linear, angular = (part.reshape(-1, f, 3, m) for part in flat[2:])
        return points, normals, linear, angular

    def _sort_pairs(self) -> None:
        """Pairs of a posture of the thumb and one of another finger that oppose each other."""
        robot, chosen = self.robot, self.parameters
        thumb = robot.fingers.index(robot.thumb)
        found, keys = [], []
        least = np.cos(chosen.facing)
        for share in range(len(self.q)):
            a, n = self.points[share, :, thumb], self.normals[share, :, thumb]
            for other in range(len(robot.fingers)):
                if other == thumb:
                    continue
                b, o = self.points[share, :, other], self.normals[share, :, other]
                way = b[None] - a[:, None]
                length = np.linalg.norm(way, axis=-1)
                way /= np.maximum(length, 1e-9)[..., None]
                first = np.einsum("ijk,ik->ij", way, n)
                second = -np.einsum("ijk,jk->ij", way, o)
                i, j = np.nonzero((first > least) & (second > least))
                found.append(
                    np.stack([np.full(len(i), share), np.full(len(i), other), i, j], axis=1)
                )
                keys.append(self.key(length[i, j], first[i, j], second[i, j]))
        pairs, key = np.concatenate(found), np.concatenate(keys)
        if len(pairs) > chosen.pairs:
            kept = np.random.default_rng(0).choice(len(pairs), chosen.pairs, replace=False)
            pairs, key = pairs[kept], key[kept]
        order = np.argsort(key, kind="stable")
        self.pairs, self._keys = pairs[order], key[order]

    def key(self, length: Array, first: Array, second: Array) -> NDArray[np.int64]:
        """Cells of pairs: distance [m] and the cosines of both normals with the line."""
        chosen = self.parameters
        turns = [
            np.minimum(np.arccos(np.clip(c, -1, 1)) / chosen.turn, 99).astype(np.int64)
            for c in (first, second)
        ]
        return ((length / chosen.cell).astype(np.int64) * 100 + turns[0]) * 100 + turns[1]

    def cells(self, key: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First pair of cells and how many there are."""
        first = np.searchsorted(self._keys, key, "left")
        return first, np.searchsorted(self._keys, key, "right") - first


_TABLES: WeakKeyDictionary[ArmHand, HandTable] = WeakKeyDictionary()


def hand_kernel(robot: RobotDescription) -> FunctionKernel:
    """Contacts and their Jacobians over the fingers' motors, in the palm frame, of q."""
    motors = sorted({i for name in robot.finger_names for i in robot.finger_actuators(name)})
    f, m, n = len(robot.finger_names), len(motors), len(robot.actuators)
    name = ca.Function.fix_name(f"{robot.name}_hand_contacts")

    def build() -> ca.Function:
        q = ca.SX.sym("q", n)
        moving = actuated(robot, q)
        palm = moving.kinematics.palm
        parts: list[list[ca.SX]] = [[], [], [], []]
        for finger in robot.finger_names:
            point, normal = moving.kinematics.contact(finger)
            linear, angular = moving.contact_jacobian(finger, motors)
            parts[0].append(palm.inverse_apply(point).T)
            parts[1].append((palm.rotation.T @ normal).T)
            parts[2].append(palm.rotation.T @ linear)
            parts[3].append(palm.rotation.T @ angular)
        outputs = [ca.densify(ca.vertcat(*part)) for part in parts]
        return ca.Function(name, [q], outputs, ["q"], ["points", "normals", "linear", "angular"])

    shapes = ((f, 3), (f, 3), (3 * f, m), (3 * f, m))
    return FunctionKernel(FunctionGraph(name, build, {"q": (n, 1)}, shapes, recipe(name, robot)))


def _sobol(dimensions: int, count: int, seed: int) -> Array:
    """(count, dimensions) points of [0, 1]."""
    power = int(np.ceil(np.log2(max(count, 2))))
    qmc: Any = import_module("scipy.stats").qmc
    return qmc.Sobol(dimensions, rng=seed).random_base2(power)[:count]


def rigid(rotation: Array, origin: Array) -> Array:
    """(k, 4, 4) poses."""
    pose = np.zeros((*origin.shape[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, origin, 1.0
    return pose
