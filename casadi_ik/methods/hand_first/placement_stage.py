"""Arm placement: arms in closed form are tried, and the one farthest from its limits is kept."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.arm_placement import ALLOWED, ITERATIONS, NO_MARGIN, place_arm
from casadi_ik.methods.common.form_search import (
    PLACEMENT,
    THOROUGH,
    WINDOWS,
    beginnings,
    place_form,
    trials,
)
from casadi_ik.methods.common.held_search import holds, place_held
from casadi_ik.methods.common.nearly_closed import brought_to
from casadi_ik.methods.hand_first.state import HandFirstLayouts, with_rows
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.closed_arms.held import HeldArm
from casadi_ik.symbolic.closed_arms.recognise import ArmForm
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.srs_arm import SrsArm
from casadi_ik.symbolic.subexpressions import shared


def placement_stage(layouts: HandFirstLayouts, form: ArmForm | HeldArm) -> ca.Function:
    """A trial of the stage; after the last one the least violating arm is refined."""
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = list(layouts.robot.arm_actuators)
    palm = Pose(s["palm_rotation"], s["palm_origin"])
    bounds = p["lower"][columns], p["upper"][columns]
    hits, swivel = ca.MX(1), s["swivel"]
    if isinstance(form, SrsArm):
        arm, margin = place_arm(form, palm, *bounds, s["spent"])
        most = ITERATIONS, ITERATIONS
    elif isinstance(form, HeldArm):
        candidate = s["candidate"] + s["earlier"]
        found = place_held(form, palm, bounds, s["spent"], s["arm"], s["swivel"], candidate)
        arm, margin, swivel = found
        most = len(holds(form)), len(holds(form))
    else:
        window = ca.fmod(s["candidate"] + s["earlier"] / layouts.candidates, WINDOWS)
        arm, margin, swivel = place_form(form, palm, *bounds, s["spent"], s["swivel"], window)
        most = trials(form, PLACEMENT), trials(form, THOROUGH)
    exact = True
    if not isinstance(form, SrsArm) and not form.exact:
        exact = False
        arm, hits = brought_to(layouts.robot, arm, palm, p["lower"], p["upper"], form.off)
    place = _placed(layouts, most, exact)
    outputs = place(state, parameters, arm, margin, swivel, hits)
    return ca.Function("placement", [state, parameters], list(outputs))


def _placed(layouts: HandFirstLayouts, most: tuple[int, int], exact: bool) -> ca.Function:
    """Keep the best arm so far; take it if it is within limits.

    Args:
        layouts: Of the robot.
        most: Trials of the stage, in the first round and in those after it.
        exact: Whether the arm brings the palm where it was asked for in any case; else the last
            input says it.
    """
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = layouts.robot.arm_actuators
    arm, margin, swivel = ca.SX.sym("arm", len(columns)), ca.SX.sym("margin"), ca.SX.sym("swivel")
    # What is looked for in a part of the range is not compared with what was found before.
    former = s["margin"]
    if most[0] < most[1]:
        begins = sum((s["spent"] == trial for trial in beginnings(THOROUGH)), ca.SX(0))
        former = ca.if_else(begins > 0, NO_MARGIN, former)
    hits = ca.SX.sym("hits")
    better = margin > former
    best_margin = ca.fmax(margin, former)
    allowed = best_margin >= ALLOWED
    if not exact:
        # Newton's steps keep within limits, whether or not the ideal arm did.
        better, allowed = ca.logic_or(better, hits), ca.logic_or(allowed, hits)
    best = ca.if_else(better, arm, s["arm"])
    spent = s["spent"] + 1
    over = spent >= (
        most[0] if most[0] == most[1] else ca.if_else(s["earlier"] > 0, most[1], most[0])
    )
    q = with_rows(s["q"], columns, best)
    q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
    # The last candidate is placed even if its hand does not fit.
    solved = ca.logic_and(allowed, s["fits"] > 0)
    solved = solved if exact else ca.logic_and(solved, hits)
    leave = ca.logic_or(allowed, over)
    after = layouts.state.pack(
        layouts.counted(s, Phase.ARM_PLACEMENT)
        | {
            "q": ca.if_else(leave, q, s["q"]),
            "phase": ca.if_else(leave, float(Phase.REFINEMENT), float(Phase.ARM_PLACEMENT)),
            "spent": ca.if_else(leave, 0.0, spent),
            "margin": best_margin,
            "arm": best,
            "swivel": ca.if_else(better, swivel, s["swivel"]),
        }
    )
    status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
    record = layouts.row(s, p, q, Phase.ARM_PLACEMENT, status, margin=best_margin)
    inputs = [state, parameters, arm, margin, swivel, hits]
    return ca.Function("place", inputs, shared(after, record, status))
