"""Arm choice: the arm in closed form that is nearest to where the robot is."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.methods.common.arm_choice import TRIALS, Wanted, choose_arm, is_allowed
from casadi_ik.methods.common.arm_placement import NO_MARGIN
from casadi_ik.methods.common.form_search import CHOICE, choose_form, trials
from casadi_ik.methods.common.held_search import choices, choose_held
from casadi_ik.methods.hand_first.state import HandFirstLayouts, with_rows
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.closed_arms.held import HeldArm
from casadi_ik.symbolic.closed_arms.recognise import ArmForm
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.srs_arm import SrsArm
from casadi_ik.symbolic.subexpressions import shared

TINY = 1e-9
"""Smallest range [rad] a motion is measured by."""


def choice_stage(layouts: HandFirstLayouts, arm: ArmForm | HeldArm) -> ca.Function:
    """A trial of the stage.

    Where no arm is seen within limits, the placement takes over: of an S-R-S arm after the first
    trial, since it knows the swivels at which joints stand at their limits.
    """
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = list(layouts.robot.arm_actuators)
    ranges = (layouts.robot.upper - layouts.robot.lower)[columns]
    wanted = Wanted(
        p["start"][columns],
        p["lower"][columns],
        p["upper"][columns],
        ca.DM((1 / np.maximum(ranges, TINY)).tolist()),
    )
    palm = Pose(s["palm_rotation"], s["palm_origin"])
    if isinstance(arm, SrsArm):
        found = choose_arm(arm, palm, wanted, s["spent"], s["swivel"], s["elbow"])
        taken = _taken(layouts, TRIALS, patience=1, exact=True)
    elif isinstance(arm, HeldArm):
        found = (*choose_held(arm, palm, wanted, s["spent"], s["swivel"]), s["elbow"])
        taken = _taken(layouts, choices(arm), choices(arm), arm.exact)
    else:
        found = (*choose_form(arm, palm, wanted, s["spent"], s["swivel"]), s["elbow"])
        most = trials(arm, CHOICE)
        taken = _taken(layouts, most, most, arm.exact)
    outputs = taken(state, parameters, *found)
    return ca.Function("choice", [state, parameters], list(outputs))


def _taken(layouts: HandFirstLayouts, most: int, patience: int, exact: bool) -> ca.Function:
    """Keep the best arm; after the last trial it is the answer if the hand fits.

    Args:
        layouts: Of the robot.
        most: Trials of the stage.
        patience: After so many without an arm within limits it is left.
        exact: Whether the arm brings the palm where it was asked for; else it is refined.
    """
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = layouts.robot.arm_actuators
    arm = ca.SX.sym("arm", len(columns))
    score, swivel, elbow = (ca.SX.sym(name) for name in ("score", "swivel", "elbow"))
    better = score > s["margin"]
    best = ca.if_else(better, arm, s["arm"])
    best_score = ca.fmax(score, s["margin"])
    allowed, spent = is_allowed(best_score), s["spent"] + 1
    over = ca.logic_and(allowed, spent >= most)
    q = with_rows(s["q"], columns, best)
    q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
    given_up = ca.logic_and(ca.logic_not(allowed), spent >= patience)
    leave = ca.logic_or(over, given_up)
    stay = ca.if_else(over, float(Phase.REFINEMENT), float(Phase.ARM_CHOICE))
    after = layouts.state.pack(
        layouts.counted(s, Phase.ARM_CHOICE)
        | {
            "q": ca.if_else(over, q, s["q"]),
            "phase": ca.if_else(given_up, float(Phase.ARM_PLACEMENT), stay),
            "spent": ca.if_else(leave, 0.0, spent),
            "margin": ca.if_else(given_up, NO_MARGIN, best_score),
            "arm": best,
            "swivel": ca.if_else(better, swivel, s["swivel"]),
            "elbow": ca.if_else(better, elbow, s["elbow"]),
        }
    )
    solved = ca.logic_and(over, s["fits"] > 0) if exact else ca.SX(0)
    status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
    record = layouts.row(s, p, q, Phase.ARM_CHOICE, status)
    inputs = [state, parameters, arm, score, swivel, elbow]
    return ca.Function("taken", inputs, shared(after, record, status))
