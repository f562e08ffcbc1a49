"""All arms for a palm pose: its branches, and how far each of them may be varied.

What an arm in closed form offers, whatever its form: `find` gives every branch
within bounds with the exact interval of its one freedom, if it has one; `arms` the configurations
of a branch at values of the freedom; `best_arm` is the one that scores highest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.common.arm_branches import SIDES, arm_at, arm_edges
from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.symbolic.srs_arm import SrsArm

TURN = 2 * np.pi

SAMPLES = 33
"""Swivels looked at along an interval, and again around the best of them."""

ZOOMS = 2
"""How often what is around the best is looked at; each time the steps shrink to a sixteenth."""


@dataclass(frozen=True)
class ArmBranch:
    """One way to bend an arm, and how far it may be varied.

    Attributes:
        shoulder: +1 or -1. Of an arm with a spherical shoulder, elbow and spherical wrist (S-R-S):
            sign of joint 2 from where axes 1 and 3 are aligned.
        elbow: +1 or -1; S-R-S: sign of joint 4 from the stretched arm.
        wrist: +1 or -1; S-R-S: sign of joint 6 from where axes 5 and 7 are aligned.
        swivel: (start, end) [rad] of an interval of the arm's freedom within limits, start <= end;
            None for an arm without one. S-R-S: the angle of the elbow about the line from shoulder
            to wrist, a whole turn if none is out. Other arms of seven joints: the position of the
            joint that is swept, see `ClosedForm.swept_joint`.
        root: Number of the arm among those of the same signs, at each position of a swept joint:
            a wrist whose last axis passes by it may have several. 0 of other arms.

    Example:
        >>> branch = solver.solve_all(grasp, limit=1)[0].branch
        >>> branch.elbow in (-1, 1), branch.swivel[0] <= branch.swivel[1]
        (True, True)
    """

    shoulder: int
    elbow: int
    wrist: int
    swivel: tuple[float, float] | None
    root: int = 0


class Branches(Protocol):
    """Enumerates the arms of one robot."""

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Every interval of every branch.

        Args:
            palm: (4, 4) pose of the palm, base frame.
            lower: (n,) bounds [rad].
            upper: (n,).
        """
        ...

    def arms(self, palm: Array, branch: ArmBranch, swivels: Array) -> Array:
        """Configurations (k, n) [rad] of a branch at values (k,) of its freedom."""
        ...


class ArmBranches:
    """Enumerates the arms of an S-R-S arm."""

    def __init__(self, arm: SrsArm, compiled: bool = True) -> None:
        """Compile the functions of the arm or load them from the cache."""
        self._at = FunctionKernel(arm_at(arm), compiled)
        self._edges = FunctionKernel(arm_edges(arm), compiled)

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Every interval of every branch.

        The allowed swivels end where a joint stands at a limit, so between two such swivels all
        are allowed or none: the middle decides.

        Args:
            palm: (4, 4) pose of the palm, base frame.
            lower: (7,) bounds [rad].
            upper: (7,).
        """
        rotation, origin = palm[:3, :3], palm[:3, 3]
        found = []
        for elbow in (1, -1):
            (roots,) = self._edges(rotation, origin, float(elbow), lower, upper)
            edges = np.unique(np.mod(roots, TURN))
            ends = np.append(edges[1:], edges[0] + TURN)
            tried = np.concatenate([(edges + ends) / 2, edges])
            arms, reachable = self._at(rotation, origin, float(elbow), tried)
            margin = np.minimum(arms - lower, upper - arms).min(axis=2)
            allowed = (margin >= ALLOWED) & (reachable >= 0)[:, None]
            for side, (shoulder, wrist) in enumerate(SIDES):
                between, at = np.split(allowed[:, side], 2)
                found += [
                    ArmBranch(shoulder, elbow, wrist, interval)
                    for interval in _intervals(edges, ends, between, at)
                ]
        return found

    def arms(self, palm: Array, branch: ArmBranch, swivels: Array) -> Array:
        """Configurations (k, 7) [rad] of a branch at swivels (k,)."""
        arms, _ = self._at(palm[:3, :3], palm[:3, 3], float(branch.elbow), swivels)
        return arms[:, SIDES.index((branch.shoulder, branch.wrist))]


def best_arm(
    branches: Branches, palm: Array, branch: ArmBranch, score: Callable[[Array], Array]
) -> tuple[Array, float | None]:
    """The arm of a branch with the highest score, and its swivel.

    Args:
        branches: Of the arm.
        palm: (4, 4).
        branch: With its interval.
        score: Of configurations (k, n) -> (k,).
    """
    if branch.swivel is None:
        return branches.arms(palm, branch, np.zeros(1))[0], None
    first, last = branch.swivel
    swivels = np.linspace(first, last, SAMPLES)
    for _ in range(ZOOMS):
        i = int(np.argmax(score(branches.arms(palm, branch, swivels))))
        step = swivels[1] - swivels[0]
        swivels = np.linspace(max(first, swivels[i] - step), min(last, swivels[i] + step), SAMPLES)
    arms = branches.arms(palm, branch, swivels)
    i = int(np.argmax(score(arms)))
    return arms[i], float(swivels[i])


def _intervals(
    edges: Array, ends: Array, between: NDArray[np.bool_], at: NDArray[np.bool_]
) -> list[tuple[float, float]]:
    """Joined stretches; a lone edge that is allowed is a stretch of no length.

    Args:
        edges: (m,) sorted, within one turn.
        ends: (m,) the next edge of each.
        between: (m,) whether the swivels from an edge to the next are allowed.
        at: (m,) whether the edge itself is.
    """
    if between.all():
        return [(float(edges[0]), float(edges[0] + TURN))]
    count = len(edges)
    found = []
    for i in np.flatnonzero(between & ~np.roll(between, 1)):
        length = 0.0
        j = int(i)
        while between[j % count]:
            length += ends[j % count] - edges[j % count]
            j += 1
        found.append((float(edges[i]), float(edges[i] + length)))
    lone = at & ~between & ~np.roll(between, 1)
    return found + [(float(edge), float(edge)) for edge in edges[lone]]
