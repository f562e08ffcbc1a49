"""Whether no hand within a box of postures can meet a target: one test, as a graph.

Every contact of such a hand lies in a ball (`proofs.boxes`), every contact asked for within its
tolerances. Hence inequalities between what is kept by all motions of the palm, and between that
and what the arm can do. All are necessary: what is refuted is impossible, what is not may be, too.

*Pairs.* What two contacts keep however the palm is moved: distance, angle, heights, handedness.
Each as a row ``|value| <= width``: the value asked for less that of the middle of the box, and a
width that holds the tolerances and all that the box lets the contacts move. That is bounded twice,
and the smaller bound taken: by the balls of the contacts, and by the slopes of the value itself,
which see only what changes it. What the slopes leave out are the products of two changes, and
`near` and `close` of the contacts. With unit vectors a, b asked for, a = (n + T u) + r in the frame
of the palm and |r| <= close: products are split so that one factor is what is asked for, whose
length is known.

*Rigid fit.* The largest trace tr(R S) over all rotations R is the largest eigenvalue of Horn's
symmetric 4 x 4 matrix (Horn 1987). Newton's method on its characteristic polynomial falls towards
it from above (Theobald 2005), so that every iterate is a bound.

*Wrist.* Where the contacts put the wrist, against the distances from the shoulder an arm can hold.

*Cones.* For a place of the wrist the elbow of a seven-joint arm can be anywhere on a circle. The
limit of joint 2 leaves an arc of it, in which the upper arm is within a cone about axis 1; the
limit of joint 6 another, in which the forearm is within a cone about axis 7, which goes with the
palm. No elbow is in both if the middles of the arcs are further apart than half their lengths.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.linear_algebra import solve_spd
from casadi_ik.kinematics.smooth import Expr, safe_norm, shared
from casadi_ik.solve.proofs.boxes import SLACK, BoxContact, HandSpace, box_contacts
from casadi_ik.solve.proofs.premises import ArmCones, ArmSpan

ANGLE_SLACK = 1e-7
"""What angles and cosines of the arm's cones are let off by."""


@dataclass(frozen=True, eq=False)
class BoxTest:
    """The step for one robot.

    Attributes:
        space: The hand's coordinates.
        arm: The arm; None if the palm does not move.
        cones: What the limits of its shoulder and wrist leave; None for other arms.
    """

    space: HandSpace
    arm: ArmSpan | None
    cones: ArmCones | None

    def graph(self) -> FunctionGraph:
        """The graph.

        Returns:
            ``(lower, upper, joint_lower, joint_upper, points, normals, tolerance, asked, span,
            cosines) -> (refuted, scores)``: coordinates (h,), joints of the fingers (m,), contacts
            (f, 3), tolerances and what is asked (f, 2), the wrist's smallest and largest distance
            (2,), cosines of the arm's cones (2,).
            Refuted by the hand and by the reach (2,) where > 0; scores (h,): what each coordinate
            leaves open.
        """
        robot = self.space.robot
        h, m, f = len(robot.finger_motors), len(robot.finger_joints), len(robot.fingers)
        shapes = {"lower": (h, 1), "upper": (h, 1), "joint_lower": (m, 1), "joint_upper": (m, 1)}
        shapes |= {"points": (f, 3), "normals": (f, 3), "tolerance": (f, 2), "asked": (f, 2)}
        shapes |= {"span": (2, 1), "cosines": (2, 1)}
        name = ca.Function.fix_name(f"{robot.name}_box_test")

        def build() -> ca.Function:
            symbols = {key: ca.SX.sym(key, *shape) for key, shape in shapes.items()}
            outputs = shared(*map(ca.densify, self._outputs(symbols)))
            return ca.Function(
                name, list(symbols.values()), outputs, list(shapes), ["refuted", "scores"]
            )

        place: tuple[Array, ...] = () if self.arm is None else (self.arm.shoulder, self.arm.wrist)
        place += () if self.cones is None else (self.cones.last,)
        known = recipe(name, robot, place)
        return FunctionGraph(name, build, shapes, ((2, 1), (h, 1)), known)

    def _outputs(self, p: dict[str, ca.SX]) -> tuple[Expr, Expr]:
        ranges = self.space.intervals(p["lower"], p["upper"])
        half = (p["upper"] - p["lower"]) / 2
        contacts = box_contacts(self.space, ranges, half, p, self.arm is not None)
        hand, reach = [ca.SX(-1)], [ca.SX(-1)]
        for i, name in enumerate(self.space.robot.finger_joints):
            hand.append(ranges[name].lower - p["joint_upper"][i])
            hand.append(p["joint_lower"][i] - ranges[name].upper)
        rows: list[Row] = []
        if self.arm is None:
            hand += [test for contact in contacts for test in contact.alone()]
        else:
            for a, b in combinations(contacts, 2):
                rows += pair_rows(a, b)
                hand += pair_angles(a, b)
            hand += [ca.fabs(row.value) - row.width for row in rows]
            hand.append(rigid_excess(contacts))
            tests, reached = self._reach(contacts, self.arm, p)
            reach, rows = reach + tests, rows + reached
        refuted = ca.vertcat(ca.mmax(ca.vertcat(*hand)), ca.mmax(ca.vertcat(*reach)))
        return refuted, self._scores(contacts, rows, p["asked"])

    def _reach(
        self, contacts: list[BoxContact], arm: ArmSpan, p: dict[str, ca.SX]
    ) -> tuple[list[Expr], list[Row]]:
        """Tests of the arm, and rows of what decides most of them."""
        ball = carried(contacts, ca.SX(ca.DM(arm.wrist)), 1)
        found, rows = wrist_excess(contacts, arm, p["span"], ball)
        if self.cones is not None:
            last = carried(contacts, ca.SX(ca.DM(self.cones.last)), 0)
            found.append(cone_excess(self.cones, ball, last, p["span"], p["cosines"]))
        return found, rows

    def _scores(self, contacts: list[BoxContact], rows: list[Row], asked: Expr) -> Expr:
        """By coordinate what it leaves open: most of all in rows that are nearly broken.

        0.1 m count as much as one radian; a coordinate that moves a finger counts a tenth of one
        that widens a row nearly broken.
        """
        found = []
        for k in range(len(self.space.coordinates)):
            most = ca.SX(0)
            for i, contact in enumerate(contacts):
                share = asked[i, 0] * contact.moved[k] / 0.1 + asked[i, 1] * contact.turned[k]
                most = ca.fmax(most, share)
            found.append(0.1 * most if rows else most)
        for row in rows:
            square = (row.value / row.width) ** 2
            for k, share in enumerate(row.shares):
                found[k] += square * square * share / row.width
        return ca.vertcat(*found)


@dataclass(frozen=True, eq=False)
class Row:
    """One inequality; `shares` is what each coordinate adds to its width."""

    value: Expr
    width: Expr
    shares: list[Expr]


def pair_rows(a: BoxContact, b: BoxContact) -> Iterator[Row]:
    """The rows of two contacts; all zero where something of them is not asked for."""
    asked, here = b.target - a.target, b.point - a.point
    long, short, far = safe_norm(asked), safe_norm(here), a.radius + b.radius
    both, near = a.placed * b.placed, a.near + b.near
    apart = b.moves - a.moves
    moved = [one + other for one, other in zip(a.moved, b.moved, strict=True)]
    turned = [one + other for one, other in zip(a.turned, b.turned, strict=True)]
    drift, swing_a, swing_b = (_lengths(slopes) for slopes in (apart, a.turns, b.turns))
    line = here / short
    along = ca.fabs(line.T @ apart)
    aside = _lengths(apart - line @ (line.T @ apart))
    most = ca.sqrt((short + ca.sum2(along)) ** 2 + ca.sum2(aside) ** 2) - short
    yield Row(both * (long - short), ca.fmin(far, most + near), moved)
    faced = both * a.faced * b.faced
    cosine = ca.dot(a.facing, b.facing) - ca.dot(a.normal, b.normal)
    sloped = _total(b.normal.T @ a.turns + a.normal.T @ b.turns)
    sloped += ca.sum2(swing_a) * ca.sum2(swing_b) + a.close + b.close + a.close * b.close
    yield Row(faced * cosine, ca.fmin(a.chord + b.chord, sloped), turned)
    for one, swing in ((a, swing_a), (b, swing_b)):
        height = ca.dot(one.facing, asked) - ca.dot(one.normal, here)
        shares = [m + t * long for m, t in zip(moved, one.turned, strict=True)]
        sloped = _total(here.T @ one.turns + one.normal.T @ apart)
        sloped += ca.sum2(swing) * ca.sum2(drift) + one.close * long + (1 + one.close) * near
        yield Row(both * one.faced * height, ca.fmin(far + one.chord * long, sloped), shares)
    across, there = ca.cross(a.normal, b.normal), ca.cross(a.facing, b.facing)
    yield Row(
        faced * (ca.dot(there, asked) - ca.dot(across, here)),
        far + (a.chord + b.chord) * long,
        [m + t * long for m, t in zip(moved, turned, strict=True)],
    )


def _lengths(slopes: Expr) -> Expr:
    """(1, h) lengths of columns."""
    return ca.horzcat(*(safe_norm(slopes[:, k]) for k in range(slopes.shape[1])))


def _total(slopes: Expr) -> Expr:
    """How far slopes (1, h) carry a value within the box."""
    return ca.sum2(ca.fabs(slopes))


def pair_angles(a: BoxContact, b: BoxContact) -> Iterator[Expr]:
    """Tests > 0 if angles cannot be as asked: of the normals, and of each with the line of points.

    They say more than cosines where the angles are near 0 or half a turn, as of normals that face
    each other.
    """
    asked, here = b.target - a.target, b.point - a.point
    long, short, far = safe_norm(asked), safe_norm(here), a.radius + b.radius
    both, most = a.placed * b.placed, ca.fmax(long, short)
    cosines = ca.dot(a.facing, b.facing), ca.dot(a.normal, b.normal)
    turns = _turn(a.chord), _turn(b.chord)
    yield both * a.faced * b.faced * _apart(cosines, turns)
    # The line between the points turns by no more than asin(far / length), of either length.
    sine = ca.fmin(far / most, 1.0)
    tilt = ca.sqrt(1 - sine * sine), sine
    for one, turn in zip((a, b), turns, strict=True):
        cosines = ca.dot(one.facing, asked) / long, ca.dot(one.normal, here) / short
        test = ca.if_else(far < most, _apart(cosines, (turn, tilt)), -1.0)
        yield both * one.faced * test


def _turn(chord: Expr) -> tuple[Expr, Expr]:
    """Cosine and sine of the angle of a chord, half a turn at most."""
    half = ca.fmin(chord, 2.0) / 2
    return 1 - 2 * half * half, 2 * half * ca.sqrt(ca.fmax(1 - half * half, 0.0))


def _apart(cosines: tuple[Expr, Expr], turns: tuple[tuple[Expr, Expr], tuple[Expr, Expr]]) -> Expr:
    """> 0 if two angles differ by more than the sum of two others (cosine, sine), if < pi."""
    rounding = 1e-8  # more than is lost where a sine is taken from a cosine near 1
    one, other = cosines
    sines = [ca.sqrt(ca.fmax(1 - c * c, 0.0)) for c in cosines]
    (cos_a, sin_a), (cos_b, sin_b) = turns
    widest = cos_a * cos_b - sin_a * sin_b
    excess = widest - rounding - (one * other + sines[0] * sines[1])
    # Both are at most half a turn: their sum is less than that where cosine a > -cosine b.
    return ca.if_else(cos_a + cos_b > rounding, excess, -1.0)


def largest_trace(S: Expr, bound: Expr, steps: int = 7) -> Expr:
    """An upper bound of tr(R S) over all rotations R, (1, 1).

    Args:
        S: (3, 3), the sum of weight x_source x_target'.
        bound: A bound that is known, > 0; the result is as close as rounding to `bound` allows.
        steps: Newton's.
    """
    s = S / bound
    xx, xy, xz = s[0, 0], s[0, 1], s[0, 2]
    yx, yy, yz = s[1, 0], s[1, 1], s[1, 2]
    zx, zy, zz = s[2, 0], s[2, 1], s[2, 2]
    K = ca.vertcat(
        ca.horzcat(xx + yy + zz, yz - zy, zx - xz, xy - yx),
        ca.horzcat(yz - zy, xx - yy - zz, xy + yx, zx + xz),
        ca.horzcat(zx - xz, xy + yx, yy - xx - zz, yz + zy),
        ca.horzcat(xy - yx, zx + xz, yz + zy, zz - xx - yy),
    )
    # x^4 + c2 x^2 + c1 x + c0; the trace of K is zero.
    c2, c1, c0 = -2 * ca.sumsqr(s), -8 * ca.det(s), ca.det(K)
    x = ca.SX(1)
    for _ in range(steps):
        value = ((x * x + c2) * x + c1) * x + c0
        slope = (4 * x * x + 2 * c2) * x + c1
        # Where the value is rounding errors these must not carry it past the root.
        ahead = ca.logic_and(value > 1e-13, slope > 0)
        x = x - ca.if_else(ahead, value / ca.fmax(slope, 1e-300), 0.0)
    return x * bound


def rigid_excess(contacts: list[BoxContact]) -> Expr:
    """> 0 if no motion of the palm brings all contacts within their balls and chords.

    The least weighted sum of squares of what is left, against what would be allowed.
    """
    heavy = [contact.placed / contact.radius**2 for contact in contacts]
    light = [contact.faced / contact.chord**2 for contact in contacts]
    total = sum(heavy, ca.SX(1e-300))
    there = sum((w * c.target for w, c in zip(heavy, contacts, strict=True)), ca.SX(3, 1)) / total
    here = sum((w * c.point for w, c in zip(heavy, contacts, strict=True)), ca.SX(3, 1)) / total
    S, size, allowed = ca.SX(3, 3), ca.SX(1e-300), ca.SX(0)
    for w, v, contact in zip(heavy, light, contacts, strict=True):
        x, y = contact.point - here, contact.target - there
        S += w * (x @ y.T) + v * (contact.normal @ contact.facing.T)
        size += w * (ca.sumsqr(x) + ca.sumsqr(y)) + 2 * v
        allowed += contact.placed + contact.faced
    least = size - 2 * largest_trace(S, size / 2)
    # What is left of a double root in doubles, as a part of the largest terms.
    return (least - 3e-8 * size) / ca.fmax(allowed, 1.0) - 1


@dataclass(frozen=True, eq=False)
class Ball:
    """What holds a point or a direction of the palm, base frame.

    Attributes:
        centre: (3, 1).
        radius: Of the ball.
        shares: What each coordinate of the box adds to it, h of them.
    """

    centre: Expr
    radius: Expr
    shares: list[Expr]


def _combination(
    contacts: list[BoxContact], vector: Expr, whole: int, asked: bool
) -> list[tuple[Expr, Expr]]:
    """Coefficients of the contacts' points and normals that give a vector, nearly.

    Those with the least weighted sum of squares; those of the points sum to `whole`.

    Args:
        contacts: Of the box.
        vector: (3, 1).
        whole: 1 for a point, 0 for a direction.
        asked: Whether of what is asked for, base frame; else of what the hand makes, palm frame.
    """
    sources = [(c.target, c.facing) if asked else (c.point, c.normal) for c in contacts]
    heavy = [contact.placed / contact.radius**2 for contact in contacts]
    total = sum(heavy, ca.SX(1e-300))
    share = [w / total for w in heavy]
    mean = sum((w * point for w, (point, _) in zip(share, sources, strict=True)), ca.SX(3, 1))
    columns, weights = [], []
    for w, contact, (point, direction) in zip(heavy, contacts, sources, strict=True):
        columns += [point - mean, direction]
        weights += [w, contact.faced / contact.chord**2]
    A, W = ca.horzcat(*columns), ca.diag(ca.vertcat(*weights))
    normal = A @ W @ A.T
    scale = normal[0, 0] + normal[1, 1] + normal[2, 2]
    normal += 1e-9 * (scale + 1e-300) * ca.DM.eye(3)
    found = W @ A.T @ solve_spd(ca.densify(normal), vector - whole * mean)
    # The mean draws on every contact, too.
    left = whole - sum((found[2 * i] for i in range(len(contacts))), ca.SX(0))
    return [(found[2 * i] + w * left, found[2 * i + 1]) for i, w in enumerate(share)]


def carried(contacts: list[BoxContact], vector: Expr, whole: int) -> Ball:
    """The ball that holds a point (whole 1) or a unit vector (whole 0) of the palm.

    With contacts x, normals n and any coefficients a point of the palm is sum(a x) + sum(b n) +
    rest; the same sum of what is asked for differs by at most sum(|a| radius) + sum(|b| chord) +
    |rest|, or by the slopes' bound of the same, if that is smaller.
    """
    centre, rest = ca.SX(3, 1), vector
    slopes, radius, sloped = ca.SX(3, contacts[0].moves.shape[1]), ca.SX(0), ca.SX(0)
    pairs = zip(_combination(contacts, vector, whole, asked=False), contacts, strict=True)
    for (p, n), contact in pairs:
        centre += p * contact.target + n * contact.facing
        rest -= p * contact.point + n * contact.normal
        slopes += p * contact.moves + n * contact.turns
        radius += ca.fabs(p) * contact.radius + ca.fabs(n) * contact.chord
        sloped += ca.fabs(p) * contact.near + ca.fabs(n) * contact.close
    # What moves the contacts as a whole moves the palm among them.
    shares = _columns(slopes)
    sloped += sum(shares, ca.SX(0))
    return Ball(centre, safe_norm(rest) + SLACK + ca.fmin(radius, sloped), shares)


@dataclass(frozen=True, eq=False)
class Seen:
    """Where the palm sees a point of the base: the same sum, of what is asked for.

    In the palm frame the wrist stands still, and it is known which way a slope carries the point.

    Attributes:
        centre: (3, 1) in the middle of the box [m], palm frame.
        slopes: (3, h) by u [m].
        loose: How far the point can be from there besides [m].
    """

    centre: Expr
    slopes: Expr
    loose: Expr

    @classmethod
    def point(cls, contacts: list[BoxContact], point: Expr) -> Seen:
        """A point (3, 1) of the base."""
        centre, rest = ca.SX(3, 1), point
        slopes, loose = ca.SX(3, contacts[0].moves.shape[1]), ca.SX(SLACK)
        for (p, n), contact in zip(
            _combination(contacts, point, 1, asked=True), contacts, strict=True
        ):
            centre += p * contact.point + n * contact.normal
            rest -= p * contact.target + n * contact.facing
            slopes += p * contact.moves + n * contact.turns
            loose += ca.fabs(p) * contact.near + ca.fabs(n) * contact.close
        return cls(centre, slopes, loose + safe_norm(rest))

    def distances(self, other: Expr) -> tuple[Expr, Expr, Expr]:
        """Smallest and largest distance from a point (3, 1) of the palm [m].

        And (1, h) what each coordinate adds to what is between.
        """
        away = self.centre - other
        length = safe_norm(away)
        line = away / length
        along = line.T @ self.slopes
        aside = self.slopes - line @ along
        shares = ca.fabs(along)
        ahead, far = ca.sum2(shares), sum(_columns(aside), ca.SX(0))
        most = ca.sqrt((length + ahead) ** 2 + far**2) + self.loose
        return length - ahead - self.loose, most, shares


def _columns(matrix: Expr) -> list[Expr]:
    return [safe_norm(matrix[:, k]) for k in range(matrix.shape[1])]


def wrist_excess(
    contacts: list[BoxContact], arm: ArmSpan, span: Expr, ball: Ball
) -> tuple[list[Expr], list[Row]]:
    """Tests that are > 0 if the wrist is out of the arm's span, and rows of what decides them.

    Args:
        contacts: Of the box.
        arm: The arm.
        span: Smallest and largest distance [m].
        ball: That holds the wrist, see `carried`.
    """
    shoulder, near, far = ca.SX(ca.DM(arm.shoulder)), span[0], span[1]
    point, found = ca.SX(ca.DM(arm.wrist)), []
    for contact in contacts:
        away = safe_norm(contact.target - shoulder)
        length = safe_norm(point - contact.point)
        found.append(contact.placed * (away - length - contact.radius - far))
        found.append(contact.placed * (length - contact.radius - away - far))
        found.append(contact.placed * (near - away - length - contact.radius))
    seen = Seen.point(contacts, shoulder)
    least, most, shares = seen.distances(point)
    away = safe_norm(seen.centre - point)
    found += [least - far, near - most]
    rows = [Row(_outside(away, span), ca.fmax(away - least, most - away), ca.horzsplit(shares))]
    # Far from the contacts the shoulder is seen less sharply than the wrist.
    away = safe_norm(ball.centre - shoulder)
    found += [away - ball.radius - far, near - away - ball.radius]
    return found, [*rows, Row(_outside(away, span), ball.radius, ball.shares)]


def _outside(distance: Expr, span: Expr) -> Expr:
    return ca.fmax(ca.fmax(distance - span[1], span[0] - distance), 0.0)


def cone_excess(arm: ArmCones, wrist: Ball, last: Ball, span: Expr, cosines: Expr) -> Expr:
    """> 0 if no elbow is within both cones.

    Args:
        arm: The cones.
        wrist: Ball that holds the wrist, base frame.
        last: Ball that holds axis 7.
        span: Smallest and largest distance of the wrist from the shoulder [m].
        cosines: (2, 1) of the half angles.
    """
    a, b = arm.lengths
    reach, loose = wrist.centre - ca.DM(arm.shoulder), wrist.radius + ANGLE_SLACK
    length = safe_norm(reach)
    known = ca.logic_and(loose < length, span[1] > 0)
    line = reach / length
    tilt = ca.asin(ca.fmin(loose / length, 1.0))
    near = ca.fmax(ca.fmax(length - loose, span[0]), 1e-9)
    far = ca.fmax(ca.fmin(length + loose, span[1]), near)
    # The elbow's circle, seen from the shoulder and from the wrist: its angles to the line.
    upper, upper_give = _opening(a, b, near, far)
    fore, fore_give = _opening(b, a, near, far)
    first, axis = ca.SX(ca.DM(arm.first)), last.centre
    slack = tilt + ANGLE_SLACK
    one = _arc(line, first, upper, cosines[0] - slack - upper_give)
    # Seen from the wrist the circle is on the other side of the line.
    other = _arc(line, axis, -fore, cosines[1] - slack - fore_give - last.radius)
    cross = ca.cross(one[0], other[0])
    between = ca.atan2(ca.dot(cross, line), ca.dot(one[0], other[0]))
    apart = ca.fabs(between) - one[1] - other[1] - ANGLE_SLACK
    excess = ca.fmax(ca.fmax(one[2], other[2]), apart)
    return ca.if_else(known, excess, -1.0)


def _opening(a: float, b: float, near: Expr, far: Expr) -> tuple[Expr, Expr]:
    """Angle at the end of side a of a triangle with the sides a, b and one in [near, far].

    Its middle, and how much less or more it can be.
    """

    def cosine(side: Expr) -> Expr:
        return ca.fmax(ca.fmin((side * side + a * a - b * b) / (2 * a * side), 1.0), -1.0)

    ends = cosine(near), cosine(far)
    least, most = ca.fmin(*ends), ca.fmax(*ends)
    if a > b:
        # In between, where the angle at the end of b is a right one.
        turn = float(np.sqrt(a * a - b * b))
        inside = ca.logic_and(near < turn, far > turn)
        least = ca.if_else(inside, ca.fmin(least, cosine(ca.SX(turn))), least)
    low, high = ca.acos(most), ca.acos(least)
    return (low + high) / 2, (high - low) / 2 + ANGLE_SLACK


def _arc(line: Expr, axis: Expr, opening: Expr, cosine: Expr) -> tuple[Expr, Expr, Expr]:
    """Where on the circle a direction at an angle to the line has at least a cosine to an axis.

    Returns:
        The middle of the arc (3, 1) as a vector across the line, half its length [rad], and a test
        that is > 0 if there is no such arc.
    """
    along = ca.dot(axis, line)
    across = axis - along * line
    size = ca.fabs(ca.sin(opening)) * safe_norm(across)
    least = cosine - ca.cos(opening) * along
    half = ca.acos(ca.fmax(ca.fmin(least / ca.fmax(size, 1e-6), 1.0), -1.0))
    middle = ca.if_else(opening < 0, -across, across)
    return middle, ca.if_else(size < 1e-6, np.pi, half), least - size
