"""One cycle of a robot that follows moving contacts, as one graph.

The *goal* of the motors is computed by a few Gauss-Newton steps of all motors together,

    min |r + J s - e|^2 + damping |r|^2 |s|^2 + |clearances|^2 + pull |goal + s - anchor|^2

within bounds. r and J are the residual of the contacts (`ContactRows`) and its Jacobian. Motor
positions are scaled by the unit of each motor. The steps start at the previous goal, so the goal
stays on its branch.

While motors can follow the contacts they are *locked on* the goal: the bounds follow from the
limits of velocity and acceleration, and the anchor continues the momentum of the motors. So free
motions are smooth, and near singular configurations accelerations stay moderate at the price of a
small error. Errors that remain decay over some cycles (e is the error that the next cycle may
keep), because bounds would contradict errors that must vanish at once. The anchor moves towards the
posture only as far as these errors leave tolerance, so a distant posture does not pull contacts out
of tolerance where limits block its way.

When contacts cannot be met in this way (they leap, are too fast, or out of reach), the goal moves
ahead within the limits of positions and velocities, and the motors track it as fast as they can
without overshoot (`track_goal`) until they arrive.

Lacking clearances shrink as a critically damped spring does, with the time constant of the free
motions: a step removes the part ``1 - momentum`` of the clearance that is lacking when the cycle
begins. A clearance that had to be restored within one cycle would form an undamped oscillator with
the momentum.

Velocities are expressed as steps, that is the distance in one cycle, and accelerations as changes
of a step from cycle to cycle. A motor with step w whose steps shrink by c in each cycle stops after

    w + (w - c) + (w - 2 c) + ...

so the longest step from which it can stop within a distance follows in closed form (`brake`). It is
applied twice: to stop at the goal, relative to the motion of the goal, and to stop at the limits,
independently of the goal. After a step that satisfies the second condition there is another one, so
the bounds below are never empty.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.box_qp import BoxBounds, damped_step
from casadi_ik.kinematics.contact_fit import contact_jacobian, contact_residual
from casadi_ik.kinematics.contacts import (
    LENGTH,
    ContactRows,
    Kinds,
    kinds_suffix,
    tip_vectors,
    within_tolerance,
)
from casadi_ik.kinematics.forward import actuated, motor_scales
from casadi_ik.kinematics.se3 import skew
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True)
class CycleTuning:
    """Parameters of a cycle. Source: ``studies/moving.py``.

    Attributes:
        steps: Number of Gauss-Newton steps.
        passes: Number of corrections of the active set of bounds in a step.
        residual_damping: Damping per squared residual. If contacts are out of reach, the minimum
            residual is not small, and undamped Gauss-Newton steps oscillate about it.
        max_goal_step: Maximum motion of the goal in a cycle [rad, or fraction of a slider's range],
            independently of the speed of the motor: a larger step may change the branch.
        clearance_weight: Weight of a clearance relative to a contact: clearances use free motions
            and hardly move contacts.
        braking_share: Fraction of the acceleration limit that motors use to stop at the goal; the
            remainder allows for the motion of the goal.
        arrival_distance: Distance from the goal at which a motor has arrived [rad or m].
        min_change: Minimum step of the goal, as a fraction of the maximum change of a step. Smaller
            steps, and steps below `arrival_distance`, are omitted, so that the motors stop exactly.
    """

    steps: int = 2
    passes: int = 2
    residual_damping: float = 0.03
    max_goal_step: float = 0.1
    clearance_weight: float = 0.1
    braking_share: float = 0.7
    arrival_distance: float = 1e-9
    min_change: float = 1e-5


CYCLE_TUNING = CycleTuning()


def brake(distance: Expr, change: Expr) -> Expr:
    """Return the longest step from which a motor can stop within a distance.

    Args:
        distance: (n, 1) distance >= 0.
        change: (n, 1) maximum change of a step from cycle to cycle, > 0.

    Returns:
        (n, 1) change (u + N (N + 1) / 2) / (N + 1) with u = distance / change and N the number of
        steps that follow, the largest with N (N + 1) / 2 <= u.
    """
    u = distance / change
    steps = ca.floor((ca.sqrt(1 + 8 * u) - 1) / 2)
    return change * (u + steps * (steps + 1) / 2) / (steps + 1)


def step_bounds(s: dict[str, Expr], p: dict[str, Expr]) -> tuple[Expr, Expr]:
    """Return the minimum and maximum steps of the motors, (n, 1) each.

    Args:
        s: State with "q" and "last_step".
        p: Parameters with "lower", "upper", "max_step" and "max_change".
    """
    max_step, max_change = p["max_step"], p["max_change"]
    low = ca.fmax(-max_step, s["last_step"] - max_change)
    low = ca.fmax(low, -brake(ca.fmax(s["q"] - p["lower"], 0.0), max_change))
    high = ca.fmin(max_step, s["last_step"] + max_change)
    high = ca.fmin(high, brake(ca.fmax(p["upper"] - s["q"], 0.0), max_change))
    # Rounding errors may lead the lower bound slightly beyond the upper one.
    return ca.fmin(low, high), high


def last_within(start: Expr, end: Expr, low: Expr, high: Expr) -> Expr:
    """Return the farthest posture (n, 1) within bounds on the line from one posture to another.

    Args:
        start: (n, 1) first posture, within the bounds.
        end: (n, 1) second posture.
        low: (n, 1) lower bounds.
        high: (n, 1) upper bounds.
    """
    line = end - start
    available = ca.if_else(line > 0, high - start, start - low)
    # 1e-15: motors that do not move do not limit the fraction.
    length = ca.fmax(ca.fabs(line), 1e-15)
    fraction = ca.fmin(1.0, ca.mmin((available + 1e-15) / length))
    return ca.fmin(ca.fmax(start + fraction * line, low), high)


def track_goal(s: dict[str, Expr], goal: Expr, goal_step: Expr, p: dict[str, Expr]) -> Expr:
    """Return the positions (n, 1) of motors after a cycle in which they track a goal.

    Args:
        s: State with "q" and "last_step".
        goal: (n, 1) goal.
        goal_step: (n, 1) motion of the goal in this cycle, which is expected to continue.
        p: Parameters with "lower", "upper", "max_step" and "max_change".
    """
    distance = goal - s["q"] - goal_step
    change = CYCLE_TUNING.braking_share * p["max_change"]
    step = goal_step + ca.sign(distance) * brake(ca.fabs(distance), change)
    low, high = step_bounds(s, p)
    q = s["q"] + ca.fmin(ca.fmax(step, low), high)
    return ca.fmin(ca.fmax(q, p["lower"]), p["upper"])


@dataclass(frozen=True)
class StateFields:
    """Positions of the fields of `Cycle.state` in its vector.

    Attributes:
        q: Commanded positions.
        last_step: Last step of the motors.
        goal: Goal of the motors.
        locked_on: 1 if the motors are at the goal, 0 if they track it.
    """

    q: slice
    last_step: slice
    goal: slice
    locked_on: int

    @classmethod
    def of(cls, n: int) -> StateFields:
        """Return the positions for n motors."""
        return cls(slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n), 3 * n)


PALM_ROWS = 12
"""Number of rows of a palm's residual: position and three axes."""


def side_name(name: str, side: str | None) -> str:
    """Return the name of a side's parameter; side is None for a single arm-hand."""
    return name if side is None else f"{name}_{side}"


@dataclass(frozen=True)
class Cycle:
    """Graph of a cycle for one robot and given kinds of contacts.

    Attributes:
        robot: Robot description.
        kinds: Kind of contact by finger.
        obstacles: Number of clearances in the least squares.
    """

    robot: RobotDescription
    kinds: Kinds
    obstacles: int = 0

    @cached_property
    def contacts(self) -> ContactRows:
        """Residual rows of the contacts."""
        return ContactRows(self.kinds)

    @cached_property
    def palms(self) -> dict[str | None, tuple[str, Array]]:
        """Link and placement of the palms that move, by side; they may have target poses."""
        if self.robot.sides:
            return {side.name: (side.palm_link, side.palm_placement) for side in self.robot.sides}
        if not self.robot.arm_actuators:
            return {}
        return {None: (self.robot.palm_link, self.robot.palm_placement)}

    @cached_property
    def state(self) -> Layout:
        """Layout of the state that a cycle passes to the next one."""
        n, rows = len(self.robot.actuators), self.contacts.size + PALM_ROWS * len(self.palms)
        return Layout(
            (
                Field("q", (n,), unit="rad or m", doc="commanded positions"),
                Field("last_step", (n,), unit="rad or m", doc="last step of the motors"),
                Field("goal", (n,), unit="rad or m", doc="goal of the motors"),
                Field("locked_on", doc="1: motors are at the goal; 0: they track it"),
                Field("residual", (rows,), doc="residual of contacts and palms"),
            )
        )

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the parameters of a cycle."""
        n, m, f = len(self.robot.actuators), self.obstacles, len(self.kinds)
        fields = [
            *self.contacts.fields,
            Field("position_tolerance", (f,), unit="m"),
            Field("angle_tolerance", (f,), unit="rad"),
            Field("lower", (n,), unit="rad or m"),
            Field("upper", (n,), unit="rad or m"),
            Field("posture", (n,), unit="rad or m", doc="posture to which free motions lead"),
            Field("max_step", (n,), unit="rad or m", doc="longest step of a cycle"),
            Field("max_change", (n,), unit="rad or m", doc="largest change of a step"),
            Field("pull", doc="weight of the anchor [unit of J'J]"),
            Field("momentum", doc="part of a free motion that continues in the next cycle"),
            Field("spring", doc="part of the distance to the posture added to a free motion"),
            Field("error_decay", doc="part of an error that may remain after a cycle"),
        ]
        for side in self.palms:
            point, axes, weight = (
                side_name(f"palm_{name}", side) for name in ("point", "axes", "weight")
            )
            fields += [
                Field(point, (3,), unit="m", doc="target position of the palm, base frame"),
                Field(axes, (3, 3), doc="target axes of the palm as columns, base frame"),
                Field(weight, (2,), doc="weights of position and axes"),
            ]
        if m:
            fields += [
                Field("slopes", (m, n), unit="m per rad or m", doc="gradients of clearances"),
                Field("lacking", (m,), unit="m", doc="lacking clearances; 0 or less: none"),
            ]
        return Layout(tuple(fields))

    @cached_property
    def record(self) -> Layout:
        """Layout of the results of a cycle."""
        f = len(self.kinds)
        return Layout(
            (
                Field("position_error", (f,), unit="m", doc="error of the motors; 0 if free"),
                Field("angle_error", (f,), unit="rad"),
                Field("goal_position_error", (f,), unit="m", doc="error of the goal"),
                Field("goal_angle_error", (f,), unit="rad"),
                Field("error_ratio", doc="largest error of the motors over its tolerance"),
                Field("goal_error_ratio", doc="largest error of the goal over its tolerance"),
                Field("checksum", doc="finite if the target is finite and no normal is 0"),
            )
        )

    @property
    def graph(self) -> FunctionGraph:
        """Graph ``(state, parameters) -> (state', record)``, built when it is needed."""
        variant = f"cycle_{self.obstacles}" if self.obstacles else "cycle"
        name = ca.Function.fix_name(f"{self.robot.name}_{variant}{kinds_suffix(self.kinds)}")
        inputs = {"state": (self.state.size, 1), "parameters": (self.parameters.size, 1)}
        outputs = (self.state.size, 1), (self.record.size, 1)
        graph_recipe = recipe(name, self.robot, self.kinds, self.obstacles)
        return FunctionGraph(name, lambda: self._build(name), inputs, outputs, graph_recipe)

    def _build(self, name: str) -> ca.Function:
        """Return the function of the graph: bounds and anchor, Gauss-Newton steps, new state."""
        begin, step, end = self._begin(), self._step(avoids=False), self._end()
        state = ca.MX.sym("state", self.state.size)
        parameters = ca.MX.sym("parameters", self.parameters.size)
        first, low, high, *anchor_and_error = begin(state, parameters)
        goal, condition = first, list[ca.MX]()
        if self.obstacles:
            # A step without clearances is faster by a fifth, so it is used where none is lacking.
            step = ca.Function.if_else("choose", self._step(avoids=True), step)
            condition = [ca.mmax(parameters[self.parameters.slice("lacking")]) > 0]
        origin = state[self.state.slice("goal")]
        for _ in range(CYCLE_TUNING.steps):
            goal = step(*condition, origin, goal, low, high, *anchor_and_error, parameters)
        new_state, record = end(state, first, goal, low, high, parameters)
        names = ["state", "parameters"], ["new_state", "record"]
        return ca.Function(name, [state, parameters], [new_state, record], *names)

    def _symbols(self, *names: str) -> list[ca.SX]:
        return [ca.SX.sym(name, len(self.robot.actuators)) for name in names]

    def _unpacked(self, parameters: ca.SX) -> dict[str, Expr]:
        """Return the parameters by name, normals as unit vectors."""
        p = self.parameters.unpack(parameters)
        lengths = ca.sqrt(ca.sum2(p["normals"] ** 2))
        return p | {"normals": p["normals"] / ca.repmat(lengths, 1, 3)}

    def _begin(self) -> ca.Function:
        """Return ``(state, parameters) -> (first, low, high, anchor, error)`` of the goal.

        `first` is the goal at which the Gauss-Newton steps start, `low` and `high` are its bounds
        in this cycle; anchor and error are those of the least squares, see the module.
        """
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        s, p = self.state.unpack(state), self.parameters.unpack(parameters)
        locked_on = s["locked_on"] > 0.5
        low, high = step_bounds(s, p)
        max_goal_step = CYCLE_TUNING.max_goal_step * motor_scales(self.robot)
        longest = ca.fmin(p["max_step"], max_goal_step)
        # Rounding errors of motors that stop at a limit must not exceed it: clip both.
        low, high = (
            ca.fmin(
                ca.fmax(s["goal"] + ca.if_else(locked_on, motor_step, goal_step), p["lower"]),
                p["upper"],
            )
            for motor_step, goal_step in ((low, -longest), (high, longest))
        )
        continued = ca.if_else(locked_on, s["last_step"], 0.0)
        first = ca.fmin(ca.fmax(s["goal"] + continued, low), high)
        spring = p["spring"] * self._unused_tolerance(s["residual"], p)
        free_step = p["momentum"] * s["last_step"] + spring * (p["posture"] - s["goal"])
        anchor = s["goal"] + ca.if_else(locked_on, free_step, 0.0)
        error = ca.if_else(locked_on, p["error_decay"] * s["residual"], 0.0)
        outputs = with_cse(first, low, high, anchor, error)
        return ca.Function("begin", [state, parameters], outputs)

    def _unused_tolerance(self, residual: Expr, p: dict[str, Expr]) -> Expr:
        """Return the fraction of the tolerance that the residual of the contacts leaves, >= 0."""
        tolerance = ca.fmin(
            ca.mmin(p["position_tolerance"]) / LENGTH, ca.mmin(p["angle_tolerance"])
        )
        largest = ca.mmax(ca.fabs(residual[: self.contacts.size]))
        return ca.fmax(1.0 - largest / ca.fmax(tolerance, 1e-12), 0.0)

    def _step(self, avoids: bool) -> ca.Function:
        """Return a step ``(origin, goal, low, high, anchor, error, parameters) -> goal'``.

        Args:
            avoids: True if the step increases lacking clearances.
        """
        names = "origin", "goal", "low", "high", "anchor"
        origin, goal, low, high, anchor = self._symbols(*names)
        residual = self.state.slice("residual")
        error = ca.SX.sym("error", residual.stop - residual.start)
        parameters = self.parameters.symbols("parameters")
        p = self._unpacked(parameters)
        new_goal = self._goal(goal, (low, high), anchor, error, p, origin if avoids else None)
        return ca.Function(
            "avoiding_step" if avoids else "step",
            [origin, goal, low, high, anchor, error, parameters],
            with_cse(ca.densify(new_goal)),
        )

    def _end(self) -> ca.Function:
        """Return ``(state, first, goal', low, high, parameters) -> (state', record)``."""
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        s, p = self.state.unpack(state), self._unpacked(parameters)
        locked_on = s["locked_on"] > 0.5
        first, solution, low, high = self._symbols("first", "solution", "low", "high")
        goal = last_within(first, solution, low, high)
        # Without a threshold, rounding errors would move the motors indefinitely.
        threshold = ca.fmin(
            CYCLE_TUNING.min_change * p["max_change"], CYCLE_TUNING.arrival_distance
        )
        excess = ca.mmax(ca.fabs(goal - s["goal"]) - threshold)
        goal = ca.if_else(excess <= 0, s["goal"], goal)
        position, angle = self._errors(goal, p)
        is_met = within_tolerance(position, angle, p["position_tolerance"], p["angle_tolerance"])
        goal_step = ca.if_else(is_met, goal - s["goal"], 0.0)
        q = ca.if_else(locked_on, goal, track_goal(s, goal, goal_step, p))
        has_arrived = ca.mmax(ca.fabs(goal - q)) <= CYCLE_TUNING.arrival_distance
        stays_locked_on = ca.logic_and(is_met, ca.logic_or(locked_on, has_arrived))
        new_state = {
            "q": q,
            "last_step": q - s["q"],
            "goal": goal,
            "locked_on": ca.if_else(stays_locked_on, 1.0, 0.0),
            "residual": self._residual(q, p),
        }
        motor_position, motor_angle = self._errors(q, p)
        record = {
            "position_error": motor_position,
            "angle_error": motor_angle,
            "goal_position_error": position,
            "goal_angle_error": angle,
            "error_ratio": _error_ratio(motor_position, motor_angle, p),
            "goal_error_ratio": _error_ratio(position, angle, p),
            "checksum": ca.sum1(new_state["residual"]),
        }
        outputs = with_cse(self.state.pack(new_state), self.record.pack(record))
        return ca.Function("end", [state, first, solution, low, high, parameters], outputs)

    def _goal(
        self,
        start: Expr,
        bounds: tuple[Expr, Expr],
        anchor: Expr,
        error: Expr,
        p: dict[str, Expr],
        origin: Expr | None,
    ) -> Expr:
        """Return the solution (n, 1) of the least squares; it may exceed the bounds slightly.

        Args:
            start: (n, 1) start of the step, within the bounds.
            bounds: Lower and upper bounds, (n, 1) each.
            anchor: (n, 1) goal that the free motions lead to.
            error: Residual that may remain after the cycle.
            p: Parameters by name.
            origin: (n, 1) goal at which the clearances were measured; None ignores them.
        """
        n, scales = start.numel(), motor_scales(self.robot)
        residual, jacobian = self._residual(start, p), self._jacobian(start, p)
        squared_residual, clearance_rows = ca.dot(residual, residual), None
        if origin is not None:
            lacking = ca.fmax(p["lacking"], 0.0)
            # The balance of clearances and contacts does not depend on the period: the squared
            # weight of a row, times the fraction of the clearance that a cycle restores, is
            # constant.
            restored_fraction = 1 - p["momentum"]
            weight = CYCLE_TUNING.clearance_weight / LENGTH / ca.sqrt(restored_fraction)
            slopes = -p["slopes"] * ca.repmat(weight * ca.if_else(lacking > 0, 1.0, 0.0), 1, n)
            restored = weight * restored_fraction * lacking
            clearance_rows = slopes @ ca.diag(scales), restored + slopes @ (start - origin)
        residual = residual - error
        pull = ca.sqrt(p["pull"])
        residual = ca.vertcat(residual, pull * (start - anchor) / scales)
        jacobian = ca.sparsify(ca.vertcat(jacobian @ ca.diag(scales), pull * ca.SX.eye(n)))
        low, high = bounds
        box = BoxBounds(start / scales, low / scales, high / scales, first=0)
        damping = CYCLE_TUNING.residual_damping * squared_residual
        passes = CYCLE_TUNING.passes
        result = damped_step(jacobian, residual, damping, box, passes, clearance_rows)
        return start + result.step * scales

    def _residual(self, q: Expr, p: dict[str, Expr]) -> Expr:
        """Return the residual (rows, 1) of contacts and palms."""
        rows = [contact_residual(self.robot, self.contacts, q, p)]
        links = actuated(self.robot, q).kinematics.links
        for side, (link, placement) in self.palms.items():
            palm, weight = links[link].compose(placement), p[side_name("palm_weight", side)]
            rows.append(weight[0] * (palm.origin - p[side_name("palm_point", side)]) / LENGTH)
            axes_error = palm.rotation - p[side_name("palm_axes", side)]
            rows.append(weight[1] * ca.vec(axes_error))
        return ca.vertcat(*rows)

    def _jacobian(self, q: Expr, p: dict[str, Expr]) -> Expr:
        """Return the Jacobian (rows, n) of the residual."""
        rows, body = list[Expr](), actuated(self.robot, q)
        for side, (link, placement) in self.palms.items():
            palm, weight = (
                body.kinematics.links[link].compose(placement),
                p[side_name("palm_weight", side)],
            )
            linear, angular = body.twist(link, palm.origin, range(q.numel()))
            axes = ca.horzsplit(palm.rotation)
            axes_rows = [-weight[1] * skew(axis) @ angular for axis in axes]
            rows += [weight[0] * linear / LENGTH, *axes_rows]
        jacobian = contact_jacobian(self.robot, self.contacts, q, p)
        return ca.vertcat(jacobian, *map(ca.sparsify, rows)) if rows else jacobian

    def _errors(self, q: Expr, p: dict[str, Expr]) -> tuple[Expr, Expr]:
        """Return the position errors [m] and angle errors [rad] (f, 1); 0 where free."""
        kinematics = actuated(self.robot, q).kinematics
        errors: tuple[list[Expr], list[Expr]] = ([], [])
        goals, weights = self.contacts.goals(p), p["weights"]
        for i, (name, kind) in enumerate(zip(self.robot.finger_names, self.kinds, strict=True)):
            tip = tip_vectors(kinematics, name)
            for aspect, condition in enumerate(kind.conditions):
                error = condition.measure(tip, goals[i])
                errors[aspect].append(ca.if_else(weights[i, aspect] > 0, error, 0.0))
        return ca.vertcat(*errors[0]), ca.vertcat(*errors[1])


def _error_ratio(position: Expr, angle: Expr, p: dict[str, Expr]) -> Expr:
    """Return the largest error of the contacts over its tolerance."""
    tolerances = p["position_tolerance"], p["angle_tolerance"]
    ratios = [
        error / ca.fmax(tolerance, 1e-12)
        for error, tolerance in zip((position, angle), tolerances, strict=True)
    ]
    return ca.mmax(ca.vertcat(*ratios))
