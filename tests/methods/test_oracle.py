"""Reachable targets of all samplers are solved, verified in numpy alone."""

from __future__ import annotations

import numpy as np
import numpy_oracle
import pytest
from samplers import SAMPLERS

import casadi_ik as ik

TOLERANCES = ((5e-3, float(np.radians(3))), (1e-6, 1e-6))
KUKA, AR10 = "kuka_lwr_barrett", ("thumb", "index", "middle")
SETS = [(KUKA, sampler, 10_000, None) for sampler in ("random", "corners", "limits")]
SETS += [(name, "random", 10_000, None) for name in (f"{KUKA}_coupled", "ar10")]
SETS += [(KUKA, f"aligned{kind}", 1200, None) for kind in ("", "-grasps", "-limits")]
SETS += [(KUKA, "grasps", 1200, None)]
SETS += [
    (name, sampler, 300, fingers)
    for name in ("ar10", "baxter_ar10")
    for sampler, fingers in (
        *(("random", AR10[:count]) for count in (1, 2, 3)),
        ("limits", AR10),
        ("random", None),
    )
]
"""Robot, sampler, number of targets and of fingers with a contact (None: all) of each set."""


@pytest.mark.parametrize("tolerance", TOLERANCES, ids=str)
@pytest.mark.parametrize(("name", "sampler", "count", "fingers"), SETS)
def test_targets_are_solved_and_answers_verified(name, sampler, count, fingers, tolerance):
    robot = ik.load_robot(name)
    q = SAMPLERS[sampler][1](robot, np.random.default_rng(31), count)
    assert numpy_oracle.beyond_limits(robot, q).max() <= 1e-9
    points, normals = numpy_oracle.contacts(robot, q)
    free = [fingers is not None and finger not in fingers for finger in robot.fingers]
    points[:, free] = normals[:, free] = np.nan
    batch = ik.Solver(robot, tolerance=ik.Tolerance(*tolerance)).solve_batch(points, normals)
    assert np.flatnonzero(~batch.success).tolist() == []
    points_reached, faced = numpy_oracle.contacts(robot, batch.q)
    # Rounding of two kinds of arithmetic over a chain of a metre, and the slack of the verdict.
    distance = np.linalg.norm(points_reached - points, axis=2)
    np.testing.assert_array_equal(np.isnan(distance), np.tile(free, (count, 1)))
    assert np.nanmax(distance) <= tolerance[0] * (1 + 1e-6)
    chord = np.linalg.norm(faced - normals, axis=2)
    assert np.nanmax(2 * np.arcsin(chord / 2)) <= tolerance[1] * (1 + 1e-6)
    assert numpy_oracle.beyond_limits(robot, batch.q).max() <= 1e-9
