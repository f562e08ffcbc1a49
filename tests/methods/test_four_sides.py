"""A multi-arm robot with the largest number of sides: all its stages, in lanes and one by one."""

import numpy as np
from toy_robots import grasp_at

import casadi_ik as ik

BODY = """
name: four
trunk: planar
sides:
  front: {arm: widowx_250s, hand: tool, at: {xyz: [0.2, 0, 0]}}
  back: {arm: widowx_250s, hand: tool, at: {xyz: [-0.2, 0, 0]}}
  left: {arm: widowx_250s, hand: tool, at: {xyz: [0, 0.2, 0]}}
  right: {arm: widowx_250s, hand: tool, at: {xyz: [0, -0.2, 0]}}
"""


def test_four_sides_are_solved_near_q0_as_in_lanes(tmp_path):
    file = tmp_path / "four.yaml"
    file.write_text(BODY, encoding="utf-8")
    robot = ik.load_robot(file)
    q = robot.random(np.random.default_rng(4), 24)
    points, normals = robot.contacts(q)
    start = q + 0.05 * np.random.default_rng(5).uniform(-1.0, 1.0, q.shape)
    start = np.clip(start, robot.lower, robot.upper)
    solver = ik.Solver(robot)
    batch = solver.solve_batch(points, normals, q0=start, prefer="q0")
    assert batch.success.all()
    for row in (0, 11, 23):
        single = solver.solve(grasp_at(robot, q[row]), q0=start[row], prefer="q0")
        np.testing.assert_array_equal(single.q, batch.q[row])
