"""Balance stage: contacts that least squares misses by little are brought within tolerance."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.balance import CLOSER
from casadi_ik.methods.common.contact_fit import fresh_fit
from casadi_ik.methods.common.whole_contacts import whole_balance
from casadi_ik.methods.hand_first.state import HandFirstLayouts
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.subexpressions import shared


def balance_stage(layouts: HandFirstLayouts) -> ca.Function:
    """The stage: all motors at once, from where refinement ended.

    It ends with a solution or with the next candidate.
    """
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    balanced = whole_balance(layouts.robot, layouts.contacts, s, p)
    failed = ca.logic_and(balanced.over, ca.logic_not(balanced.within))
    fit = {
        name: ca.if_else(failed, fresh_fit().get(name, 0.0), balanced.fit[name])
        for name in balanced.fit
    }
    after = layouts.state.pack(
        layouts.counted(s, Phase.BALANCE)
        | {
            "q": balanced.q,
            "phase": ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.BALANCE)),
            "candidate": s["candidate"] + failed,
            "returns": s["returns"] + ca.logic_and(failed, balanced.largest > CLOSER * s["least"]),
            "least": ca.if_else(failed, ca.fmin(balanced.largest, s["least"]), s["least"]),
        }
        | fit
    )
    status = ca.if_else(balanced.within, float(Status.SOLVED), float(Status.RUNNING))
    record = layouts.row(
        s, p, s["q"], Phase.BALANCE, status, balanced.tried, accepted=balanced.accepted
    )
    return ca.Function("balance", [state, parameters], shared(after, record, status))
