"""What answers print, and show in notebooks."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik


def answers(name):
    robot = ik.load_robot(name)
    solver = ik.Solver(robot)
    q = robot.random(np.random.default_rng(0), 300)
    points, normals = robot.contacts(q)
    points[7] += 9.0
    batch = solver.solve_batch(points, normals, diagnose=True)
    grasps = [
        ik.Grasp({f: ik.Contact(*pair) for f, *pair in zip(robot.fingers, *both, strict=True)})
        for both in zip(points[:3], normals[:3], strict=True)
    ]
    ranked = solver.choose(grasps)
    return robot, batch.solution(0), batch.solution(7), batch, batch.diagnoses[7], ranked, ranked[0]


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "ur5e+shadow"])
def test_short(name):
    for answer in answers(name):
        text = str(answer)
        assert len(text.split("\n")) <= 25, text
        assert max(map(len, text.split("\n"))) <= 80
        assert len(repr(answer).split("\n")) == 1
        assert repr(answer).startswith(f"<{type(answer).__name__} ")
        page = answer._repr_html_()
        assert page.count("<table") == page.count("</table>")
        assert "<script" not in page


def test_what_is_said(robot):
    _, solved, missed, batch, why, ranked, best = answers("kuka_lwr_barrett")
    assert "SOLVED  hand-first on kuka_lwr_barrett" in str(solved)
    for name, value in zip(solved.actuators, solved.q, strict=True):
        assert f"{name}" in str(solved)
        assert f"{value:.6f}" in str(solved)
    assert all(finger in str(solved) for finger in robot.fingers)
    assert missed.status.name in str(missed)
    assert why.lines[0][:40] in str(missed)
    assert str(why).split("\n")[0] == why.lines[0][:80]
    assert f"{batch.success.sum()} of 300 targets" in str(batch)
    assert "rows 7" in str(batch)
    assert "3 of 3 candidates have an answer" in str(ranked)
    assert f"candidate {best.candidate}" in str(best)
    assert "thumb (placed first)" in str(robot)
