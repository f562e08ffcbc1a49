"""Arms whose last axis passes by the point where the two before it meet: Sawyer, xArm 6.

With the last joint at t, the point follows from the palm pose, and the other joints from the point
as those of the arm with a spherical wrist beside it, the ideal arm (Pieper 1968), whose last axis
goes through the point. The ideal arm turns its last joint by some angle g(t); where ``g(t) = t``
the arm is the real one. So the search is for the roots of one function of one angle, on each of the
eight branches of the ideal arm. It changes slowly: by the offset, to how far the point is from the
first axes.

All roots: on a branch the condition is looked at all around the last joint's turn, and between each
two of these places where a parabola is highest or lowest, since two roots may be near each other;
where it changes its sign there is a root. What is lost are two arms near each other at the edge of
reach, where the condition has a kink.

The best arm: all branches are seen with the last joint somewhere, and each then once more with the
last joint as the ideal arm turned it: near enough for the best of them to be chosen. That one is
followed by secants to where the ideal arm is the real one but for a thousandth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import SIGNS, ArmFamily, Redundancy, Score, margin
from casadi_ik.kinematics.arms.screws import Screws, Turn
from casadi_ik.kinematics.arms.six_joints import SphericalArm
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, shared

TURN = 2 * np.pi

TINY = 1e-300

ROOTS = 4
"""Of a branch, at most: of 200 random poses of an xArm 6 two branches had as many."""


@dataclass(frozen=True)
class RootSearch:
    """How the last joint is searched for.

    Attributes:
        places: Turns of the last joint looked at for all roots.
        steps: From there to a root, of Anderson and Bjorck's (1973) method.
        closed: What they may leave of the condition [rad].
        edge: Nearer to a place, as a part of the way to the next, it is not looked at again.
        secants: Steps on the branch that was chosen for the best arm.
        loose: What may be left of the condition [rad] on the branches that one is chosen from.
        strict: Below this [rad] the ideal arm is that of t, for `newton_polish` to end.
        slope: That of ``g(t) - t`` is taken for no flatter: it is near -1 where a root is alone.
        step: Longest of t [rad].
    """

    places: int = 40
    steps: int = 20
    closed: float = 1e-9
    edge: float = 0.01
    secants: int = 2
    loose: float = 0.5
    strict: float = 1e-3
    slope: float = -0.2
    step: float = 1.0


SEARCH = RootSearch()


@dataclass(frozen=True, eq=False)
class OffsetWristArm(ArmFamily):
    """An arm with an ideal one beside it.

    Attributes:
        screws: Of the real arm, in the order of the ideal arm's solution.
        ideal: Its last axis goes through the sphere's point.
        offset: (3,) from that point to the real last axis [m].
        model_error: What the secants leave [m and rad].
    """

    screws: Screws
    ideal: SphericalArm
    offset: Array
    model_error: float = SEARCH.strict
    rows = len(SIGNS) * ROOTS
    roots = ROOTS
    starts = 3

    @property
    def kind(self) -> str:
        """That of the ideal arm, and which joint is off it."""
        return f"{self.ideal.kind}, joint {self.last + 1} off it"

    @property
    def parts(self) -> tuple[str, str, str]:
        """Those of the ideal arm."""
        return self.ideal.parts

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """That of the ideal arm."""
        return self.ideal.redundancy

    @property
    def last(self) -> int:
        """Number of the joint whose axis passes by the sphere."""
        return self.screws.joints[-1]

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """By the middle of the circle that the sphere's point is on."""
        motion = self.screws.motion(palm)
        middle = Pose(motion.rotation, motion.origin + motion.rotation @ ca.DM(self.offset))
        beyond = self.ideal.beyond_reach(middle, lower, upper)
        radius = float(np.linalg.norm(self.offset))
        return beyond - ca.fmin(ca.fmax(beyond, -radius), radius)

    def arms(self) -> ca.Function:
        """All roots on all branches."""
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        redundancy = ca.MX.sym("redundancy", self.size)
        left_rotation, left_origin, *_ = self._begin()(redundancy, rotation, origin)
        on_branch, whole = self._all_roots(), self._whole()
        arms, slacks = [], []
        for signs in SIGNS:
            found, slack = on_branch(left_rotation, left_origin, *signs)
            arms += [whole(found[i, :].T, redundancy).T for i in range(ROOTS)]
            slacks.append(slack)
        outputs = [ca.vertcat(*arms), ca.vertcat(*slacks)]
        return ca.Function("arms", [rotation, origin, redundancy], outputs)

    def best(self, name: str, score: Score) -> ca.Function:
        """Searched from where `near` has the last joint."""
        n = len(self.screws)
        redundancy = ca.MX.sym("redundancy", self.size)
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        lower, upper, near = (ca.MX.sym(word, n) for word in ("lower", "upper", "near"))
        given = [redundancy, lower, upper, near]
        left_rotation, left_origin, plus, minus = self._begin()(redundancy, rotation, origin)
        left = left_rotation, left_origin
        branch, condition, secant = self._branch(), self._condition(), _next_turn()
        loose, strict = (self._scored(score, most) for most in (SEARCH.loose, SEARCH.strict))
        first, seen = near[self.last], []
        for one, two in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            signs = [plus if sign > 0 else minus for sign in (one, two)]
            rests = _both(condition(*left, first, *signs, plus))
            for end, was in zip((plus, minus), rests, strict=True):
                t = first + was
                arm, slack, rest = branch(*left, t, *signs, end)
                _, reached = loose(arm, slack, rest, *given)
                seen.append((reached, *signs, end, t, rest, first, was))
        chosen = _best(len(seen))(*(value for each in seen for value in each))
        one, two, end, t, rest, before, was = chosen
        arm, slack = ca.MX(6, 1), ca.MX(1)
        for _ in range(SEARCH.secants):
            t, before, was = secant(t, rest, before, was), t, rest
            arm, slack, rest = branch(*left, t, one, two, end)
        found, reached = strict(arm, slack, rest, *given)
        inputs = [redundancy, rotation, origin, lower, upper, near]
        return ca.Function(name, inputs, [found, reached])

    def _begin(self) -> ca.Function:
        """(redundancy, rotation, origin) -> the motion of six screws, and the numbers 1 and -1.

        The signs of branches are given as outputs: constants cannot be inputs of the inner
        functions of a step for several solves side by side.
        """
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        redundancy = ca.SX.sym("redundancy", self.size)
        left = self._real.left(Pose(rotation, origin), redundancy)
        outputs = [left.rotation, left.origin, ca.SX(1), ca.SX(-1)]
        return ca.Function("begin", [redundancy, rotation, origin], outputs)

    @property
    def _real(self) -> SphericalArm:
        """The ideal arm with the real screws, for what comes before its solution."""
        return replace(self.ideal, screws=self.screws)

    def _branch(self) -> ca.Function:
        """(rotation, origin, t, two signs of the bend and one of the end) of the ideal arm.

        Returns:
            The six joints (6, 1) [rad] in the order of the screws, the slack, and what is left of
            the condition: ``g(t) - t`` in [-pi, pi] [rad].
        """
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        t, one, two, end = (ca.SX.sym(name) for name in ("t", "one", "two", "end"))
        back = Turn(ca.cos(t), -ca.sin(t)).about(self.screws.axes[-1])
        shift = ca.DM(self.offset) - back @ ca.DM(self.offset)
        moved = Pose(rotation, origin + rotation @ shift)
        (bend,) = self.ideal.six(moved, (one, two))
        ((plus, minus),) = bend.ends
        ends = {joint: ca.if_else(end > 0, angle, minus[joint]) for joint, angle in plus.items()}
        joints = bend.joints | ends
        arm = ca.vertcat(*(joints[self.screws.joints[place]] for place in self.ideal.places))
        rest = ends[self.last] - t
        rest -= TURN * ca.floor(rest / TURN + 0.5)
        inputs = [rotation, origin, t, one, two, end]
        return ca.Function("branch", inputs, shared(arm, bend.slack, rest))

    def _condition(self) -> ca.Function:
        """What is left of the condition alone, of the inputs of `_branch`."""
        whole = self._branch()
        inputs = whole.sx_in()
        return ca.Function("condition", inputs, shared(whole(*inputs)[2]))

    def _joined(self, six: Expr, redundancy: Expr) -> Expr:
        """All joints (n, 1), in their order, of the six in the order of their screws."""
        joints = {self.screws.joints[p]: six[i] for i, p in enumerate(self.ideal.places)}
        for i, one in enumerate(self.redundancy):
            joints[one.joint or 0] = redundancy[i]
        return ca.vertcat(*(joints[i] for i in range(len(joints))))

    def _whole(self) -> ca.Function:
        six, redundancy = ca.SX.sym("six", 6), ca.SX.sym("redundancy", self.size)
        return ca.Function("whole", [six, redundancy], [self._joined(six, redundancy)])

    def _scored(self, score: Score, most: float) -> ca.Function:
        """(six, slack, rest, redundancy, lower, upper, near) -> the arm and its score.

        More than `most` [rad] left of the condition is out of reach.
        """
        n, six = len(self.screws), ca.SX.sym("six", 6)
        slack, rest = ca.SX.sym("slack"), ca.SX.sym("rest")
        redundancy = ca.SX.sym("redundancy", self.size)
        lower, upper, near = (ca.SX.sym(word, n) for word in ("lower", "upper", "near"))
        arm, wide = self._joined(six, redundancy), self.screws.turning
        joints = {
            i: score.moved(i, arm[i], lower, upper, near) if i in wide else arm[i] for i in range(n)
        }
        short = ca.if_else(ca.fabs(rest) > most, -ca.fabs(rest), np.inf)
        short = ca.fmin(short, ca.if_else(slack < 0, slack, np.inf))
        least = ca.fmin(margin(joints, lower, upper), short)
        outputs = ca.vertcat(*joints.values()), score.total(score.cost(joints, near), least)
        inputs = [six, slack, rest, redundancy, lower, upper, near]
        name = "loose" if most == SEARCH.loose else "strict"
        return ca.Function(name, inputs, shared(*outputs))

    def _all_roots(self) -> ca.Function:
        """(rotation, origin, three signs) -> six joints of every root (`ROOTS`, 6), the slack."""
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        signs = [ca.MX.sym("sign") for _ in range(3)]
        at, condition, narrowed = self._branch(), self._condition(), _narrowed()
        step, between, count = TURN / SEARCH.places, _between(), SEARCH.places
        middle = float(self.screws.lower[-1] + self.screws.upper[-1]) / 2
        first = [middle + step * i for i in range(count)]
        around = [condition(rotation, origin, place, *signs) for place in first]
        places, rests = [], []
        for i, place in enumerate(first):
            part = between(*(around[(i + k) % count] for k in (-1, 0, 1, 2)))
            places += [ca.MX(place), place + step * part]
            rests += [around[i], condition(rotation, origin, places[-1], *signs)]
        begins = _changes()(*places, *rests)
        arms, slacks = [], []
        for root in range(ROOTS):
            *bracket, t, is_root = begins[6 * root : 6 * root + 6]
            for _ in range(SEARCH.steps):
                *bracket, t = narrowed(*bracket, t, condition(rotation, origin, t, *signs))
            arm, slack, rest = at(rotation, origin, t, *signs)
            arms.append(arm.T)
            slacks.append(_known()(slack, rest, is_root))
        outputs = [ca.vertcat(*arms), ca.vertcat(*slacks)]
        return ca.Function("on_branch", [rotation, origin, *signs], outputs)


def _next_turn() -> ca.Function:
    """(t, what is left, t before, what was left there) -> the next t of the secant method."""
    t, rest, before, was = (ca.SX.sym(name) for name in ("t", "rest", "before", "was"))
    change = t - before
    moved = ca.fabs(change) > 1e-12
    slope = ca.if_else(moved, (rest - was) / ca.if_else(moved, change, 1.0), -1.0)
    slope = ca.fmin(ca.fmax(slope, -5.0), SEARCH.slope)
    step = ca.fmin(ca.fmax(-rest / slope, -SEARCH.step), SEARCH.step)
    return ca.Function("next_turn", [t, rest, before, was], shared(t + step))


def _both(rest: Expr) -> tuple[Expr, Expr]:
    """What is left of the condition at one end and at the other, half a turn away."""
    given = ca.SX.sym("rest")
    other = given + ca.if_else(given > 0, -np.pi, np.pi)
    one, two = ca.Function("both", [given], [given, other])(rest)
    return one, two


def _best(count: int) -> ca.Function:
    """Of so many rows of eight numbers the seven behind the largest first one."""
    rows = [[ca.SX.sym("value") for _ in range(8)] for _ in range(count)]
    best = rows[0]
    for row in rows[1:]:
        keep = best[0] >= row[0]
        best = [ca.if_else(keep, a, b) for a, b in zip(best, row, strict=True)]
    return ca.Function("best_branch", [value for row in rows for value in row], shared(*best[1:]))


def _between() -> ca.Function:
    """(what is left at four places) -> the part of the way from the second to the third.

    Where a parabola through three of them is highest or lowest, if that is between the two.
    """
    before, here, there, behind = given = [ca.SX.sym("rest") for _ in range(4)]
    part: Expr = ca.SX(0.5)
    for one, middle, other, start in ((here, there, behind, 1.0), (before, here, there, 0.0)):
        bent, rise = one + other - 2 * middle, other - one
        straight = ca.fabs(bent) < TINY
        at = start - ca.if_else(straight, 0.0, rise / (2 * ca.if_else(straight, 1.0, bent)))
        part = ca.if_else(ca.logic_and(at > SEARCH.edge, at < 1 - SEARCH.edge), at, part)
    return ca.Function("between", given, shared(part))


def _changes() -> ca.Function:
    """(places ..., what is left at every place ...) -> six numbers for every root.

    The place before it and what is left there, the place behind it likewise, where a line between
    them is zero, and whether there is a root at all.
    """
    places = [ca.SX.sym("place") for _ in range(2 * SEARCH.places)]
    rests = [ca.SX.sym("rest") for _ in places]
    passed: Expr = ca.SX(0)
    found = [[ca.SX(0) for _ in range(6)] for _ in range(ROOTS)]
    for i, place in enumerate(places):
        behind = places[i + 1] if i + 1 < len(places) else places[0] + TURN
        here, there = rests[i], rests[(i + 1) % len(places)]
        changes = ca.logic_and(here * there <= 0, ca.fabs(there - here) < np.pi)
        values = (place, here, behind, there, _zero(place, here, behind, there), 1.0)
        for root in range(ROOTS):
            taken = ca.logic_and(changes, passed == root)
            found[root] = [
                ca.if_else(taken, value, old)
                for value, old in zip(values, found[root], strict=True)
            ]
        passed = passed + changes
    outputs = [value for each in found for value in each]
    return ca.Function("changes", [*places, *rests], shared(*outputs))


def _zero(one: Expr, here: Expr, other: Expr, there: Expr) -> Expr:
    """Where a line is zero; the middle where it is level."""
    rise = there - here
    level = ca.fabs(rise) < TINY
    part = ca.if_else(level, 0.5, -here / ca.if_else(level, 1.0, rise))
    return one + part * (other - one)


def _narrowed() -> ca.Function:
    """A step of Anderson and Bjorck's method: secants that keep the root between two places.

    Returns:
        (one place, what is left there, the other, what is left there, t, what is left at it) ->
        the first four and t anew.
    """
    one, here, other, there, t, at = given = [ca.SX.sym("value") for _ in range(6)]
    crossed = at * there <= 0
    ratio = 1 - at / ca.if_else(ca.fabs(there) < TINY, 1.0, there)
    weight = ca.if_else(ratio > 0, ratio, 0.5)
    start = ca.if_else(crossed, other, one)
    left_there = ca.if_else(crossed, there, weight * here)
    outputs = [start, left_there, t, at, _zero(start, left_there, t, at)]
    return ca.Function("narrowed", given, shared(*outputs))


def _known() -> ca.Function:
    """(slack, what is left, whether it is a root) -> the slack, negative where there is no root."""
    slack, rest, is_root = given = [ca.SX.sym(name) for name in ("slack", "rest", "is_root")]
    closed = ca.logic_and(is_root > 0, ca.fabs(rest) <= SEARCH.closed)
    return ca.Function("known", given, [ca.if_else(closed, slack, ca.fmin(slack, -1.0))])
