"""Balance stage: contacts that the steps along the chain miss by little."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.whole_contacts import whole_balance
from casadi_ik.methods.thumb_first.merit import merit
from casadi_ik.methods.thumb_first.state import ThumbFirstLayouts
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.subexpressions import shared


def balance_stage(layouts: ThumbFirstLayouts) -> ca.Function:
    """One step of all motors; it ends with a solution or with the next start."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    balanced = whole_balance(layouts.robot, layouts.contacts, s, p)
    failed = ca.logic_and(balanced.over, ca.logic_not(balanced.within))
    after = layouts.after(
        s,
        Phase.BALANCE,
        balanced.fit,
        q=balanced.q,
        phase=ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.BALANCE)),
        start=s["start"] + failed,
    )
    status = ca.if_else(balanced.within, float(Status.SOLVED), float(Status.RUNNING))
    there = merit(layouts.robot, layouts.contacts, balanced.q, p)
    record = layouts.row(
        s,
        p,
        balanced.q,
        Phase.BALANCE,
        status,
        there,
        damping=s["damping"],
        step_size=balanced.tried.size,
        accepted=balanced.accepted,
    )
    return ca.Function("balance", [state, parameters], shared(after, record, status))
