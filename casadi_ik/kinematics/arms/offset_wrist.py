"""Arms with an offset wrist, whose last axis misses the intersection of the previous two.

Examples are Sawyer and the xArm 6. With the last joint at t, the position of the wrist point
follows from the palm pose, and the other joints follow as for the ideal arm with a spherical wrist
(Pieper 1968), whose last axis passes through the point. The ideal arm turns its last joint by an
angle g(t); for ``g(t) = t`` it is the real arm. The solutions are thus the roots of a function of
one angle on each of the eight branches of the ideal arm.

All roots: the residual ``g(t) - t`` is sampled over a full turn, and between samples at the
extremum of a parabola, since two roots may be close to each other; each sign change brackets a
root. Pairs of solutions at the workspace boundary, where the residual has a kink, may be missed.

The best arm: every branch is evaluated at an initial t, and once more at g(t), which is accurate
enough to select the best one. Secant steps then refine it to a residual of 1e-3 rad.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import SIGNS, ArmFamily, Redundancy, Score, margin
from casadi_ik.kinematics.arms.screws import CosSin, Screws
from casadi_ik.kinematics.arms.six_joints import SphericalArm
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, with_cse

FULL_TURN = 2 * np.pi

MIN_CURVATURE = 1e-300

ROOTS = 4
"""Maximum number of roots of a branch. Source: of 200 random poses of an xArm 6 two branches had
4."""


@dataclass(frozen=True)
class RootSearch:
    """Parameters of the search for the last joint.

    Attributes:
        samples: Samples of the last joint over a turn.
        steps: Steps of the method of Anderson and Bjorck (1973) for each root.
        root_tolerance: Largest residual of a root [rad].
        min_gap: Smallest distance of an extremum from a sample [sample spacings].
        secant_steps: Secant steps on the selected branch.
        coarse_tolerance: Largest residual of branches that are compared [rad].
        fine_tolerance: Largest residual of the result, which `newton_polish` refines [rad].
        max_slope: Upper bound of the slope of ``g(t) - t``, which is near -1 at an isolated root.
        max_step: Largest step of t [rad].
    """

    samples: int = 40
    steps: int = 20
    root_tolerance: float = 1e-9
    min_gap: float = 0.01
    secant_steps: int = 2
    coarse_tolerance: float = 0.5
    fine_tolerance: float = 1e-3
    max_slope: float = -0.2
    max_step: float = 1.0


ROOT_SEARCH = RootSearch()


@dataclass(frozen=True, eq=False)
class OffsetWristArm(ArmFamily):
    """An arm with an offset wrist, solved through a nominal spherical-wrist arm.

    Attributes:
        screws: Screws of the real arm, in the order of the ideal arm's solution.
        ideal: Ideal arm, whose last axis passes through the wrist point.
        offset: (3,) vector from the wrist point to the real last axis [m].
        model_error: Residual after the secant steps [m and rad].
    """

    screws: Screws
    ideal: SphericalArm
    offset: Array
    model_error: float = ROOT_SEARCH.fine_tolerance
    rows = len(SIGNS) * ROOTS
    roots = ROOTS
    starts = 3

    @property
    def kind(self) -> str:
        """Description of the ideal arm, and the joint with the offset."""
        return f"{self.ideal.kind}, joint {self.last + 1} off it"

    @property
    def sign_names(self) -> tuple[str, str, str]:
        """Names of the ideal arm."""
        return self.ideal.sign_names

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """Redundancy parameter of the ideal arm."""
        return self.ideal.redundancy

    @property
    def last(self) -> int:
        """Number of the joint with the offset axis."""
        return self.screws.joints[-1]

    def distance_out_of_reach(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """Return the bound from the centre of the circle of the wrist point."""
        motion = self.screws.motion(palm)
        middle = Pose(motion.rotation, motion.origin + motion.rotation @ ca.DM(self.offset))
        distance = self.ideal.motion_out_of_reach(middle, lower, upper)
        radius = float(np.linalg.norm(self.offset))
        return distance - ca.fmin(ca.fmax(distance, -radius), radius)

    def arms(self) -> ca.Function:
        """Return the function of all roots on all branches."""
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        redundancy = ca.MX.sym("redundancy", self.size)
        left_rotation, left_origin, *_ = self._start()(redundancy, rotation, origin)
        on_branch, all_joints = self._all_roots(), self._all_joints_function()
        arms, slacks = [], []
        for signs in SIGNS:
            roots, slack = on_branch(left_rotation, left_origin, *signs)
            arms += [all_joints(roots[i, :].T, redundancy).T for i in range(ROOTS)]
            slacks.append(slack)
        outputs = [ca.vertcat(*arms), ca.vertcat(*slacks)]
        return ca.Function("arms", [rotation, origin, redundancy], outputs)

    def best(self, name: str, score: Score) -> ca.Function:
        """Return the function of the best branch; the search starts at `reference`."""
        n = len(self.screws)
        redundancy = ca.MX.sym("redundancy", self.size)
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        lower, upper, reference = (ca.MX.sym(word, n) for word in ("lower", "upper", "near"))
        scoring_inputs = [redundancy, lower, upper, reference]
        left_rotation, left_origin, plus, minus = self._start()(redundancy, rotation, origin)
        six_motion = left_rotation, left_origin
        branch, condition, secant = self._branch(), self._condition(), _secant_step()
        coarse, fine = (
            self._scored_arm(score, tolerance)
            for tolerance in (ROOT_SEARCH.coarse_tolerance, ROOT_SEARCH.fine_tolerance)
        )
        first, candidates = reference[self.last], []
        for sign_1, sign_2 in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            signs = [plus if sign > 0 else minus for sign in (sign_1, sign_2)]
            residuals = _opposite_turns(condition(*six_motion, first, *signs, plus))
            for flip, first_residual in zip((plus, minus), residuals, strict=True):
                t = first + first_residual
                arm, slack, residual = branch(*six_motion, t, *signs, flip)
                _, value = coarse(arm, slack, residual, *scoring_inputs)
                candidates.append((value, *signs, flip, t, residual, first, first_residual))
        values = (value for candidate in candidates for value in candidate)
        selected = _best_branch(len(candidates))(*values)
        sign_1, sign_2, flip, t, residual, previous_t, previous_residual = selected
        arm, slack = ca.MX(6, 1), ca.MX(1)
        for _ in range(ROOT_SEARCH.secant_steps):
            next_t = secant(t, residual, previous_t, previous_residual)
            t, previous_t, previous_residual = next_t, t, residual
            arm, slack, residual = branch(*six_motion, t, sign_1, sign_2, flip)
        best_arm, value = fine(arm, slack, residual, *scoring_inputs)
        inputs = [redundancy, rotation, origin, lower, upper, reference]
        return ca.Function(name, inputs, [best_arm, value])

    def _start(self) -> ca.Function:
        """Return (redundancy, rotation, origin) -> motion of six screws, 1 and -1.

        The signs of branches are outputs, because constants cannot be inputs of the inner functions
        of a step in lanes.
        """
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        redundancy = ca.SX.sym("redundancy", self.size)
        six_motion = self._real_arm.remaining_motion(Pose(rotation, origin), redundancy)
        outputs = [six_motion.rotation, six_motion.origin, ca.SX(1), ca.SX(-1)]
        return ca.Function("begin", [redundancy, rotation, origin], outputs)

    @property
    def _real_arm(self) -> SphericalArm:
        """The ideal arm with the screws of the real arm."""
        return replace(self.ideal, screws=self.screws)

    def _branch(self) -> ca.Function:
        """Return the function of a branch of the ideal arm.

        Returns:
            (rotation, origin, t, two signs of the elbow branch, sign of the wrist flip) -> the six
            joints (6, 1) [rad] in the order of the screws, the reach margin, and the residual
            ``g(t) - t`` in [-pi, pi] [rad].
        """
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        t, sign_1, sign_2, flip = (ca.SX.sym(name) for name in ("t", "one", "two", "end"))
        inverse = CosSin(ca.cos(t), -ca.sin(t)).rotation(self.screws.axes[-1])
        shift = ca.DM(self.offset) - inverse @ ca.DM(self.offset)
        shifted_palm = Pose(rotation, origin + rotation @ shift)
        (bend,) = self.ideal.branches_of_six(shifted_palm, (sign_1, sign_2))
        ((plus, minus),) = bend.wrist_flips
        joints = {joint: angle.value for joint, angle in bend.joints.items()}
        flips = {
            joint: ca.if_else(flip > 0, angle.value, minus[joint].value)
            for joint, angle in plus.items()
        }
        joints |= flips
        arm = ca.vertcat(*(joints[self.screws.joints[index]] for index in self.ideal.indices))
        residual = flips[self.last] - t
        residual -= FULL_TURN * ca.floor(residual / FULL_TURN + 0.5)
        inputs = [rotation, origin, t, sign_1, sign_2, flip]
        return ca.Function("branch", inputs, with_cse(arm, bend.slack, residual))

    def _condition(self) -> ca.Function:
        """Return the function of the residual alone, with the inputs of `_branch`."""
        all_joints = self._branch()
        inputs = all_joints.sx_in()
        return ca.Function("condition", inputs, with_cse(all_joints(*inputs)[2]))

    def _all_joints(self, six: Expr, redundancy: Expr) -> Expr:
        """Return all joints (n, 1) in their order from the six in the order of the screws."""
        joints = {self.screws.joints[p]: six[i] for i, p in enumerate(self.ideal.indices)}
        for i, parameter in enumerate(self.redundancy):
            joints[parameter.joint or 0] = redundancy[i]
        return ca.vertcat(*(joints[i] for i in range(len(joints))))

    def _all_joints_function(self) -> ca.Function:
        six, redundancy = ca.SX.sym("six", 6), ca.SX.sym("redundancy", self.size)
        return ca.Function("whole", [six, redundancy], [self._all_joints(six, redundancy)])

    def _scored_arm(self, score: Score, tolerance: float) -> ca.Function:
        """Return (six, slack, residual, redundancy, lower, upper, near) -> the arm and its score.

        A residual above `tolerance` [rad] counts as out of reach.
        """
        n, six = len(self.screws), ca.SX.sym("six", 6)
        slack, residual = ca.SX.sym("slack"), ca.SX.sym("rest")
        redundancy = ca.SX.sym("redundancy", self.size)
        lower, upper, reference = (ca.SX.sym(word, n) for word in ("lower", "upper", "near"))
        arm, multi_turn = self._all_joints(six, redundancy), self.screws.multi_turn_joints
        joints = {
            i: score.unwrap(i, arm[i], lower, upper, reference) if i in multi_turn else arm[i]
            for i in range(n)
        }
        violation = ca.if_else(ca.fabs(residual) > tolerance, -ca.fabs(residual), np.inf)
        violation = ca.fmin(violation, ca.if_else(slack < 0, slack, np.inf))
        smallest = ca.fmin(margin(joints, lower, upper), violation)
        outputs = ca.vertcat(*joints.values()), score.total(score.cost(joints, reference), smallest)
        inputs = [six, slack, residual, redundancy, lower, upper, reference]
        name = "loose" if tolerance == ROOT_SEARCH.coarse_tolerance else "strict"
        return ca.Function(name, inputs, with_cse(*outputs))

    def _all_roots(self) -> ca.Function:
        """Return (rotation, origin, three signs) -> all roots (`ROOTS`, 6) and their margins."""
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        signs = [ca.MX.sym("sign") for _ in range(3)]
        branch, condition = self._branch(), self._condition()
        refine_bracket, extremum = _anderson_bjorck_step(), _extremum_between()
        spacing, count = FULL_TURN / ROOT_SEARCH.samples, ROOT_SEARCH.samples
        middle = float(self.screws.lower[-1] + self.screws.upper[-1]) / 2
        first = [middle + spacing * i for i in range(count)]
        residuals_around = [condition(rotation, origin, sample, *signs) for sample in first]
        samples, residuals = [], []
        for i, sample in enumerate(first):
            fraction = extremum(*(residuals_around[(i + k) % count] for k in (-1, 0, 1, 2)))
            samples += [ca.MX(sample), sample + spacing * fraction]
            residuals += [residuals_around[i], condition(rotation, origin, samples[-1], *signs)]
        brackets = _sign_changes()(*samples, *residuals)
        arms, slacks = [], []
        for root in range(ROOTS):
            *bracket, t, is_root = brackets[6 * root : 6 * root + 6]
            for _ in range(ROOT_SEARCH.steps):
                *bracket, t = refine_bracket(*bracket, t, condition(rotation, origin, t, *signs))
            arm, slack, residual = branch(rotation, origin, t, *signs)
            arms.append(arm.T)
            slacks.append(_root_slack()(slack, residual, is_root))
        outputs = [ca.vertcat(*arms), ca.vertcat(*slacks)]
        return ca.Function("on_branch", [rotation, origin, *signs], outputs)


def _secant_step() -> ca.Function:
    """Return (t, residual, previous t, previous residual) -> next t of the secant method."""
    names = ("t", "residual", "previous_t", "previous_residual")
    t, residual, previous_t, previous_residual = (ca.SX.sym(name) for name in names)
    change = t - previous_t
    has_moved = ca.fabs(change) > 1e-12
    divisor = ca.if_else(has_moved, change, 1.0)
    slope = ca.if_else(has_moved, (residual - previous_residual) / divisor, -1.0)
    slope = ca.fmin(ca.fmax(slope, -5.0), ROOT_SEARCH.max_slope)
    step = ca.fmin(ca.fmax(-residual / slope, -ROOT_SEARCH.max_step), ROOT_SEARCH.max_step)
    return ca.Function(
        "next_turn", [t, residual, previous_t, previous_residual], with_cse(t + step)
    )


def _opposite_turns(value: Expr) -> tuple[Expr, Expr]:
    """Return the residuals of both wrist flips, which differ by half a turn."""
    residual = ca.SX.sym("rest")
    opposite = residual + ca.if_else(residual > 0, -np.pi, np.pi)
    first, second = ca.Function("both", [residual], [residual, opposite])(value)
    return first, second


def _best_branch(count: int) -> ca.Function:
    """Return the function that selects the row with the largest first number, without it."""
    rows = [[ca.SX.sym("value") for _ in range(8)] for _ in range(count)]
    best = rows[0]
    for row in rows[1:]:
        keep_best = best[0] >= row[0]
        best = [ca.if_else(keep_best, a, b) for a, b in zip(best, row, strict=True)]
    return ca.Function("best_branch", [value for row in rows for value in row], with_cse(*best[1:]))


def _extremum_between() -> ca.Function:
    """Return (residuals at four samples) -> position between the second and the third.

    The position is the extremum of a parabola through three samples if it is between the two,
    otherwise 0.5.
    """
    r0, r1, r2, r3 = residuals = [ca.SX.sym("rest") for _ in range(4)]
    fraction: Expr = ca.SX(0.5)
    for left_value, middle, right, start in ((r1, r2, r3, 1.0), (r0, r1, r2, 0.0)):
        curvature, slope = left_value + right - 2 * middle, right - left_value
        straight = ca.fabs(curvature) < MIN_CURVATURE
        position = start - ca.if_else(
            straight, 0.0, slope / (2 * ca.if_else(straight, 1.0, curvature))
        )
        fraction = ca.if_else(
            ca.logic_and(position > ROOT_SEARCH.min_gap, position < 1 - ROOT_SEARCH.min_gap),
            position,
            fraction,
        )
    return ca.Function("between", residuals, with_cse(fraction))


def _sign_changes() -> ca.Function:
    """Return (samples ..., residuals ...) -> six numbers for every root.

    They are the sample before the root and its residual, the sample behind it and its residual, the
    zero of the line between them, and 1 if there is a root.
    """
    samples = [ca.SX.sym("place") for _ in range(2 * ROOT_SEARCH.samples)]
    residuals = [ca.SX.sym("rest") for _ in samples]
    count: Expr = ca.SX(0)
    roots = [[ca.SX(0) for _ in range(6)] for _ in range(ROOTS)]
    for i, sample in enumerate(samples):
        next_sample = samples[i + 1] if i + 1 < len(samples) else samples[0] + FULL_TURN
        residual, next_residual = residuals[i], residuals[(i + 1) % len(samples)]
        changes = ca.logic_and(
            residual * next_residual <= 0, ca.fabs(next_residual - residual) < np.pi
        )
        values = (
            sample,
            residual,
            next_sample,
            next_residual,
            _linear_zero(sample, residual, next_sample, next_residual),
            1.0,
        )
        for root in range(ROOTS):
            is_selected = ca.logic_and(changes, count == root)
            roots[root] = [
                ca.if_else(is_selected, value, old)
                for value, old in zip(values, roots[root], strict=True)
            ]
        count = count + changes
    outputs = [value for root_values in roots for value in root_values]
    return ca.Function("changes", [*samples, *residuals], with_cse(*outputs))


def _linear_zero(x0: Expr, y0: Expr, x1: Expr, y1: Expr) -> Expr:
    """Return the zero of a line through two points; their middle if it is level."""
    rise = y1 - y0
    level = ca.fabs(rise) < MIN_CURVATURE
    fraction = ca.if_else(level, 0.5, -y0 / ca.if_else(level, 1.0, rise))
    return x0 + fraction * (x1 - x0)


def _anderson_bjorck_step() -> ca.Function:
    """Return a step of the method of Anderson and Bjorck, which keeps the root bracketed.

    Returns:
        (x0, y0, x1, y1, t, residual at t) -> the updated bracket and the next t.
    """
    x0, y0, x1, y1, t, y = inputs = [ca.SX.sym("value") for _ in range(6)]
    has_crossed = y * y1 <= 0
    ratio = 1 - y / ca.if_else(ca.fabs(y1) < MIN_CURVATURE, 1.0, y1)
    weight = ca.if_else(ratio > 0, ratio, 0.5)
    start = ca.if_else(has_crossed, x1, x0)
    y_start = ca.if_else(has_crossed, y1, weight * y0)
    outputs = [start, y_start, t, y, _linear_zero(start, y_start, t, y)]
    return ca.Function("narrowed", inputs, with_cse(*outputs))


def _root_slack() -> ca.Function:
    """Return (slack, residual, is_root) -> the slack, negative without a root."""
    slack, residual, is_root = inputs = [ca.SX.sym(name) for name in ("slack", "rest", "is_root")]
    root_tolerance = ca.logic_and(is_root > 0, ca.fabs(residual) <= ROOT_SEARCH.root_tolerance)
    return ca.Function("known", inputs, [ca.if_else(root_tolerance, slack, ca.fmin(slack, -1.0))])
