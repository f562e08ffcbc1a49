"""Why targets are missed: whether hand or arm is not found, and how near the best answer comes."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Status

AT_A_LIMIT = 1e-3
"""Part of its range within which a motor stands at a limit."""

CAUSE_HEADS = (
    *("missed", "solved now", "of the rest, if the hand is given", "if the hand is nearly given"),
    *("arm motors at limits", "hand motors at limits", "off, median"),
)

CAUSES = """
*Solved now:* by the code that wrote this page. *If the hand is given:* one round of the method from
the hand posture that the target was made with; what that solves was missed because no posture came
near enough, the others because no arm was found that holds the hand where it fits. *Nearly:* eight
postures around it, by 0.1 rad (a slider: a tenth of its stroke). *At limits:* mean over the missed
of the part of arm and hand motors within a thousandth of their range. *Off:* the largest error of a
contact in the best answer.
"""


def causes(robot: ik.ArmHand, tolerance: ik.Tolerance, q: Array) -> list[str]:
    """The row of a table for configurations (k, n) whose contacts were missed."""
    points, normals = robot.contacts(q)
    solver = ik.Solver(robot, tolerance=tolerance)
    batch = solver.solve_batch(points, normals)
    left = ~batch.success
    count = int(left.sum())
    text = [f"{len(q)}", f"{len(q) - count}"]
    if not count:
        return [*text, *5 * ["-"]]
    problems = Problems(points[left], normals[left], tolerance, enforce_limits=True)
    method = HandFirstMethod(robot.description, HandFirstParameters())
    given, nearly = (_solved(method, problems, q[left], by) for by in (0.0, 0.1))
    ranges = robot.upper - robot.lower
    at_limits = np.minimum(q - robot.lower, robot.upper - q) < AT_A_LIMIT * ranges
    parts = [
        f"{100 * at_limits[left][:, list(motors)].mean():.0f} %" if len(motors) else "-"
        for motors in (robot.description.arm_actuators, robot.description.hand_actuators)
    ]
    off = 1e6 * np.median(np.nanmax(batch.position_error[left], axis=1))
    return [*text, f"{given} of {count}", f"{nearly} of {count}", *parts, f"{off:.3g} um"]


def _solved(method: HandFirstMethod, problems: Problems, q: Array, by: float) -> int:
    """How many a round from hands around these (k, n) solves."""
    hand, robot = list(method.robot.hand_actuators), ik.ArmHand(method.robot)
    lower, upper = robot.lower[hand], robot.upper[hand]
    rng = np.random.default_rng(0)
    postures = np.repeat(q[:, None, hand], method.options.candidates, axis=1)
    postures += by * method.hands.size * rng.normal(size=postures.shape)
    rows = method.rows(problems, np.zeros_like(q), np.clip(postures, lower, upper), begun=True)
    return int((method.run_rows(*rows).status == Status.SOLVED).sum())
