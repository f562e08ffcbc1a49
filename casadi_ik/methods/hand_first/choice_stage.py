"""Arm choice: the arm of a family that is nearest to where the robot is."""

from __future__ import annotations

import casadi as ca

from casadi_ik.arms.family import ArmFamily
from casadi_ik.arms.search import PARAMETERS, ArmTrials, Nearest, is_allowed
from casadi_ik.methods.hand_first.state import HandFirstLayouts, with_rows
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import shared


def choice_stage(layouts: HandFirstLayouts, family: ArmFamily) -> ca.Function:
    """A trial of the stage. Where no arm is seen within limits, the placement takes over."""
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = list(layouts.robot.arm_actuators)
    ranges = (layouts.robot.upper - layouts.robot.lower)[columns]
    search = ArmTrials(family, Nearest.by_ranges(ranges))
    palm = Pose(s["palm_rotation"], s["palm_origin"])
    bounds = p["lower"][columns], p["upper"][columns]
    best, near = (s["arm"], s["swivel"]), p["start"][columns]
    found = search.trial(palm, bounds, s["spent"], best, s["candidate"], near)
    outputs = _taken(layouts, search)(state, parameters, *found)
    return ca.Function("choice", [state, parameters], list(outputs))


def _taken(layouts: HandFirstLayouts, search: ArmTrials) -> ca.Function:
    """Keep the best arm; after the last trial it is the answer if the hand fits.

    A nominal arm that is not the real one is refined.
    """
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    columns = layouts.robot.arm_actuators
    arm = ca.SX.sym("arm", len(columns))
    score, swivel = ca.SX.sym("score"), ca.SX.sym("swivel")
    better = score > s["margin"]
    best = ca.if_else(better, arm, s["arm"])
    best_score = ca.fmax(score, s["margin"])
    allowed, spent = is_allowed(best_score), s["spent"] + 1
    over = ca.logic_and(allowed, spent >= search.trials)
    q = with_rows(s["q"], columns, best)
    q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
    given_up = ca.logic_and(ca.logic_not(allowed), spent >= search.patience)
    leave = ca.logic_or(over, given_up)
    stay = ca.if_else(over, float(Phase.REFINEMENT), float(Phase.ARM_CHOICE))
    after = layouts.state.pack(
        layouts.counted(s, Phase.ARM_CHOICE)
        | {
            "q": ca.if_else(over, q, s["q"]),
            "phase": ca.if_else(given_up, float(Phase.ARM_PLACEMENT), stay),
            "spent": ca.if_else(leave, 0.0, spent),
            "margin": ca.if_else(given_up, PARAMETERS.no_margin, best_score),
            "arm": best,
            "swivel": ca.if_else(better, swivel, s["swivel"]),
        }
    )
    solved = ca.logic_and(over, s["fits"] > 0) if search.family.exact else ca.SX(0)
    status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
    record = layouts.row(s, p, q, Phase.ARM_CHOICE, status)
    inputs = [state, parameters, arm, score, swivel]
    return ca.Function("taken", inputs, shared(after, record, status))
