"""Deprecated names of options and results still work, and warn."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.solve.registry import RENAMED_OPTIONS, build_method


@pytest.mark.parametrize(("old", "new"), RENAMED_OPTIONS.items())
def test_old_options_set_the_new_ones(robot: ik.ArmHand, old: str, new: str) -> None:
    with pytest.warns(DeprecationWarning, match=old):
        method = build_method("thumb-first", robot.description, {old: 0.25})
    assert method.parameters[new] == 0.25


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
