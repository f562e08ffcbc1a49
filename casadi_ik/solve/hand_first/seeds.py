"""Seeds of the restarts of hand-first: tables of hand postures, and the graph that repairs them.

The seeds of each restart are chosen in restarts.c and seeds.c.
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
"""Number of features of a fingertip: point / `LENGTH` and normal in the palm frame, and the squares
of both."""

MIN_WEIGHT = 1e-12
"""Lower bound of a sum of weights in a denominator."""


@dataclass(frozen=True, eq=False)
class TableSamples:
    """Low-discrepancy samples of a table of hand postures.

    Attributes:
        count: Number of postures.
        at_limits: Fraction of the range that is mapped to the limits.
        lower: (n,) lower bounds of the samples [rad or m].
        upper: (n,) upper bounds of the samples [rad or m].
    """

    count: int
    at_limits: float
    lower: Array
    upper: Array


class Seeds:
    """Tables of hand postures of a robot, which are filled when first needed."""

    def __init__(
        self, robot: RobotDescription, options: HandFirstParameters, compiled: bool
    ) -> None:
        """Store the arguments.

        Args:
            robot: Description of the robot.
            options: Parameters of the method, with the sizes of the tables.
            compiled: Whether lookups run in compiled code.
        """
        self._robot = ArmHand(robot)
        self._hand = list(robot.hand_actuators)
        self._options = options
        self._compiled = compiled

    @property
    def table_samples(self) -> tuple[TableSamples, TableSamples, TableSamples]:
        """Samples of the first table, of the wide one, and of the one for ignored limits."""
        limits, options = (self._robot.lower, self._robot.upper), self._options
        rows = options.table
        if not options.is_many(self._robot.description) and len(self._robot.fingers) > 3:
            min_rows = options.candidates * options.rounds
            rows = max(int(options.few_motors_table * rows), min_rows)
        return (
            TableSamples(rows, 0.0, *limits),
            TableSamples(options.wide_table, options.at_limits, *limits),
            TableSamples(options.wide_table, 0.0, *self._unlimited_bounds),
        )

    @cached_property
    def table(self) -> PostureTable:
        """Table of the first restart."""
        return self._table(0)

    @cached_property
    def _wide_table(self) -> PostureTable:
        return self._table(1)

    @cached_property
    def _unlimited_table(self) -> PostureTable:
        return self._table(2)

    def tables(self, enforce_limits: bool) -> tuple[PostureTable, ...]:
        """Return the tables in use, in the order of `table_samples`.

        A multi-arm robot has none, but its sides have.
        """
        if self._robot.description.sides:
            return ()
        if not enforce_limits:
            return self.table, self._wide_table, self._unlimited_table
        return (self.table,) if self.can_repair else (self.table, self._wide_table)

    def _table(self, index: int) -> PostureTable:
        samples = self.table_samples[index]
        return PostureTable(
            self._robot,
            tuple(self._hand),
            samples.count,
            samples.at_limits,
            compiled=self._compiled,
            bounds=(samples.lower, samples.upper),
        )

    @property
    def can_repair(self) -> bool:
        """True if postures can be repaired by finger: many motors, and none moves two fingers."""
        robot = self._robot.description
        if robot.sides:
            return False
        fingers = [robot.finger_actuators(finger) for finger in robot.finger_names]
        hand = [a for motors in fingers for a in motors if a in robot.hand_actuators]
        return self._options.is_many(robot) and len(fingers) > 1 and len(hand) == len(set(hand))

    @cached_property
    def finger_errors(self) -> FunctionKernel:
        """Kernel of `finger_errors`, for the repair of postures."""
        return FunctionKernel(finger_errors(self._robot.description), self._compiled)

    @property
    def fingers(self) -> list[FingerTable]:
        """Tables of the fingers, for the repair of postures."""
        robot = self._robot.description
        tips, count = _tips(robot), len(robot.finger_names)
        return [_finger_table(robot, tips, finger, self._options) for finger in range(count)]

    def global_bounds(self, enforce_limits: bool) -> tuple[Array, Array]:
        """Return the bounds (n,) of the samples of global restarts [rad or m]."""
        return (self._robot.lower, self._robot.upper) if enforce_limits else self._unlimited_bounds

    @property
    def _unlimited_bounds(self) -> tuple[Array, Array]:
        """Bounds (n,) for ignored limits: a full turn, within the mechanical limits."""
        description = self._robot.description
        middle = (self._robot.lower + self._robot.upper) / 2
        half_turn = np.where([a.unit == "rad" for a in description.actuators], np.pi, 0.0)
        lower = np.minimum(middle - half_turn, self._robot.lower)
        upper = np.maximum(middle + half_turn, self._robot.upper)
        mechanical_lower, mechanical_upper = description.mechanical_limits
        return np.maximum(lower, mechanical_lower), np.minimum(upper, mechanical_upper)


@dataclass(frozen=True, eq=False)
class FingerTable:
    """Postures of a finger.

    Attributes:
        columns: Indices of its motors among those of the hand.
        postures: (t, m) positions of its motors [rad or m].
        features: (`FEATURES`, t) features of the fingertip.
    """

    columns: tuple[int, ...]
    postures: Array
    features: Array


def finger_errors(robot: RobotDescription) -> FunctionGraph:
    """Return the graph of a target in the palm frame of the best palm pose of a posture.

    Returns:
        points (f, 3) [m] and normals (f, 3), NaN where free, posture (hand, 1) -> factors
        (`FEATURES`, f) whose product with the features of a finger's table is the squared distance
        of each row, except for a constant; these squared distances of the posture itself (f, 1);
        their sum with the constants.
    """
    f, hand = len(robot.finger_names), len(robot.hand_actuators)
    name = ca.Function.fix_name(f"finger_errors_{robot.name}")
    inputs = {"points": (f, 3), "normals": (f, 3), "posture": (hand, 1)}
    outputs = ((FEATURES, f), (f, 1), (1, 1))
    return FunctionGraph(
        name, lambda: _build_finger_errors(name, robot), inputs, outputs, recipe(name, robot)
    )


def _tips(robot: RobotDescription) -> ca.Function:
    """Return posture (hand, 1) -> (6, f): point / `LENGTH` and normal in the palm frame."""
    hand = ca.SX.sym("hand", len(robot.hand_actuators))
    # With the arm at zero the palm pose is a constant, which CasADi folds.
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


def _build_finger_errors(name: str, robot: RobotDescription) -> ca.Function:
    f = len(robot.finger_names)
    points, normals = ca.SX.sym("points", f, 3), ca.SX.sym("normals", f, 3)
    hand = ca.SX.sym("posture", len(robot.hand_actuators))
    tips = _tips(robot)(hand)
    weights = [[_is_number(vectors[i, 0]) for vectors in (points, normals)] for i in range(f)]
    goals = [
        [ca.if_else(w, vector[i, :].T, 0.0) for w, vector in zip(weights[i], vectors, strict=True)]
        for i, vectors in enumerate([(points / LENGTH, normals)] * f)
    ]
    total = ca.fmax(sum(w[0] for w in weights), MIN_WEIGHT)
    goal_centre = sum((w[0] * goal[0] for w, goal in zip(weights, goals, strict=True))) / total
    tip_centre = sum(weights[i][0] * tips[:3, i] for i in range(f)) / total
    correlation = ca.SX.zeros(3, 3)
    for i, ((w_point, w_normal), (point, normal)) in enumerate(zip(weights, goals, strict=True)):
        correlation += w_point * (point - goal_centre) @ (tips[:3, i] - tip_centre).T
        correlation += w_normal * normal @ tips[3:, i].T
    rotation = align(correlation)
    all_factors, distances, cost = [], [], ca.SX(0)
    for i, ((w_point, w_normal), (point, normal)) in enumerate(zip(weights, goals, strict=True)):
        point, normal = rotation.T @ (point - goal_centre) + tip_centre, rotation.T @ normal
        factors = ca.vertcat(-2 * w_point * point, -2 * w_normal * normal, w_point, w_normal)
        all_factors.append(factors)
        distances.append(ca.dot(factors, _features(tips[:, i])))
        cost += distances[i] + w_point * ca.sumsqr(point) + w_normal * ca.sumsqr(normal)
    outputs = ca.horzcat(*all_factors), ca.vertcat(*distances), cost
    return ca.Function(name, [points, normals, hand], with_cse(*outputs))


def _features(tip: Expr) -> Expr:
    """Return the `FEATURES` of a fingertip (6, 1)."""
    return ca.vertcat(tip, ca.sumsqr(tip[:3]), ca.sumsqr(tip[3:]))


def _finger_table(
    robot: RobotDescription, tips: ca.Function, finger: int, options: HandFirstParameters
) -> FingerTable:
    hand, count = list(robot.hand_actuators), options.finger_rows
    motors = robot.finger_actuators(robot.finger_names[finger])
    columns = [hand.index(actuator) for actuator in motors if actuator in hand]
    lower, upper = robot.lower[hand][columns], robot.upper[hand][columns]
    samples = (spread_points(count, len(columns)) - 0.5) / (1 - options.at_limits) + 0.5
    postures = np.zeros((len(hand), count))
    postures[columns] = (lower + np.clip(samples, 0.0, 1.0) * (upper - lower)).T
    tip_vectors = np.array(tips.map(count)(postures)).reshape(6, count, -1)[:, :, finger]
    squares = [np.square(vector).sum(axis=0) for vector in (tip_vectors[:3], tip_vectors[3:])]
    features = np.vstack([tip_vectors, *squares])
    return FingerTable(tuple(columns), postures[columns].T, features)


def _is_number(x: Expr) -> Expr:
    """Return 1 where x is a number, 0 where NaN, in a form that is not simplified to 1."""
    return ca.logic_or(x <= 0, x > 0)
