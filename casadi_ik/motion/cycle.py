"""One cycle of a robot that follows moving contacts, as one graph.

Where it is to go, the *goal*, is found by a few Gauss-Newton steps of all motors together,

    min |r + J s - left|^2 + damping |r|^2 |s|^2 + |clearances|^2 + pull |goal + s - anchor|^2

within bounds, r and J the contacts' residual (`ContactRows`), every motor in its own unit. They
begin where the goal before was, so it stays on its branch.

While motors can keep up with the contacts they are *at* the goal: the bounds are what velocities
and accelerations permit, and the anchor is where the motors' own momentum leads. So motions that
the contacts leave free are smooth, and near singular postures accelerations stay moderate at the
price of a small error. Errors that this leaves fade over some cycles (`left` is what may still be
there), since bounds and errors that have to vanish at once would fight each other. The anchor moves
towards the posture only as far as these errors leave tolerance, so a distant posture does not pull
contacts out of tolerance where limits block its way.

When contacts cannot be met so (they leap, or are too fast, or out of reach), goal and motors part:
the goal goes on within the limits of position and velocity, and the motors run after it as fast as
they may and without going past it (`track_goal`), until they are there.

Lacking clearances shrink as a critically damped spring does, with the time constant of the free
motions: a step removes the part ``1 - keep`` of what is lacking where the cycle begins. A clearance
that had to be restored within one cycle would make an undamped oscillator of it and the momentum.

How fast motors are. Lengths are steps: a velocity is counted as the way of one cycle, an
acceleration as what a step may differ from the one before. A motor whose steps shrink by ``change``
each stops after

    w + (w - c) + (w - 2 c) + ...        (w its step, c the change)

so the longest step from which it can stop within a distance follows in closed form (`brake`). It is
asked twice: to come to rest at the goal, relative to the goal's own motion, and at the limits,
whatever the goal does. A step that keeps the second can be followed by one that does too, so the
bounds below are never empty.
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
    """Numbers of a cycle, chosen with ``studies/moving.py``.

    Attributes:
        steps: Gauss-Newton steps; the second goes on with the motors that the first held.
        passes: Corrections of the set of motors at their bounds in a step.
        residual_damping: How much damping grows with the squared residual: where contacts are out
            of reach the least residual is not small, and undamped Gauss-Newton swings about it.
        cap: Farthest that a motor's goal moves in a cycle [rad, or part of a slider's range],
            however fast the motor is: a goal that leaps may come down on another branch.
        avoidance: How much a clearance counts, a contact counting 1: it may use what contacts
            leave free, and hardly moves a contact.
        spare: Part of the acceleration that motors count on to come to rest at their goal: the
            rest is for what the goal itself does meanwhile.
        locked_on: So near to its goal a motor is there [rad or m].
        least_change: Steps of the goal below this part of the largest change of a step, or below
            `locked_on`, are omitted: the motors come to rest exactly.
    """

    steps: int = 2
    passes: int = 2
    residual_damping: float = 0.03
    cap: float = 0.1
    avoidance: float = 0.1
    spare: float = 0.7
    locked_on: float = 1e-9
    least_change: float = 1e-5


TUNING = CycleTuning()


def brake(distance: Expr, change: Expr) -> Expr:
    """The longest step now from which a motor can stop within a distance.

    Args:
        distance: (n, 1) >= 0.
        change: (n, 1) > 0 by how much steps may shrink.

    Returns:
        (n, 1); with u = distance / change and N the number of steps that follow, of which
        N (N + 1) / 2 <= u: change (u + N (N + 1) / 2) / (N + 1).
    """
    u = distance / change
    after = ca.floor((ca.sqrt(1 + 8 * u) - 1) / 2)
    return change * (u + after * (after + 1) / 2) / (after + 1)


def step_bounds(s: dict[str, Expr], p: dict[str, Expr]) -> tuple[Expr, Expr]:
    """Least and largest step of the motors, (n, 1) each.

    Args:
        s: "q", "moved".
        p: "lower", "upper", "fastest", "change".
    """
    fastest, change = p["fastest"], p["change"]
    low = ca.fmax(-fastest, s["moved"] - change)
    low = ca.fmax(low, -brake(ca.fmax(s["q"] - p["lower"], 0.0), change))
    high = ca.fmin(fastest, s["moved"] + change)
    high = ca.fmin(high, brake(ca.fmax(p["upper"] - s["q"], 0.0), change))
    # Rounding may leave them a hair past each other.
    return ca.fmin(low, high), high


def share_within(start: Expr, end: Expr, low: Expr, high: Expr) -> Expr:
    """As far from a place towards another as bounds permit, (n, 1): all motors the same share.

    Args:
        start: (n, 1) within the bounds.
        end: (n, 1).
        low: (n, 1).
        high: (n, 1).
    """
    way = end - start
    room = ca.if_else(way > 0, high - start, start - low)
    length = ca.fmax(ca.fabs(way), 1e-15)
    share = ca.fmin(1.0, ca.mmin((room + 1e-15) / length))
    return ca.fmin(ca.fmax(start + share * way, low), high)


def track_goal(s: dict[str, Expr], goal: Expr, drawn: Expr, p: dict[str, Expr]) -> Expr:
    """Where motors are after the cycle that run after a goal, (n, 1).

    Args:
        s: "q", "moved".
        goal: (n, 1) where they are to go.
        drawn: (n, 1) the goal's own motion that they may count on.
        p: "lower", "upper", "fastest", "change".
    """
    left = goal - s["q"] - drawn
    wanted = drawn + ca.sign(left) * brake(ca.fabs(left), TUNING.spare * p["change"])
    low, high = step_bounds(s, p)
    q = s["q"] + ca.fmin(ca.fmax(wanted, low), high)
    return ca.fmin(ca.fmax(q, p["lower"]), p["upper"])


PALM_ROWS = 12
"""Of a palm's residual: its place, and its three axes."""


def of_side(name: str, side: str | None) -> str:
    """What a parameter of a side's palm is called; None: of the only one."""
    return name if side is None else f"{name}_{side}"


@dataclass(frozen=True)
class Cycle:
    """The graph for one robot and kinds of contacts.

    Attributes:
        robot: The robot.
        kinds: Of the contacts, by finger.
        obstacles: Clearances that the goal minds at once.
    """

    robot: RobotDescription
    kinds: Kinds
    obstacles: int = 0

    @cached_property
    def contacts(self) -> ContactRows:
        """The contacts' rows."""
        return ContactRows(self.kinds)

    @cached_property
    def palms(self) -> dict[str | None, tuple[str, Array]]:
        """Palms that move, so that they may have targets too: link and placement, by side."""
        if self.robot.sides:
            return {side.name: (side.palm_link, side.palm_placement) for side in self.robot.sides}
        if not self.robot.arm_actuators:
            return {}
        return {None: (self.robot.palm_link, self.robot.palm_placement)}

    @cached_property
    def state(self) -> Layout:
        """What a cycle hands on to the next."""
        n, rows = len(self.robot.actuators), self.contacts.size + PALM_ROWS * len(self.palms)
        return Layout(
            (
                Field("q", (n,), unit="rad or m", doc="where the motors are told to be"),
                Field("moved", (n,), unit="rad or m", doc="their last step"),
                Field("goal", (n,), unit="rad or m", doc="where they are going"),
                Field("locked_on", doc="1: they go with the goal; 0: they run after it"),
                Field("left", (rows,), doc="residual of contacts and palms"),
            )
        )

    @cached_property
    def parameters(self) -> Layout:
        """What a cycle is asked."""
        n, m, f = len(self.robot.actuators), self.obstacles, len(self.kinds)
        fields = [
            *self.contacts.fields,
            Field("position_tolerance", (f,), unit="m"),
            Field("angle_tolerance", (f,), unit="rad"),
            Field("lower", (n,), unit="rad or m"),
            Field("upper", (n,), unit="rad or m"),
            Field("posture", (n,), unit="rad or m", doc="where free motions lead"),
            Field("fastest", (n,), unit="rad or m", doc="longest step of a cycle"),
            Field("change", (n,), unit="rad or m", doc="how much a step may differ from the last"),
            Field("pull", doc="of the anchor [unit of J'J]"),
            Field("keep", doc="part of a free motion that the next cycle keeps"),
            Field("drift", doc="part of the way to the posture that a free motion gains"),
            Field("patience", doc="part of an error that may be left after a cycle"),
        ]
        for side in self.palms:
            point, axes, weight = (
                of_side(f"palm_{name}", side) for name in ("point", "axes", "weight")
            )
            fields += [
                Field(point, (3,), unit="m", doc="where the palm is wanted, base frame"),
                Field(axes, (3, 3), doc="its axes as columns, base frame"),
                Field(weight, (2,), doc="of its place and its axes"),
            ]
        if m:
            fields += [
                Field("slopes", (m, n), unit="m per rad or m", doc="how clearances grow"),
                Field("rooms", (m,), unit="m", doc="how much they lack; 0 or less: nothing"),
            ]
        return Layout(tuple(fields))

    @cached_property
    def record(self) -> Layout:
        """What a cycle tells."""
        f = len(self.kinds)
        return Layout(
            (
                Field("position_error", (f,), unit="m", doc="of the motors; 0 if free"),
                Field("angle_error", (f,), unit="rad"),
                Field("goal_position_error", (f,), unit="m", doc="of the goal"),
                Field("goal_angle_error", (f,), unit="rad"),
                Field("error_ratio", doc="largest error of the motors over its tolerance"),
                Field("goal_error_ratio", doc="largest error of the goal over its tolerance"),
                Field("sound", doc="finite if all numbers of the target are, and no normal is 0"),
            )
        )

    @property
    def graph(self) -> FunctionGraph:
        """``(state, parameters) -> (state', record)``."""
        what = f"cycle_{self.obstacles}" if self.obstacles else "cycle"
        name = ca.Function.fix_name(f"{self.robot.name}_{what}{kinds_suffix(self.kinds)}")
        inputs = {"state": (self.state.size, 1), "parameters": (self.parameters.size, 1)}
        outputs = (self.state.size, 1), (self.record.size, 1)
        known = recipe(name, self.robot, self.kinds, self.obstacles)
        return FunctionGraph(name, lambda: self._build(name), inputs, outputs, known)

    def _build(self, name: str) -> ca.Function:
        begin, step, end = self._begin(), self._step(minded=False), self._end()
        state = ca.MX.sym("state", self.state.size)
        parameters = ca.MX.sym("parameters", self.parameters.size)
        first, low, high, *others = begin(state, parameters)
        goal, which = first, list[ca.MX]()
        if self.obstacles:
            # A step without them takes a fifth less time.
            step = ca.Function.if_else("choose", self._step(minded=True), step)
            which = [ca.mmax(parameters[self.parameters.slice("rooms")]) > 0]
        origin = state[self.state.slice("goal")]
        for _ in range(TUNING.steps):
            goal = step(*which, origin, goal, low, high, *others, parameters)
        after, record = end(state, first, goal, low, high, parameters)
        return ca.Function(
            name, [state, parameters], [after, record], ["state", "parameters"], ["after", "record"]
        )

    def _symbols(self, *names: str) -> list[ca.SX]:
        return [ca.SX.sym(name, len(self.robot.actuators)) for name in names]

    def _unpacked(self, parameters: ca.SX) -> dict[str, Expr]:
        """Parameters by name, normals as unit vectors."""
        p = self.parameters.unpack(parameters)
        lengths = ca.sqrt(ca.sum2(p["normals"] ** 2))
        return p | {"normals": p["normals"] / ca.repmat(lengths, 1, 3)}

    def _begin(self) -> ca.Function:
        """``(state, parameters) -> (first, low, high, anchor, left)`` of the goal."""
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        s, p = self.state.unpack(state), self.parameters.unpack(parameters)
        locked_on = s["locked_on"] > 0.5
        low, high = step_bounds(s, p)
        longest = ca.fmin(p["fastest"], TUNING.cap * motor_scales(self.robot))
        # Rounding of what stops at a limit must not lead past it: both are within the limits.
        low, high = (
            ca.fmin(ca.fmax(s["goal"] + ca.if_else(locked_on, step, free), p["lower"]), p["upper"])
            for step, free in ((low, -longest), (high, longest))
        )
        along = ca.if_else(locked_on, s["moved"], 0.0)
        first = ca.fmin(ca.fmax(s["goal"] + along, low), high)
        drift = p["drift"] * self._slack(s["left"], p)
        free = p["keep"] * s["moved"] + drift * (p["posture"] - s["goal"])
        anchor = s["goal"] + ca.if_else(locked_on, free, 0.0)
        left = ca.if_else(locked_on, p["patience"] * s["left"], 0.0)
        outputs = with_cse(first, low, high, anchor, left)
        return ca.Function("begin", [state, parameters], outputs)

    def _slack(self, residual: Expr, p: dict[str, Expr]) -> Expr:
        """Return the part of the tolerance that a residual leaves: 1 without errors, 0 beyond."""
        tolerance = ca.fmin(
            ca.mmin(p["position_tolerance"]) / LENGTH, ca.mmin(p["angle_tolerance"])
        )
        largest = ca.mmax(ca.fabs(residual[: self.contacts.size]))
        return ca.fmax(1.0 - largest / ca.fmax(tolerance, 1e-12), 0.0)

    def _step(self, minded: bool) -> ca.Function:
        """Return a step ``(origin, goal, low, high, anchor, left, parameters) -> goal'``.

        Args:
            minded: Whether it increases lacking clearances.
        """
        names = "origin", "goal", "low", "high", "anchor"
        origin, goal, low, high, anchor = self._symbols(*names)
        left = ca.SX.sym("left", self.state.size - 3 * goal.numel() - 1)
        parameters = self.parameters.symbols("parameters")
        p = self._unpacked(parameters)
        end = self._goal(goal, (low, high), anchor, left, p, origin if minded else None)
        return ca.Function(
            "minding" if minded else "step",
            [origin, goal, low, high, anchor, left, parameters],
            with_cse(ca.densify(end)),
        )

    def _end(self) -> ca.Function:
        """``(state, first, goal', low, high, parameters) -> (state', record)``."""
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        s, p = self.state.unpack(state), self._unpacked(parameters)
        locked_on = s["locked_on"] > 0.5
        first, wanted, low, high = self._symbols("first", "wanted", "low", "high")
        goal = share_within(first, wanted, low, high)
        # Without this, rounding errors would move the motors indefinitely.
        threshold = ca.fmin(TUNING.least_change * p["change"], TUNING.locked_on)
        excess = ca.mmax(ca.fabs(goal - s["goal"]) - threshold)
        goal = ca.if_else(excess <= 0, s["goal"], goal)
        position, angle = self._errors(goal, p)
        met = within_tolerance(position, angle, p["position_tolerance"], p["angle_tolerance"])
        drawn = ca.if_else(met, goal - s["goal"], 0.0)
        q = ca.if_else(locked_on, goal, track_goal(s, goal, drawn, p))
        arrived = ca.mmax(ca.fabs(goal - q)) <= TUNING.locked_on
        after = {
            "q": q,
            "moved": q - s["q"],
            "goal": goal,
            "locked_on": ca.if_else(ca.logic_and(met, ca.logic_or(locked_on, arrived)), 1.0, 0.0),
            "left": self._residual(q, p),
        }
        own_position, own_angle = self._errors(q, p)
        record = {
            "position_error": own_position,
            "angle_error": own_angle,
            "goal_position_error": position,
            "goal_angle_error": angle,
            "error_ratio": _error_ratio(own_position, own_angle, p),
            "goal_error_ratio": _error_ratio(position, angle, p),
            "sound": ca.sum1(after["left"]),
        }
        outputs = with_cse(self.state.pack(after), self.record.pack(record))
        return ca.Function("end", [state, first, wanted, low, high, parameters], outputs)

    def _goal(
        self,
        here: Expr,
        bounds: tuple[Expr, Expr],
        anchor: Expr,
        left: Expr,
        p: dict[str, Expr],
        origin: Expr | None,
    ) -> Expr:
        """Return the solution (n, 1) of the least squares; it may exceed the bounds slightly.

        Args:
            here: (n, 1) start of the step, within the bounds.
            bounds: Lower and upper bounds, (n, 1) each.
            anchor: (n, 1) goal that the free motions lead to.
            left: Residual that may remain after the cycle.
            p: Parameters by name.
            origin: (n, 1) goal at which the clearances were measured; None ignores them.
        """
        n, scales = here.numel(), motor_scales(self.robot)
        residual, jacobian = self._residual(here, p), self._jacobian(here, p)
        missed, full = ca.dot(residual, residual), None
        if origin is not None:
            rooms = ca.fmax(p["rooms"], 0.0)
            felt = TUNING.avoidance / LENGTH * ca.if_else(rooms > 0, 1.0, 0.0)
            slopes = -p["slopes"] * ca.repmat(felt, 1, n)
            full = (
                slopes @ ca.diag(scales),
                TUNING.avoidance / LENGTH * (1 - p["keep"]) * rooms + slopes @ (here - origin),
            )
        residual = residual - left
        pull = ca.sqrt(p["pull"])
        residual = ca.vertcat(residual, pull * (here - anchor) / scales)
        jacobian = ca.vertcat(jacobian @ ca.diag(scales), pull * ca.SX.eye(n))
        at, (low, high) = here / scales, bounds
        box = BoxBounds(at, low / scales, high / scales, first=0)
        damping = TUNING.residual_damping * missed
        found = damped_step(ca.sparsify(jacobian), residual, damping, box, TUNING.passes, full)
        return here + found.step * scales

    def _residual(self, q: Expr, p: dict[str, Expr]) -> Expr:
        """Of contacts and palms, (rows, 1)."""
        rows = [contact_residual(self.robot, self.contacts, q, p)]
        links = actuated(self.robot, q).kinematics.links
        for side, (link, placement) in self.palms.items():
            palm, weight = links[link].at(placement), p[of_side("palm_weight", side)]
            rows.append(weight[0] * (palm.origin - p[of_side("palm_point", side)]) / LENGTH)
            turned = palm.rotation - p[of_side("palm_axes", side)]
            rows.append(weight[1] * ca.vec(turned))
        return ca.vertcat(*rows)

    def _jacobian(self, q: Expr, p: dict[str, Expr]) -> Expr:
        """Its Jacobian (rows, n)."""
        rows, body = list[Expr](), actuated(self.robot, q)
        for side, (link, placement) in self.palms.items():
            palm, weight = (
                body.kinematics.links[link].at(placement),
                p[of_side("palm_weight", side)],
            )
            linear, angular = body.twist(link, palm.origin, range(q.numel()))
            axes = ca.horzsplit(palm.rotation)
            turned = [-weight[1] * skew(axis) @ angular for axis in axes]
            rows += [weight[0] * linear / LENGTH, *turned]
        jacobian = contact_jacobian(self.robot, self.contacts, q, p)
        return ca.vertcat(jacobian, *map(ca.sparsify, rows)) if rows else jacobian

    def _errors(self, q: Expr, p: dict[str, Expr]) -> tuple[Expr, Expr]:
        """Distances [m] and angles [rad] of all contacts, (f, 1); 0 where free."""
        kinematics = actuated(self.robot, q).kinematics
        found: tuple[list[Expr], list[Expr]] = ([], [])
        goals, weights = self.contacts.goals(p), p["weights"]
        for i, (name, kind) in enumerate(zip(self.robot.finger_names, self.kinds, strict=True)):
            tip = tip_vectors(kinematics, name)
            for aspect, condition in enumerate(kind.conditions):
                error = condition.measure(tip, goals[i])
                found[aspect].append(ca.if_else(weights[i, aspect] > 0, error, 0.0))
        return ca.vertcat(*found[0]), ca.vertcat(*found[1])


def _error_ratio(position: Expr, angle: Expr, p: dict[str, Expr]) -> Expr:
    """Return the largest error of the contacts over its tolerance."""
    tolerances = p["position_tolerance"], p["angle_tolerance"]
    ratios = [
        error / ca.fmax(tolerance, 1e-12)
        for error, tolerance in zip((position, angle), tolerances, strict=True)
    ]
    return ca.mmax(ca.vertcat(*ratios))
