"""Where the robot is: whether that solves already, or is near enough to be refined as it is."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.contact_fit import Tried
from casadi_ik.methods.hand_first.state import HandFirstLayouts
from casadi_ik.problem.contacts import chord, within_tolerance
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.smooth import Expr, shared

WHOLE = 0.5
"""Cost up to which a start is refined as a whole (three contacts off by 4 cm each)."""


def at_start(s: dict[str, Expr]) -> Expr:
    """Whether a solve that wants what is near is at its beginning."""
    return ca.logic_and(s["candidate"] < 0, s["spent"] < 1)


def start_stage(layouts: HandFirstLayouts) -> ca.Function:
    """A look at the contacts where the robot is; nothing moves.

    It ends with a solution, with the refinement of the whole from there, or with hand postures. A
    hand without an arm is refined in any case.
    """
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    residual = layouts.whole.residual(layouts.state.unpack(state)["q"], parameters)
    outputs = _looked(layouts)(state, parameters, residual)
    return ca.Function("start", [state, parameters], list(outputs))


def _looked(layouts: HandFirstLayouts) -> ca.Function:
    """What follows from the residual of the contacts where the robot is."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    contacts = layouts.contacts
    residual = ca.SX.sym("residual", contacts.size)
    cost = ca.sumsqr(residual)
    tolerances = p["position_tolerance"], chord(p["angle_tolerance"])
    met = within_tolerance(*contacts.errors(residual), *tolerances)
    far = cost > WHOLE if layouts.robot.arm_actuators else ca.SX(0)
    after = layouts.state.pack(
        layouts.counted(s, Phase.REFINEMENT)
        | {
            "phase": ca.if_else(far, float(Phase.CANDIDATE), float(Phase.REFINEMENT)),
            "candidate": s["candidate"] + far,
            "spent": 1.0,
            "best_cost": ca.fmin(cost, s["best_cost"]),
        }
    )
    status = ca.if_else(met, float(Status.SOLVED), float(Status.RUNNING))
    looked = Tried(s["q"], residual, residual, ca.SX(0), ca.SX(0))
    record = layouts.row(s, p, s["q"], Phase.REFINEMENT, status, looked)
    return ca.Function("looked", [state, parameters, residual], shared(after, record, status))
