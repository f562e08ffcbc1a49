"""How several tasks share the joints: null-space projection in its usual forms.

Every task is solved on its own; they differ in the projector that keeps a lower task from
disturbing the higher ones (Qiu & Kermani 2021, section I).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from casadi_ik.steps.tasks import Task
from casadi_ik.symbolic.linear_algebra import project_to_null_space, solve_spd
from casadi_ik.symbolic.smooth import Expr

PROJECTIONS = ("successive", "augmented", "none")
"""Which null space a lower task has to stay in."""

EXACT = 1e-6
"""Damping of a projector that is meant to be exact [unit of the task's Jacobian]."""

RANK_FLOOR = 1e-3
"""Damping of the augmented projector [rad/rad, and mm/rad times 1e-3]: below it a row left over
from the higher tasks counts as dependent on them."""


def combine(
    tasks: Sequence[Task],
    steps: Sequence[Expr],
    projection: str,
    damping: float | None = None,
) -> Expr:
    """One step for all tasks (k, 1), the highest first.

    Args:
        tasks: From the highest priority to the lowest, over the same actuators.
        steps: (k, 1) of every task by itself.
        projection: "successive": dq_1 + N_1 dq_2 + N_1 N_2 dq_3 + ..., each N_i of its own task
            only. "augmented": dq_1 + N_1 dq_2 + N_12 dq_3 + ..., N_12 of the tasks 1 and 2 stacked.
            "none": the plain sum, no priorities.
        damping: Of the pseudoinverse in the projectors [mm; rad/rad], so that a lower task leaks
            into the higher ones; None: the projectors are exact wherever that is possible.
    """
    if projection == "none":
        return sum(steps[1:], steps[0])
    if projection == "successive":
        total = steps[0]
        for level in range(1, len(tasks)):
            step = steps[level]
            for higher in reversed(tasks[:level]):
                step = project_to_null_space(higher.jacobian, step, damping or EXACT)
            total = total + step
        return total
    total, spared = steps[0], None
    for higher, step in zip(tasks, steps[1:], strict=False):
        spared = extended(spared, higher, damping)
        total = total + spared.project(step)
    return total


@dataclass(frozen=True, eq=False)
class Spared:
    """The projector P = I - A X into the null space of some tasks, r rows in all.

    Its factors are a fifth of the matrix: forming P and multiplying it level by level took five
    times the instructions.

    Attributes:
        A: (k, r).
        X: (r, k).
    """

    A: Expr
    X: Expr

    def project(self, vectors: Expr) -> Expr:
        """P v for every column of `vectors` (k, c)."""
        return vectors - self.A @ (self.X @ vectors)


def extended(spared: Spared | None, task: Task, damping: float | None) -> Spared:
    """One more task to be spared: P' = P N(J P), N(Y) = I - Y' (Y Y' + damping^2 I)^-1 Y."""
    J = task.jacobian
    if damping is None:
        damping, J = RANK_FLOOR, J * (1e-3 if task.is_position else 1.0)
    if spared is None:
        Y, PY = J, J.T
    else:
        Y = J - (J @ spared.A) @ spared.X
        PY = spared.project(Y.T)
    G = Y @ Y.T + damping**2 * ca.DM.eye(Y.shape[0])
    X = solve_spd(G, Y)
    if spared is None:
        return Spared(PY, X)
    return Spared(ca.horzcat(spared.A, PY), ca.vertcat(spared.X, X))
