"""Targets that are met only within their tolerance, by every call of a solver."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from toy_robots import grasp_of

import casadi_ik as ik
from casadi_ik.compile.emitter import CodeOptions
from casadi_ik.solve.registry import build_method


def displaced_contacts(robot, seed, count, tolerance, part):
    """Return contacts of random configurations, displaced by a part of the tolerance."""
    rng = np.random.default_rng(seed)
    points, normals = robot.contacts(robot.random(rng, count))
    shift, across = rng.normal(size=points.shape), rng.normal(size=points.shape)
    shift /= np.linalg.norm(shift, axis=2, keepdims=True)
    across -= normals * (across * normals).sum(axis=2, keepdims=True)
    across /= np.linalg.norm(across, axis=2, keepdims=True)
    angle = part * tolerance.angle
    turned = np.cos(angle) * normals + np.sin(angle) * across
    return points + part * tolerance.position * shift, turned


@pytest.mark.parametrize("degrees", [10.0, 30.0])
@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_displaced_targets_are_solved_in_a_batch(robot, degrees, prefer):
    """The exact fit alone lost up to 80 % of them."""
    tolerance = ik.Tolerance(0.005, np.radians(degrees))
    points, normals = displaced_contacts(robot, 7, 500, tolerance, 0.8)
    starts = robot.random(np.random.default_rng(1), len(points))
    batch = ik.Solver(robot, tolerance=tolerance).solve_batch(
        points, normals, q0=starts, prefer=prefer
    )
    assert np.flatnonzero(~batch.success).tolist() == []


def test_every_call_solves_the_same_targets(robot):
    tolerance = ik.Tolerance(0.005, np.radians(30.0))
    points, normals = displaced_contacts(robot, 7, 20, tolerance, 0.8)
    solver = ik.Solver(robot, tolerance=tolerance)
    fast = solver.fast()
    for target in zip(points, normals, strict=True):
        grasp = grasp_of(robot, *target)
        assert fast(*target)[1] == ik.Status.SOLVED
        assert solver.solve(grasp, diagnose=False).success
        assert solver.solve_all(grasp, limit=1)
        assert len(solver.choose([grasp]))


def test_the_loop_has_a_queue_for_every_stage():
    """It had twelve, whatever the method; the lanes then mixed stages."""
    body = ik.load_robot("two_pandas+allegro").description
    method: Any = build_method("hand-first", body, {})
    stages = method.graph.function
    assert len(stages.functions) >= 12
    assert f"#define STEP_STAGES ({len(stages.functions)})\n" in stages.source(CodeOptions())
