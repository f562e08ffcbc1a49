"""Arm stage: the arm in closed form for a palm pose, the swivel chosen by the joint limits.

First a few swivels are tried and the configuration farthest from its limits is kept. If none is
within, the swivels at which some joint stands exactly at a limit are tried: the allowed swivels
are intervals that end at such points, so no interval is missed, however short.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.srs_arm import (
    Spherical,
    SrsArm,
    at_angle,
    limit_roots,
    swivel,
)
from casadi_ik.symbolic.subexpressions import shared

SAMPLES = 6
"""Swivels tried first, for each sign of the elbow."""

ROOTS = 24
"""Swivels at which a joint may stand at a limit: six joints, two limits, two roots."""

BLOCK = 8
"""Roots tried in one iteration."""

ITERATIONS = 1 + 2 * ROOTS // BLOCK
"""Iterations of the stage if nothing is found."""

ALLOWED = -1e-9
"""Margin [rad] that still counts as within limits: rounding at a root."""


NO_MARGIN = -1e9
"""Margin before any arm was seen."""


def place_arm(arm: SrsArm, palm: Pose, lower: Expr, upper: Expr, trial: Expr) -> tuple[Expr, Expr]:
    """Try the swivels of one iteration.

    Args:
        arm: The arm's constants.
        palm: Palm pose, base frame.
        lower: (7, 1) bounds of the arm [rad].
        upper: (7, 1).
        trial: Number of the iteration, from 0.

    Returns:
        The best configuration (7, 1) [rad] and its margin: the smallest distance of any joint
        from its bounds [rad], negative if outside.
    """
    first = ca.Function.if_else("trial", _sampled(arm), _at_limits(arm))
    q, margin = first(trial < 1, palm.rotation, palm.origin, lower, upper, trial)
    return q, margin


def _inputs() -> tuple[list[ca.SX], Pose, ca.SX, ca.SX, ca.SX]:
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    lower, upper, trial = ca.SX.sym("lower", 7), ca.SX.sym("upper", 7), ca.SX.sym("trial")
    return [rotation, origin, lower, upper, trial], Pose(rotation, origin), lower, upper, trial


def _sampled(arm: SrsArm) -> ca.Function:
    """Evenly spread swivels for both signs of the elbow."""
    inputs, palm, lower, upper, _ = _inputs()
    angles = ca.DM((2 * np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES).tolist())
    results = [_best(arm, palm, sign, angles, lower, upper) for sign in (1.0, -1.0)]
    q, margin = _better(*results)
    return ca.Function("sampled", inputs, shared(q, margin))


def _at_limits(arm: SrsArm) -> ca.Function:
    """A block of the swivels at which some joint stands at a limit; odd trials elbow +, even -."""
    inputs, palm, lower, upper, trial = _inputs()
    sign = ca.if_else(ca.fmod(trial, 2) > 0.5, 1.0, -1.0)
    chain = swivel(arm, palm, sign)
    roots = ca.vertcat(
        limit_roots(arm.shoulder_joints, chain.shoulder, lower[:3], upper[:3]),
        limit_roots(arm.wrist_joints, chain.wrist, lower[4:], upper[4:]),
    )
    block = ca.floor((trial - 1) / 2)
    chosen = sum(
        (
            ca.if_else(block == i, roots[BLOCK * i : BLOCK * (i + 1)], 0.0)
            for i in range(ROOTS // BLOCK)
        ),
        ca.SX.zeros(BLOCK, 1),
    )
    q, margin = _best(arm, palm, sign, chosen, lower, upper)
    return ca.Function("at_limits", inputs, shared(q, margin))


def _best(
    arm: SrsArm, palm: Pose, sign: Expr, angles: Expr, lower: Expr, upper: Expr
) -> tuple[Expr, Expr]:
    """The configuration with the largest margin among some swivels."""
    chain = swivel(arm, palm, sign)
    elbow_margin = ca.fmin(chain.elbow - lower[3], upper[3] - chain.elbow)
    # Out of reach the arm points straight at the palm; the margin says by how much it falls short.
    fixed = ca.fmin(elbow_margin, ca.if_else(chain.reachable < 0, chain.reachable, np.inf))
    result: tuple[Expr, Expr] | None = None
    for i in range(angles.numel()):
        shoulder, first = _sphere(
            arm.shoulder_joints, at_angle(chain.shoulder, angles[i]), lower[:3], upper[:3]
        )
        wrist, second = _sphere(
            arm.wrist_joints, at_angle(chain.wrist, angles[i]), lower[4:], upper[4:]
        )
        q = ca.vertcat(shoulder, chain.elbow, wrist)
        found = (q, ca.fmin(fixed, ca.fmin(first, second)))
        result = found if result is None else _better(result, found)
    assert result is not None
    return result


def _sphere(spherical: Spherical, matrix: Expr, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
    """The better of a sphere's two triples, and its margin."""
    pairs = []
    for triple in spherical.triples(matrix, lower, upper):
        pairs.append((triple, ca.mmin(ca.fmin(triple - lower, upper - triple))))
    return _better(pairs[0], pairs[1])


def _better(one: tuple[Expr, Expr], other: tuple[Expr, Expr]) -> tuple[Expr, Expr]:
    """Whichever has the larger margin."""
    keep = one[1] >= other[1]
    return ca.if_else(keep, one[0], other[0]), ca.fmax(one[1], other[1])
