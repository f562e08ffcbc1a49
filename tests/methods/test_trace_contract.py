"""Standard fields of traces: every method has them, their values are true, and events follow."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from samplers import (
    aligned_arms,
    near_limits_on_aligned_arms,
    random_arm_targets,
    random_hands,
)
from trace_checks import (
    ACCEPTED,
    ACTIVE_MASK,
    COST,
    DAMPING,
    RESTART,
    Layout,
    SolveBlock,
    TraceRecorder,
    check_trace,
)

import casadi_ik as ik
from casadi_ik import logs
from casadi_ik.solve.trace import STANDARD_FIELDS, StandardField, trace_format

REQUIRED = {field for field in STANDARD_FIELDS if field.required}
PAPER_OPTIONS = {"finger_step": "closed-form", "max_iterations": 400}
METHODS: Mapping[str, tuple[set[StandardField], dict[str, Any]]] = {
    "hand-first": ({COST, DAMPING, RESTART, ACCEPTED}, {}),
    "thumb-first": ({COST, DAMPING, ACTIVE_MASK, RESTART, ACCEPTED}, {"starts": 4}),
    "enhanced-dls": (set(), PAPER_OPTIONS),
    "enhanced-sdls": (set(), PAPER_OPTIONS),
    "original-dls": (set(), PAPER_OPTIONS),
    "original-sdls": (set(), PAPER_OPTIONS),
    "ipopt": ({COST, RESTART}, {"restarts": 2}),
}
"""Optional fields that each method records, and options that keep the runs short."""


def run(robot: ik.ArmHand, method: str) -> SolveBlock:
    """Return shipped grasps and random targets, at limits, singular, and out of reach."""
    rng = np.random.default_rng(12)
    grasps = random_arm_targets(robot, ("cup", "mug"), 4, rng)
    # The original methods converge only from near the target.
    q_near = robot.home + rng.normal(size=(4, len(robot.home))) * [[0.02], [0.02], [1e-3], [1e-3]]
    hard = (random_hands, near_limits_on_aligned_arms, aligned_arms)
    q = [np.clip(q_near, robot.lower, robot.upper), *(draw(robot, rng, 6) for draw in hard)]
    points, normals = (
        np.concatenate([first, second])
        for first, second in zip(grasps, robot.contacts(np.concatenate(q)), strict=True)
    )
    points[-2:] += np.array([0.6, 0.0, 0.0])
    recorder, options = TraceRecorder(), METHODS[method][1]
    options_of_method = {name: value for name, value in options.items() if name != "finger_step"}
    solver = ik.Solver(
        robot,
        method,
        options=options_of_method,
        finger_step=options.get("finger_step", "closed-form"),
    )
    solver.solve_batch(points, normals, seed=3, log=recorder)
    return join_blocks(recorder.blocks)


def join_blocks(blocks: list[SolveBlock]) -> SolveBlock:
    """Return the blocks of one method as one block."""
    return dataclasses.replace(
        blocks[0],
        targets=dataclasses.replace(
            blocks[0].targets,
            points=np.concatenate([block.targets.points for block in blocks]),
            normals=np.concatenate([block.targets.normals for block in blocks]),
        ),
        batch=ik.BatchSolution.concatenate([block.batch for block in blocks]),
        rows=np.concatenate([block.rows for block in blocks]),
        started=np.concatenate([block.started for block in blocks]),
    )


@pytest.fixture(scope="module")
def blocks(robot) -> dict[str, SolveBlock]:
    """Seeded run of every method on the shipped robot."""
    return {method: run(robot, method) for method in ik.METHODS}


def test_every_method_is_tested():
    assert tuple(METHODS) == ik.METHODS


@pytest.mark.parametrize("method", METHODS)
def test_a_method_records_the_standard_fields(blocks, method):
    names = {field.name for field in REQUIRED | METHODS[method][0]}
    field_names = set(blocks[method].format.layout.names) & {
        field.name for field in STANDARD_FIELDS
    }
    assert field_names == names


@pytest.mark.parametrize("method", METHODS)
def test_trace_promises_hold(robot, blocks, method):
    check_trace(robot, blocks[method])


CASES = [
    (method, field)
    for method, (optional, _) in METHODS.items()
    for field in STANDARD_FIELDS
    if field in REQUIRED | optional
]


@pytest.mark.parametrize(
    ("method", "field"), CASES, ids=[f"{method}-{field.name}" for method, field in CASES]
)
def test_zeroed_field_is_detected(robot, blocks, method, field):
    rows = blocks[method].rows.copy()
    rows[field.name] = 0
    with pytest.raises(AssertionError):
        check_trace(robot, dataclasses.replace(blocks[method], rows=rows))


@pytest.mark.parametrize("field", STANDARD_FIELDS, ids=lambda field: field.name)
def test_field_of_another_type_is_refused(robot, blocks, field):
    layout = blocks["thumb-first"].format.layout
    wrong_dtype = "u1" if field.dtype != "u1" else "f8"
    changed = Layout.record(
        *(dataclasses.replace(f, dtype=wrong_dtype) if f.name == field.name else f for f in layout)
    )
    with pytest.raises(ik.errors.InputError, match=rf"{field.name!r}.*{wrong_dtype!r}"):
        trace_format(changed, robot.description)
    layout_without = Layout(tuple(f for f in layout if f.name != field.name))
    if field.required:
        with pytest.raises(ik.errors.InputError, match=rf"{field.name!r}"):
            trace_format(layout_without, robot.description)
    else:
        assert field.name not in trace_format(layout_without, robot.description).labels


def test_every_kind_of_event_is_produced(blocks):
    """Each kind of event occurs for some method."""
    event_counts = {}
    for method, block in blocks.items():
        events = logs.detect_events(block.format, block.rows, block.batch.iterations)
        event_counts[method] = {logs.EventKind(kind) for kind in np.unique(events["kind"])}
    # Collisions need a log with a scene: tests/logs/test_log_events.py.
    with_scene = {logs.EventKind.COLLISION_ENTERED, logs.EventKind.COLLISION_LEFT}
    assert set.union(*event_counts.values()) == set(logs.EventKind) - with_scene
    assert {
        logs.EventKind.ACTIVATED,
        logs.EventKind.RELEASED,
        logs.EventKind.RESTART,
    } <= event_counts["thumb-first"]
    assert logs.EventKind.RESTART in event_counts["hand-first"] & event_counts["ipopt"]
