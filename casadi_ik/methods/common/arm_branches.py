"""Every branch of an arm: over its whole swivel or swept joint, and where joints meet limits."""

from __future__ import annotations

import casadi as ca

from casadi_ik.symbolic.closed_arms.form import ClosedForm
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.srs_arm import SrsArm, at_angle, euler_angles, limit_roots, swivel
from casadi_ik.symbolic.subexpressions import shared

SIDES = ((1, 1), (1, -1), (-1, 1), (-1, -1))
"""Signs of shoulder and wrist (of joints 2 and 6 from the aligned position), as `arm_at` gives."""


def arm_at(arm: SrsArm) -> ca.Function:
    """The four arms of one elbow sign at a swivel.

    Returns:
        (rotation (3, 3), origin (3, 1) [m], elbow sign, swivel [rad]) -> configurations (4, 7)
        [rad], a row for each of `SIDES`, and the reach: >= 0 where the wrist can be spanned.
    """
    inputs, palm, sign = _inputs()
    psi = ca.SX.sym("psi")
    chain = swivel(arm, palm, sign)
    shoulders = euler_angles(arm.shoulder_joints, at_angle(chain.shoulder, psi))
    wrists = euler_angles(arm.wrist_joints, at_angle(chain.wrist, psi))
    rows = [
        ca.vertcat(shoulders[first < 0], chain.elbow, wrists[second < 0]).T
        for first, second in SIDES
    ]
    outputs = shared(ca.vertcat(*rows), chain.reachable)
    return ca.Function("arm_at", [*inputs, psi], outputs)


def arm_edges(arm: SrsArm) -> ca.Function:
    """Swivels at which a joint may stand at a limit.

    Returns:
        (rotation, origin, elbow sign, lower (7, 1), upper (7, 1)) -> roots (24, 1) [rad].
    """
    inputs, palm, sign = _inputs()
    lower, upper = ca.SX.sym("lower", 7), ca.SX.sym("upper", 7)
    chain = swivel(arm, palm, sign)
    roots = ca.vertcat(
        limit_roots(arm.shoulder_joints, chain.shoulder, lower[:3], upper[:3]),
        limit_roots(arm.wrist_joints, chain.wrist, lower[4:], upper[4:]),
    )
    return ca.Function("arm_edges", [*inputs, lower, upper], shared(roots))


def form_at(form: ClosedForm) -> ca.Function:
    """The eight arms at a position of the swept joint.

    Returns:
        (rotation (3, 3), origin (3, 1) [m], position [rad]) -> configurations (8, n) [rad], a row
        for each of `closed_arms.form.SIGNS`, and the slack (8, 1) of each: >= 0 within reach.
    """
    inputs, palm, position = _inputs()
    bends = form.bends(palm, position)
    arms = ca.horzcat(*(arm for bend in bends for arm in bend.arms())).T
    slack = ca.vertcat(*(bend.slack for bend in bends for _ in bend.ends))
    return ca.Function("form_at", inputs, shared(arms, slack))


def _inputs() -> tuple[list[ca.SX], Pose, ca.SX]:
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    sign = ca.SX.sym("sign")
    return [rotation, origin, sign], Pose(rotation, origin), sign
