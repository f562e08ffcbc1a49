"""Where a solve of the hand-first method begins: state and parameters from a target."""

from __future__ import annotations

import sys

import casadi as ca

from casadi_ik.kernels.graphs import FunctionGraph, recipe
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.methods.common.contact_fit import fresh_fit
from casadi_ik.methods.common.numeric_arm import SIX
from casadi_ik.methods.hand_first.state import HandFirstLayouts
from casadi_ik.problem.contacts import suffix
from casadi_ik.problem.status import Phase
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.smooth import Expr, shared


def terms(robot: RobotDescription) -> Layout:
    """What all targets of a batch have in common."""
    n, f = len(robot.actuators), len(robot.fingers)
    return Layout(
        (
            Field("position_tolerance", (f,), unit="m"),
            Field("angle_tolerance", (f,), unit="rad"),
            Field("lower", (n,), doc="lower bounds of q"),
            Field("upper", (n,), doc="upper bounds of q"),
            Field("nearest", doc="1 if the solution nearest to where the robot is is wanted"),
        )
    )


def beginning(layouts: HandFirstLayouts) -> FunctionGraph:
    """First state and parameters of the step.

    Hand motors that move free fingers only stay where they are; every start is moved into the
    bounds.

    Returns:
        points (f, 3) [m], normals (f, 3) and the contacts' other vectors, NaN where free, where
        the robot is (n, 1), the `terms`, hand postures to try (candidates, hand) -> state,
        parameters.
    """
    robot = layouts.robot
    f, n = len(robot.fingers), len(robot.actuators)
    name = ca.Function.fix_name(f"hand_first_beginning_{robot.name}{suffix(layouts.kinds)}")
    return FunctionGraph(
        name,
        lambda: _build(name, layouts),
        {
            **{f"{vector}s": (f, 3) for vector in layouts.contacts.data},
            "here": (n, 1),
            "terms": (terms(robot).size, 1),
            "postures": (layouts.candidates, len(layouts.robot.hand_actuators)),
        },
        ((layouts.state.size, 1), (layouts.parameters.size, 1)),
        recipe(name, robot, layouts.candidates, layouts.kinds),
    )


def _build(name: str, layouts: HandFirstLayouts) -> ca.Function:
    robot, hand = layouts.robot, list(layouts.robot.hand_actuators)
    f, n = len(robot.fingers), len(robot.actuators)
    vectors = {f"{vector}s": ca.SX.sym(f"{vector}s", f, 3) for vector in layouts.contacts.data}
    here = ca.SX.sym("q", n)
    common = terms(robot)
    given = common.symbols("terms")
    t = common.unpack(given)
    postures = ca.SX.sym("postures", layouts.candidates, len(hand))

    numbers = {key: _is_number(array[:, 0]) for key, array in vectors.items()}
    known = ca.horzcat(numbers["points"], numbers["normals"])
    asked = ca.logic_or(known[:, 0], known[:, 1])
    needed = ca.vertcat(*(_mover(robot, actuator, asked) for actuator in hand))
    held = _bounded(here[hand], t, hand)
    tried = [
        ca.if_else(needed, _bounded(postures[i, :].T, t, hand), held)
        for i in range(layouts.candidates)
    ]
    start = _bounded(here, t, list(range(n)))
    parameters = layouts.parameters.pack(
        {
            **{key: _or_zero(array, numbers[key]) for key, array in vectors.items()},
            "weights": known,
            "reach": 1.0,
            "alone": 0.0,
            "start": start,
            "postures": ca.horzcat(*tried).T,
            **t,
        }
    )
    zero = {item.name: ca.SX.zeros(item.size) for item in layouts.state}
    state = layouts.state.pack(
        zero
        | {
            "q": start,
            "best_q": here,
            "best_cost": sys.float_info.max,
            "least": sys.float_info.max,
            "held": _is_held(robot, t),
            "phase": ca.if_else(t["nearest"], float(Phase.REFINEMENT), float(Phase.CANDIDATE)),
            "candidate": -t["nearest"],
        }
        | fresh_fit()
    )
    inputs = [*vectors.values(), here, given, postures]
    return ca.Function(name, inputs, shared(state, parameters))


def _is_held(robot: RobotDescription, t: dict[str, Expr]) -> Expr:
    """1 if motors of the hand are held, or the arm's free ones cannot take the palm to any pose.

    Fewer than six are too few, be they held, of a short arm or of a hand that stands alone.

    A hand that is held as a whole needs no search.
    """
    hand, arm = list(robot.hand_actuators), list(robot.arm_actuators)
    free_hand, free_arm = (
        ca.sum1(t["lower"][rows] < t["upper"][rows]) if rows else 0 for rows in (hand, arm)
    )
    less = ca.logic_or(free_hand < len(hand), free_arm < SIX)
    return ca.logic_and(less, free_hand > 0)


def _is_number(x: Expr) -> Expr:
    """1 where x is a number, 0 where NaN; written so that it is not simplified to 1."""
    return ca.logic_or(x <= 0, x > 0)


def _or_zero(x: Expr, known: Expr) -> Expr:
    return ca.if_else(ca.repmat(known, 1, 3), x, 0.0)


def _mover(robot: RobotDescription, actuator: int, known: Expr) -> Expr:
    """1 if an actuator moves a finger that has a contact."""
    moved = [i for i, f in enumerate(robot.finger_names) if actuator in robot.finger_actuators(f)]
    return ca.mmax(ca.vertcat(ca.SX(0), known[moved]))


def _bounded(q: Expr, t: dict[str, Expr], actuators: list[int]) -> Expr:
    return ca.fmin(ca.fmax(q, t["lower"][actuators]), t["upper"][actuators])
