"""The best arm in closed form for a palm pose, over all positions of the swept joint, if any.

All arms at a position are seen at once: the three joints of an end choose their way independently
of the other bends. Where a joint is swept, the first trial looks at positions all over its range;
the next ones look closer around the best so far, and at positions between the first, since there
may be several stretches that are allowed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.methods.common.arm_choice import OUTSIDE, Wanted
from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.methods.common.passing_search import Scored, best_at
from casadi_ik.symbolic.closed_arms.form import Bend, ClosedForm
from casadi_ik.symbolic.closed_arms.passing import PassingArm
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.srs_arm import AROUND, at_held
from casadi_ik.symbolic.subexpressions import shared

TURN = 2 * np.pi

SAMPLES = 6
"""Positions of the swept joint looked at in a trial."""

FEWER = 3
"""As many of an arm whose last axis passes by its sphere: each of them costs more."""


@dataclass(frozen=True)
class Look:
    """Where a trial looks.

    Attributes:
        around: Whether around the best so far, else all over the range.
        by: Width [steps of the first trial] if around the best, else how far the positions are
            moved from those of the first trial [such steps].
        part: Which part of the range it keeps to, see `PARTS`; None: to none.
        begins: Whether it is the first of its part: what was found elsewhere does not count.
    """

    around: bool
    by: float
    part: int | None = None
    begins: bool = False


PLACEMENT = (
    *(Look(False, 0.0), Look(True, 1.0), Look(False, 1 / 3), Look(True, 1 / 2)),
    *(Look(False, -1 / 3), Look(True, 1 / 3), Look(True, 1 / 18), Look(True, 1 / 108)),
    Look(True, 1 / 600),
)
"""Looks for an arm within limits: of 20,000 random poses of a Panda 2,427 need more than the first,
369 more than two, 6 more than all."""

TRIES = 3
"""Turns of the joint off a sphere that searches begin at."""

PARTS = 4
"""Parts of the range that are searched one after the other."""

WINDOWS, GOLDEN = 32, (np.sqrt(5) - 1) / 2
"""Ways to go through the parts, and by how much the positions of the next way are moved on [their
distance]: with eight ways 3 of 12,000 poses of a Panda near limits were found in none."""

THOROUGH = (
    *PLACEMENT,
    *(
        look
        for part in range(PARTS)
        for look in (
            *(Look(False, between / 4, part, begins=not between) for between in range(4)),
            *(Look(True, 1 / 4**power, part) for power in (1, 2, 3, 4)),
        )
    ),
)
"""The same for poses that were given up before, and then in each part of the range by itself: what
is best of all may be short of the limits everywhere, and a stretch where an arm stands with several
joints at theirs is short. Of 107 poses of a Panda near limits that the first looks miss, of 8,000,
these miss 7; eight looks over the whole range at once and five closer ones miss 35."""

CHOICE = (
    *(Look(False, 0.0), Look(False, 1 / 3), Look(False, -1 / 3)),
    *(Look(True, 1 / 2), Look(True, 1 / 12), Look(True, 1 / 72)),
)
"""Looks for the arm nearest to a given one."""


def trials(form: ClosedForm, looks: tuple[Look, ...]) -> int:
    """How many of the looks an arm needs: one if no joint is swept, and it need not be searched."""
    if form.swept:
        return len(looks)
    return TRIES if isinstance(form, PassingArm) else 1


def beginnings(looks: tuple[Look, ...]) -> list[int]:
    """Trials from which on what was found before does not count."""
    return [i for i, look in enumerate(looks) if look.begins]


def place_form(
    form: ClosedForm,
    palm: Pose,
    lower: Expr,
    upper: Expr,
    trial: Expr,
    around: Expr,
    window: Expr,
) -> tuple[Expr, Expr, Expr]:
    """One trial of the search for an arm far from its limits.

    Args:
        form: The arm.
        palm: Palm pose, base frame.
        lower: (n, 1) bounds of the arm [rad].
        upper: (n, 1).
        trial: Its number, from 0.
        around: Best position of the swept joint so far [rad].
        window: In which of the `WINDOWS` ways late looks go through the parts of the range.

    Returns:
        The best arm (n, 1) [rad] of the trial, its margin (the smallest distance of a joint from
        its bounds [rad], negative if outside), and its swept position.
    """
    if isinstance(form, PassingArm):
        at = best_at(form, "place_at", _placed(form), near=False)
        begin = form.middle + TURN / TRIES * ca.fmod(trial, TRIES)
        given = (palm.rotation, palm.origin, lower, upper, begin)
        return _looked(form, "place", at, THOROUGH, given)(trial, around, window)
    symbols = _Symbols(form)
    best: tuple[Expr, ...] = ()
    ends = symbols.lower, symbols.upper
    for found in form.bends(symbols.palm, symbols.position):
        bend = _at_held(form, found, *ends)
        margins = [_margin(end, *ends) for end in bend.ends]
        common = ca.fmin(_margin(bend.joints, *ends), _short(bend))
        arm = ca.if_else(margins[0] >= margins[1], *bend.arms())
        best = _better(best, (ca.fmin(ca.fmax(*margins), common), arm))
    margin, arm = best
    at = ca.Function("place_at", symbols.at, shared(arm, margin))
    looked = _looked(form, "place", at, THOROUGH, (palm.rotation, palm.origin, lower, upper))
    return looked(trial, around, window)


def choose_form(
    form: ClosedForm, palm: Pose, wanted: Wanted, trial: Expr, around: Expr
) -> tuple[Expr, Expr, Expr]:
    """One trial of the search for the arm nearest to a given one.

    Args:
        form: The arm.
        palm: Palm pose, base frame.
        wanted: What it is chosen by.
        trial: Its number, from 0.
        around: Best position of the swept joint so far [rad].

    Returns:
        The best arm (n, 1) [rad] of the trial, its score (see `Wanted`), its swept position.
    """
    if isinstance(form, PassingArm):
        at = best_at(form, "choose_at", _chosen(form, wanted.scales), near=True)
        given = (palm.rotation, palm.origin, wanted.lower, wanted.upper, wanted.near)
        return _looked(form, "choose", at, CHOICE, given)(trial, around, 0.0)
    symbols = _Symbols(form)
    near = ca.SX.sym("near", len(form.screws))
    asked = Wanted(near, symbols.lower, symbols.upper, wanted.scales)
    best: tuple[Expr, ...] = ()
    for found in form.bends(symbols.palm, symbols.position):
        bend = _nearest_turns(form, found, asked)
        cost, margin = _cost(bend.joints, asked)
        margin = ca.fmin(margin, _short(bend))
        ends = [_cost(end, asked) for end in bend.ends]
        scores = [_score(cost + c, ca.fmin(margin, m)) for c, m in ends]
        arm = ca.if_else(scores[0] >= scores[1], *bend.arms())
        best = _better(best, (ca.fmax(*scores), arm))
    most, arm = best
    at = ca.Function("choose_at", [*symbols.at, near], shared(arm, most))
    given = (palm.rotation, palm.origin, wanted.lower, wanted.upper, wanted.near)
    return _looked(form, "choose", at, CHOICE, given)(trial, around, 0.0)


def _placed(form: ClosedForm) -> Scored:
    """An arm, its held joints moved by whole turns, and its margin."""

    def scored(arm: Expr, short: Expr, lower: Expr, upper: Expr, _: Expr) -> tuple[Expr, Expr]:
        found = Bend(dict(enumerate(ca.vertsplit(arm))), ({}, {}), short)
        joints = _at_held(form, found, lower, upper).joints
        return ca.vertcat(*joints.values()), ca.fmin(_margin(joints, lower, upper), short)

    return scored


def _chosen(form: ClosedForm, scales: ca.DM) -> Scored:
    """An arm moved by whole turns towards a given one, and its score."""

    def scored(arm: Expr, short: Expr, lower: Expr, upper: Expr, near: Expr) -> tuple[Expr, Expr]:
        asked = Wanted(near, lower, upper, scales)
        found = Bend(dict(enumerate(ca.vertsplit(arm))), ({}, {}), short)
        joints = _nearest_turns(form, found, asked).joints
        cost, margin = _cost(joints, asked)
        return ca.vertcat(*joints.values()), _score(cost, ca.fmin(margin, short))

    return scored


class _Symbols:
    """What an arm at a position of the swept joint is a function of."""

    def __init__(self, form: ClosedForm) -> None:
        count = len(form.screws)
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        self.palm = Pose(rotation, origin)
        self.position = ca.SX.sym("position")
        self.lower, self.upper = ca.SX.sym("lower", count), ca.SX.sym("upper", count)
        self.at = [self.position, rotation, origin, self.lower, self.upper]


def _looked(
    form: ClosedForm, name: str, at: ca.Function, looks: tuple[Look, ...], given: tuple[Expr, ...]
) -> Callable[[Expr, Expr, Expr], tuple[Expr, Expr, Expr]]:
    """A trial: the best of the arms at its positions, its score, and its position.

    One function that is called for each position: written out, they would be most of the code.

    Args:
        form: The arm.
        name: Of the search.
        at: (position, given ...) -> arm and score.
        looks: Where the trials look.
        given: Palm, bounds and what else `at` asks for.
    """

    def look(trial: Expr, around: Expr, window: Expr) -> tuple[Expr, Expr, Expr]:
        joint = form.swept_joint
        if joint is None:
            arm, score = at(0.0, *given)
            return arm, score, around
        symbols = [ca.SX.sym(word) for word in ("lower", "upper", "trial", "around", "window")]
        samples = FEWER if isinstance(form, PassingArm) else SAMPLES
        at_these = shared(*_positions(looks, samples, *symbols))
        spread = ca.Function(f"{name}_positions", symbols, at_these)
        positions = spread(given[2][joint], given[3][joint], trial, around, window)
        found = [(*at(position, *given), position) for position in positions]
        count = len(form.screws)
        tried = [(ca.SX.sym("arm", count), ca.SX.sym("score"), ca.SX.sym("at")) for _ in found]
        best: tuple[Expr, ...] = ()
        for arm, score, position in tried:
            best = _better(best, (score, arm, position))
        score, arm, position = best
        inputs = [each for one in tried for each in one]
        chosen = ca.Function(f"{name}_best", inputs, shared(arm, score, position))
        q, most, place = chosen(*(each for one in found for each in one))
        return q, most, place

    return look


def _positions(
    looks: tuple[Look, ...],
    samples: int,
    lower: Expr,
    upper: Expr,
    trial: Expr,
    around: Expr,
    window: Expr,
) -> list[Expr]:
    """Positions of the swept joint that a trial looks at."""
    middle, half = (lower + upper) / 2, ca.fmin((upper - lower) / 2, np.pi)
    between = ca.fmod(GOLDEN * window, 1.0)
    centre, width = middle, half
    for i, look in enumerate(looks):
        inside, reach, by = middle, half, ca.SX(look.by)
        if look.part is not None:
            part = ca.fmod(look.part + window, PARTS)
            inside, reach = middle + half * ((2 * part + 1) / PARTS - 1), half / PARTS
            by = look.by - 0.5 + between / 4
        step = 2 * reach / samples
        at = around if look.around else inside + by * step
        wide = look.by * step / 2 if look.around else reach
        centre = ca.if_else(trial == i, at, centre)
        width = ca.if_else(trial == i, wide, width)
    parts = ((2 * np.arange(samples) + 1) / samples - 1).tolist()
    return [ca.fmin(ca.fmax(centre + width * p, middle - half), middle + half) for p in parts]


def _nearest_turns(form: ClosedForm, bend: Bend, wanted: Wanted) -> Bend:
    """Joints that turn more than once moved by whole turns towards the given arm."""

    def nearest(joint: int, angle: Expr) -> Expr:
        turns = ca.floor((wanted.near[joint] - angle) / TURN + 0.5)
        moved = angle + TURN * turns
        margin = ca.fmin(moved - wanted.lower[joint], wanted.upper[joint] - moved)
        return ca.if_else(margin >= ALLOWED, moved, angle)

    return _turned(form, bend, nearest)


def _at_held(form: ClosedForm, bend: Bend, lower: Expr, upper: Expr) -> Bend:
    """Joints that turn more than once moved by whole turns to where they are held, if they are."""
    return _turned(form, bend, lambda i, angle: at_held(angle, lower[i], upper[i]))


def _turned(form: ClosedForm, bend: Bend, moved: Callable[[int, Expr], Expr]) -> Bend:
    """The bend with every joint that turns all around moved, given its number and its angle."""
    ranges = form.screws.upper - form.screws.lower
    around = [i for i, wide in zip(form.screws.joints, ranges >= AROUND, strict=True) if wide]

    def each(joints: dict[int, Expr]) -> dict[int, Expr]:
        return {i: moved(i, angle) if i in around else angle for i, angle in joints.items()}

    return Bend(each(bend.joints), (each(bend.ends[0]), each(bend.ends[1])), bend.slack)


def _margin(joints: dict[int, Expr], lower: Expr, upper: Expr) -> Expr:
    """Smallest distance of some joints from their bounds."""
    margins = [ca.fmin(angle - lower[i], upper[i] - angle) for i, angle in joints.items()]
    return ca.mmin(ca.vertcat(*margins))


def _short(bend: Bend) -> Expr:
    """A margin for what is out of reach: the slack if it is negative."""
    return ca.if_else(bend.slack < 0, bend.slack, np.inf)


def _cost(joints: dict[int, Expr], wanted: Wanted) -> tuple[Expr, Expr]:
    rows = list(joints)
    return wanted.part(rows).cost(ca.vertcat(*joints.values()))


def _score(cost: Expr, margin: Expr) -> Expr:
    return ca.if_else(margin >= ALLOWED, -cost, OUTSIDE + margin)


def _better(one: tuple[Expr, ...], other: tuple[Expr, ...]) -> tuple[Expr, ...]:
    """Whichever is first or has the larger first entry."""
    if not one:
        return other
    keep = one[0] >= other[0]
    return tuple(ca.if_else(keep, a, b) for a, b in zip(one, other, strict=True))
