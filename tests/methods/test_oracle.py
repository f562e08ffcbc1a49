"""A hundred thousand reachable targets: all solved, every answer checked by numpy alone."""

from __future__ import annotations

import numpy as np
import numpy_oracle
import pytest
from samplers import SAMPLERS

import casadi_ik as ik

TOLERANCES = ((5e-3, float(np.radians(3))), (1e-6, 1e-6))
COUNT = 10_000
ROBOTS = {
    "kuka_lwr_barrett": ("random hands", "corners", "near limits"),
    "kuka_lwr_barrett_coupled": ("random hands",),
    "ar10": ("random hands",),
}
"""Five sets of `COUNT` targets, at two tolerances."""


@pytest.mark.parametrize("tolerance", TOLERANCES, ids=str)
@pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name, kinds in ROBOTS.items() for kind in kinds]
)
def test_all_are_solved_and_every_answer_is_right(name, kind, tolerance):
    robot = ik.load_robot(name)
    q = dict(SAMPLERS.values())[kind](robot, np.random.default_rng(31), COUNT)
    assert numpy_oracle.beyond_limits(robot, q).max() <= 1e-9
    points, normals = numpy_oracle.contacts(robot, q)
    batch = ik.Solver(robot, tolerance=ik.Tolerance(*tolerance)).solve_batch(points, normals)
    assert np.flatnonzero(~batch.success).tolist() == []
    reached, faced = numpy_oracle.contacts(robot, batch.q)
    # Rounding: of two kinds of arithmetic over a chain of a metre, and of the verdict's own slack.
    assert np.linalg.norm(reached - points, axis=2).max() <= tolerance[0] * (1 + 1e-6)
    chord = np.linalg.norm(faced - normals, axis=2)
    assert (2 * np.arcsin(chord / 2)).max() <= tolerance[1] * (1 + 1e-6)
    assert numpy_oracle.beyond_limits(robot, batch.q).max() <= 1e-9
