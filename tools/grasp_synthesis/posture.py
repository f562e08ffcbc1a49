"""The pinch: hand posture and object pose in the palm frame that make all contacts exact.

A nonlinear programme, symmetric about the palm's y-z plane. Unknowns: the symmetric posture, where
the object is (y, z and a turn about x), the surface coordinates of the contacts, and the squeeze.
Constraints: pads on the surface and facing into it, margins to the limits. The measure that is
minimised:

    friction needed + 0.1 sum_j (5 deg / margin_j)^2 + 0.02 ((thumb - finger) / 20 deg)^2

over the flexion joints j, where margin_j is the distance to the nearer limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import Pose
from casadi_ik.model.objects import GraspObject
from casadi_ik.model.shapes import BentCapsule, Cylinder, Sphere
from grasp_synthesis.hand import ArmHand, full_posture
from grasp_synthesis.patches import Patch, primitive
from grasp_synthesis.programme import Programme
from grasp_synthesis.recipes import Recipe

LIMIT_MARGIN = np.deg2rad(3.0)
UNIT_MARGIN = np.deg2rad(5.0)
MAX_DISTAL = np.deg2rad(45.0)


@dataclass(frozen=True)
class Pinch:
    """A solved pinch.

    Attributes:
        posture: (7,) spread, then proximal and distal of thumb, finger_2, finger_3 [rad].
        object_in_palm: (4, 4) pose of the object in palm frame W.
        friction: Friction coefficient that the squeeze found needs.
        measure: The value minimised.
        residual: Largest violation of a contact [m or unit vector].
    """

    posture: Array
    object_in_palm: Array
    friction: float
    measure: float
    residual: float


class PinchProblem:
    """The programme of one object."""

    def __init__(self, hand: ArmHand, item: GraspObject, recipe: Recipe) -> None:
        self.hand, self.recipe = hand, recipe
        thumb = Patch(primitive(item), +1, recipe.box_axis, recipe.edge_margin)
        finger = Patch(primitive(item), -1, recipe.box_axis, recipe.edge_margin)
        posture, place = ca.SX.sym("posture", 5), ca.SX.sym("place", 3)
        u_thumb, u_finger = ca.SX.sym("u_thumb", 2), ca.SX.sym("u_finger", 2)
        squeeze = ca.SX.sym("squeeze", 2)  # friction coefficient, tension between the fingers
        x = ca.vertcat(posture, place, u_thumb, u_finger, squeeze)
        full = ca.vertcat(*(posture[i] for i in (0, 1, 2, 3, 4, 3, 4)))
        contacts = hand.contacts_in_palm(full)
        c, s = ca.cos(place[2]), ca.sin(place[2])
        turn = ca.vertcat(ca.horzcat(1, 0, 0), ca.horzcat(0, c, -s), ca.horzcat(0, s, c))
        rotation = turn @ ca.DM(np.array(recipe.axes))
        origin = ca.vertcat(-recipe.along, place[0], place[1])
        # In the mirror plane, and without spread, x holds by itself: those rows are left out.
        spreads = isinstance(item.shape, (Sphere, BentCapsule))
        contact_rows, facing = [], []
        for name, patch, u in (("thumb", thumb, u_thumb), ("finger_2", finger, u_finger)):
            frame, (surface_point, surface_normal) = contacts[name], patch.at(u)
            gap = 10 * (frame.origin - origin - rotation @ surface_point)
            cosines = frame.rotation.T @ rotation @ surface_normal
            contact_rows.append(gap[1:] if name == "thumb" else gap)
            contact_rows.append(cosines[[0, 2]] if name != "thumb" and spreads else cosines[0])
            facing.append(-cosines[1] - 0.5)
        equalities = ca.vertcat(*contact_rows)
        inequalities = ca.vertcat(*_cones(contacts, squeeze), *facing)
        flexion = posture[1:]
        low, high = hand.lower[1:5], hand.upper[1:5]
        margin = ca.fmin(flexion - low, high - flexion)
        flexion_difference = (flexion[:2] - flexion[2:]) / np.deg2rad(20.0)
        cost = (
            squeeze[0]
            + 0.1 * ca.sumsqr(UNIT_MARGIN / margin)
            + 0.02 * ca.sumsqr(flexion_difference)
        )
        self.pose = ca.Function("pose", [x], [rotation, origin])
        spread = np.array([0.0, np.pi / 2] if spreads else [0.0, 0.0])
        spread = np.full(2, recipe.spread) if recipe.spread is not None else spread
        turn_bound = 0.0 if isinstance(item.shape, (Sphere, Cylinder)) else 1.0
        middle = thumb.middle(recipe.along)
        (t_low, t_high), (f_low, f_high) = thumb.bounds(), finger.bounds()
        t_low, t_high = (np.where(np.isnan(middle), b, middle) for b in (t_low, t_high))
        high = np.minimum(high - LIMIT_MARGIN, [np.pi, MAX_DISTAL, np.pi, MAX_DISTAL])
        lower = np.concatenate(
            [spread[:1], low + LIMIT_MARGIN, [-0.1, 0.08, -turn_bound], t_low, f_low, [0.0, -4.0]]
        )
        upper = np.concatenate(
            [spread[1:], high, [0.15, 0.30, turn_bound], t_high, f_high, [3.0, 4.0]]
        )
        self.programme = Programme(x, cost, equalities, inequalities, lower, upper)

    def solve(self, rng: np.random.Generator, starts: int) -> list[Pinch]:
        """Every distinct local minimum found from random starts, best first."""
        minima: list[Pinch] = []
        for x, measure, residual in self.programme.minima(rng, starts):
            rotation, origin = self.pose(x)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = np.array(rotation), np.array(origin)[:, 0]
            posture = full_posture(x[:5])
            minima.append(Pinch(posture, pose, float(x[-2]), measure, residual))
        return sorted(minima, key=lambda pinch: pinch.measure)


def _cones(contacts: dict[str, Pose], squeeze: ca.SX) -> list[ca.SX]:
    """Entries >= 0 when thumb and finger_2 squeeze inside their friction cones."""
    thumb, first, second = (contacts[name].origin for name in ("thumb", "finger_2", "finger_3"))
    forces = {
        "thumb": first + second - 2 * thumb,
        "finger_2": thumb - first + squeeze[1] * (second - first),
    }
    rows = []
    for name, force in forces.items():
        press = 20 * ca.dot(force, contacts[name].rotation[:, 1])
        rows += [press, (1 + squeeze[0] ** 2) * press**2 - 400 * ca.sumsqr(force)]
    return rows
