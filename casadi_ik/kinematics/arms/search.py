"""The search of the loop for an arm: all branches at some values of the redundancy in every trial.

Where a family knows the values at which joints stand at their bounds, its breakpoints, the first
trial looks at values all around, and if none is allowed, the next ones look at the breakpoints: the
allowed values are intervals that end there, so none is missed, however short. Of other families
trials look all over the bounds, each time at values between those before, and in between ever
closer around the best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.files.arrays import Array, even_steps
from casadi_ik.kinematics.arms.family import ArmFamily, ClosedForm, Score, better
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, shared

TURN = 2 * np.pi


@dataclass(frozen=True)
class Level:
    """Where a trial looks.

    Attributes:
        around: Whether around the best so far, else all over the bounds.
        by: Half the width, or the shift [steps of the first trial]. Of a redundancy of r numbers
            the volume shrinks by as much.
    """

    around: bool
    by: float


@dataclass(frozen=True)
class ArmSearchParameters:
    """How arms are searched for.

    Attributes:
        samples: Values of the redundancy looked at in a trial.
        iterative_samples: As many of an iterative family: each of them costs more.
        joint_samples: As many where several joints are locked, in as many more trials: for most
            palm poses one of the first places is within limits.
        block: Breakpoints looked at in a trial.
        placement: Trials for an arm far from its limits. Of 20,000 random poses of a Panda 2,427
            need more than the first, 369 more than two, 6 more than all.
        choice: Trials for the arm nearest to a given one.
        swivels: The same of a family with breakpoints, at which placement finds what these miss.
            The distance is flat where it is smallest: the last values, 0.8 deg apart, are near
            enough.
        parts: Of the bounds, each searched by itself for poses that were given up before: what is
            best of all may be short of the limits everywhere, and a stretch where an arm stands
            with several joints at theirs is short. Of 20,000 grasps of a Panda near its limits, at
            1e-6, none is missed with them and 39 without.
        allowed: Margin [rad] that still counts as within limits: rounding at a breakpoint.
        no_margin: Margin before any arm was seen.
        outside: Score of an arm outside its bounds, less what it is outside by [rad].
    """

    samples: int = 6
    iterative_samples: int = 3
    joint_samples: int = 1
    block: int = 8
    placement: tuple[Level, ...] = (
        *(Level(False, 0.0), Level(True, 1.0), Level(False, 1 / 3), Level(True, 1 / 2)),
        *(Level(False, -1 / 3), Level(True, 1 / 3), Level(True, 1 / 18), Level(True, 1 / 108)),
        Level(True, 1 / 600),
    )
    choice: tuple[Level, ...] = (
        *(Level(False, 0.0), Level(False, 1 / 3), Level(False, -1 / 3)),
        *(Level(True, 1 / 2), Level(True, 1 / 12), Level(True, 1 / 72)),
    )
    swivels: tuple[Level, ...] = (
        *(Level(False, 0.0), Level(False, 1 / 2), Level(True, 1 / 2), Level(True, 1 / 12)),
    )
    parts: int = 4
    allowed: float = -1e-9
    no_margin: float = -1e9
    outside: float = -1e3


PARAMETERS = ArmSearchParameters()


class Farthest(Score):
    """Far from its limits: the margin counts."""

    def moved(self, joint: int, angle: Expr, lower: Expr, upper: Expr, near: Expr) -> Expr:
        """The turn in which the joint is held, if its bounds are equal."""
        del near
        turns = ca.floor((lower[joint] - angle) / TURN + 0.5)
        return ca.if_else(lower[joint] < upper[joint], angle, angle + TURN * turns)

    def cost(self, joints: dict[int, Expr], near: Expr) -> Expr:
        """Nothing."""
        del joints, near
        return 0.0

    def total(self, cost: Expr, margin: Expr) -> Expr:
        """The margin."""
        del cost
        return margin

    def part(self, joints: object) -> Score:
        """The same."""
        del joints
        return self


@dataclass(frozen=True, eq=False)
class Nearest(Score):
    """Near to a given arm, within the bounds.

    Attributes:
        scales: (n,) what joint motions are multiplied by before they are squared, numbers: as an
            input of a function they would keep solves from going side by side.
    """

    scales: Array

    @classmethod
    def by_ranges(cls, ranges: Array) -> Nearest:
        """Every joint as a part of its range [rad]."""
        return cls(1 / np.maximum(ranges, 1e-9))

    def moved(self, joint: int, angle: Expr, lower: Expr, upper: Expr, near: Expr) -> Expr:
        """The turn nearest to the given arm, if it is within the bounds."""
        moved = angle + TURN * ca.floor((near[joint] - angle) / TURN + 0.5)
        margin = ca.fmin(moved - lower[joint], upper[joint] - moved)
        return ca.if_else(margin >= PARAMETERS.allowed, moved, angle)

    def cost(self, joints: dict[int, Expr], near: Expr) -> Expr:
        """Squared distance."""
        away = [float(self.scales[i]) * (angle - near[i]) for i, angle in joints.items()]
        return ca.sumsqr(ca.vertcat(*away))

    def total(self, cost: Expr, margin: Expr) -> Expr:
        """Minus the distance; outside the bounds what it is outside by."""
        return ca.if_else(margin >= PARAMETERS.allowed, -cost, PARAMETERS.outside + margin)

    def part(self, joints: list[int]) -> Score:  # type: ignore[override]
        """Of some joints."""
        return Nearest(self.scales[joints])


def is_allowed(score: Expr) -> Expr:
    """Whether the arm with a score of `Nearest` is within its bounds."""
    return score > PARAMETERS.outside / 2


@dataclass(frozen=True, eq=False)
class ArmTrials:
    """The trials for an arm of a family.

    Attributes:
        family: The arm's.
        score: What arms are compared by, `Farthest` or `Nearest`.
    """

    family: ArmFamily
    score: Score

    @property
    def trials(self) -> int:
        """How many there are."""
        if not self._varied:
            return self._starts
        if self._breaks:
            return 1 + 2 * self._blocks
        return len(self._levels)

    @property
    def all_trials(self) -> int:
        """How many there are with those in parts of the bounds."""
        by_parts = self._varied == 1 and not self._breaks and not self.is_nearest
        return self.trials * (1 + PARAMETERS.parts) if by_parts else self.trials

    @property
    def patience(self) -> int:
        """Trials after which no arm within bounds is hoped for: breakpoints know better then."""
        if _break_count(self.family):
            return sum(not level.around for level in self._levels)
        return self.trials

    @property
    def closer(self) -> int | None:
        """The first trial around the best so far; None if nothing is varied."""
        closer = (i for i, level in enumerate(self._levels) if level.around)
        return next(closer) if self._varied else None

    @property
    def is_nearest(self) -> bool:
        """Whether arms near to a given one are wanted."""
        return isinstance(self.score, Nearest)

    def begins(self, trial: Expr) -> Expr:
        """Whether what was found in trials before does not count: another part begins."""
        starts = range(self.trials, self.all_trials, self.trials)
        return sum((trial == i for i in starts), ca.SX(0)) > 0

    def trial(
        self,
        palm: Pose,
        bounds: tuple[Expr, Expr],
        trial: Expr,
        best: tuple[Expr, Expr],
        visit: Expr,
        near: Expr | None = None,
    ) -> tuple[Expr, Expr, Expr]:
        """One trial, as calls of functions.

        Args:
            palm: Palm pose, base frame.
            bounds: (n, 1) lower and upper ones of the arm [rad].
            trial: Its number, from 0.
            best: Best arm (n, 1) so far [rad], and its swivel.
            visit: Number of the search: each looks at other values.
            near: (n, 1) the arm to be near to, for `Nearest`.

        Returns:
            The best arm (n, 1) [rad] of the trial, its score, and the last number of its redundancy
            [rad], which is the swivel of an S-R-S arm.
        """
        # What is not looked at is passed on all the same: constants cannot be inputs.
        given = bounds[0] if near is None else near
        near, *values = self._values()(trial, *best, *bounds, visit, given)
        inputs = [palm.rotation, palm.origin, *bounds, near]
        if not self._breaks:
            return self._look(len(values))(*inputs, *values)
        look = ca.Function.if_else("trial", self._sampled(len(values)), self._at_breakpoints())
        return look(trial < 1, *inputs, *values, trial)

    @property
    def _levels(self) -> tuple[Level, ...]:
        if not self.is_nearest and self._varied > 1:
            times = PARAMETERS.samples // self._samples
            return tuple(level for level in PARAMETERS.placement for _ in range(times))
        if not self.is_nearest:
            return PARAMETERS.placement
        return PARAMETERS.swivels if _break_count(self.family) else PARAMETERS.choice

    @property
    def _varied(self) -> int:
        """How many numbers of the redundancy are varied, the last ones."""
        count = len(self.family.redundancy)
        # Near to an arm the locked joints are where that has them.
        return count - len(self.family.locked) if self.is_nearest else count

    @property
    def _starts(self) -> int:
        return 1 if self.is_nearest else self.family.starts

    @property
    def _breaks(self) -> int:
        return 0 if self.is_nearest else _break_count(self.family)

    @property
    def _blocks(self) -> int:
        return -(-self._breaks // PARAMETERS.block)

    @property
    def _samples(self) -> int:
        if not self._varied:
            return 1
        if self._varied > 1:
            return PARAMETERS.joint_samples
        iterative = self.family.is_iterative
        return PARAMETERS.iterative_samples if iterative else PARAMETERS.samples

    def _values(self) -> ca.Function:
        """(trial, best arm, its swivel, lower, upper, visit, near) -> near, values (r, 1) ..."""
        n, family = len(self.family.screws), self.family
        trial, swivel, visit = (ca.SX.sym(word) for word in ("trial", "swivel", "visit"))
        arm, lower, upper, near = (ca.SX.sym(w, n) for w in ("arm", "lower", "upper", "near"))
        inputs = [trial, arm, swivel, lower, upper, visit, near]
        ends = [one.bounds(lower, upper) for one in family.redundancy]
        low, high = (ca.vertcat(*(end[i] for end in ends)) for i in (0, 1))
        here = [swivel if one.joint is None else arm[one.joint] for one in family.redundancy]
        count = len(ends) - self._varied
        fixed = [ca.fmin(ca.fmax(near[j], lower[j]), upper[j]) for j in family.locked[:count]]
        if not ends or not self._varied:
            values = [ca.vertcat(*fixed) if ends else ca.SX.zeros(1)]
        elif self._varied == 1:
            spread = self._along(trial, here[-1], low[-1], high[-1], visit)
            if family.redundancy[-1].joint is not None:
                spread = [ca.fmin(ca.fmax(value, low[-1]), high[-1]) for value in spread]
            values = [ca.vertcat(*fixed, value) for value in spread]
        else:
            values = self._within(trial, ca.vertcat(*here), low, high, visit)
        if not self.is_nearest:
            turn = ca.fmod(trial, self._starts) * TURN / self._starts
            near = (lower + upper) / 2 + turn if family.is_iterative else near
        return ca.Function("values", inputs, shared(near, *values))

    def _along(self, trial: Expr, here: Expr, low: Expr, high: Expr, visit: Expr) -> list[Expr]:
        """Values of one number: all over its bounds, or over a part of them."""
        middle, half = (low + high) / 2, (high - low) / 2
        shift: Expr = ca.SX(0)
        if self.all_trials > self.trials:
            parts, run = PARAMETERS.parts, ca.floor(trial / self.trials)
            part = ca.fmod(run - 1 + visit, parts)
            trial = trial - run * self.trials
            middle = middle + ca.if_else(run > 0, half * ((2 * part + 1) / parts - 1), 0)
            half = ca.if_else(run > 0, half / parts, half)
            by_visit = visit * float(even_steps(1)[0])
            shift = ca.if_else(run > 0, (by_visit - ca.floor(by_visit) - 0.5) / 3, 0)
        step = 2 * half / self._samples
        centre, width = middle, half
        for i, level in enumerate(self._levels):
            at = here if level.around else middle + (level.by + shift) * step
            wide = level.by * step / 2 if level.around else half
            centre = ca.if_else(trial == i, at, centre)
            width = ca.if_else(trial == i, wide, width)
        parts = (2 * np.arange(self._samples) + 1) / self._samples - 1
        return [centre + width * float(part) for part in parts]

    def _within(self, trial: Expr, here: Expr, low: Expr, high: Expr, visit: Expr) -> list[Expr]:
        """Values of several numbers, evenly spread, from the middle on."""
        size, samples = self._varied, self._samples
        width: Expr = ca.SX(1)
        for i, level in enumerate(self._levels):
            if level.around:
                part = (level.by / PARAMETERS.samples) ** (1 / size)
                width = ca.if_else(trial == i, part, width)
        centre = ca.if_else(width < 1, here, (low + high) / 2)
        values = []
        for i in range(samples):
            number = (visit * len(self._levels) + trial) * samples + i
            spread = number * ca.DM(even_steps(size).tolist())
            spread = spread - ca.floor(spread + 0.5)
            value = centre + width * spread * (high - low)
            values.append(ca.fmin(ca.fmax(value, low), high))
        return values

    def _look(self, count: int) -> ca.Function:
        """(rotation, origin, lower, upper, near, values ...) -> the best of all, see `trial`.

        One function that is called for each value: written out, they would be most of the code.
        """
        best = self.family.best("best_at", self.score)
        inputs = best.mx_in()[1:]
        values = [ca.MX.sym("value", best.size1_in(0)) for _ in range(count)]
        at = _hoisted(best, inputs)
        found = [(*at(value), value[-1]) for value in values]
        outputs = _best_of(found)
        return ca.Function("look", [*inputs, *values], outputs)

    def _sampled(self, count: int) -> ca.Function:
        look = self._look(count)
        inputs = look.mx_in()
        return ca.Function("sampled", [*inputs, ca.MX.sym("trial")], list(look(*inputs)))

    def _at_breakpoints(self) -> ca.Function:
        """The same at a block of breakpoints; odd trials of the one elbow, even of the other."""
        family, n = self.family, len(self.family.screws)
        assert isinstance(family, ClosedForm)
        rotation, origin, sign = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3), ca.SX.sym("sign")
        lower, upper, near = (ca.SX.sym(word, n) for word in ("lower", "upper", "near"))
        palm, value = Pose(rotation, origin), ca.SX.sym("value")
        bends = family.bends(palm, value, (sign,))
        given = [rotation, origin, lower, upper, near, sign]
        best = family.best_of(bends, self.score, lower, upper, near)
        at_value = ca.Function("best_bent", [value, *given], shared(*best))
        block = ca.SX.sym("block")
        roots: Expr = family.breakpoints(palm, (sign,), lower, upper)
        size = PARAMETERS.block
        chosen = sum(
            (
                ca.if_else(block == b, roots[size * b : size * (b + 1)], 0.0)
                for b in range(self._blocks)
            ),
            ca.SX.zeros(size, 1),
        )
        roots_of = ca.Function("breakpoints", [block, *given], shared(*ca.vertsplit(chosen)))
        trial = ca.SX.sym("trial")
        parity = ca.if_else(ca.fmod(trial, 2) > 0.5, 1.0, -1.0)
        turn = ca.Function("turn", [trial], [parity, ca.floor((trial - 1) / 2)])
        inputs = [ca.MX.sym(x.name() if x.is_scalar() else "x", x.shape) for x in given[:-1]]
        number = ca.MX.sym("trial")
        unused = [ca.MX.sym("value") for _ in range(self._samples)]
        way, which = turn(number)
        values = roots_of(which, *inputs, way)
        at = _hoisted(at_value, [*inputs, way])
        outputs = _best_of([(*at(value), value) for value in values])
        return ca.Function("at_breakpoints", [*inputs, *unused, number], outputs)


@cache
def _break_count(family: ArmFamily) -> int:
    """How many breakpoints a bend has."""
    if not isinstance(family, ClosedForm):
        return 0
    n = len(family.screws)
    palm = Pose(ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3))
    found = family.breakpoints(palm, (ca.SX(1),), ca.SX.sym("low", n), ca.SX.sym("high", n))
    return 0 if found is None else found.numel()


def _hoisted(best: ca.Function, given: list[Expr]) -> Callable[[Expr], tuple[Expr, Expr]]:
    """A function of the redundancy and of what is given, the latter's part evaluated once."""
    if not best.is_a("SXFunction"):
        return lambda value: best(value, *given)
    value, *inputs = best.sx_in()
    outputs = best(value, *inputs)
    varying, symbols, constant = ca.extract_parametric(list(outputs), inputs)
    before = ca.Function("hoisted", inputs, shared(ca.vertcat(*constant)))
    names = ca.vertcat(*symbols)
    after = ca.Function(best.name(), [value, *inputs, names], shared(*varying))
    known = before(*given)
    return lambda value: after(value, *given, known)


def _best_of(found: list[tuple[Expr, Expr, Expr]]) -> list[Expr]:
    """Arm, score and value with the highest score."""
    chosen = _best_value(len(found), found[0][0].numel())
    return list(chosen(*(each for one in found for each in one)))


@cache
def _best_value(count: int, size: int) -> ca.Function:
    """So many arms of so many joints, each with score and value -> those of the highest score."""
    tried = [(ca.SX.sym("arm", size), ca.SX.sym("score"), ca.SX.sym("value")) for _ in range(count)]
    best: tuple[Expr, ...] = ()
    for arm, score, value in tried:
        best = better(best, (score, arm, value))
    score, arm, value = best
    return ca.Function(
        "best_value", [each for one in tried for each in one], shared(arm, score, value)
    )


def arms_graph(family: ArmFamily, name: str, recipe: str) -> FunctionGraph:
    """All branches at a value of the redundancy, of one vector.

    Args:
        family: The arm's.
        name: Of the function.
        recipe: What it follows from.

    Returns:
        Rotation (9, row by row), origin (3) [m] and redundancy [rad] -> the branches one after the
        other [rad], then the slack of each: >= 0 within reach.
    """
    size, rows = 12 + family.size, family.rows

    def build() -> ca.Function:
        symbols: Any = ca.MX if family.is_iterative else ca.SX
        x = symbols.sym("x", size)
        arms, slack = family.arms()(ca.reshape(x[:9], 3, 3).T, x[9:12], x[12:])
        both = ca.vertcat(ca.vec(arms.T), slack)
        return ca.Function(
            name, [x], [both] if family.is_iterative else shared(both), ["x"], ["arms"]
        )

    outputs = ((rows * (len(family.screws) + 1), 1),)
    return FunctionGraph(name, build, {"x": (size, 1)}, outputs, recipe)
