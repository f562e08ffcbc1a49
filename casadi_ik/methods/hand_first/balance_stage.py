"""Balance stage: contacts that least squares misses by little are brought within tolerance."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.balance import CLOSER, balanced
from casadi_ik.methods.common.contact_fit import fresh_fit
from casadi_ik.methods.common.whole_contacts import WholeStep
from casadi_ik.methods.hand_first.state import HandFirstLayouts
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.smooth import shared


def balance_stage(layouts: HandFirstLayouts) -> ca.Function:
    """The stage: all motors at once, from where refinement ended.

    It ends with a solution or with the next candidate.
    """
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s = layouts.state.unpack(state)
    step = layouts.whole.balanced(s["q"], s["damping"], s["power"], parameters)
    outputs = _judged(layouts, step)(state, parameters, *step.parts)
    return ca.Function("balance", [state, parameters], list(outputs))


def _judged(layouts: HandFirstLayouts, step: WholeStep) -> ca.Function:
    """Go on from where a step leads if it gained."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    given, symbols = step.as_inputs()
    found = balanced(s["q"], given.tried(s["q"]), layouts.contacts, s, p)
    failed = ca.logic_and(found.over, ca.logic_not(found.within))
    fit = {
        name: ca.if_else(failed, fresh_fit().get(name, 0.0), found.fit[name]) for name in found.fit
    }
    after = layouts.state.pack(
        layouts.counted(s, Phase.BALANCE)
        | {
            "q": found.q,
            "phase": ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.BALANCE)),
            "candidate": s["candidate"] + failed,
            "returns": s["returns"] + ca.logic_and(failed, found.largest > CLOSER * s["least"]),
            "least": ca.if_else(failed, ca.fmin(found.largest, s["least"]), s["least"]),
        }
        | fit
    )
    status = ca.if_else(found.within, float(Status.SOLVED), float(Status.RUNNING))
    record = layouts.row(s, p, s["q"], Phase.BALANCE, status, found.tried, accepted=found.accepted)
    return ca.Function("balanced", [state, parameters, *symbols], shared(after, record, status))
