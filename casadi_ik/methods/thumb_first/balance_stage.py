"""Balance stage: contacts that the steps along the chain miss by little."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.balance import balanced
from casadi_ik.methods.common.whole_contacts import WholeContacts, WholeStep
from casadi_ik.methods.thumb_first.merit import merit
from casadi_ik.methods.thumb_first.state import ThumbFirstLayouts
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.smooth import shared


def balance_stage(layouts: ThumbFirstLayouts) -> ca.Function:
    """One step of all motors; it ends with a solution or with the next start."""
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s = layouts.state.unpack(state)
    whole = WholeContacts(layouts.robot, layouts.contacts, layouts.parameters)
    step = whole.balanced(s["q"], s["damping"], s["power"], parameters)
    outputs = _judged(layouts, step)(state, parameters, *step.parts)
    return ca.Function("balance", [state, parameters], list(outputs))


def _judged(layouts: ThumbFirstLayouts, step: WholeStep) -> ca.Function:
    """Go on from where a step leads if it gained."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    given, symbols = step.as_inputs()
    found = balanced(s["q"], given.tried(s["q"]), layouts.contacts, s, p)
    failed = ca.logic_and(found.over, ca.logic_not(found.within))
    after = layouts.after(
        s,
        Phase.BALANCE,
        found.fit,
        q=found.q,
        phase=ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.BALANCE)),
        start=s["start"] + failed,
    )
    status = ca.if_else(found.within, float(Status.SOLVED), float(Status.RUNNING))
    there = merit(layouts.robot, layouts.contacts, found.q, p)
    record = layouts.row(
        s,
        p,
        found.q,
        Phase.BALANCE,
        status,
        there,
        damping=s["damping"],
        step_size=found.tried.size,
        accepted=found.accepted,
    )
    return ca.Function("balanced", [state, parameters, *symbols], shared(after, record, status))
