"""From one posture to another without touching anything."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.problem.clearance import Surroundings

STRIDE = 0.02
"""Longest step of a motor between two postures that are looked at [rad, or part of its range]."""

SECONDS = 5.0
"""Time that a planner has."""


def between_postures(start: Array, end: Array, units: Array) -> Array:
    """(k, n) postures on the straight way, close to one another; both ends are among them."""
    count = max(2, math.ceil(float(np.max(np.abs(end - start) / units)) / STRIDE) + 1)
    return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)


def motor_units(robot: ArmHand) -> Array:
    """(n,) what counts as a unit of each motor: 1 rad, or the range of a slider."""
    slides = np.array([actuator.unit == "m" for actuator in robot.description.actuators])
    return np.where(slides, robot.upper - robot.lower, 1.0)


def dense(corners: Array, units: Array) -> Array:
    """Straight ways from corner to corner (k, n), looked at closely."""
    return np.concatenate([between_postures(*pair, units) for pair in pairwise(corners)])


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
    if around is None or around.free(dense(straight, units)).all():
        return straight, "straight"
    for posture, name in ((start, "start"), (end, "pre-grasp")):
        if not around.free(posture[None])[0]:
            return None, f"the {name} is not free"
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
    information.setStateValidityCheckingResolution(STRIDE / space.getMaximumExtent())
    setup.setPlanner(geometric.RRTConnect(information))
    setup.solve(SECONDS)
    if not setup.haveExactSolutionPath():
        return None, f"the straight way is not free, and OMPL found no other in {SECONDS:g} s"
    setup.simplifySolution(SECONDS / 5)
    found = setup.getSolutionPath().getStates()
    corners = units * np.array([_numbers(state, n) for state in found])
    corners[0], corners[-1] = start, end
    if not around.free(dense(corners, units)).all():
        return None, "the way that OMPL found is not free between the postures it looked at"
    return corners, "OMPL, RRT-Connect"


def _numbers(state: Any, n: int) -> Array:
    """A state of OMPL, whose annotations do not know that it has elements, as (n,)."""
    return np.array([state[i] for i in range(n)])
