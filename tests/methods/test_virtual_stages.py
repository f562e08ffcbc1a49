"""The virtual machine selects stages of hand-first like the C code."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.compile import RUNNING
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.hand_first.iteration import VirtualIteration
from casadi_ik.solve.hand_first.state import Stage
from casadi_ik.solve.registry import build_method

DECISIONS = (
    *("phase", "candidate", "stage_iterations", "arm_starts", "arm_flipped_joint"),
    "repeated_minima",
)
TOLERANCE = ik.Tolerance(position=1e-3, angle=1e-2)
MAX_ITERATIONS = 600


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "baxter_ar10", "ar10"])
@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_each_stage_is_followed_by_the_same_one(name: str, prefer: str) -> None:
    """Every iteration starts from the same state; only rounding may change a decision."""
    robot, rng = ik.load_robot(name), np.random.default_rng(8)
    method: Any = build_method("hand-first", robot.description, {})
    virtual, layout = VirtualIteration(method.step), method.step.layouts.state
    points, normals = robot.contacts(
        np.where(rng.random((6, len(robot.home))) < 0.5, robot.lower, robot.upper)
    )
    points[3:] += rng.normal(0.0, 0.001, points[3:].shape)  # contacts that contradict each other
    targets = replace(TargetBatch(points, normals, TOLERANCE, True), prefer=prefer)
    visits, agreements = Counter[Stage](), Counter[Stage]()
    for number in (0, 1):
        for state, parameters in zip(*method.begin(targets, number), strict=True):
            if number:
                state[layout.slice("candidates_before")] = method.options.candidates
            status, count = RUNNING, 0
            while status == RUNNING and count < MAX_ITERATIONS:
                virtual.inputs[0][:], virtual.inputs[1][:] = state, parameters
                assert virtual()
                result = method.kernel.run(state[None], parameters[None], 1)
                stage = Stage(int(state[layout.slice("phase").start]))
                state, status, count = result.states[0], int(result.status[0]), count + 1
                fields = [layout.slice(field).start for field in DECISIONS]
                is_same = np.array_equal(state[fields], virtual.outputs[0][fields])
                visits[stage] += 1
                agreements[stage] += is_same and status == virtual.outputs[2][0]
    assert agreements.total() > 0.95 * visits.total()
    assert all(agreements[stage] > visits[stage] / 2 for stage in visits)
    assert len(visits) >= 4
