"""Search for an arm over its redundancy parameters, by trials that evaluate all branches.

If a family knows its breakpoints (the values at which joints reach their bounds), the first trial
samples the whole range; if no sample is feasible, the next trials evaluate the breakpoints.
Feasible values form intervals that end at breakpoints, so no interval is missed, however short. For
other families, trials alternate between finer samples of the whole range and samples around the
best value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arms.family import ArmFamily, ClosedForm, Score, better
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, with_cse

FULL_TURN = 2 * np.pi


@dataclass(frozen=True)
class Level:
    """Sampling of a trial.

    Attributes:
        is_local: True for samples around the best value, False for the whole range.
        extent: Half width if local, otherwise the shift [steps of the first trial]. With r
            redundancy parameters it scales the volume.
    """

    is_local: bool
    extent: float


@dataclass(frozen=True)
class ArmSearchParameters:
    """Parameters of the arm search.

    Attributes:
        samples: Values of the redundancy parameter per trial.
        iterative_samples: Values per trial for iterative families, whose samples cost more.
        joint_samples: Values per trial with several locked joints, in proportionally more trials;
            for most palm poses one of the first values is feasible.
        block: Breakpoints per trial.
        placement_levels: Trials for an arm far from its limits. Source: of 20,000 random poses of a
            Panda 2,427 need more than the first trial, 369 more than two, 6 more than all.
        nearest_levels: Trials for the arm nearest to a reference.
        nearest_levels_with_breakpoints: Trials for the nearest arm of a family with breakpoints.
            The distance is flat at its minimum, so that a final spacing of 0.8 deg suffices.
        subintervals: Parts of the range that are searched separately for poses without a solution:
            intervals in which several joints are at their limits are short. Source: of 20,000
            grasps of a Panda near its limits, at a tolerance of 1e-6, none is missed with them and
            39 without.
        tolerance: Smallest limit margin that counts as feasible [rad]: rounding at a breakpoint.
        no_margin: Limit margin before any arm was evaluated.
        outside: Score of an arm outside its bounds, to which its (negative) margin is added [rad].
    """

    samples: int = 6
    iterative_samples: int = 3
    joint_samples: int = 1
    block: int = 8
    placement_levels: tuple[Level, ...] = (
        *(Level(False, 0.0), Level(True, 1.0), Level(False, 1 / 3), Level(True, 1 / 2)),
        *(Level(False, -1 / 3), Level(True, 1 / 3), Level(True, 1 / 18), Level(True, 1 / 108)),
        Level(True, 1 / 600),
    )
    nearest_levels: tuple[Level, ...] = (
        *(Level(False, 0.0), Level(False, 1 / 3), Level(False, -1 / 3)),
        *(Level(True, 1 / 2), Level(True, 1 / 12), Level(True, 1 / 72)),
    )
    nearest_levels_with_breakpoints: tuple[Level, ...] = (
        *(Level(False, 0.0), Level(False, 1 / 2), Level(True, 1 / 2), Level(True, 1 / 12)),
    )
    subintervals: int = 4
    tolerance: float = -1e-9
    no_margin: float = -1e9
    outside: float = -1e3


ARM_SEARCH = ArmSearchParameters()


class Farthest(Score):
    """Order by the limit margin, the largest first."""

    def unwrap(self, joint: int, angle: Expr, lower: Expr, upper: Expr, reference: Expr) -> Expr:
        """Shift the angle to the turn of a joint that is held (equal bounds)."""
        del reference
        shift = ca.floor((lower[joint] - angle) / FULL_TURN + 0.5)
        return ca.if_else(lower[joint] < upper[joint], angle, angle + FULL_TURN * shift)

    def cost(self, joints: dict[int, Expr], reference: Expr) -> Expr:
        """Return zero."""
        del joints, reference
        return 0.0

    def total(self, cost: Expr, margin: Expr) -> Expr:
        """Return the margin."""
        del cost
        return margin

    def restrict(self, joints: object) -> Score:
        """Return this order."""
        del joints
        return self


@dataclass(frozen=True, eq=False)
class Nearest(Score):
    """Order by the distance from a reference arm, within the bounds.

    Attributes:
        scales: (n,) factors of joint differences before they are squared. They are numbers, since
            function inputs would prevent lanes.
    """

    scales: Array

    @classmethod
    def by_ranges(cls, ranges: Array) -> Nearest:
        """Scale the joints by their ranges [rad]."""
        return cls(1 / np.maximum(ranges, 1e-9))

    def unwrap(self, joint: int, angle: Expr, lower: Expr, upper: Expr, reference: Expr) -> Expr:
        """Shift the angle to the turn nearest to the reference if it is within the bounds."""
        unwrapped = angle + FULL_TURN * ca.floor((reference[joint] - angle) / FULL_TURN + 0.5)
        margin = ca.fmin(unwrapped - lower[joint], upper[joint] - unwrapped)
        return ca.if_else(margin >= ARM_SEARCH.tolerance, unwrapped, angle)

    def cost(self, joints: dict[int, Expr], reference: Expr) -> Expr:
        """Return the squared distance."""
        differences = [
            float(self.scales[i]) * (angle - reference[i]) for i, angle in joints.items()
        ]
        return ca.sumsqr(ca.vertcat(*differences))

    def total(self, cost: Expr, margin: Expr) -> Expr:
        """Return minus the distance; outside the bounds a large penalty."""
        return ca.if_else(margin >= ARM_SEARCH.tolerance, -cost, ARM_SEARCH.outside + margin)

    def restrict(self, joints: list[int]) -> Score:  # type: ignore[override]
        """Return the order for some joints."""
        return Nearest(self.scales[joints])


def is_allowed(score: Expr) -> Expr:
    """Return True for a score of `Nearest` of an arm within its bounds."""
    return score > ARM_SEARCH.outside / 2


@dataclass(frozen=True, eq=False)
class ArmTrials:
    """Trials of the search for an arm.

    Attributes:
        family: Family of the arm.
        score: Order of the solutions, `Farthest` or `Nearest`.
    """

    family: ArmFamily
    score: Score

    @property
    def trials(self) -> int:
        """Number of trials."""
        if not self._varied_count:
            return self._start_count
        if self._breakpoint_count:
            return 1 + 2 * self._block_count
        return len(self._levels)

    @property
    def all_trials(self) -> int:
        """Number of trials including those of the subintervals."""
        by_parts = self._varied_count == 1 and not self._breakpoint_count and not self.is_nearest
        return self.trials * (1 + ARM_SEARCH.subintervals) if by_parts else self.trials

    @property
    def hopeful_trials(self) -> int:
        """Number of trials after which the search stops without a feasible arm."""
        if _break_count(self.family):
            return sum(not level.is_local for level in self._levels)
        return self.trials

    @property
    def first_local_trial(self) -> int | None:
        """Index of the first local trial; None if no parameter is varied."""
        local_trials = (i for i, level in enumerate(self._levels) if level.is_local)
        return next(local_trials) if self._varied_count else None

    @property
    def is_nearest(self) -> bool:
        """True if solutions are ordered by the distance from a reference."""
        return isinstance(self.score, Nearest)

    def starts_subinterval(self, trial: Expr) -> Expr:
        """Return 1 for a trial that starts another subinterval and ignores earlier results."""
        starts = range(self.trials, self.all_trials, self.trials)
        return sum((trial == i for i in starts), ca.SX(0)) > 0

    def trial(
        self,
        palm: Pose,
        bounds: tuple[Expr, Expr],
        trial: Expr,
        best: tuple[Expr, Expr],
        visit: Expr,
        reference: Expr | None = None,
    ) -> tuple[Expr, Expr, Expr]:
        """Return the expressions of a trial.

        Args:
            palm: Palm pose in the base frame.
            bounds: (n, 1) lower and upper bounds of the arm [rad].
            trial: Number of the trial, from 0.
            best: Best arm so far (n, 1) [rad], and its swivel angle [rad].
            visit: Number of the search; each one samples other values.
            reference: (n, 1) reference arm for `Nearest`.

        Returns:
            The best arm of the trial (n, 1) [rad], its score, and its last redundancy parameter
            [rad], which is the swivel angle of an S-R-S arm.
        """
        # Unused inputs are also passed, because constants cannot be inputs.
        reference_arm = bounds[0] if reference is None else reference
        reference, *values = self._values()(trial, *best, *bounds, visit, reference_arm)
        inputs = [palm.rotation, palm.origin, *bounds, reference]
        if not self._breakpoint_count:
            return self._best_of_values(len(values))(*inputs, *values)
        select = ca.Function.if_else("trial", self._sampled(len(values)), self._at_breakpoints())
        return select(trial < 1, *inputs, *values, trial)

    @property
    def _levels(self) -> tuple[Level, ...]:
        if not self.is_nearest and self._varied_count > 1:
            times = ARM_SEARCH.samples // self._samples
            return tuple(level for level in ARM_SEARCH.placement_levels for _ in range(times))
        if not self.is_nearest:
            return ARM_SEARCH.placement_levels
        if _break_count(self.family):
            return ARM_SEARCH.nearest_levels_with_breakpoints
        return ARM_SEARCH.nearest_levels

    @property
    def _varied_count(self) -> int:
        """Number of redundancy parameters that are varied, the last ones."""
        count = len(self.family.redundancy)
        # For `Nearest` the locked joints stay at the reference.
        return count - len(self.family.locked) if self.is_nearest else count

    @property
    def _start_count(self) -> int:
        return 1 if self.is_nearest else self.family.starts

    @property
    def _breakpoint_count(self) -> int:
        return 0 if self.is_nearest else _break_count(self.family)

    @property
    def _block_count(self) -> int:
        return -(-self._breakpoint_count // ARM_SEARCH.block)

    @property
    def _samples(self) -> int:
        if not self._varied_count:
            return 1
        if self._varied_count > 1:
            return ARM_SEARCH.joint_samples
        iterative = self.family.is_iterative
        return ARM_SEARCH.iterative_samples if iterative else ARM_SEARCH.samples

    def _values(self) -> ca.Function:
        """Return (trial, best arm, swivel, lower, upper, visit, near) -> near, values (r, 1) ..."""
        n, family = len(self.family.screws), self.family
        trial, swivel, visit = (ca.SX.sym(word) for word in ("trial", "swivel", "visit"))
        arm, lower, upper, reference = (ca.SX.sym(w, n) for w in ("arm", "lower", "upper", "near"))
        inputs = [trial, arm, swivel, lower, upper, visit, reference]
        bounds = [parameter.bounds(lower, upper) for parameter in family.redundancy]
        low, high = (ca.vertcat(*(end[i] for end in bounds)) for i in (0, 1))
        current = [
            swivel if parameter.joint is None else arm[parameter.joint]
            for parameter in family.redundancy
        ]
        count = len(bounds) - self._varied_count
        fixed = [ca.fmin(ca.fmax(reference[j], lower[j]), upper[j]) for j in family.locked[:count]]
        if not bounds or not self._varied_count:
            values = [ca.vertcat(*fixed) if bounds else ca.SX.zeros(1)]
        elif self._varied_count == 1:
            samples = self._values_of_one(trial, current[-1], low[-1], high[-1], visit)
            if family.redundancy[-1].joint is not None:
                samples = [ca.fmin(ca.fmax(value, low[-1]), high[-1]) for value in samples]
            values = [ca.vertcat(*fixed, value) for value in samples]
        else:
            values = self._values_of_several(trial, ca.vertcat(*current), low, high, visit)
        if not self.is_nearest:
            offset = ca.fmod(trial, self._start_count) * FULL_TURN / self._start_count
            reference = (lower + upper) / 2 + offset if family.is_iterative else reference
        return ca.Function("values", inputs, with_cse(reference, *values))

    def _values_of_one(
        self, trial: Expr, current: Expr, low: Expr, high: Expr, visit: Expr
    ) -> list[Expr]:
        """Return the values of one parameter over its range, or over a subinterval."""
        middle, half_range = (low + high) / 2, (high - low) / 2
        shift: Expr = ca.SX(0)
        if self.all_trials > self.trials:
            subintervals, run = ARM_SEARCH.subintervals, ca.floor(trial / self.trials)
            index = ca.fmod(run - 1 + visit, subintervals)
            trial = trial - run * self.trials
            middle = middle + ca.if_else(
                run > 0, half_range * ((2 * index + 1) / subintervals - 1), 0
            )
            half_range = ca.if_else(run > 0, half_range / subintervals, half_range)
            by_visit = visit * float(spread_steps(1)[0])
            shift = ca.if_else(run > 0, (by_visit - ca.floor(by_visit) - 0.5) / 3, 0)
        step = 2 * half_range / self._samples
        centre, width = middle, half_range
        for i, level in enumerate(self._levels):
            level_centre = current if level.is_local else middle + (level.extent + shift) * step
            level_width = level.extent * step / 2 if level.is_local else half_range
            centre = ca.if_else(trial == i, level_centre, centre)
            width = ca.if_else(trial == i, level_width, width)
        offsets = (2 * np.arange(self._samples) + 1) / self._samples - 1
        return [centre + width * float(offset) for offset in offsets]

    def _values_of_several(
        self, trial: Expr, current: Expr, low: Expr, high: Expr, visit: Expr
    ) -> list[Expr]:
        """Return a low-discrepancy sample of several parameters, from the middle on."""
        size, samples = self._varied_count, self._samples
        width: Expr = ca.SX(1)
        for i, level in enumerate(self._levels):
            if level.is_local:
                scale = (level.extent / ARM_SEARCH.samples) ** (1 / size)
                width = ca.if_else(trial == i, scale, width)
        centre = ca.if_else(width < 1, current, (low + high) / 2)
        values = []
        for i in range(samples):
            number = (visit * len(self._levels) + trial) * samples + i
            fractions = number * ca.DM(spread_steps(size).tolist())
            fractions = fractions - ca.floor(fractions + 0.5)
            value = centre + width * fractions * (high - low)
            values.append(ca.fmin(ca.fmax(value, low), high))
        return values

    def _best_of_values(self, count: int) -> ca.Function:
        """Return (rotation, origin, lower, upper, near, values ...) -> the best arm of all values.

        One function is called for each value; inlining it would multiply the code.
        """
        best = self.family.best("best_at", self.score)
        inputs = best.mx_in()[1:]
        values = [ca.MX.sym("value", best.size1_in(0)) for _ in range(count)]
        evaluate = _with_common_part(best, inputs)
        candidates = [(*evaluate(value), value[-1]) for value in values]
        outputs = _best_arm(candidates)
        return ca.Function("look", [*inputs, *values], outputs)

    def _sampled(self, count: int) -> ca.Function:
        look = self._best_of_values(count)
        inputs = look.mx_in()
        return ca.Function("sampled", [*inputs, ca.MX.sym("trial")], list(look(*inputs)))

    def _at_breakpoints(self) -> ca.Function:
        """Return `_sampled` at a block of breakpoints; odd and even trials use different elbows."""
        family, n = self.family, len(self.family.screws)
        assert isinstance(family, ClosedForm)
        rotation, origin, sign = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3), ca.SX.sym("sign")
        lower, upper, reference = (ca.SX.sym(word, n) for word in ("lower", "upper", "near"))
        palm, value = Pose(rotation, origin), ca.SX.sym("value")
        bends = family.bends(palm, value, (sign,))
        inputs = [rotation, origin, lower, upper, reference, sign]
        best = family.best_of(bends, self.score, lower, upper, reference)
        at_value = ca.Function("best_bent", [value, *inputs], with_cse(*best))
        block = ca.SX.sym("block")
        roots: Expr = family.breakpoints(palm, (sign,), lower, upper)
        size = ARM_SEARCH.block
        block_roots = sum(
            (
                ca.if_else(block == b, roots[size * b : size * (b + 1)], 0.0)
                for b in range(self._block_count)
            ),
            ca.SX.zeros(size, 1),
        )
        roots_of = ca.Function(
            "breakpoints", [block, *inputs], with_cse(*ca.vertsplit(block_roots))
        )
        trial = ca.SX.sym("trial")
        parity = ca.if_else(ca.fmod(trial, 2) > 0.5, 1.0, -1.0)
        turn = ca.Function("turn", [trial], [parity, ca.floor((trial - 1) / 2)])
        inputs = [ca.MX.sym(x.name() if x.is_scalar() else "x", x.shape) for x in inputs[:-1]]
        number = ca.MX.sym("trial")
        unused = [ca.MX.sym("value") for _ in range(self._samples)]
        elbow_sign, block_number = turn(number)
        values = roots_of(block_number, *inputs, elbow_sign)
        evaluate = _with_common_part(at_value, [*inputs, elbow_sign])
        outputs = _best_arm([(*evaluate(value), value) for value in values])
        return ca.Function("at_breakpoints", [*inputs, *unused, number], outputs)


@cache
def _break_count(family: ArmFamily) -> int:
    """Return the number of breakpoints of an elbow branch."""
    if not isinstance(family, ClosedForm):
        return 0
    n = len(family.screws)
    palm = Pose(ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3))
    breakpoints = family.breakpoints(palm, (ca.SX(1),), ca.SX.sym("low", n), ca.SX.sym("high", n))
    return 0 if breakpoints is None else breakpoints.numel()


def _with_common_part(best: ca.Function, fixed: list[Expr]) -> Callable[[Expr], tuple[Expr, Expr]]:
    """Split a function of the redundancy so that the part of the fixed inputs is evaluated once."""
    if not best.is_a("SXFunction"):
        return lambda value: best(value, *fixed)
    value, *inputs = best.sx_in()
    outputs = best(value, *inputs)
    varying, symbols, constant = ca.extract_parametric(list(outputs), inputs)
    common = ca.Function("hoisted", inputs, with_cse(ca.vertcat(*constant)))
    names = ca.vertcat(*symbols)
    varying_part = ca.Function(best.name(), [value, *inputs, names], with_cse(*varying))
    common_values = common(*fixed)
    return lambda value: varying_part(value, *fixed, common_values)


def _best_arm(candidates: list[tuple[Expr, Expr, Expr]]) -> list[Expr]:
    """Return arm, score and value with the highest score."""
    select = _best_value(len(candidates), candidates[0][0].numel())
    return list(select(*(value for candidate in candidates for value in candidate)))


@cache
def _best_value(count: int, size: int) -> ca.Function:
    """Return the function that selects the arm with the highest score."""
    candidates = [
        (ca.SX.sym("arm", size), ca.SX.sym("score"), ca.SX.sym("value")) for _ in range(count)
    ]
    best: tuple[Expr, ...] = ()
    for arm, score, value in candidates:
        best = better(best, (score, arm, value))
    score, arm, value = best
    return ca.Function(
        "best_value",
        [part for candidate in candidates for part in candidate],
        with_cse(arm, score, value),
    )


def arms_graph(family: ArmFamily, name: str, recipe: str) -> FunctionGraph:
    """Return the graph of all branches with one input vector.

    Args:
        family: Family of the arm.
        name: Name of the function.
        recipe: Recipe of the function.

    Returns:
        Rotation (9, row-major), origin (3) [m] and redundancy [rad] -> the concatenated branches
        [rad], then their reach margins, >= 0 within reach.
    """
    size, rows = 12 + family.size, family.rows

    def build() -> ca.Function:
        symbols: Any = ca.MX if family.is_iterative else ca.SX
        x = symbols.sym("x", size)
        arms, slack = family.arms()(ca.reshape(x[:9], 3, 3).T, x[9:12], x[12:])
        both = ca.vertcat(ca.vec(arms.T), slack)
        return ca.Function(
            name, [x], [both] if family.is_iterative else with_cse(both), ["x"], ["arms"]
        )

    outputs = ((rows * (len(family.screws) + 1), 1),)
    return FunctionGraph(name, build, {"x": (size, 1)}, outputs, recipe)
