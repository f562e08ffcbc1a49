"""Solves side by side: each bit for bit as it would be alone, whatever the others do."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from casadi_ik.kernels import (
    NON_FINITE,
    REPEATED,
    RUNNING,
    Field,
    Layout,
    LoopKernel,
    LoopResult,
    StepGraph,
)
from casadi_ik.kernels.function_kernel import machine_lanes
from casadi_ik.kernels.loop import FEWEST, ROOM_BYTES, SLOTS, WORTH

from .graphs import (
    COUNT,
    DONE,
    branching_step,
    circling_step,
    counting_step,
    needs_compiler,
    random_step,
    step_of,
)

pytestmark = needs_compiler

COUNTS = (FEWEST, 9, 2 * SLOTS + 3)
"""Solves in a batch: fewer than lanes, one that must wait, many more than are under way at once."""


@pytest.fixture(params=[4, 8], autouse=True)
def lanes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Both widths, where the machine has them."""
    if machine_lanes() < request.param:
        pytest.skip(f"this machine has {machine_lanes()} lanes")
    monkeypatch.setattr("casadi_ik.kernels.loop.machine_lanes", lambda: request.param)
    return request.param


def assert_as_alone(
    step: StepGraph, states: np.ndarray, parameters: np.ndarray, budget: int
) -> LoopResult:
    """The result, once it is known to be that of each solve alone."""
    kernel = LoopKernel(step)
    assert kernel.lanes > 1
    found = kernel.run(states, parameters, budget, trace=True)
    assert found.rows is not None
    alone = [
        kernel.run(state[None], own[None], budget, trace=True)
        for state, own in zip(states, parameters, strict=True)
    ]
    assert found.states.tobytes() == np.concatenate([each.states for each in alone]).tobytes()
    assert found.iterations.tolist() == [each.iterations[0] for each in alone]
    assert found.status.tolist() == [each.status[0] for each in alone]
    rows = [each.rows for each in alone if each.rows is not None]
    assert found.rows.tobytes() == b"".join(each.tobytes() for each in rows)
    untraced = kernel.run(states, parameters, budget)
    assert untraced.states.tobytes() == found.states.tobytes()
    return found


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("step", [random_step(0), random_step(1), branching_step()])
def test_as_alone(step: StepGraph, count: int) -> None:
    rng = np.random.default_rng(count)
    states, parameters = rng.normal(size=(count, 4)), rng.normal(size=(count, 2))
    found = assert_as_alone(step, states, parameters, 300)
    # Not vacuous: solves end at different iterations.
    assert count < COUNTS[-1] or len(np.unique(found.iterations)) > 2


def staged_step(stages: int) -> StepGraph:
    """Goes through its stages by chance, each with an arithmetic of its own."""
    x, stage, p = ca.SX.sym("x"), ca.SX.sym("stage"), ca.SX.sym("p")
    cases = [
        ca.Function(f"case_{i}", [x, p], [ca.sin((3 + i) * x + p) * 2 + i / 7])
        for i in range(stages)
    ]
    xm, sm, pm = ca.MX.sym("x"), ca.MX.sym("stage"), ca.MX.sym("p")
    new = ca.Function.conditional("choose", cases[:-1], cases[-1])(sm, xm, pm)
    # The digits up to the sixth after the point are as good as chance.
    digits = ca.floor(1e6 * ca.fabs(x))
    drawn = digits - stages * ca.floor(digits / stages)
    after = ca.Function(
        "after",
        [x, stage],
        [
            ca.if_else(ca.sin(50 * x) > 0.2, drawn, stage),
            ca.if_else(ca.fabs(x) < 0.01, DONE, RUNNING),
        ],
    )
    next_stage, status = after(new, sm)
    state = ca.MX.sym("state", 2)
    function = ca.Function("inner", [xm, sm, pm], [ca.vertcat(new, next_stage), new, status])
    name = f"staged_{stages}"
    outer = ca.Function(name, [state, pm], list(function(state[0], state[1], pm)))
    layout = Layout((Field("x"), Field("stage")))
    return StepGraph(name, outer, layout, Layout((Field("p"),)), COUNT, stage="stage")


# Eleven stages are more than the driver keeps apart.
@pytest.mark.parametrize("stages", [2, 4, 11])
@pytest.mark.parametrize("count", COUNTS)
def test_stages(stages: int, count: int) -> None:
    rng = np.random.default_rng(count + stages)
    states = np.column_stack([rng.normal(size=count), rng.integers(stages, size=count)])
    found = assert_as_alone(staged_step(stages), states, rng.normal(size=(count, 1)), 400)
    assert count < COUNTS[-1] or len(np.unique(found.states[:, 1])) > 1
    assert count < COUNTS[-1] or len(np.unique(found.iterations)) > 2


@pytest.mark.parametrize("count", COUNTS)
def test_every_end_beside_every_other(count: int) -> None:
    """Done, repeated, not finite, out of iterations: side by side in one batch."""
    x, p = ca.SX.sym("x"), ca.SX.sym("p", 2)
    counting, exploding = x + 1, x * x * 1e30
    circling = ca.if_else(x >= 20, x - 3, x + 1)
    new = ca.if_else(p[0] == 0, counting, ca.if_else(p[0] == 1, exploding, circling))
    new = ca.if_else(p[0] == 3, x + 0.25, new)
    status = ca.if_else(ca.logic_and(p[0] == 0, new >= p[1]), DONE, RUNNING)
    step = step_of("all_ends", ca.Function("all_ends", [x, p], [new, new, status]), COUNT)
    rng = np.random.default_rng(count)
    parameters = np.column_stack([np.arange(count) % 4, rng.integers(1, 90, size=count)])
    found = assert_as_alone(step, rng.uniform(1, 2, size=(count, 1)), parameters, 100)
    assert set(found.status.tolist()) == {DONE, REPEATED, NON_FINITE, RUNNING}


def test_pauses_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("casadi_ik.kernels.loop.SLICE", 0.0)
    rng = np.random.default_rng(3)
    count = COUNTS[-1]
    states = np.column_stack([rng.normal(size=count), np.zeros(count)])
    assert_as_alone(staged_step(4), states, rng.normal(size=(count, 1)), 400)
    assert_as_alone(circling_step("circling_lanes"), np.zeros((9, 1)), np.arange(9.0)[:, None], 500)


def test_shared_parameters_and_time() -> None:
    kernel = LoopKernel(counting_step())
    result = kernel.run(np.arange(10.0)[:, None], [500.0], 1000)
    np.testing.assert_array_equal(result.states[:, 0], 500.0)
    np.testing.assert_array_equal(result.iterations, 500 - np.arange(10))
    assert (result.time > 0).all()


def test_traces_of_other_lengths_than_the_last_one() -> None:
    """Room is made for as much as the last one needed: too much, too little, none at all."""
    kernel = LoopKernel(counting_step("lengths"))
    assert kernel.lanes > 1
    for count, ends in ((40, 3), (40, 700), (9, 2), (FEWEST - 1, 900), (2, 0), (70, 5)):
        ran = kernel.run(np.zeros((count, 1)), np.full((count, 1), ends), ends, trace=True)
        assert ran.rows is not None
        assert ran.rows.base is None
        assert ran.rows["count"].tolist() == [*range(1, ends + 1)] * count
        room = kernel._room(count) * ran.rows.dtype.itemsize
        assert len(ran.rows) * ran.rows.dtype.itemsize <= room <= ROOM_BYTES


def test_few_solves_wait_for_no_compiler(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, lanes: int
) -> None:
    """Until a library is at hand, whoever had it made."""
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path))
    step = dataclasses.replace(counting_step(f"few_{lanes}"), recipe="counting")

    def compiled() -> int:
        return len(list(tmp_path.glob(f"few_{lanes}_lanes*.so")))

    def run(kernel: LoopKernel, count: int) -> bytes:
        states = np.arange(float(count))[:, None]
        return kernel.run(states, [500.0], 1000, trace=True).states.tobytes()

    early = LoopKernel(step)
    few = run(early, WORTH - 1)
    assert compiled() == 0
    assert run(early, WORTH)[: len(few)] == few
    assert compiled() == 1
    later = LoopKernel(step)
    assert later._for(FEWEST - 1) is None
    assert later._for(FEWEST) is not None
    assert run(later, WORTH - 1) == few


def test_without_compiler_there_are_no_lanes() -> None:
    assert LoopKernel(counting_step(), compiled=False).lanes == 1
