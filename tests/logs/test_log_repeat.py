"""A solve is repeated from what its log says of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_up_solves import changed, make_block

import casadi_ik as ik
from casadi_ik.logs import OneSolve, one_solve
from casadi_ik.logs.rows import solve_format
from casadi_ik.problem.problems import Problems

GRASP = ik.load_grasp("cup")


def repeated(solve: OneSolve) -> ik.Solution:
    """The same asked again, of a solver built from the log."""
    contacts = {
        finger: ik.Contact(point, None if np.isnan(normal).any() else normal, tolerance)
        for finger, point, normal, tolerance in zip(
            solve.fingers, solve.target_points, solve.target_normals, solve.tolerances, strict=True
        )
        if not np.isnan(point).any()
    }
    asked = solve.asked
    solver = ik.Solver(ik.load_robot(solve.robot), solve.method, limits=asked.limits)
    return solver.solve(
        ik.Grasp(contacts),
        q0=asked.start,
        seed=asked.seed,
        fixed=asked.fixed,
        prefer=asked.prefer,
    )


@pytest.mark.parametrize("limits", ["enforce", "ignore"])
def test_a_solve_is_repeated_from_its_log(tmp_path: Path, limits: str) -> None:
    """Own tolerances, a free normal, a start, a seed and a held actuator included."""
    robot = ik.load_robot("kuka_lwr_barrett")
    contacts = dict(GRASP.contacts)
    contacts["thumb"] = ik.Contact(contacts["thumb"].point, None, ik.Tolerance(1e-5, 0.2))
    fixed = {"lwr_joint_3": 0.2, "bh_spread": float(robot.upper[7])}
    q0 = robot.random(np.random.default_rng(5), 1)[0]
    path = tmp_path / "asked.mcap"
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-3, 0.01), limits=limits)
    first = solver.solve(ik.Grasp(contacts), q0=q0, seed=12345678901, fixed=fixed, log=path)
    solve = one_solve(ik.logs.open(path))
    asked = solve.asked
    assert (asked.limits, asked.seed, asked.fixed) == (limits, 12345678901, fixed)
    free = [name not in fixed for name in robot.actuators]
    assert asked.start is not None
    np.testing.assert_array_equal(asked.start[free], q0[free])
    assert asked.tolerances == (ik.Tolerance(1e-5, 0.2), *(ik.Tolerance(1e-3, 0.01),) * 2)
    again = repeated(solve)
    assert (again.status, again.iterations, again.restarts) == (
        *(first.status, first.iterations, first.restarts),
    )
    # A unit normal that is normalised again may change in its last bit.
    np.testing.assert_allclose(again.q, first.q, rtol=0, atol=1e-9)
    other = ik.Solver(robot, limits=limits).solve(GRASP)
    assert not np.allclose(other.q, first.q, atol=1e-3)


def test_held_actuators_beyond_one_word(write: Callable[..., Path]) -> None:
    block = make_block(3)
    held = np.full(40, np.nan)
    held[[1, 33]] = 0.5, -0.25
    points, normals = block.problems.points, block.problems.normals
    wide = changed(
        block,
        q=np.zeros((1, 40)),
        starts=np.ones((1, 40)),
        problems=Problems(points, normals, ik.Tolerance(), enforce_limits=False, fixed=held),
    )
    assert solve_format(wide).layout.dtype["fixed_mask"].shape == (2,)
    solve = one_solve(ik.logs.open(write(wide)))
    assert list(solve.asked.fixed.values()) == [0.5, -0.25]
    assert solve.asked.limits == "ignore"
    assert solve.asked.start is not None
    assert solve.asked.start[[0, 1, 33]].tolist() == [1.0, 0.5, -0.25]
