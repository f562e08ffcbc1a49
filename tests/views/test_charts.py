"""Charts of a solve: errors with units, events, limits, a part of a long run."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from processes import python

import casadi_ik as ik
from casadi_ik import errors, logs
from casadi_ik.app import pictures as views


def words(figure) -> str:
    texts = [text.get_text() for text in figure.texts]
    texts += [text.get_text() for axes in figure.axes for text in axes.texts]
    texts += [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return "\n".join(texts)


def test_convergence_draws_the_errors_in_millimetres_and_degrees(robot, log) -> None:
    iterations = log.iterations()
    figure = views.draw_convergence(iterations, dpi=40)
    by_title = {axes.get_title(loc="left"): axes for axes in figure.axes}
    for title, field, factor in (
        ("distance to the contact [mm]", "position_error", 1e3),
        ("angle to the normal [deg]", "angle_error", np.rad2deg(1)),
    ):
        lines = {line.get_label(): line for line in by_title[title].lines}
        for column, finger in enumerate(robot.fingers):
            values = lines[finger.replace("_", " ")].get_ydata()
            expected = np.maximum(iterations.rows[field][:, column] * factor, 1e-6)
            np.testing.assert_allclose(values, expected, rtol=1e-6)
    bounds = [
        line.get_ydata()[0]
        for axes in by_title.values()
        for line in axes.lines
        if line.get_label() == "tolerance"
    ]
    np.testing.assert_allclose(bounds, [5.0, 3.0])
    assert "smallest singular value" in by_title
    assert "thumb reaching" in words(figure)
    assert "SOLVED" in words(figure)
    ever = np.bitwise_or.reduce(iterations.rows["limit_mask"])
    named = [label.get_text() for label in by_title["at a limit"].get_yticklabels()]
    assert named == [
        name.replace("_", " ") for bit, name in enumerate(robot.actuators) if ever >> bit & 1
    ]


def test_convergence_takes_a_tolerance_and_a_title(log) -> None:
    tolerance = ik.Tolerance(position=1e-3)
    figure = views.draw_convergence(log.iterations(), tolerance=tolerance, title="mine", dpi=40)
    assert 1.0 in [line.get_ydata()[0] for line in figure.axes[0].lines]
    assert "mine" in words(figure)


def test_convergence_wants_one_solve(log) -> None:
    part = log.iterations().part
    none = dataclasses.replace(
        part, rows=part.rows[:0], solve_id=part.solve_id[:0], iteration=part.iteration[:0]
    )
    with pytest.raises(errors.InputError, match="iterations:"):
        views.draw_convergence(logs.Table("iteration", (none,)))
    two = dataclasses.replace(part, solve_id=np.arange(len(part)) % 2)
    with pytest.raises(errors.InputError, match="several solves"):
        views.draw_convergence(logs.Table("iteration", (two,)))


def test_convergence_marks_events_and_draws_every_actuator(robot, log) -> None:
    events = log.events()
    figure = views.draw_convergence(log.iterations(), events=events, dpi=40)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert "actuators [rad or m]" in titles
    actuators = figure.axes[titles.index("actuators [rad or m]")]
    assert len(actuators.lines) == len(robot.actuators)
    assert actuators.get_yscale() == "linear"


def test_the_strip_of_events_has_a_row_per_kind_and_jacobian(log) -> None:
    layout = np.dtype(
        [("value", "f8"), ("threshold", "f8"), ("joint_mask", "u4")]
        + [(name, "u1") for name in ("kind", "jacobian", "phase")]
    )
    rows = np.zeros(4, layout)
    rows["kind"] = [0, 0, 8, 6]
    rows["jacobian"] = [1, 2, 0, 0]
    labels = {
        "kind": tuple(kind.name for kind in logs.EventKind),
        "jacobian": ("", "closed_chain", "thumb"),
        "joint_mask": (),
        "phase": ("",),
    }
    numbers = np.arange(4)
    part = logs.MethodRows("made-up", rows, numbers * 0, numbers * 10, labels, {})
    figure = views.draw_convergence(log.iterations(), events=logs.Table("event", (part,)), dpi=40)
    (axes,) = [
        candidate_axes
        for candidate_axes in figure.axes
        if candidate_axes.get_title(loc="left") == "events"
    ]
    named = [label.get_text() for label in axes.get_yticklabels()]
    begun = [bars.get_paths()[0].vertices[:, 0].min() for bars in axes.collections]
    assert dict(zip(named, begun, strict=True)) == {
        "near singular closed chain": -0.5,
        "near singular thumb": 9.5,
        "stall": 19.5,
        "restart": 29.5,
    }


@pytest.fixture(scope="module")
def long_log(robot, tmp_path_factory) -> ik.logs.Log:
    """Solve next to a straight elbow: 60 iterations, with a nearly singular arm at the start."""
    path = tmp_path_factory.mktemp("span") / "long.mcap"
    q = robot.home.copy()
    q[robot.actuators.index("lwr_joint_4")] = 1e-3
    solver = ik.Solver(
        robot, "enhanced-dls", finger_step="closed-form", options={"max_iterations": 60}
    )
    solver.solve(ik.load_grasp("cup"), q0=q, log=path)
    return ik.logs.open(path)


def draw_log(long_log: ik.logs.Log, **options):
    return views.draw_convergence(long_log.iterations(), events=long_log.events(), **options)


def test_only_the_span_is_drawn_and_scaled(long_log):
    full_axes, part = draw_log(long_log).axes[0], draw_log(long_log, span=(4, 10)).axes[0]
    assert part.get_xlim() == (2.5, 9.5)
    assert full_axes.get_xlim()[1] > 9.5
    shown_values = part.lines[0].get_ydata()
    assert np.isfinite(shown_values[3:10]).all()
    assert np.isnan(np.delete(shown_values, slice(3, 10))).all()


@pytest.mark.parametrize("span", [(0, 3), (5, 4), (1, 10_000)])
def test_a_span_that_is_not_there_is_refused(long_log, span):
    with pytest.raises(errors.InputError, match="span: found"):
        draw_log(long_log, span=span)


def test_a_threshold_that_was_passed_is_a_line_with_a_name(long_log):
    axes = next(
        axes
        for axes in draw_log(long_log).axes
        if axes.get_title("left") == "smallest singular value"
    )
    named = {line.get_label(): line for line in axes.lines}
    (event,) = [
        r for r in long_log.events(event="NEAR_SINGULAR").records() if r["jacobian"] == "arm"
    ][:1]
    assert set(named["arm: near singular"].get_ydata()) == {event["threshold"]}


@pytest.mark.parametrize("backend", ["not_installed", "module://not_installed", "agg", ""])
def test_an_inherited_backend(backend: str, tmp_path: Path, log: ik.logs.Log) -> None:
    """Pictures in files are independent of the backend of matplotlib in the environment."""
    picture = tmp_path / "cup.png"
    words = "-m", "casadi_ik", "log", "plot", log.shards[0].path, "--out", picture
    done = python(*words, env={"MPLBACKEND": backend})
    assert (done.returncode, done.stderr) == (0, "")
    assert picture.read_bytes().startswith(b"\x89PNG")
