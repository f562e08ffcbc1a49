"""How several tasks share the joints: null-space projection in its usual forms.

Every task is solved on its own; they differ in the projector that keeps a lower task from
disturbing the higher ones (Qiu & Kermani 2021, section I).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from casadi_ik.methods.qiu.tasks import MILLIMETRE, Task
from casadi_ik.symbolic.linear_algebra import project_to_null_space, solve_spd
from casadi_ik.symbolic.smooth import Expr

PROJECTIONS = ("successive", "augmented", "none")
"""Which null space a lower task has to stay in."""

EXACT = 1e-6
"""Damping of a projector that is meant to be exact [unit of the task's Jacobian]."""

RANK_FLOOR = 1e-3
"""Damping of the augmented projector [rad/rad, and m/rad]: below it a row left over
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
    projectors: list[Projector] = []
    for higher in tasks[:-1]:
        projectors.append(_projector(higher, projectors, damping))
    total = steps[-1]
    for step, projector in zip(reversed(steps[:-1]), reversed(projectors), strict=True):
        total = step + projector.of_column(total)
    return total


@dataclass(frozen=True, eq=False)
class Projector:
    """N = I - Y' Z with Z = (Y Y' + damping^2 I)^-1 Y, kept as its factors, both (3, k).

    Multiplied with vectors one after the other they take a third of the instructions of a product
    of the matrices.
    """

    Y: Expr
    Z: Expr

    def of_column(self, column: Expr) -> Expr:
        """N v for v (k, 1)."""
        return column - self.Y.T @ (self.Z @ column)

    def of_rows(self, rows: Expr) -> Expr:
        """R N for R (r, k)."""
        return rows - (rows @ self.Y.T) @ self.Z


def _projector(task: Task, higher: Sequence[Projector], damping: float | None) -> Projector:
    """What the tasks so far and one more leave free is N_1 N_2 ... N_k: this is N_k.

    Y = J N_1 ... N_k-1 is the part of the task that the higher ones left to it.
    """
    Y = task.jacobian
    if damping is None:
        damping, Y = RANK_FLOOR, Y * (MILLIMETRE if task.is_position else 1.0)
    for projector in higher:
        Y = projector.of_rows(Y)
    G = Y @ Y.T + damping**2 * ca.DM.eye(Y.shape[0])
    # Structurally zero columns stay so: the highest tasks have many.
    columns = sorted(set(Y.sparsity().get_col()))
    Z = type(Y)(*Y.shape)
    Z[:, columns] = solve_spd(G, Y[:, columns])
    return Projector(Y, Z)
