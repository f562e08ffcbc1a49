"""All arms of a form whose last axis passes by its sphere, at positions of the swept joint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.methods.common.arm_branches import rows_of
from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.solving.alternatives.branches import ArmBranch, ArmBranches, Branches
from casadi_ik.solving.alternatives.form_branches import FormBranches
from casadi_ik.symbolic.closed_arms.passing import PassingArm
from casadi_ik.symbolic.closed_arms.recognise import ArmForm
from casadi_ik.symbolic.srs_arm import SrsArm

POSITIONS = 37
"""Of the swept joint: each costs a search for the roots of every branch."""


class PassingBranches(FormBranches):
    """Enumerates the arms of such a form; stretches end at positions that were looked at."""

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Every stretch of every root of every branch."""
        return [branch for branch, _, _ in self.looked(palm, lower, upper)]

    def best(
        self, palm: Array, lower: Array, upper: Array, score: Callable[[Array], Array]
    ) -> list[tuple[Array, ArmBranch, float | None]]:
        """Of every stretch the arm (n,) with the highest score, and its swept position."""
        found = []
        for branch, positions, arms in self.looked(palm, lower, upper):
            i = int(np.argmax(score(arms)))
            swivel = None if branch.swivel is None else float(positions[i])
            found.append((arms[i], branch, swivel))
        return found

    def looked(
        self, palm: Array, lower: Array, upper: Array
    ) -> list[tuple[ArmBranch, Array, Array]]:
        """Every stretch, the positions (k,) of it, and the arms (k, n) there."""
        joint = self._form.swept_joint
        grid = np.zeros(1)
        if joint is not None:
            middle, half = (lower[joint] + upper[joint]) / 2, (upper[joint] - lower[joint]) / 2
            half = min(half, np.pi)
            # Away from the ends: the swept joint is within its limits, the others tell apart.
            grid = middle + half * ((2 * np.arange(POSITIONS) + 1) / POSITIONS - 1)
        arms, slack = self._at(palm[:3, :3], palm[:3, 3], grid)
        margin = np.minimum(arms - lower, upper - arms).min(axis=2)
        allowed = (margin >= ALLOWED) & (slack.reshape(margin.shape) >= 0)
        found = []
        for side in range(rows_of(self._form)):
            inside = np.flatnonzero(allowed[:, side])
            for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1):
                if not len(run):
                    continue
                ends = None if joint is None else (float(grid[run[0]]), float(grid[run[-1]]))
                found.append((self._branch(side, ends), grid[run], arms[run, side]))
        return found


def branches_of(form: ArmForm, compiled: bool = True) -> Branches:
    """The branches of an arm in closed form."""
    if isinstance(form, SrsArm):
        return ArmBranches(form, compiled)
    kind = PassingBranches if isinstance(form, PassingArm) else FormBranches
    return kind(form, compiled)
