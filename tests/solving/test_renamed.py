"""Deprecated names of options and results still work, and warn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("as_it_is", "max_cost_of_q0"),
        ("eased", "damping_decrease"),
        ("tightened", "damping_increase"),
    ],
)
def test_old_options_set_the_new_ones(
    robot: ik.ArmHand, tmp_path: Path, old: str, new: str
) -> None:
    with pytest.warns(DeprecationWarning, match=old):
        solver = ik.Solver(robot, "thumb-first", options={old: 0.25}, compiled=False)
    solver.solve(ik.load_grasp("cup"), log=tmp_path / "cup.mcap", diagnose=False)
    parameters = ik.logs.open(tmp_path / "cup.mcap").metadata["parameters"]
    assert parameters["options"][new] == 0.25
    assert old not in parameters["options"]


def test_old_attributes_of_a_diagnosis(robot: ik.ArmHand) -> None:
    points, normals = robot.contacts(robot.home)
    contacts = zip(robot.fingers, np.add(points, [0.0, 0.0, 2.0]), normals, strict=True)
    grasp = ik.Grasp({name: ik.Contact(point, normal) for name, point, normal in contacts})
    diagnosis = ik.Solver(robot).solve(grasp).diagnosis
    assert diagnosis is not None
    assert diagnosis.hand is not None
    with pytest.warns(DeprecationWarning, match="freed"):
        assert diagnosis.freed == diagnosis.released
    with pytest.warns(DeprecationWarning, match="fits"):
        assert diagnosis.hand.fits is diagnosis.hand.ok is True
