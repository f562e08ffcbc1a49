"""A pinch by the fingertips of any hand: posture and object pose that make all contacts exact.

A nonlinear programme. Unknowns: the motors of the fingers that touch, the object's pose in the
hand, the surface coordinates of the contacts, and the squeeze: tensions t_ij between the contacts,
whose forces f_i = sum_j t_ij (p_j - p_i) are in equilibrium by construction. Constraints: pads on
the surface and facing into it, forces inside their friction cones. The measure that is minimised:

    friction needed^2 + 0.02 sum_j (distance of motor j from the middle of its range)^4

with ranges from -1 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.se3 import exp_so3
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.objects import GraspObject
from casadi_ik.model.shapes import Sphere
from grasp_synthesis.patches import Patch, primitive
from grasp_synthesis.programme import Programme

LENGTH = 0.1  # [m] unit of positions in the programme
RANGE = 0.97  # part of a motor's range that may be used
TURN = 0.8  # [rad] by how much the object may turn from the recipe's orientation
PRESS = 0.05  # smallest force along a normal, in units of the tensions


@dataclass(frozen=True)
class TipPinch:
    """A solved pinch.

    Attributes:
        q: (n,) configuration, the arm at zero, fingers that do not touch at home.
        object_in_hand: (4, 4) pose of the object in the hand's root frame.
        friction: Friction coefficient that the squeeze found needs.
        measure: The value minimised.
        residual: Largest violation of a contact [0.1 m or unit vector].
    """

    q: Array
    object_in_hand: Array
    friction: float
    measure: float
    residual: float


class TipPinchProblem:
    """The programme of one object."""

    def __init__(
        self,
        robot: RobotDescription,
        root: str,
        item: GraspObject,
        sides: dict[str, int],
        axes: Sequence[Sequence[float]],
        box_axis: int,
        edge_margin: float,
        idle: Array,
        position_bounds: tuple[Array, Array],
        min_contact_distance: float = 0.0,
    ) -> None:
        """Build it.

        Args:
            robot: The arm-hand.
            root: The hand's root link.
            item: The object.
            sides: By touching finger the side of the object, see `Patch`.
            axes: Object axes x, y, z in the hand's root frame, about which it may turn by `TURN`.
            box_axis: For a box the axis whose faces are pinched.
            edge_margin: Distance of contacts from edges [m].
            idle: (n,) positions of all other motors.
            position_bounds: (3,) corners of the object positions in the frame of the hand root [m].
            min_contact_distance: Smallest distance of two contacts on the same side [m].
        """
        self.idle = idle
        self.motors = sorted({i for name in sides for i in robot.finger_actuators(name)})
        k, f = len(self.motors), len(sides)
        pairs = list(combinations(range(f), 2))
        motors, place, turn = ca.SX.sym("motors", k), ca.SX.sym("place", 3), ca.SX.sym("turn", 3)
        surface, squeeze = ca.SX.sym("surface", 2, f), ca.SX.sym("squeeze", len(pairs))
        friction = ca.SX.sym("friction")
        q = ca.SX(ca.DM(idle))
        centre, half_range = (robot.upper + robot.lower) / 2, (robot.upper - robot.lower) / 2
        for i, motor in enumerate(self.motors):
            q[motor] = centre[motor] + half_range[motor] * motors[i]
        kinematics = actuated(robot, q).kinematics
        hand = kinematics.links[root]
        rotation = exp_so3(turn) @ ca.DM(np.array(axes).T)
        patches = [Patch(primitive(item), side, box_axis, edge_margin) for side in sides.values()]
        points, normals, rows, facing = [], [], [], []
        for i, (name, patch) in enumerate(zip(sides, patches, strict=True)):
            point, normal = kinematics.contact(name)
            points.append(hand.inverse_apply(point) / LENGTH)
            normals.append(hand.rotation.T @ normal)
            surface_point, surface_normal = patch.at(surface[:, i])
            rows.append(points[i] - place - rotation @ surface_point / LENGTH)
            # Square to the pad's normal there are two directions; opposite to it there is one.
            frame = kinematics.contact_frame(name)
            out = rotation @ surface_normal
            tangents = null_space(robot.finger(name).normal)
            rows.append((frame.rotation.T @ hand.rotation @ out).T @ ca.DM(tangents))
            facing.append(-0.5 - ca.dot(out, normals[i]))
        equalities = ca.vertcat(*(ca.vec(row) for row in rows))
        tensions = dict(zip(pairs, ca.vertsplit(squeeze), strict=True))
        cones = []
        for i in range(f):
            force = sum(
                (
                    tensions[min(i, j), max(i, j)] * (points[j] - points[i])
                    for j in range(f)
                    if j != i
                ),
                ca.SX.zeros(3, 1),
            )
            press = ca.dot(force, normals[i])
            cones += [press - PRESS, (1 + friction**2) * press**2 - ca.sumsqr(force)]
        on = list(sides.values())
        beside = [
            ca.sumsqr(points[i] - points[j]) - (min_contact_distance / LENGTH) ** 2
            for i, j in pairs
            if min_contact_distance and on[i] == on[j]
        ]
        inequalities = ca.vertcat(*cones, *facing, *beside)
        cost = friction**2 + 0.02 * ca.sumsqr(motors**2)
        x = ca.vertcat(motors, place, turn, ca.vec(surface), squeeze, friction)
        self.solution = ca.Function("found", [x], [q, rotation, place * LENGTH])
        turning = 0.0 if isinstance(item.shape, Sphere) else TURN
        bounds = np.array([patch.bounds() for patch in patches])
        low = [
            np.full(k, -RANGE),
            position_bounds[0] / LENGTH,
            np.full(3, -turning),
            bounds[:, 0].ravel(),
        ]
        high = [
            np.full(k, RANGE),
            position_bounds[1] / LENGTH,
            np.full(3, turning),
            bounds[:, 1].ravel(),
        ]
        # The first tension, between the first two fingers, sets the scale of the others.
        lower = np.concatenate([*low, [1.0], np.full(len(pairs) - 1, -4.0), [0.0]])
        upper = np.concatenate([*high, [1.0], np.full(len(pairs) - 1, 4.0), [2.0]])
        self.programme = Programme(x, cost, equalities, inequalities, lower, upper)

    def solve(self, rng: np.random.Generator, starts: int) -> list[TipPinch]:
        """Every local minimum found from random starts, best first."""
        pinches: list[TipPinch] = []
        for x, measure, residual in self.programme.minima(rng, starts):
            q, rotation, origin = (np.array(part) for part in self.solution(x))
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, origin[:, 0]
            pinches.append(TipPinch(q[:, 0], pose, float(x[-1]), measure, residual))
        return sorted(pinches, key=lambda pinch: pinch.measure)


def null_space(normal: Array) -> Array:
    """(3, 2) unit vectors square to a unit vector and to each other."""
    return np.linalg.svd(normal[None])[2][1:].T
