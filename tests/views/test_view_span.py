"""A part of a long run drawn by itself, and thresholds where they were passed."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.errors import InputError
from casadi_ik.views import draw_convergence


@pytest.fixture(scope="module")
def log(robot, tmp_path_factory) -> ik.logs.Log:
    """A solve next to a straight elbow: 60 iterations, the arm near singular at its start."""
    path = tmp_path_factory.mktemp("span") / "long.mcap"
    q = robot.home.copy()
    q[robot.actuators.index("lwr_joint_4")] = 1e-3
    solver = ik.Solver(
        robot, "enhanced-dls", finger_step="closed-form", options={"max_iterations": 60}
    )
    solver.solve(ik.load_grasp("cup"), q0=q, log=path)
    return ik.logs.open(path)


def drawn(log: ik.logs.Log, **options):
    return draw_convergence(log.iterations(), events=log.events(), **options)


def test_only_the_span_is_drawn_and_scaled(log):
    whole, part = drawn(log).axes[0], drawn(log, span=(3, 9)).axes[0]
    assert part.get_xlim() == (2.5, 9.5)
    assert whole.get_xlim()[1] > 9.5
    seen = part.lines[0].get_ydata()
    assert np.isfinite(seen[3:10]).all()
    assert np.isnan(np.delete(seen, slice(3, 10))).all()


@pytest.mark.parametrize("span", [(-1, 3), (5, 4), (0, 10_000)])
def test_a_span_that_is_not_there_is_refused(log, span):
    with pytest.raises(InputError, match="span: found"):
        drawn(log, span=span)


def test_a_threshold_that_was_passed_is_a_line_with_a_name(log):
    axes = next(
        axes for axes in drawn(log).axes if axes.get_title("left") == "smallest singular value"
    )
    named = {line.get_label(): line for line in axes.lines}
    (event,) = [r for r in log.events(event="NEAR_SINGULAR").records() if r["jacobian"] == "arm"][
        :1
    ]
    assert set(named["arm: near singular"].get_ydata()) == {event["threshold"]}


def test_no_two_lines_of_a_panel_look_alike(log):
    axes = next(axes for axes in drawn(log).axes if axes.get_title("left").startswith("actuators"))
    looks = {
        (line.get_color(), str(line._dash_pattern))
        for line in axes.lines
        if len(line.get_ydata()) > 2
    }
    assert len(looks) == log.iterations().rows["q"].shape[1]
