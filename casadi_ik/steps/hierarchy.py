"""How several tasks share the joints: null-space projection in its usual forms.

Every task is solved on its own; they differ in the projector that keeps a lower task from
disturbing the higher ones (Qiu & Kermani 2021, section I).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import casadi as ca

from casadi_ik.steps.tasks import Task, TaskSolver
from casadi_ik.symbolic.linear_algebra import null_projector, project_to_null_space
from casadi_ik.symbolic.smooth import Expr

PROJECTIONS = ("successive", "augmented", "none")
"""Which null space a lower task has to stay in."""

RANK_FLOOR = 1e-3
"""Damping of the augmented projector [rad/rad, and mm/rad times 1e-3]: below it a row left over
from the higher tasks counts as dependent on them."""


def combine(tasks: Sequence[Task], solver: TaskSolver, projection: str) -> Expr:
    """One step for all tasks (k, 1), the highest first.

    Args:
        tasks: From the highest priority to the lowest, over the same actuators.
        solver: Solves one task.
        projection: "successive": dq_1 + N_1 dq_2 + N_1 N_2 dq_3 + ..., each N_i of its own task
            only. "augmented": dq_1 + N_1 dq_2 + N_12 dq_3 + ..., N_12 of the tasks 1 and 2 stacked.
            "none": the plain sum, no priorities.
    """
    steps = [solver(task) for task in tasks]
    if projection == "none":
        return sum(steps[1:], steps[0])
    if projection == "successive":
        total = steps[0]
        for level in range(1, len(tasks)):
            step = steps[level]
            for higher in reversed(tasks[:level]):
                step = project_to_null_space(higher.jacobian, step)
            total = total + step
        return total
    total, projector = steps[0], ca.SX.eye(steps[0].numel())
    for higher, step in zip(tasks, steps[1:], strict=False):
        projector = narrowed(projector, higher)
        total = total + projector @ step
    return total


def narrowed(projector: Expr, task: Task) -> Expr:
    """The projector (k, k) into the null space of what it already spares and one more task."""
    scale = 1e-3 if task.is_position else 1.0
    return _narrowed(*task.jacobian.shape)(projector, task.jacobian * scale)


@cache
def _narrowed(m: int, k: int) -> ca.Function:
    """P' = P N(J P): a function of its own, since it is called once per level."""
    P, J = ca.SX.sym("P", k, k), ca.SX.sym("J", m, k)
    return ca.Function(f"narrowed_{m}_{k}", [P, J], [P @ null_projector(J @ P, RANK_FLOOR)])
