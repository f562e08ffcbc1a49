"""The loop is the same in C and in the virtual machine: all ends, all records."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
from processes import POSIX, python

import casadi_ik as ik
from casadi_ik.compile import (
    FAILED,
    NON_FINITE,
    REPEATED,
    RUNNING,
    Field,
    Layout,
    LoopKernel,
    LoopResult,
    StepGraph,
)
from casadi_ik.compile.function_kernel import machine_lanes
from casadi_ik.compile.loop import (
    FIRST_ROWS,
    MAX_FIRST_TRACE_BYTES,
    MIN_BATCH_FOR_LANES,
    MIN_SOLVES_IN_LANES,
    SLOTS,
)

from .graphs import (
    BOTH,
    COUNT,
    DONE,
    branching_step,
    circling_step,
    counting_step,
    needs_compiler,
    random_step,
    step_of,
)


def starts(count: int, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 4)), rng.normal(size=(count, 2))


def assert_same(a: LoopResult, b: LoopResult) -> None:
    np.testing.assert_array_equal(a.states, b.states)
    np.testing.assert_array_equal(a.iterations, b.iterations)
    np.testing.assert_array_equal(a.status, b.status)
    assert a.rows is not None
    assert b.rows is not None
    assert a.rows.tobytes() == b.rows.tobytes()


@needs_compiler
@pytest.mark.parametrize("step", [random_step(0, turning=False), random_step(1, turning=False)])
def test_compiled_loop_equals_vm_bit_for_bit(step):
    kernel, vm = LoopKernel(step), LoopKernel(step, compiled=False)
    assert kernel.compiled
    assert not vm.compiled
    states, parameters = starts(6)
    fast = kernel.run(states, parameters, 400, trace=True)
    assert_same(fast, vm.run(states, parameters, 400, trace=True))
    # The solves move and end at different iterations.
    assert len(np.unique(fast.iterations)) > 2
    assert np.unique(fast.states).size > 12
    assert fast.states.dtype == np.float64
    assert (fast.iterations.dtype, fast.status.dtype) == (np.int64, np.int32)
    assert (fast.time > 0).all()


@needs_compiler
@pytest.mark.parametrize("step", [random_step(0), random_step(1), branching_step()])
def test_compiled_step_equals_vm_but_for_the_last_places(step):
    """Compiled code has its own sine, whose rounding chaotic steps would amplify when iterated."""
    kernel, vm = LoopKernel(step), LoopKernel(step, compiled=False)
    states, parameters = starts(200)
    fast = kernel.run(states, parameters, 1, trace=True)
    slow = vm.run(states, parameters, 1, trace=True)
    np.testing.assert_allclose(fast.states, slow.states, rtol=0, atol=1e-13)
    assert (fast.states != slow.states).any()


@BOTH
def test_recording_changes_nothing(compiled):
    kernel = LoopKernel(random_step(), compiled=compiled)
    states, parameters = starts(4)
    states_before = states.copy()
    plain = kernel.run(states, parameters, 50)
    traced = kernel.run(states, parameters, 50, trace=True)
    np.testing.assert_array_equal(plain.states, traced.states)
    np.testing.assert_array_equal(plain.iterations, traced.iterations)
    assert plain.rows is None
    assert plain.trace == ()
    assert [len(rows) for rows in traced.trace] == traced.iterations.tolist()
    for rows, state in zip(traced.trace, traced.states, strict=True):
        np.testing.assert_array_equal(rows["x"][-1], state)
    np.testing.assert_array_equal(states, states_before)


@BOTH
def test_ends_by_status_or_by_budget(compiled):
    kernel = LoopKernel(counting_step(), compiled=compiled)
    result = kernel.run(np.zeros((3, 1)), [[4], [10], [99]], 10)
    assert result.iterations.tolist() == [4, 10, 10]
    assert result.status.tolist() == [DONE, DONE, RUNNING]
    assert result.states[:, 0].tolist() == [4, 10, 10]


@BOTH
def test_repeated_state_ends_the_solve(compiled):
    """Counting to 20 and then round in fours: the first mark in the circle is the 32nd state.

    Begun in the circle it is the 16th, the first there is.
    """
    kernel = LoopKernel(circling_step(), compiled=compiled)
    result = kernel.run([[0.0], [20.0], [1e9]], [20], 100)
    assert result.status.tolist() == [REPEATED, REPEATED, RUNNING]
    assert result.iterations.tolist() == [36, 20, 100]
    # Interruptions by the clock or by a full trace change nothing.
    traced = kernel.run(np.zeros((3, 1)), [[3], [300], [900]], 10_000, trace=True)
    assert traced.iterations.tolist() == [20, 516, 1028]


@BOTH
def test_parameters_for_all_or_for_each(compiled):
    kernel = LoopKernel(counting_step(), compiled=compiled)
    shared = kernel.run(np.arange(10.0)[:, None], [50], 60)
    assert shared.iterations.tolist() == (50 - np.arange(10)).tolist()
    assert (shared.time > 0).all()
    # Strided views and other number types are accepted.
    strided = np.arange(12, dtype=np.int32).reshape(6, 2)[::3, 1:]
    assert kernel.run(np.zeros((2, 1)), strided, 10).iterations.tolist() == [1, 7]


@BOTH
def test_empty_batch(compiled):
    kernel = LoopKernel(counting_step(), compiled=compiled)
    none = kernel.run(np.zeros((0, 1)), [5], 10, trace=True)
    assert none.states.shape == (0, 1)
    assert none.trace == ()
    still = kernel.run(np.full((2, 1), 3.0), [5], 0, trace=True)
    assert still.states.tolist() == [[3], [3]]
    assert still.status.tolist() == [RUNNING, RUNNING]
    assert [len(rows) for rows in still.trace] == [0, 0]


@BOTH
def test_traces_longer_than_the_first_block(compiled):
    kernel = LoopKernel(counting_step(), compiled=compiled)
    ends = [3, 5 * FIRST_ROWS + 1, 1, FIRST_ROWS]
    result = kernel.run(np.zeros((4, 1)), np.array(ends)[:, None], 10**6, trace=True)
    assert result.iterations.tolist() == ends
    assert result.rows is not None
    assert len(result.rows) == sum(ends)
    for rows, end in zip(result.trace, ends, strict=True):
        np.testing.assert_array_equal(rows["count"], np.arange(1, end + 1))


@BOTH
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_state_ends_the_loop(compiled, bad):
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    # Only one element becomes non-finite, and the step reports a normal end.
    new = ca.vertcat(x[0] + 1, ca.if_else(x[0] >= 2, p, x[1]))
    done = ca.if_else(x[0] >= 2, DONE, RUNNING)
    step = step_of("spoiled", ca.Function("spoiled", [x, p], [new, x[0], done]), COUNT)
    result = LoopKernel(step, compiled=compiled).run([[0, 7], [-1, 8]], [bad], 9, trace=True)
    assert result.status.tolist() == [NON_FINITE, NON_FINITE]
    assert result.states.tolist() == [[2, 7], [2, 8]]
    assert result.iterations.tolist() == [3, 4]
    assert [len(rows) for rows in result.trace] == [3, 4]


@BOTH
@pytest.mark.parametrize("code", [np.nan, np.inf, -np.inf, 2.0**31, -(2.0**31)])
def test_invalid_status_ends_the_loop(compiled, code):
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    step = step_of("no_code", ca.Function("no_code", [x, p], [x + 1, x, p]), COUNT)
    result = LoopKernel(step, compiled=compiled).run([[0]], [code], 9)
    assert result.status.tolist() == [NON_FINITE]
    assert result.states.tolist() == [[0]]


def test_step_that_fails_ends_its_solve_only():
    x, p = ca.MX.sym("x"), ca.MX.sym("p")
    guarded = x.attachAssert(x < p, "too large")
    done = ca.if_else(x >= 9, DONE, RUNNING)
    step = step_of("guarded", ca.Function("guarded", [x, p], [guarded + 1, x, done]), COUNT)
    result = LoopKernel(step, compiled=False).run([[0], [0]], [[4], [99]], 50, trace=True)
    assert result.status.tolist() == [FAILED, DONE]
    assert result.states.tolist() == [[4], [10]]
    assert [len(rows) for rows in result.trace] == [4, 10]


@BOTH
def test_sparse_step_and_no_parameters(compiled):
    x, none = ca.SX.sym("x", 3), ca.SX.sym("p", 0)
    new = ca.SX(3, 1)
    new[1] = x[1] + 1
    record = ca.SX(2, 1)
    record[1] = x[1]
    function = ca.Function("sparse", [x, none], [new, record, ca.SX(1, 1)])
    step = StepGraph(
        "sparse",
        function,
        Layout((Field("x", (3,)),)),
        Layout(()),
        Layout((Field("r", (2,)),)),
    )
    result = LoopKernel(step, compiled=compiled).run([[1, 2, 3]], np.zeros(0), 2, trace=True)
    assert result.states.tolist() == [[0, 4, 0]]
    assert result.trace[0]["r"].tolist() == [[0, 2], [0, 3]]


def test_step_without_c_code_runs_in_the_vm():
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes"}
    nlp = ca.nlpsol("nlp", "ipopt", {"x": x, "p": p, "f": (x - p) ** 2}, options)
    xm, pm = ca.MX.sym("x"), ca.MX.sym("p")
    best = nlp(x0=xm, p=pm)["x"]
    function = ca.Function("nlp_step", [xm, pm], [best, best, DONE])
    layout = Layout((Field("x"),))
    step = StepGraph("nlp_step", function, layout, layout, layout, compilable=False)
    kernel = LoopKernel(step)
    assert not kernel.compiled
    result = kernel.run([[0.0]], [3.0], 5)
    assert result.status.tolist() == [DONE]
    np.testing.assert_allclose(result.states, [[3.0]], atol=1e-6)


@needs_compiler
def test_step_that_wrongly_claims_c_code_is_named():
    class Callback(ca.Callback):
        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.construct("python_node", {})

        def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
            return list(arg)

    callback = Callback()
    x, p = ca.MX.sym("x"), ca.MX.sym("p")
    step = step_of("claims", ca.Function("claims", [x, p], [callback(x), x, 0]), COUNT)
    with pytest.raises(ik.errors.KernelError, match="claims"):
        LoopKernel(step)


def test_wrong_shapes_are_named():
    kernel = LoopKernel(random_step(), compiled=False)
    states, parameters = starts(3)
    with pytest.raises(ik.errors.InputError, match=r"states have shape \(4,\), expected \(k, 4\)"):
        kernel.run(states[0], parameters[0], 5)
    with pytest.raises(ik.errors.InputError, match=r"\(2,\).*\(3, 2\)"):
        kernel.run(states, parameters[:2], 5)
    with pytest.raises(ik.errors.InputError, match="max_iterations is -1"):
        kernel.run(states, parameters, -1)


@BOTH
def test_threads_share_a_kernel(compiled):
    kernel = LoopKernel(branching_step(), compiled=compiled)
    inputs = [starts(3, seed) for seed in range(24)]
    sequential = [kernel.run(*pair, 100, trace=True) for pair in inputs]
    with ThreadPoolExecutor(6) as pool:
        concurrent = list(
            pool.map(lambda pair: kernel.run(pair[0], pair[1], 100, trace=True), inputs)
        )
    for a, b in zip(sequential, concurrent, strict=True):
        assert_same(a, b)


@needs_compiler
def test_pauses_for_signals_change_nothing():
    """Runs of more than half a second return to Python every 0.2 s."""
    kernel, count = LoopKernel(counting_step()), 50_000_000
    assert kernel.run(np.zeros((1, 1)), [float(count)], 10**9).iterations.tolist() == [count]


@POSIX
@needs_compiler
def test_keyboard_interrupt_reaches_a_compiled_loop():
    script = """
        import os, signal, threading
        import casadi as ca
        from casadi_ik.compile import Field, Layout, LoopKernel, StepGraph
        x, p = ca.SX.sym("x"), ca.SX.sym("p")
        one = Layout((Field("x"),))
        function = ca.Function("endless", [x, p], [x + p, x, 0])
        kernel = LoopKernel(StepGraph("endless", function, one, one, one))
        assert kernel.compiled
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's "&" ignores it
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        try:
            kernel.run([[0.0]], [1.0], 10**15)
        except KeyboardInterrupt:
            print("interrupted")
    """
    done = python("-c", script)
    assert done.stdout == "interrupted\n", done.stderr


pytestmark = needs_compiler

COUNTS = (MIN_SOLVES_IN_LANES, 9, 2 * SLOTS + 3)
"""Numbers of solves in a batch: fewer than lanes, one that must wait, many more than slots."""


@pytest.fixture(params=[4, 8])
def lanes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Number of lanes: both widths, where the machine has them."""
    if machine_lanes() < request.param:
        pytest.skip(f"this machine has {machine_lanes()} lanes")
    monkeypatch.setenv("CASADI_IK_LANES", str(request.param))
    return request.param


LANES = pytest.mark.usefixtures("lanes")


def assert_as_alone(
    step: StepGraph, states: np.ndarray, parameters: np.ndarray, budget: int
) -> LoopResult:
    """Return the result of a batch after checking that it is that of single solves."""
    kernel = LoopKernel(step)
    assert kernel.lanes > 1
    batch_run = kernel.run(states, parameters, budget, trace=True)
    assert batch_run.rows is not None
    single_runs = [
        kernel.run(state[None], row_parameters[None], budget, trace=True)
        for state, row_parameters in zip(states, parameters, strict=True)
    ]
    assert (
        batch_run.states.tobytes() == np.concatenate([run.states for run in single_runs]).tobytes()
    )
    assert batch_run.iterations.tolist() == [run.iterations[0] for run in single_runs]
    assert batch_run.status.tolist() == [run.status[0] for run in single_runs]
    rows = [run.rows for run in single_runs if run.rows is not None]
    assert batch_run.rows.tobytes() == b"".join(run.tobytes() for run in rows)
    untraced = kernel.run(states, parameters, budget)
    assert untraced.states.tobytes() == batch_run.states.tobytes()
    return batch_run


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("step", [random_step(0), random_step(1), branching_step()])
@LANES
def test_lanes_match_single_solves(step, count):
    rng = np.random.default_rng(count)
    states, parameters = rng.normal(size=(count, 4)), rng.normal(size=(count, 2))
    batch_run = assert_as_alone(step, states, parameters, 300)
    # Solves end at different iterations.
    assert count < COUNTS[-1] or len(np.unique(batch_run.iterations)) > 2


def staged_step(stages: int) -> StepGraph:
    """Return a step that moves at random through stages with different arithmetic."""
    x, stage, p = ca.SX.sym("x"), ca.SX.sym("stage"), ca.SX.sym("p")
    cases = [
        ca.Function(f"case_{i}", [x, p], [ca.sin((3 + i) * x + p) * 2 + i / 7])
        for i in range(stages)
    ]
    xm, sm, pm = ca.MX.sym("x"), ca.MX.sym("stage"), ca.MX.sym("p")
    new = ca.Function.conditional("choose", cases[:-1], cases[-1])(sm, xm, pm)
    # The digits after the sixth decimal act as random numbers.
    digits = ca.floor(1e6 * ca.fabs(x))
    stage_choice = digits - stages * ca.floor(digits / stages)
    after = ca.Function(
        "after",
        [x, stage],
        [
            ca.if_else(ca.sin(50 * x) > 0.2, stage_choice, stage),
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


# Eleven stages are more than the driver has queues for.
@pytest.mark.parametrize("stages", [2, 4, 11])
@pytest.mark.parametrize("count", COUNTS)
@LANES
def test_stages(stages, count):
    rng = np.random.default_rng(count + stages)
    states = np.column_stack([rng.normal(size=count), rng.integers(stages, size=count)])
    batch_run = assert_as_alone(staged_step(stages), states, rng.normal(size=(count, 1)), 400)
    assert count < COUNTS[-1] or len(np.unique(batch_run.states[:, 1])) > 1
    assert count < COUNTS[-1] or len(np.unique(batch_run.iterations)) > 2


@pytest.mark.parametrize("count", COUNTS)
@LANES
def test_all_statuses_in_neighbouring_lanes(count):
    """Done, repeated, non-finite and unfinished solves run side by side in one batch."""
    x, p = ca.SX.sym("x"), ca.SX.sym("p", 2)
    counting, exploding = x + 1, x * x * 1e30
    circling = ca.if_else(x >= 20, x - 3, x + 1)
    new = ca.if_else(p[0] == 0, counting, ca.if_else(p[0] == 1, exploding, circling))
    new = ca.if_else(p[0] == 3, x + 0.25, new)
    status = ca.if_else(ca.logic_and(p[0] == 0, new >= p[1]), DONE, RUNNING)
    step = step_of("all_ends", ca.Function("all_ends", [x, p], [new, new, status]), COUNT)
    rng = np.random.default_rng(count)
    parameters = np.column_stack([np.arange(count) % 4, rng.integers(1, 90, size=count)])
    batch_run = assert_as_alone(step, rng.uniform(1, 2, size=(count, 1)), parameters, 100)
    assert set(batch_run.status.tolist()) == {DONE, REPEATED, NON_FINITE, RUNNING}


@LANES
def test_lanes_pause_for_signals():
    kernel, ends = LoopKernel(counting_step("pausing")), 1e7 * np.arange(1.0, 10.0)[:, None]
    assert kernel.lanes > 1
    assert kernel.run(np.zeros((9, 1)), ends, 10**9).iterations.tolist() == ends[:, 0].tolist()


@LANES
def test_lanes_end_where_a_state_comes_back():
    assert_as_alone(circling_step("circling_lanes"), np.zeros((9, 1)), np.arange(9.0)[:, None], 500)


@LANES
def test_traces_longer_than_the_previous():
    """The reserved memory follows the previous trace: too large, too small, none."""
    kernel = LoopKernel(counting_step("lengths"))
    assert kernel.lanes > 1
    for count, ends in (
        (40, 3),
        (40, 700),
        (9, 2),
        (MIN_SOLVES_IN_LANES - 1, 900),
        (2, 0),
        (70, 5),
    ):
        ran = kernel.run(np.zeros((count, 1)), np.full((count, 1), ends), ends, trace=True)
        assert ran.rows is not None
        assert ran.rows.base is None
        assert ran.rows["count"].tolist() == [*range(1, ends + 1)] * count
        bytes_reserved = kernel._first_rows(count) * ran.rows.dtype.itemsize
        assert len(ran.rows) * ran.rows.dtype.itemsize <= bytes_reserved <= MAX_FIRST_TRACE_BYTES


def test_small_batches_do_not_wait_for_a_compiler(monkeypatch, tmp_path, lanes):
    """Lanes are used once their library exists, whoever compiled it."""
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path))
    step = dataclasses.replace(counting_step(f"few_{lanes}"), recipe="counting")

    def compiled() -> int:
        return len(list(tmp_path.glob(f"few_{lanes}_lanes*.so")))

    def run(kernel: LoopKernel, count: int) -> bytes:
        states = np.arange(float(count))[:, None]
        return kernel.run(states, [500.0], 1000, trace=True).states.tobytes()

    early = LoopKernel(step)
    few = run(early, MIN_BATCH_FOR_LANES - 1)
    assert compiled() == 0
    assert run(early, MIN_BATCH_FOR_LANES)[: len(few)] == few
    assert compiled() == 1
    later = LoopKernel(step)
    assert later.loop_for(MIN_SOLVES_IN_LANES - 1) is None
    assert later.loop_for(MIN_SOLVES_IN_LANES) is not None
    assert run(later, MIN_BATCH_FOR_LANES - 1) == few


def test_without_compiler_there_are_no_lanes():
    assert LoopKernel(counting_step(), compiled=False).lanes == 1
