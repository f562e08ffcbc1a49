"""What rounds of hand-first begin from: tables of hand postures, and graphs that make better ones.

Which round begins from which of them stands in seeds.c.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.compile import FunctionGraph, FunctionKernel
from casadi_ik.compile.graphs import recipe
from casadi_ik.files.arrays import Array, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.posture_table import PostureTable
from casadi_ik.kinematics.se3 import align
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.hand_first.parameters import HandFirstParameters

FEATURES = 8
"""Numbers of a row: point / `LENGTH` and normal in the palm frame, and the square of either."""

ROOM = 1e-12
"""Smallest sum of weights that is divided by."""


@dataclass(frozen=True, eq=False)
class Spread:
    """How postures of a table are spread.

    Attributes:
        count: How many.
        at_limits: Part of the range that is moved to the limits.
        lower: (n,) from where.
        upper: (n,) to where.
    """

    count: int
    at_limits: float
    lower: Array
    upper: Array


class Seeds:
    """The hand postures that a robot's rounds begin from; tables are filled when first needed."""

    def __init__(
        self, robot: RobotDescription, options: HandFirstParameters, compiled: bool
    ) -> None:
        """Remember what the tables are made of.

        Args:
            robot: The description.
            options: How many postures there are.
            compiled: Whether lookups run in compiled code.
        """
        self._robot = ArmHand(robot)
        self._hand = list(robot.hand_actuators)
        self._options = options
        self._compiled = compiled

    @property
    def spreads(self) -> tuple[Spread, Spread, Spread]:
        """Of the first table, the wide one, and the wide one where limits are ignored."""
        own, options = (self._robot.lower, self._robot.upper), self._options
        rows = options.table
        if not options.is_many(self._robot.description) and len(self._robot.fingers) > 3:
            least = options.candidates * options.rounds
            rows = max(int(options.few_motors_table * rows), least)
        return (
            Spread(rows, 0.0, *own),
            Spread(options.wide_table, options.at_limits, *own),
            Spread(options.wide_table, 0.0, *self._everywhere),
        )

    @cached_property
    def table(self) -> PostureTable:
        """The hand postures of the first round."""
        return self._table(0)

    @cached_property
    def _wide_table(self) -> PostureTable:
        return self._table(1)

    @cached_property
    def _free_table(self) -> PostureTable:
        return self._table(2)

    def tables(self, enforce_limits: bool) -> tuple[PostureTable, ...]:
        """Those that are asked, in the order of `spreads`; of a body its sides know theirs."""
        if self._robot.description.sides:
            return ()
        if not enforce_limits:
            return self.table, self._wide_table, self._free_table
        return (self.table,) if self.mends else (self.table, self._wide_table)

    def _table(self, which: int) -> PostureTable:
        spread = self.spreads[which]
        return PostureTable(
            self._robot,
            tuple(self._hand),
            spread.count,
            spread.at_limits,
            compiled=self._compiled,
            bounds=(spread.lower, spread.upper),
        )

    @property
    def mends(self) -> bool:
        """Whether postures are mended: a hand with many motors, no two fingers share one."""
        robot = self._robot.description
        if robot.sides:
            return False
        fingers = [robot.finger_actuators(finger) for finger in robot.finger_names]
        hand = [a for motors in fingers for a in motors if a in robot.hand_actuators]
        return self._options.is_many(robot) and len(fingers) > 1 and len(hand) == len(set(hand))

    @cached_property
    def seen(self) -> FunctionKernel:
        """What mending asks of a posture of such a hand."""
        return FunctionKernel(seen(self._robot.description), self._compiled)

    @property
    def fingers(self) -> list[FingerRows]:
        """Tables of such a hand's fingers."""
        robot = self._robot.description
        tips, count = _tips(robot), len(robot.finger_names)
        return [_rows(robot, tips, finger, self._options) for finger in range(count)]

    def anywhere_bounds(self, enforce_limits: bool) -> tuple[Array, Array]:
        """(n,) between which configurations from anywhere are."""
        return (self._robot.lower, self._robot.upper) if enforce_limits else self._everywhere

    @property
    def _everywhere(self) -> tuple[Array, Array]:
        """(n,) bounds where limits are ignored: a full turn, or what the mechanisms permit."""
        description = self._robot.description
        middle = (self._robot.lower + self._robot.upper) / 2
        far = np.where([a.unit == "rad" for a in description.actuators], np.pi, 0.0)
        lower = np.minimum(middle - far, self._robot.lower)
        upper = np.maximum(middle + far, self._robot.upper)
        ends = description.mechanical_limits
        return np.maximum(lower, ends[0]), np.minimum(upper, ends[1])


@dataclass(frozen=True, eq=False)
class FingerRows:
    """Postures of a finger.

    Attributes:
        places: Of its motors among the hand's.
        postures: (t, m).
        features: (`FEATURES`, t) of the tip.
    """

    places: tuple[int, ...]
    postures: Array
    features: Array


def seen(robot: RobotDescription) -> FunctionGraph:
    """A target seen from the palm pose that suits a posture best.

    Returns:
        points (f, 3) [m] and normals (f, 3), NaN where free, posture (hand, 1) -> what the rows of
        a finger's table are multiplied with (`FEATURES`, f) for their squared distances, without
        the part that all rows share; these distances of the posture itself (f, 1), without that
        part; their sum with it.
    """
    f, hand = len(robot.finger_names), len(robot.hand_actuators)
    name = ca.Function.fix_name(f"seen_{robot.name}")
    inputs = {"points": (f, 3), "normals": (f, 3), "posture": (hand, 1)}
    outputs = ((FEATURES, f), (f, 1), (1, 1))
    return FunctionGraph(name, lambda: _seen(name, robot), inputs, outputs, recipe(name, robot))


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


def _seen(name: str, robot: RobotDescription) -> ca.Function:
    f = len(robot.finger_names)
    points, normals = ca.SX.sym("points", f, 3), ca.SX.sym("normals", f, 3)
    hand = ca.SX.sym("posture", len(robot.hand_actuators))
    here = _tips(robot)(hand)
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
    return ca.Function(name, [points, normals, hand], with_cse(*outputs))


def _features(tip: Expr) -> Expr:
    """The `FEATURES` of a tip (6, 1)."""
    return ca.vertcat(tip, ca.sumsqr(tip[:3]), ca.sumsqr(tip[3:]))


def _rows(
    robot: RobotDescription, tips: ca.Function, finger: int, options: HandFirstParameters
) -> FingerRows:
    hand, count = list(robot.hand_actuators), options.finger_rows
    moved = robot.finger_actuators(robot.finger_names[finger])
    places = [hand.index(actuator) for actuator in moved if actuator in hand]
    lower, upper = robot.lower[hand][places], robot.upper[hand][places]
    spread = (spread_points(count, len(places)) - 0.5) / (1 - options.at_limits) + 0.5
    postures = np.zeros((len(hand), count))
    postures[places] = (lower + np.clip(spread, 0.0, 1.0) * (upper - lower)).T
    columns = np.array(tips.map(count)(postures)).reshape(6, count, -1)[:, :, finger]
    squares = [np.square(part).sum(axis=0) for part in (columns[:3], columns[3:])]
    return FingerRows(tuple(places), postures[places].T, np.vstack([columns, *squares]))


def _known(x: Expr) -> Expr:
    """1 where x is a number, 0 where NaN; written so that it is not simplified to 1."""
    return ca.logic_or(x <= 0, x > 0)
