"""Postures of the AR10 and what a run of the control law leaves there."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik
from ar10.figures import translation
from casadi_ik.arrays import Array

STEPS = 80
"""Of a run that is drawn."""

RESOLUTION = 1e-4
"""Steps of a slider [m]: an assumption, from memory of what small servo screws repeat to."""

COLORS = ("#e08a2e", "#2f6db3", "#1f9d55", "#8e4ec6")


def within(robot: ik.ArmHand, part: float) -> Array:
    """Every actuator at a part of its stroke."""
    return robot.lower + part * span(robot)


def span(robot: ik.ArmHand) -> Array:
    """Strokes of all actuators."""
    return robot.upper - robot.lower


def final_distance(control: ik.papers.ScrewControl, start: Array, goal: Array, steps: int) -> float:
    """Distance of the tip from the goal's after so many steps [mm]."""
    target = control.target(goal)
    end = control.run(start, target, steps).points[-1]
    return 1e3 * float(np.linalg.norm(end - translation(target)))


def rate_rows(rates: list[tuple[float, float]]) -> list[tuple[str, str, str]]:
    """Fitted rates beside the law's."""
    return [
        (f"{gain:g}", f"{rate:.3f}", "infinite" if gain == 1 else f"{-np.log(1 - gain):.3f}")
        for gain, rate in rates
    ]
