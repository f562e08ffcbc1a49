"""Arm placement: arms of a family are tried, and the one farthest from its limits is kept."""

from __future__ import annotations

import casadi as ca

from casadi_ik.arms.family import ArmFamily
from casadi_ik.arms.search import PARAMETERS, ArmTrials, Farthest
from casadi_ik.methods.common.numeric_arm import newton_polish
from casadi_ik.methods.hand_first.state import HandFirstLayouts, with_rows
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import shared


def placement_stage(layouts: HandFirstLayouts, family: ArmFamily) -> ca.Function:
    """A trial of the stage; after the last one the least violating arm is refined."""
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = list(layouts.robot.arm_actuators)
    pose = s["palm_rotation"], s["palm_origin"]
    bounds = p["lower"][columns], p["upper"][columns]
    search = ArmTrials(family, Farthest())
    visit = s["candidate"] + s["earlier"]
    best = s["arm"], s["swivel"]
    arm, margin, swivel = search.trial(Pose(*pose), bounds, s["spent"], best, visit)
    hits = ca.MX(1)
    if not family.exact:
        polish = newton_polish(layouts.robot, family.model_error)
        arm, hits = polish(arm, *pose, p["lower"], p["upper"])
    outputs = _placed(layouts, search)(state, parameters, arm, margin, swivel, hits)
    return ca.Function("placement", [state, parameters], list(outputs))


def _placed(layouts: HandFirstLayouts, search: ArmTrials) -> ca.Function:
    """Keep the best arm so far; take it if it is within limits.

    The last input says whether a nominal arm brings the palm where it was asked for.
    """
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = layouts.robot.arm_actuators
    arm, margin, swivel = ca.SX.sym("arm", len(columns)), ca.SX.sym("margin"), ca.SX.sym("swivel")
    # What is looked for in a part of the range is not compared with what was found before.
    former = ca.if_else(search.begins(s["spent"]), PARAMETERS.no_margin, s["margin"])
    hits, exact = ca.SX.sym("hits"), search.family.exact
    better = margin > former
    best_margin = ca.fmax(margin, former)
    allowed = best_margin >= PARAMETERS.allowed
    if not exact:
        # Newton's steps keep within limits, whether or not the nominal arm did.
        better, allowed = ca.logic_or(better, hits), ca.logic_or(allowed, hits)
    best = ca.if_else(better, arm, s["arm"])
    spent = s["spent"] + 1
    over = spent >= ca.if_else(s["earlier"] > 0, search.all_trials, search.trials)
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
