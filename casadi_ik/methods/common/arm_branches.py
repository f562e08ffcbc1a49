"""Every branch of an arm: over its whole swivel or swept joint, and where joints meet limits."""

from __future__ import annotations

from typing import Any

import casadi as ca

from casadi_ik.kernels.function_graph import FunctionGraph
from casadi_ik.methods.common.passing_roots import passing_at
from casadi_ik.symbolic.closed_arms.form import SIGNS, ClosedForm
from casadi_ik.symbolic.closed_arms.held import HeldArm
from casadi_ik.symbolic.closed_arms.passing import ROOTS, PassingArm
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
    """The arms at a position of the swept joint, eight of them unless branches have several roots.

    Returns:
        (rotation (3, 3), origin (3, 1) [m], position [rad]) -> configurations (8, n) [rad], a row
        for each of `closed_arms.form.SIGNS`, and the slack (8, 1) of each: >= 0 within reach.
        Of a `PassingArm` there are `ROOTS` rows for each.
    """
    if isinstance(form, PassingArm):
        return passing_at(form)
    inputs, palm, position = _inputs()
    bends = form.bends(palm, position)
    arms = ca.horzcat(*(arm for bend in bends for arm in bend.arms())).T
    slack = ca.vertcat(*(bend.slack for bend in bends for _ in bend.ends))
    return ca.Function("form_at", inputs, shared(arms, slack))


def held_at(arm: HeldArm) -> ca.Function:
    """The arms with the held joints at given angles, as many as `form_at` gives.

    Returns:
        (rotation (3, 3), origin (3, 1) [m], angles of the held joints and position of the swept
        one, if there is one [rad]) -> configurations (8, n) [rad] of the whole arm and the slack
        (8, 1) of each, as `form_at`.
    """
    symbols: Any = ca.MX if arm.passes else ca.SX
    rotation, origin = symbols.sym("rotation", 3, 3), symbols.sym("origin", 3)
    held = len(arm.held)
    place = symbols.sym("place", places_of(arm))
    angles, position = place[:held], place[held] if arm.form.swept else symbols(0)
    seen = seen_by(arm)(rotation, origin, angles)
    found, slack = form_at(arm.form)(*seen, position)
    rows = [arm.joined(found[i, :].T, angles).T for i in range(rows_of(arm))]
    outputs = [ca.vertcat(*rows), slack]
    outputs = outputs if arm.passes else shared(*outputs)
    return ca.Function("held_at", [rotation, origin, place], outputs)


def seen_by(arm: HeldArm) -> ca.Function:
    """(rotation, origin, angles of the held joints) -> the pose left to the solved joints."""
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    angles = ca.SX.sym("angles", len(arm.held))
    seen = arm.seen(Pose(rotation, origin), angles)
    outputs = shared(ca.densify(seen.rotation), ca.densify(seen.origin))
    return ca.Function("held_seen", [rotation, origin, angles], outputs)


def places_of(arm: SrsArm | ClosedForm | HeldArm) -> int:
    """How many numbers say at which place of its freedom an arm is, see `arms_graph`."""
    if isinstance(arm, HeldArm):
        return len(arm.held) + bool(arm.form.swept)
    return 2 if isinstance(arm, SrsArm) else 1


def rows_of(arm: ClosedForm | HeldArm) -> int:
    """How many arms there are at a place."""
    return len(SIGNS) * (ROOTS if _passes(arm) else 1)


def _passes(arm: SrsArm | ClosedForm | HeldArm) -> bool:
    return arm.passes if isinstance(arm, HeldArm) else isinstance(arm, PassingArm)


def arms_graph(arm: SrsArm | ClosedForm | HeldArm, name: str, recipe: str) -> FunctionGraph:
    """All arms at a place of what the arm is free in, of one vector.

    Args:
        arm: The arm.
        name: Of the function.
        recipe: What it follows from.

    Returns:
        Rotation (9, row by row), origin (3) [m], and of an S-R-S arm elbow sign and swivel [rad],
        of another the angles of its held joints, if it has any, and the position of its swept
        joint [rad] -> the joints of the arm of every side one after the other [rad], then the
        slack of each: >= 0 within reach.
    """
    alone = isinstance(arm, SrsArm)
    sides, joints = (len(SIDES), 7) if isinstance(arm, SrsArm) else (rows_of(arm), len(arm.screws))
    size = 12 + places_of(arm)

    def build() -> ca.Function:
        symbols: Any = ca.MX if _passes(arm) else ca.SX
        x = symbols.sym("x", size)
        palm = [ca.reshape(x[:9], 3, 3).T, x[9:12]]
        if isinstance(arm, HeldArm):
            arms, slack = held_at(arm)(*palm, x[12:])
        else:
            at = arm_at(arm) if isinstance(arm, SrsArm) else form_at(arm)
            arms, slack = at(*palm, *ca.vertsplit(x[12:]))
        slacks = ca.repmat(slack, sides, 1) if alone else slack
        both = ca.vertcat(ca.vec(arms.T), slacks)
        outputs = [both] if _passes(arm) else shared(both)
        return ca.Function(name, [x], outputs, ["x"], ["arms"])

    outputs = ((sides * (joints + 1), 1),)
    return FunctionGraph(name, build, {"x": (size, 1)}, outputs, recipe)


def _inputs() -> tuple[list[ca.SX], Pose, ca.SX]:
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    sign = ca.SX.sym("sign")
    return [rotation, origin, sign], Pose(rotation, origin), sign
