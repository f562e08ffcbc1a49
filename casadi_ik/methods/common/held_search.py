"""The best arm of which some joints are held, over all that these may be held at.

In a trial they are held at one place, and the joints that are left are solved in closed form. First
they are held in the middle of their ranges, then elsewhere in them, evenly spread; then around
where the best arm so far has them. What is still outside its limits then is near enough for a
refinement of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.methods.common.arm_branches import seen_by
from casadi_ik.methods.common.arm_choice import Wanted
from casadi_ik.methods.common.even_spread import even_steps
from casadi_ik.methods.common.form_search import CHOICE, WINDOWS, choose_form, place_form, trials
from casadi_ik.symbolic.closed_arms.held import HeldArm
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.subexpressions import shared


@dataclass(frozen=True)
class Hold:
    """Where joints are held in a trial.

    Attributes:
        number: Of the point, 0 in the middle.
        width: Of what the points are spread over, as a part of the joints' ranges; below 1 it is
            around the best arm so far.
        look: Number of the trial of the closed form, see `form_search.PLACEMENT`.
    """

    number: int
    width: float = 1.0
    look: int = 0


SWEPT = (
    *(Hold(number) for number in range(6)),
    *(Hold(0, 0.0, 1), Hold(1, 1 / 4, 3), Hold(2, 1 / 4, 3), Hold(3, 1 / 8, 3)),
    *(Hold(0, 0.0, 5), Hold(4, 1 / 16, 6), Hold(0, 0.0, 7)),
)
"""Trials of an arm whose closed form has a swept joint."""

STILL = (
    *(Hold(number, look=number) for number in range(10)),
    *(Hold(10 + number, 2.0 ** -(1 + number), number) for number in range(6)),
)
"""Those of one without; their looks begin the search of a joint that passes by its sphere."""


def holds(arm: HeldArm) -> tuple[Hold, ...]:
    """The trials of an arm."""
    return SWEPT if arm.form.swept else STILL


def place_held(
    arm: HeldArm,
    palm: Pose,
    bounds: tuple[Expr, Expr],
    trial: Expr,
    best: Expr,
    around: Expr,
    candidate: Expr,
) -> tuple[Expr, Expr, Expr]:
    """One trial of the search for an arm far from its limits.

    Args:
        arm: The arm.
        palm: Palm pose, base frame.
        bounds: (n, 1) lower and upper ones of the arm [rad].
        trial: Its number, from 0.
        best: (n, 1) best arm so far [rad].
        around: Best position of the swept joint so far [rad].
        candidate: Number of the hand posture: for each of them joints are held elsewhere.

    Returns:
        The best arm (n, 1) [rad] of the trial, its margin, and its swept position.
    """
    angles, look = _held_at(arm)(trial, best, *bounds, candidate)
    left = _left(arm)(angles, palm.rotation, palm.origin, *bounds)
    rotation, origin, lower, upper = left
    window, pose = ca.fmod(candidate, WINDOWS), Pose(rotation, origin)
    found, margin, swept = place_form(arm.form, pose, lower, upper, look, around, window)
    joined, least = _joined(arm)(found, angles, margin, *bounds)
    return joined, least, swept


def choose_held(
    arm: HeldArm, palm: Pose, wanted: Wanted, trial: Expr, around: Expr
) -> tuple[Expr, Expr, Expr]:
    """One trial of the search for the arm nearest to a given one: it holds joints as that has them.

    Args:
        arm: The arm.
        palm: Palm pose, base frame.
        wanted: What it is chosen by.
        trial: Its number, from 0.
        around: Best position of the swept joint so far [rad].

    Returns:
        The best arm (n, 1) [rad] of the trial, its score (see `Wanted`), its swept position.
    """
    bounds = wanted.lower, wanted.upper
    angles, near = _held_near(arm)(wanted.near, *bounds)
    left = _left(arm)(angles, palm.rotation, palm.origin, *bounds)
    rotation, origin, lower, upper = left
    asked = Wanted(near, lower, upper, wanted.scales[list(arm.solved)])
    found, score, swept = choose_form(arm.form, Pose(rotation, origin), asked, trial, around)
    joined, _ = _joined(arm)(found, angles, 0.0, *bounds)
    return joined, score, swept


def choices(arm: HeldArm) -> int:
    """Trials of that search."""
    return trials(arm.form, CHOICE)


def _held_at(arm: HeldArm) -> ca.Function:
    """(trial, best, lower, upper, candidate) -> where joints are held, the closed form's trial."""
    count, held, tried = len(arm.screws), list(arm.held), holds(arm)
    trial, candidate = ca.SX.sym("trial"), ca.SX.sym("candidate")
    whole = [ca.SX.sym(name, count) for name in ("best", "lower", "upper")]
    best, lower, upper = (each[held] for each in whole)

    def of_trial(values: list[float]) -> Expr:
        return sum((ca.if_else(trial == i, v, 0.0) for i, v in enumerate(values)), ca.SX(0))

    number = of_trial([hold.number for hold in tried]) + candidate * len(tried)
    width = of_trial([hold.width for hold in tried])
    spread = number * ca.DM(even_steps(len(held)).tolist())
    # The middle comes first.
    spread = spread - ca.floor(spread + 0.5)
    centre = ca.if_else(width >= 1, (lower + upper) / 2, best)
    angles = centre + spread * width * (upper - lower)
    angles = ca.fmin(ca.fmax(angles, lower), upper)
    look = of_trial([hold.look for hold in tried])
    return ca.Function("held_at", [trial, *whole, candidate], shared(angles, look))


def _held_near(arm: HeldArm) -> ca.Function:
    """(near, lower, upper) -> the held joints of an arm, within bounds, and its other joints."""
    symbols = [ca.SX.sym(name, len(arm.screws)) for name in ("near", "lower", "upper")]
    near, lower, upper = symbols
    inside = ca.fmin(ca.fmax(near, lower), upper)
    return ca.Function("held_near", symbols, [inside[list(arm.held)], near[list(arm.solved)]])


def _left(arm: HeldArm) -> ca.Function:
    """(angles, palm's rotation and origin, bounds) -> pose and bounds left to the other joints."""
    angles, rotation = ca.SX.sym("angles", len(arm.held)), ca.SX.sym("rotation", 3, 3)
    origin = ca.SX.sym("origin", 3)
    bounds = [ca.SX.sym(name, len(arm.screws)) for name in ("lower", "upper")]
    outputs = seen_by(arm)(rotation, origin, angles)
    ends = [end[list(arm.solved)] for end in bounds]
    return ca.Function("held_left", [angles, rotation, origin, *bounds], [*outputs, *ends])


def _joined(arm: HeldArm) -> ca.Function:
    """(arm, angles, margin, bounds) -> the whole arm and its margin."""
    found, angles = ca.SX.sym("arm", len(arm.solved)), ca.SX.sym("angles", len(arm.held))
    margin = ca.SX.sym("margin")
    bounds = [ca.SX.sym(name, len(arm.screws)) for name in ("lower", "upper")]
    lower, upper = (end[list(arm.held)] for end in bounds)
    kept = ca.fmin(margin, ca.mmin(ca.fmin(angles - lower, upper - angles)))
    outputs = [arm.joined(found, angles), kept]
    return ca.Function("held_joined", [found, angles, margin, *bounds], outputs)
