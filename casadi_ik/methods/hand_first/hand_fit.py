"""Hand stage: palm pose and hand posture that fit the contacts, without the arm.

Three contacts with normals fix both: thirteen unknowns (palm 6, hand 7 for the Barrett) against
fifteen equations. The palm's coordinates are its pose; a step turns and shifts it in its own frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca

from casadi_ik.arms.family import ArmFamily
from casadi_ik.methods.common.bounded_step import clip
from casadi_ik.methods.common.contact_fit import Tried, lm_step
from casadi_ik.methods.common.palm_fit import HandContacts, hand_contacts
from casadi_ik.methods.hand_first.state import HandFirstLayouts
from casadi_ik.problem.contacts import LENGTH, ContactRows, Vectors
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.se3 import compose, exp_se3, skew
from casadi_ik.symbolic.smooth import Expr, part_of


class PalmAndHand(NamedTuple):
    """The unknowns of the hand stage."""

    rotation: Expr
    origin: Expr
    hand: Expr


def fit_residual(
    contacts: HandContacts, rows: ContactRows, x: PalmAndHand, p: dict[str, Expr]
) -> Expr:
    """Residual of `ContactRows`, in the palm frame."""
    return rows.residual(contacts.tips, _seen(rows.goals(p), x), p["weights"])


def fit_jacobian(
    contacts: HandContacts, rows: ContactRows, x: PalmAndHand, p: dict[str, Expr]
) -> Expr:
    """Jacobian (size, 6 + k) over palm shift [m], palm turn [rad] (palm frame) and hand.

    Seen from the palm, it is the targets that move when the palm does.
    """
    goals = _seen(rows.goals(p), x)
    k = contacts.rates[0]["point"].shape[1]
    tip_rates = [
        {name: ca.horzcat(ca.SX(3, 6), rate) for name, rate in rates.items()}
        for rates in contacts.rates
    ]
    goal_rates = [
        {
            name: ca.horzcat(
                -ca.DM.eye(3) if name == "point" else ca.DM(3, 3), skew(seen), ca.DM(3, k)
            )
            for name, seen in goal.items()
        }
        for goal in goals
    ]
    return rows.jacobian(contacts.tips, tip_rates, goals, goal_rates, p["weights"])


def _seen(goals: list[Vectors], x: PalmAndHand) -> list[Vectors]:
    """Targets of the base frame in the palm frame."""
    return [
        {
            name: x.rotation.T @ (vector - x.origin if name == "point" else vector)
            for name, vector in goal.items()
        }
        for goal in goals
    ]


def reach_row(
    arm: ArmFamily, columns: Sequence[int], x: PalmAndHand, p: dict[str, Expr]
) -> tuple[Expr, Expr] | None:
    """How far the palm is out of the arm's reach, by `LENGTH`, and its slope (1, 6).

    Where contacts leave the hand a freedom (three parallel fingers), it is spent on bringing the
    wrist where the elbow can follow. Zero, with slope zero, within reach. None: nothing is known.
    """
    shift, turn = ca.SX.sym("shift", 3), ca.SX.sym("turn", 3)
    moved = Pose(
        x.rotation @ (ca.SX.eye(3) + skew(turn)),
        x.origin + x.rotation @ shift,
    )
    bounds = p["lower"][list(columns)], p["upper"][list(columns)]
    beyond = arm.beyond(moved, *bounds)
    if beyond is None:
        return None
    if not arm.exact:
        # What the nominal arm cannot reach by so little the real one may.
        error = arm.model_error
        beyond -= ca.fmin(ca.fmax(beyond, -error), error)
    motion = ca.vertcat(shift, turn)
    slope = ca.jacobian(beyond, motion)
    here = ca.substitute([beyond, slope], [motion], [ca.SX.zeros(6, 1)])
    return p["reach"] * here[0] / LENGTH, p["reach"] * here[1] / LENGTH


def fit_step(
    layouts: HandFirstLayouts,
    arm: ArmFamily | None,
    x: PalmAndHand,
    damping: Expr,
    p: dict[str, Expr],
    q: Expr,
    given: Sequence[Expr],
) -> Tried:
    """One damped step; it turns and shifts the palm along one screw.

    With the palm on a screw, a palm that turns about the common axis of several joints while they
    turn back leaves the contacts exactly alone: the long valleys of nearly singular hands are
    straight.

    Args:
        layouts: Of the robot.
        arm: An arm whose reach is to be kept to, if known.
        x: Where the step begins.
        damping: Scalar.
        p: Parameters.
        q: (n, 1) with the hand's part at `x.hand`.
        given: Symbols that the parameters are made of.
    """
    bounds = layouts.hand_bounds(q, p, first=6)
    there = PalmAndHand(ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("h", x.hand.numel()))
    seen = part_of("fit_at", there, given, _rows(layouts, arm, there, p))

    def moved(step: Expr) -> PalmAndHand:
        rotation, origin = compose((x.rotation, x.origin), exp_se3(step[:6]))
        return PalmAndHand(rotation, origin, clip(x.hand + step[6:], bounds))

    return lm_step(lambda place: seen(*place), x, damping, bounds, moved, lambda place: place.hand)


def _rows(
    layouts: HandFirstLayouts, arm: ArmFamily | None, x: PalmAndHand, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """Residual and Jacobian of contacts and reach."""
    contacts = hand_contacts(layouts.robot, x.hand, layouts.robot.hand_actuators)
    asked = contacts, layouts.contacts, x, p
    residual, jacobian = fit_residual(*asked), fit_jacobian(*asked)
    row = None if arm is None else reach_row(arm, layouts.robot.arm_actuators, x, p)
    if row is None:
        return residual, jacobian
    beyond, slope = row
    slope = ca.horzcat(slope, ca.SX(1, len(layouts.robot.hand_actuators)))
    return ca.vertcat(residual, beyond), ca.vertcat(jacobian, slope)
