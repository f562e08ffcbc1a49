"""Better hand postures to begin from: every finger by itself takes the posture that fits best.

A table of whole hands is thin where there are many motors: of 16 motors thousands of postures are
fewer than two for each. Seen from a palm, though, the fingers know nothing of each other, and a
small table of every finger together stands for all combinations of its rows. So a posture is mended
in turns: the palm pose that suits it best, then for that pose the best row of each finger.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.kernels.function_graph import FunctionGraph
from casadi_ik.kernels.recipe import recipe
from casadi_ik.methods.hand_first.going_on import MANY
from casadi_ik.problem.contacts.conditions import LENGTH
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.alignment import align
from casadi_ik.symbolic.even_spread import evenly
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.subexpressions import shared

ROWS = 128
"""Postures of a finger; with four times as many no more fits succeed."""

AT_LIMITS = 0.5
"""Part of the range that is moved to the limits."""

TURNS = 2
"""How often the palm and then the fingers are chosen; a third turn mends little."""

FEATURES = 8
"""Numbers of a row: point / `LENGTH` and normal in the palm frame, and the square of either."""

ROOM = 1e-12
"""Smallest sum of weights that is divided by."""


@dataclass(frozen=True, eq=False)
class FingerRows:
    """Postures of a finger.

    Attributes:
        places: Of its motors among the hand's.
        postures: (t, m).
        features: (t, `FEATURES`).
    """

    places: tuple[int, ...]
    postures: Array
    features: Array


def mends(robot: RobotDescription) -> bool:
    """Whether a hand's postures are mended: it has many motors, and no two fingers share one."""
    fingers = [robot.finger_actuators(finger) for finger in robot.finger_names]
    hand = [a for motors in fingers for a in motors if a in robot.hand_actuators]
    many = len(robot.hand_actuators) > MANY and len(fingers) > 1
    return many and len(hand) == len(set(hand))


def each_finger(robot: RobotDescription) -> FunctionGraph:
    """Mends hand postures for a target.

    Args:
        robot: Its fingers have motors of their own, see `mends`.

    Returns:
        points (f, 3) [m] and normals (f, 3), NaN where free, posture (hand, 1) -> the posture
        mended, (hand, 1), and what is left of its contacts' squared errors with the best palm.
    """
    f, hand = len(robot.finger_names), len(robot.hand_actuators)
    name = ca.Function.fix_name(f"each_finger_{robot.name}")
    inputs = {"points": (f, 3), "normals": (f, 3), "posture": (hand, 1)}
    outputs = ((hand, 1), (1, 1))
    return FunctionGraph(
        name, lambda: _build(name, robot), inputs, outputs, recipe(name, robot), loops=True
    )


def _build(name: str, robot: RobotDescription) -> ca.Function:
    f, hand = len(robot.finger_names), len(robot.hand_actuators)
    points, normals = ca.MX.sym("points", f, 3), ca.MX.sym("normals", f, 3)
    posture = ca.MX.sym("posture", hand)
    tips = _tips(robot)
    seen = _seen(robot, tips)
    tables = [_rows(robot, tips, finger) for finger in range(f)]
    q = posture
    for _ in range(TURNS):
        wanted, own, _ = seen(points, normals, q)
        mended = ca.MX(q)
        for finger, table in enumerate(tables):
            distances = ca.DM(table.features) @ wanted[:, finger]
            least = ca.mmin(distances)
            row = ca.MX(ca.DM(table.postures.T))[:, ca.find(distances <= least)]
            places = list(table.places)
            mended[places] = ca.if_else(least < own[finger], row, q[places])
        q = mended
    _, _, left = seen(points, normals, q)
    return ca.Function(name, [points, normals, posture], [ca.densify(q), ca.densify(left)])


def _tips(robot: RobotDescription) -> ca.Function:
    """(hand, 1) -> features (6, f): point / `LENGTH` and normal in the palm frame."""
    hand = ca.SX.sym("hand", len(robot.hand_actuators))
    # With the arm at zero the palm is a constant, and everything up to it folds away.
    q = ca.SX.zeros(len(robot.actuators), 1)
    for i, column in enumerate(robot.hand_actuators):
        q[column] = hand[i]
    kinematics = actuated(robot, q).kinematics
    columns = []
    for finger in robot.finger_names:
        point, normal = kinematics.contact(finger)
        local = kinematics.palm.inverse_apply(point) / LENGTH
        columns.append(ca.vertcat(local, kinematics.palm.rotation.T @ normal))
    return ca.Function("tips", [hand], [ca.densify(ca.horzcat(*columns))])


def _seen(robot: RobotDescription, tips: ca.Function) -> ca.Function:
    """The target seen from the palm pose that suits a posture best.

    Returns:
        points, normals, posture -> what the rows of a table are multiplied with (`FEATURES`, f)
        for their squared distances, without the part that all rows share; these distances of the
        posture itself (f, 1), without that part; their sum with it.
    """
    f = len(robot.finger_names)
    points, normals = ca.SX.sym("points", f, 3), ca.SX.sym("normals", f, 3)
    hand = ca.SX.sym("posture", len(robot.hand_actuators))
    here = tips(hand)
    weights = [[_known(part[i, 0]) for part in (points, normals)] for i in range(f)]
    goals = [
        [ca.if_else(w, part[i, :].T, 0.0) for w, part in zip(weights[i], parts, strict=True)]
        for i, parts in enumerate([(points / LENGTH, normals)] * f)
    ]
    total = ca.fmax(sum(w[0] for w in weights), ROOM)
    target = sum((w[0] * goal[0] for w, goal in zip(weights, goals, strict=True))) / total
    centre = sum(weights[i][0] * here[:3, i] for i in range(f)) / total
    correlation = ca.SX.zeros(3, 3)
    for i, ((w_point, w_normal), (point, normal)) in enumerate(zip(weights, goals, strict=True)):
        correlation += w_point * (point - target) @ (here[:3, i] - centre).T
        correlation += w_normal * normal @ here[3:, i].T
    rotation = align(correlation)
    wanted, own, cost = [], [], ca.SX(0)
    for i, ((w_point, w_normal), (point, normal)) in enumerate(zip(weights, goals, strict=True)):
        point, normal = rotation.T @ (point - target) + centre, rotation.T @ normal
        factors = ca.vertcat(-2 * w_point * point, -2 * w_normal * normal, w_point, w_normal)
        wanted.append(factors)
        own.append(ca.dot(factors, _features(here[:, i])))
        cost += own[i] + w_point * ca.sumsqr(point) + w_normal * ca.sumsqr(normal)
    outputs = ca.horzcat(*wanted), ca.vertcat(*own), cost
    return ca.Function("seen", [points, normals, hand], shared(*outputs))


def _features(tip: Expr) -> Expr:
    """The `FEATURES` of a tip (6, 1)."""
    return ca.vertcat(tip, ca.sumsqr(tip[:3]), ca.sumsqr(tip[3:]))


def _rows(robot: RobotDescription, tips: ca.Function, finger: int) -> FingerRows:
    hand = list(robot.hand_actuators)
    moved = robot.finger_actuators(robot.finger_names[finger])
    places = [hand.index(actuator) for actuator in moved if actuator in hand]
    lower, upper = robot.lower[hand][places], robot.upper[hand][places]
    spread = (evenly(ROWS, len(places)) - 0.5) / (1 - AT_LIMITS) + 0.5
    postures = np.zeros((len(hand), ROWS))
    postures[places] = (lower + np.clip(spread, 0.0, 1.0) * (upper - lower)).T
    columns = np.array(tips.map(ROWS)(postures)).reshape(6, ROWS, -1)[:, :, finger]
    squares = [np.square(part).sum(axis=0) for part in (columns[:3], columns[3:])]
    return FingerRows(tuple(places), postures[places].T, np.vstack([columns, *squares]).T)


def _known(x: Expr) -> Expr:
    """1 where x is a number, 0 where NaN; written so that it is not simplified to 1."""
    return ca.logic_or(x <= 0, x > 0)
