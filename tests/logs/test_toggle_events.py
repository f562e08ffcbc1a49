"""A mechanism near its toggle position is an event of the log, and never a NaN."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.methods.common import coupling_record


@pytest.fixture(scope="module")
def robot() -> ik.ArmHand:
    return ik.load_robot("ar10")


def margins(robot, q):
    return np.min(list(robot.toggle_margins(q).values()), axis=0)


def logged(robot, path, q):
    """A log of a solve that ends at q, and its rows and events."""
    points, normals = robot.contacts(q)
    solver = ik.Solver(robot)
    batch = solver.solve_batch(points[None], normals[None], log=path)
    assert batch.success.all()
    log = ik.logs.open(path)
    return log.iterations().rows, list(log.events(event="NEAR_SINGULAR").records())


def test_the_least_margin_is_recorded(robot, tmp_path):
    q = robot.random(np.random.default_rng(1), 1)[0]
    rows, _ = logged(robot, tmp_path / "a.mcap", q)
    expected = [margins(robot, row) for row in rows["q"].astype(float)]
    np.testing.assert_allclose(rows["sigma_coupling"], expected, rtol=1e-5)


def test_near_a_toggle_is_an_event_that_names_the_motors(robot, tmp_path, monkeypatch):
    """The shipped strokes keep clear of it, so the threshold is raised to where they go."""
    q = robot.random(np.random.default_rng(1), 1)[0]
    _, events = logged(robot, tmp_path / "clear.mcap", q)
    assert events == []
    monkeypatch.setattr(coupling_record, "NEAR_TOGGLE", 1.0)
    rows, events = logged(robot, tmp_path / "near.mcap", q)
    assert (rows["sigma_coupling"] < 1.0).all()
    assert events
    assert {event["jacobian"] for event in events} == {"coupling"}
    named = coupling_record.coupling_jacobian(robot.description)["coupling"].joints
    assert set(named) == set(robot.actuators)


def test_a_robot_without_mechanisms_records_none():
    barrett = ik.load_robot("kuka_lwr_barrett").description
    assert coupling_record.coupling_fields(barrett) == ()
    assert coupling_record.coupling_jacobian(barrett) == {}
