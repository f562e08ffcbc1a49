"""The arm in closed form for a palm pose, as near as possible to a given one.

Near means the sum of squared joint motions, every joint as a part of its range. At a swivel the two
spheres choose their triples independently of each other, so all branches are seen at once: first at
swivels all around for both signs of the elbow, then ever closer around the best.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.srs_arm import Spherical, SrsArm, at_angle, swivel
from casadi_ik.symbolic.subexpressions import shared

SAMPLES = 12
"""Swivels tried in the first trial for a sign of the elbow."""

CLOSER = 6
"""Swivels tried around the best so far."""

ZOOMS = 3
"""Trials around the best after the first; the steps shrink to a quarter each time, at last to
0.6 deg: the distance is flat where it is smallest."""

TRIALS = 1 + ZOOMS

OUTSIDE = -1e3
"""Score of an arm outside its bounds, less what it is outside by [rad]."""

STEP = 2 * np.pi / SAMPLES


@dataclass(frozen=True, eq=False)
class Wanted:
    """What an arm is chosen by; (n, 1) each.

    Attributes:
        near: The given arm [rad].
        lower: Bounds [rad].
        upper: Bounds [rad].
        scales: What joint motions are multiplied by before they are squared, numbers: as an input
            of a function they would keep solves from going side by side.
    """

    near: Expr
    lower: Expr
    upper: Expr
    scales: ca.DM

    def part(self, rows: slice | list[int]) -> Wanted:
        """Of some of the joints."""
        return Wanted(self.near[rows], self.lower[rows], self.upper[rows], self.scales[rows])

    def cost(self, q: Expr) -> tuple[Expr, Expr]:
        """Squared distance of joints from the given ones, and their margin within the bounds."""
        margin = ca.mmin(ca.fmin(q - self.lower, self.upper - q))
        return ca.sumsqr(self.scales * (q - self.near)), margin


def is_allowed(score: Expr) -> Expr:
    """Whether the arm with this score is within its bounds."""
    return score > OUTSIDE / 2


def choose_arm(
    arm: SrsArm, palm: Pose, wanted: Wanted, trial: Expr, around: Expr, elbow: Expr
) -> tuple[Expr, Expr, Expr, Expr]:
    """One trial.

    Args:
        arm: The arm's constants.
        palm: Palm pose, base frame.
        wanted: What it is chosen by.
        trial: Its number, from 0.
        around: Best swivel so far [rad]; the first trial takes no notice.
        elbow: Its sign of the elbow.

    Returns:
        The best arm (7, 1) [rad] of the trial, its score (higher is better), swivel and elbow sign.
    """
    scales = wanted.scales
    choose = ca.Function.if_else("trial", _everywhere(arm, scales), _around(arm, scales))
    inputs = [palm.rotation, palm.origin]
    inputs += [wanted.near, wanted.lower, wanted.upper, trial, around, elbow]
    q, score, psi, sign = choose(trial < 1, *inputs)
    return q, score, psi, sign


def _inputs(scales: ca.DM) -> tuple[list[ca.SX], Pose, Wanted, ca.SX, ca.SX, ca.SX]:
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    near, lower, upper = (ca.SX.sym(name, 7) for name in ("near", "lower", "upper"))
    trial, around, elbow = (ca.SX.sym(name) for name in ("trial", "around", "elbow"))
    inputs = [rotation, origin, near, lower, upper, trial, around, elbow]
    wanted = Wanted(near, lower, upper, scales)
    return inputs, Pose(rotation, origin), wanted, trial, around, elbow


def _everywhere(arm: SrsArm, scales: ca.DM) -> ca.Function:
    inputs, palm, wanted, *_ = _inputs(scales)
    angles = ca.DM((STEP * (np.arange(SAMPLES) + 0.5)).tolist())
    found = _Best()
    for sign in (1.0, -1.0):
        found.look(arm, palm, wanted, ca.SX(sign), angles)
    return ca.Function("everywhere", inputs, shared(*found.best))


def _around(arm: SrsArm, scales: ca.DM) -> ca.Function:
    inputs, palm, wanted, trial, around, elbow = _inputs(scales)
    width = STEP * 0.25 ** (trial - 1)
    offsets = (2 * np.arange(CLOSER) + 1 - CLOSER) / CLOSER
    found = _Best()
    found.look(arm, palm, wanted, elbow, around + width * ca.DM(offsets.tolist()))
    return ca.Function("around", inputs, shared(*found.best))


class _Best:
    """The best of the arms looked at."""

    def __init__(self) -> None:
        self.best: tuple[Expr, ...] = ()

    def look(self, arm: SrsArm, palm: Pose, wanted: Wanted, sign: Expr, angles: Expr) -> None:
        """Look at the arms of an elbow sign at some swivels."""
        chain = swivel(arm, palm, sign)
        bent, elbow_margin = wanted.part(slice(3, 4)).cost(chain.elbow)
        # Out of reach the arm points straight at the palm.
        fixed = ca.fmin(elbow_margin, ca.if_else(chain.reachable < 0, chain.reachable, np.inf))
        for i in range(angles.numel()):
            shoulder, first, first_margin = _sphere(
                arm.shoulder_joints, at_angle(chain.shoulder, angles[i]), wanted.part(slice(0, 3))
            )
            wrist, second, second_margin = _sphere(
                arm.wrist_joints, at_angle(chain.wrist, angles[i]), wanted.part(slice(4, 7))
            )
            margin = ca.fmin(fixed, ca.fmin(first_margin, second_margin))
            near = -(first + bent + second)
            score = ca.if_else(margin >= ALLOWED, near, OUTSIDE + margin)
            self._take(ca.vertcat(shoulder, chain.elbow, wrist), score, angles[i], sign)

    def _take(self, *found: Expr) -> None:
        if not self.best:
            self.best = found
            return
        keep = self.best[1] >= found[1]
        pairs = zip(self.best, found, strict=True)
        self.best = tuple(ca.if_else(keep, one, other) for one, other in pairs)


def _sphere(spherical: Spherical, matrix: Expr, wanted: Wanted) -> tuple[Expr, Expr, Expr]:
    """The nearer of a sphere's two triples among those within bounds, its cost and margin."""
    triples = spherical.triples(matrix, wanted.lower, wanted.upper)
    found = [(triple, *wanted.cost(triple)) for triple in triples]
    scores = [ca.if_else(margin >= ALLOWED, -cost, OUTSIDE + margin) for _, cost, margin in found]
    keep = scores[0] >= scores[1]
    first, second, third = (ca.if_else(keep, one, other) for one, other in zip(*found, strict=True))
    return first, second, third
