"""Printed results, and results in notebooks."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from toy_robots import grasp_of

import casadi_ik as ik

TERMINAL = os.environ | {"TERM": "xterm", "COLUMNS": "80"}
WITH_PICTURE = (ik.ArmHand, ik.Solution, ik.solve.Choice)


def answers(name):
    robot = ik.load_robot(name)
    solver = ik.Solver(robot)
    q = robot.random(np.random.default_rng(0), 300)
    points, normals = robot.contacts(q)
    points[7] += 9.0
    batch = solver.solve_batch(points, normals, diagnose=True)
    grasps = [grasp_of(robot, *pair) for pair in zip(points[:3], normals[:3], strict=True)]
    ranked = solver.choose(grasps)
    return robot, batch.solution(0), batch.solution(7), batch, batch.diagnoses[7], ranked, ranked[0]


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "ur5e+shadow"])
def test_representations_are_short(name):
    for answer in answers(name):
        text = str(answer)
        assert len(text.split("\n")) <= 25, text
        assert max(map(len, text.split("\n"))) <= 80
        assert len(repr(answer).split("\n")) == 1
        assert repr(answer).startswith(f"<{type(answer).__name__} ")
        page = answer._repr_html_()
        assert page.count("<table") == page.count("</table>")
        assert "<script" not in page
        assert ("data:image/png;base64," in page) == isinstance(answer, WITH_PICTURE)


def test_representations_contain_the_result(robot):
    _, solved, missed, batch, diagnosis, ranked, best = answers("kuka_lwr_barrett")
    assert "SOLVED  hand-first on kuka_lwr_barrett" in str(solved)
    for name, value in zip(solved.actuators, solved.q, strict=True):
        assert f"{name}" in str(solved)
        assert f"{value:.6f}" in str(solved)
    assert all(finger in str(solved) for finger in robot.fingers)
    assert missed.status.name in str(missed)
    assert diagnosis.lines[0][:40] in str(missed)
    assert str(diagnosis).split("\n")[0] == diagnosis.lines[0][:80]
    assert f"{batch.success.sum()} of 300 targets" in str(batch)
    assert "rows 7" in str(batch)
    assert "3 of 3 " in str(ranked)
    assert f"candidate {best.candidate}" in str(best)
    assert "thumb (placed first)" in str(robot)


def test_tables_need_no_plotting(robot, monkeypatch):
    solution = ik.Solver(robot).solve(ik.load_grasp("cup"))
    monkeypatch.setitem(sys.modules, "casadi_ik.app.pictures.thumbnail", None)
    page = solution._repr_html_()
    assert "<img" not in page
    assert "<th" in page
    assert "bh_spread" in page
    assert "at lower" in page  # limits are known


@pytest.mark.opengl
def test_a_solution_draws_itself(own_robot, tmp_path):
    """Robots need not be shipped; without a target, the reached contacts are shown."""
    solution = ik.Solver(ik.load_robot(own_robot)).solve(ik.load_grasp("cup"))
    path = tmp_path / "cup.png"
    assert solution.draw(path=path, dpi=40).axes
    assert path.read_bytes().startswith(b"\x89PNG")
    assert solution.draw(ik.load_grasp("cup"), dpi=40).axes


PROGRAM = """
import sys
import numpy as np
import casadi_ik as ik
from casadi_ik.files import progress
progress.FIRST_DRAW_DELAY = 0.0
robot = ik.load_robot("kuka_lwr_barrett")
points, normals = robot.contacts(robot.random(np.random.default_rng(0), 400))
batch = ik.Solver(robot).solve_batch(points, normals, jobs=int(sys.argv[1]))
print(batch.success.sum(), batch.q.sum())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_on_a_terminal_changes_no_answer(jobs):
    words = [sys.executable, "-c", PROGRAM, str(jobs)]
    piped = subprocess.run(words, capture_output=True, text=True, check=True)
    assert piped.stderr == ""
    ours, theirs = os.openpty()
    process = subprocess.run(
        words, stdout=subprocess.PIPE, stderr=theirs, text=True, check=True, env=TERMINAL
    )
    os.close(theirs)
    assert b"/400" in os.read(ours, 100_000)
    os.close(ours)
    assert process.stdout == piped.stdout
