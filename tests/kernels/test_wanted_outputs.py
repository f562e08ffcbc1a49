"""What only one output needs is computed where that output is wanted, with the same values."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_ik as ik
from casadi_ik.kernels.codegen import function_source
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.problem.problems import Problems, Tolerance
from casadi_ik.registry import build_method

from .graphs import needs_compiler


def test_a_block_for_the_second_output() -> None:
    x = ca.SX.sym("x", 4)
    shared, record = ca.sin(x), ca.SX(0)
    for i in range(40):
        record = record * shared[i % 4] + i
    inner = ca.Function("inner", [x], [shared * 2, ca.vertcat(record, shared)])
    y = ca.MX.sym("y", 4)
    text = function_source(ca.Function("outer", [y], list(inner(y + 1))))
    block = text[text.index("  if (res[1]) {") :].partition("\n  }\n")[0]
    assert block.count("*") > 30
    assert "sin(" not in block
    assert "  res1[1]=res[1] ? w" in text


@needs_compiler
def test_the_same_solves_with_and_without_records(robot: ik.ArmHand) -> None:
    method = build_method("hand-first", robot.description, {})
    assert isinstance(method, HandFirstMethod)
    points, normals = robot.contacts(robot.random(np.random.default_rng(6), 40))
    problems = Problems(points, normals, Tolerance(), True)
    starts = np.repeat(robot.home[None], 40, axis=0)
    for count in (1, 40):  # alone, and side by side
        asked = problems.rows(slice(0, count))
        states, parameters = method.begin(asked, starts[:count])
        ends = [method.run_rows(states.copy(), parameters, trace=trace) for trace in (False, True)]
        assert ends[0].states.tobytes() == ends[1].states.tobytes()
        np.testing.assert_array_equal(ends[0].iterations, ends[1].iterations)
        assert ends[1].rows is not None
        assert len(ends[1].rows) == ends[1].iterations.sum()
