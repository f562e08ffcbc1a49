"""From one posture to another without touching anything."""

from __future__ import annotations

from typing import Any

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.motion.clear_between import between
from casadi_ik.problem.clearance import Surroundings

STRIDES = (0.02, 0.005, 0.002)
"""Longest steps of a motor between postures that a planner looks at [rad, or part of its range]:
finer ones where a way turns out not to be free between them."""

SECONDS = 5.0
"""Time that a planner has."""


def motor_units(robot: ArmHand) -> Array:
    """(n,) what counts as a unit of each motor: 1 rad, or the range of a slider."""
    slides = np.array([actuator.unit == "m" for actuator in robot.description.actuators])
    return np.where(slides, robot.upper - robot.lower, 1.0)


def free_way(
    robot: ArmHand, start: Array, end: Array, around: Surroundings | None, seed: int
) -> tuple[Array | None, str]:
    """Corners (k, n) of a way that touches nothing, straight if that is free.

    Args:
        robot: The robot.
        start: (n,).
        end: (n,).
        around: What must not be touched; None: nothing is checked.
        seed: Of the planner.

    Returns:
        The corners, None if no way was found; and how it was found, or why not.
    """
    units, straight = motor_units(robot), np.stack([start, end])
    if around is None or between(around, straight).free.all():
        return straight, "straight"
    for posture, name in ((start, "start"), (end, "pre-grasp")):
        found = around.check(posture[None])
        if not found.free[0]:
            return None, f"the {name} is not free: {' and '.join(found.pair(0) or ())} touch"
    try:
        from ompl import base, geometric, util
    except ImportError:
        return None, "the straight way is not free, and OMPL is not installed (casadi-ik[motion])"
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed + 1)  # OMPL takes the first of a process
    n = len(start)
    space = base.RealVectorStateSpace(n)
    bounds = base.RealVectorBounds(n)
    for i in range(n):
        bounds.setLow(i, float(robot.lower[i] / units[i]))
        bounds.setHigh(i, float(robot.upper[i] / units[i]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(
        lambda state: bool(around.free(units * _numbers(state, n)[None])[0])
    )
    states: list[Any] = []
    for posture in (start, end):
        state: Any = space.allocState()
        for i in range(n):
            state[i] = float(posture[i] / units[i])
        states.append(state)
    setup.setStartAndGoalStates(*states)
    information = setup.getSpaceInformation()
    for stride in STRIDES:
        setup.clear()
        information.setStateValidityCheckingResolution(stride / space.getMaximumExtent())
        setup.setPlanner(geometric.RRTConnect(information))
        setup.solve(SECONDS)
        if not setup.haveExactSolutionPath():
            return None, f"the straight way is not free, and OMPL found no other in {SECONDS:g} s"
        setup.simplifySolution(SECONDS / 5)
        found_way = setup.getSolutionPath().getStates()
        corners = units * np.array([_numbers(state, n) for state in found_way])
        corners[0], corners[-1] = start, end
        if between(around, corners).free.all():
            return corners, "OMPL, RRT-Connect"
    return None, "the ways that OMPL found are not free between the postures it looked at"


def _numbers(state: Any, n: int) -> Array:
    """A state of OMPL, whose annotations do not know that it has elements, as (n,)."""
    return np.array([state[i] for i in range(n)])
