"""Arm placement for arms without a closed form: damped steps towards the palm pose."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.contact_fit import FIT, judge
from casadi_ik.methods.common.numeric_arm import (
    NEAR,
    SIX,
    STARTS,
    nearest_start,
    other_side,
    pose_step,
)
from casadi_ik.methods.hand_first.state import HandFirstLayouts, with_rows
from casadi_ik.problem.contacts import LENGTH
from casadi_ik.problem.status import Phase, Status
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr, shared


def numeric_stage(layouts: HandFirstLayouts) -> ca.Function:
    """A step towards the palm pose; the first of a start begins at a row of the table."""
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    begin = nearest_start(layouts.robot)
    arm = ca.MX.sym("arm", len(layouts.robot.arm_actuators))
    inputs = [ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3), ca.MX.sym("passed"), arm]
    fresh = ca.Function("fresh", inputs, list(begin(*inputs[:3])))
    same = ca.Function("same", inputs, [arm, inputs[2]])
    now = s["q"][list(layouts.robot.arm_actuators)]
    palm = (s["palm_rotation"], s["palm_origin"])
    # The first start is the arm as it is, if a solution near it is wanted.
    own = ca.logic_and(p["nearest"], s["starts"] < 1)
    own = ca.logic_or(own, s["turned"] > 0)
    first = ca.logic_and(s["spent"] < 1, ca.logic_not(own))
    chosen = ca.Function.if_else("start", fresh, same)(first, *palm, s["passed"], now)
    outputs = _pose_step(layouts)(state, parameters, *chosen)
    return ca.Function("placement", [state, parameters], list(outputs))


def _is_near(s: dict[str, Expr], p: dict[str, Expr], rows: list[int], cost: Expr) -> Expr:
    """Whether an arm of too few free motors is as near a palm as can be asked in the first round.

    What is left is for arm and hand together.
    """
    few = ca.sum1(p["lower"][rows] < p["upper"][rows]) < SIX
    allowed = ca.mmax(p["position_tolerance"] / LENGTH) ** 2 + ca.mmax(p["angle_tolerance"]) ** 2
    near = ca.logic_and(few, cost < NEAR * allowed)
    return ca.logic_and(near, s["earlier"] < 1)


def _pose_step(layouts: HandFirstLayouts) -> ca.Function:
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    rows = list(layouts.robot.arm_actuators)
    arm, passed = ca.SX.sym("arm", len(rows)), ca.SX.sym("passed")
    inside = ca.fmin(ca.fmax(arm, p["lower"][rows]), p["upper"][rows])
    palm = Pose(s["palm_rotation"], s["palm_origin"])
    tried = pose_step(layouts.robot, inside, palm, s["damping"], p)
    judged = judge(s, tried, within=ca.SX(0), exact=ca.SX(0))
    now = ca.if_else(judged.accepted, tried.reached, inside)
    margin = -ca.sqrt(judged.cost)
    better = margin > s["margin"]
    best, best_margin = ca.if_else(better, now, s["arm"]), ca.fmax(margin, s["margin"])
    exact = judged.cost < FIT.exact * FIT.exact
    # What the first round missed may lie beyond the gap between two limits of a joint.
    *sent, turned = ca.vertsplit(other_side(layouts.robot, now, s["turned"], p))
    again = ca.logic_and(judged.settled, ca.logic_and(s["earlier"] > 0, turned > 0))
    starts = s["starts"] + ca.logic_and(judged.settled, ca.logic_not(again))
    turned = ca.if_else(judged.settled, ca.if_else(again, turned, 0), s["turned"])
    near = ca.logic_and(judged.settled, _is_near(s, p, rows, judged.cost))
    leave = ca.logic_or(ca.logic_or(exact, near), starts >= STARTS)
    q = with_rows(s["q"], rows, ca.if_else(leave, best, ca.if_else(again, ca.vertcat(*sent), now)))
    after = layouts.state.pack(
        layouts.counted(s, Phase.ARM_PLACEMENT)
        | judged.fit
        | {
            "q": q,
            "cost": s["cost"],
            "phase": ca.if_else(leave, float(Phase.REFINEMENT), float(Phase.ARM_PLACEMENT)),
            "margin": best_margin,
            "arm": best,
            "starts": starts,
            "passed": passed,
            "turned": ca.if_else(leave, 0, turned),
        }
    )
    solved = ca.logic_and(exact, s["fits"] > 0)
    status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
    record = layouts.row(s, p, q, Phase.ARM_PLACEMENT, status, margin=best_margin)
    inputs = [state, parameters, arm, passed]
    return ca.Function("pose_step", inputs, shared(after, record, status))
