"""`casadi-ik solve`: the answer, the report and the files."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from command_line import FAST, POSTURE, Command
from rich.console import Console

import casadi_ik as ik
from casadi_ik.cli.report import as_json, solution_report

GraspFile = Callable[..., Path]


def test_solved_grasp(run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    out, log = tmp_path / "pinch.json", tmp_path / "pinch.mcap"
    done = run("solve", grasp_file(), *FAST, "--out", out, "--log", log)
    assert (done.exit, done.err) == (0, "")
    assert done.out.startswith("SOLVED  pinch: enhanced-dls on kuka_lwr_barrett")
    assert "thumb-reaching" in done.out
    assert f"log      {log}" in done.out
    assert f"out      {out}" in done.out
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "pinch.json",
        "pinch.mcap",
        "pinch.yaml",
    ]


def test_json_follows_the_contract(
    run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    out = tmp_path / "pinch.json"
    run("solve", grasp_file(), *FAST, "--out", out)
    found = json.loads(out.read_text())
    assert list(found) == [
        *("success", "status", "method", "robot", "actuators", "q", "iterations", "restarts"),
        *("time", "contacts", "diagnosis"),
    ]
    assert found["success"] is True
    assert found["status"] == "SOLVED"
    assert (found["method"], found["robot"]) == ("enhanced-dls", "kuka_lwr_barrett")
    assert tuple(found["actuators"]) == robot.actuators
    assert tuple(found["contacts"]) == robot.fingers
    points, _ = robot.contacts(found["q"])
    wanted, _ = robot.contacts(POSTURE)
    errors = [contact["position_error"] for contact in found["contacts"].values()]
    np.testing.assert_allclose(np.linalg.norm(points - wanted, axis=1), errors, atol=1e-12)


def test_the_same_as_the_api(
    run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    path, out = grasp_file(), tmp_path / "pinch.json"
    start = POSTURE + 0.1
    run("solve", path, *FAST, "--out", out, "--limits", "ignore", "--q0", *start)
    solver = ik.Solver(robot, "enhanced-dls", limits="ignore", finger_step="closed-form")
    solution = solver.solve(ik.load_grasp(path), q0=start)
    found = json.loads(out.read_text())
    assert found["q"] == solution.q.tolist()
    assert found["iterations"] == solution.iterations


@pytest.mark.parametrize("form", ["commas", "spaces", "both"])
def test_start_may_be_written_in_several_ways(
    form: str, run: Command, grasp_file: GraspFile, tmp_path: Path
) -> None:
    numbers = ["-1e-3", "0.5", *["0.1"] * 12]
    words = {
        "commas": [",".join(numbers)],
        "spaces": numbers,
        "both": [",".join(numbers[:7]), " ".join(numbers[7:])],
    }[form]
    done = run("solve", grasp_file(), *FAST, "--q0", *words)
    assert done.exit in (0, 1), done.err


def test_default_finger_step_solves_too(run: Command, grasp_file: GraspFile) -> None:
    assert run("solve", grasp_file(), "--method", "enhanced-dls").exit == 0


def test_robot_option_overrides_the_file(
    run: Command, grasp_file: GraspFile, own_robot: Path
) -> None:
    path = grasp_file(robot="no_such_robot")
    done = run("solve", path, *FAST, "--robot", own_robot)
    assert done.exit == 0, done.err


def test_robot_path_counts_from_the_grasp_file(
    run: Command, grasp_file: GraspFile, own_robot: Path, tmp_path: Path
) -> None:
    path = grasp_file(robot=str(own_robot.relative_to(tmp_path)))
    assert run("solve", path, *FAST).exit == 0


def test_tolerances_are_taken(run: Command, grasp_file: GraspFile) -> None:
    done = run(
        *("solve", grasp_file(), *FAST),
        *("--tolerance-position", "0.0025", "--tolerance-angle", "0.02"),
    )
    assert done.out.count(" 2.5 mm ") == 3
    assert done.out.count(" 1.146 deg ") == 3


def test_a_fixed_actuator_stays(run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    out = tmp_path / "fixed.json"
    done = run("solve", grasp_file(), "--fixed", "lwr_joint_3=0.2", "--out", out)
    assert done.exit == 0, done.err
    answer = json.loads(out.read_text())
    assert answer["q"][answer["actuators"].index("lwr_joint_3")] == 0.2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["lwr_joint_3=9"], "fixed.lwr_joint_3: found 9.0, expected a number from -2.96706 to "),
        (["elbow=0"], "fixed: no actuator 'elbow', expected one of lwr_joint_1, "),
        (["lwr_joint_3"], "--fixed: found 'lwr_joint_3', expected NAME=NUMBER"),
        (["lwr_joint_3=0", "lwr_joint_3=1"], "--fixed: lwr_joint_3 appears twice"),
    ],
)
def test_bad_fixed_actuators(
    run: Command, grasp_file: GraspFile, words: list[str], says: str
) -> None:
    done = run("solve", grasp_file(), "--fixed", *words)
    assert done.exit == 2
    assert says in done.err


def test_the_papers_methods_cannot_fix_actuators(run: Command, grasp_file: GraspFile) -> None:
    done = run("solve", grasp_file(), *FAST, "--fixed", "lwr_joint_3=0.2")
    assert done.exit == 2
    assert "method 'enhanced-dls' cannot keep actuators fixed" in done.err


def test_not_solved_says_why(run: Command, far_away: Path, tmp_path: Path) -> None:
    out = tmp_path / "far.json"
    done = run("solve", far_away, *FAST, "--out", out)
    assert (done.exit, done.err) == (1, "")
    status = json.loads(out.read_text())["status"]
    assert status != "SOLVED"
    assert done.out.startswith(status)
    assert "at a limit: lwr_joint_" in done.out
    assert "missed" in done.out


def test_report_is_plain_at_80_columns(run: Command, far_away: Path) -> None:
    out = run("solve", far_away, *FAST).out
    assert "\x1b" not in out
    assert max(map(len, out.splitlines())) <= 80


def test_long_paths_are_not_broken(run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    out = tmp_path / ("x" * 100 + ".json")
    assert str(out) in run("solve", grasp_file(), *FAST, "--out", out).out


@pytest.mark.opengl
def test_picture_is_drawn(run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    picture = tmp_path / "pinch.png"
    done = run("solve", grasp_file(), *FAST, "--picture", picture)
    assert done.exit == 0, done.err
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_missing_matplotlib_is_found_first(
    run: Command, grasp_file: GraspFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("casadi_ik.views")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(ik.Solver, "solve", None)
    error = run("solve", grasp_file(), *FAST, "--picture", tmp_path / "pinch.png").error
    assert "casadi-ik[plots]" in error


def test_unknown_object_is_found_before_it_is_drawn(
    run: Command, grasp_file: GraspFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ik.Solver, "solve", None)
    path = grasp_file(object={"name": "nothing"})
    error = run("solve", path, *FAST, "--picture", tmp_path / "pinch.png").error
    assert error.startswith(f"{path}: object.name: ")


def test_free_finger_in_json_and_report(robot: ik.ArmHand, grasp_file: GraspFile) -> None:
    solver = ik.Solver(robot, "enhanced-dls", finger_step="closed-form")
    solution = solver.solve(ik.load_grasp(grasp_file()))
    free = ik.ContactVerdict(math.nan, math.nan, True, ik.Tolerance())
    solution = replace(solution, contacts={**solution.contacts, "finger_3": free})
    found = json.loads(json.dumps(as_json(solution), allow_nan=False))
    assert found["contacts"]["finger_3"] == {
        "position_error": None,
        "angle_error": None,
        "ok": True,
    }
    shown = _shown(solver, solution)
    (line,) = (line for line in shown.splitlines() if line.split()[:1] == ["finger_3"])
    assert line.split() == ["finger_3", "free", "free", "ok"]


def test_limits_in_the_report(robot: ik.ArmHand, grasp_file: GraspFile) -> None:
    strict = ik.Solver(robot, "enhanced-dls", finger_step="closed-form")
    lenient = ik.Solver(robot, "enhanced-dls", limits="ignore", finger_step="closed-form")
    solution = strict.solve(ik.load_grasp(grasp_file()))
    q = solution.q.copy()
    q[0], q[8] = robot.upper[0] + np.deg2rad(2.5), robot.lower[8]
    beyond = replace(solution, q=q, limits_ok=False, success=False, status=ik.Status.STALLED)
    shown = _shown(strict, beyond)
    assert "beyond a limit: lwr_joint_1 2.5 deg above" in shown
    assert "at a limit: bh_thumb_proximal (lower)" in shown
    assert "at lower" in shown
    shown = _shown(lenient, replace(beyond, success=True, status=ik.Status.SOLVED))
    assert "limits are ignored; positions beyond them: 1" in shown


def test_couplings_beyond_their_limits_are_named(coupled_robot: ik.ArmHand) -> None:
    from casadi_ik.cli.report import _beyond

    solver = ik.Solver.__new__(ik.Solver)
    solver.robot = coupled_robot
    description = coupled_robot.description
    for q in coupled_robot.random(np.random.default_rng(0), 50):
        theta = np.array(list(coupled_robot.joints(q).values()))
        outside = (theta > description.joint_upper + 1e-6) | (
            theta < description.joint_lower - 1e-6
        )
        solution = ik.Solution(
            *(False, ik.Status.STALLED, q, 0, 0, 0.0, {}, {}, False, "", ""),
            actuators=coupled_robot.actuators,
        )
        named = [line.split()[0] for line in _beyond(solver, solution)]
        assert set(named) == set(np.array(description.joint_names)[outside])


def _shown(solver: ik.Solver, solution: ik.Solution) -> str:
    console = Console(file=StringIO(), width=80)
    console.print(solution_report("pinch", solver, solution, {}))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_contacts_go_with_the_object(
    run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    """The file says nothing of an object: its contacts are in the frame that is placed."""
    out = tmp_path / "pinch.json"
    turn = ["0.0", "0.0", "-0.01", "0", "0", "0.2"]
    done = run("solve", grasp_file(), *FAST, "--out", out, "--object-pose", *turn)
    assert done.exit == 0
    reached, _ = robot.contacts(json.loads(out.read_text())["q"])
    wanted, _ = robot.contacts(POSTURE)
    c, s = math.cos(0.2), math.sin(0.2)
    moved = wanted @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0, 0, -0.01]
    assert np.linalg.norm(reached - moved, axis=1).max() < 5e-3
    done = run("solve", grasp_file(), *FAST, "--object-pose", "1", "2")
    assert done.exit == 2
    assert "--object-pose: found 2 numbers, expected 6" in done.err


@pytest.mark.filterwarnings("default:q0")
def test_effort_is_limited_and_degrees_are_noticed(run: Command, robot: ik.ArmHand) -> None:
    degrees = [f"{value:g}" for value in np.rad2deg(robot.home)]
    done = run("solve", "cup", "--q0", *degrees, "--max-rounds", "1")
    assert done.exit == 0
    (line,) = done.err.splitlines()
    assert "q0: lwr_joint_2 is 30 rad, far beyond its limits" in line
    refused = run("solve", "cup", "--method", "thumb-first", "--max-rounds", "1")
    assert refused.exit == 2
    assert "--max-rounds: option 'max_rounds' does not exist" in refused.err
