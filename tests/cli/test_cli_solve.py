"""`casadi-ik solve`: the answer, the report, the files, and the explanation of a failure."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import FAST, POSTURE, Command

import casadi_ik as ik

GraspFile = Callable[..., Path]


def test_solved_grasp(
    run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    out, log = tmp_path / "pinch.json", tmp_path / "pinch.mcap"
    done = run("solve", grasp_file(), *FAST, "--out", out, "--log", log).fine()
    words = done.out.split()
    assert words[0] == "SOLVED"
    assert {"enhanced-dls", "kuka_lwr_barrett", str(log), str(out)} < set(words)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "pinch.json",
        "pinch.mcap",
        "pinch.yaml",
    ]
    report = json.loads(out.read_text())
    assert list(report) == [
        *("success", "status", "method", "robot", "actuators", "q", "iterations", "restarts"),
        *("time", "contacts", "diagnosis"),
    ]
    assert (report["success"], report["status"], report["diagnosis"]) == (True, "SOLVED", None)
    assert (report["method"], report["robot"]) == ("enhanced-dls", "kuka_lwr_barrett")
    assert tuple(report["actuators"]) == robot.actuators
    assert tuple(report["contacts"]) == robot.fingers
    assert {frozenset(names) for names in report["contacts"].values()} == {
        frozenset(("position_error", "angle_error", "ok"))
    }
    errors = [contact["position_error"] for contact in report["contacts"].values()]
    offsets = robot.contacts(report["q"])[0] - robot.contacts(POSTURE)[0]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), errors, atol=1e-12)


def test_answers_match_the_api(
    run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    path, out = grasp_file(), tmp_path / "pinch.json"
    start = POSTURE + 0.1
    run("solve", path, *FAST, "--out", out, "--limits", "ignore", "--q0", *start)
    solver = ik.Solver(robot, "enhanced-dls", limits="ignore", finger_step="closed-form")
    solution = solver.solve(ik.load_grasp(path), q0=start)
    report = json.loads(out.read_text())
    assert report["q"] == solution.q.tolist()
    assert report["iterations"] == solution.iterations


def test_solve_options_are_accepted(
    run: Command, grasp_file: GraspFile, own_robot: Path, tmp_path: Path
) -> None:
    """Numbers with commas and spaces, tolerances, and a user's robot are accepted."""
    numbers = ["-1e-3", "0.5", *["0.1"] * 12]
    for start in ([",".join(numbers)], numbers, [",".join(numbers[:7]), " ".join(numbers[7:])]):
        assert run("solve", grasp_file(), *FAST, "--q0", *start).exit in (0, 1)
    narrow = ("--tolerance-position", "0.0025", "--tolerance-angle", "0.02")
    text = run("solve", grasp_file(), *FAST, *narrow).out
    assert (text.count(" 2.5 mm "), text.count(" 1.146 deg ")) == (3, 3)
    assert run("solve", grasp_file(), "--method", "enhanced-dls").exit == 0
    path = grasp_file(robot="no_such_robot")
    assert run("solve", path, *FAST, "--robot", own_robot).exit == 0
    # A relative path in a file is relative to that file.
    path = grasp_file(robot=str(own_robot.relative_to(tmp_path)))
    assert run("solve", path, *FAST).exit == 0


def test_fixed_actuators_stay(run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    out = tmp_path / "fixed.json"
    fixed = ("--fixed", "lwr_joint_3=0.2", "--fixed", "bh_spread=0.1")
    assert run("solve", grasp_file(), *fixed, "--out", out).exit in (0, 1)
    answer = json.loads(out.read_text())
    positions = dict(zip(answer["actuators"], answer["q"], strict=True))
    assert (positions["lwr_joint_3"], positions["bh_spread"]) == (0.2, 0.1)
    refused = run("solve", grasp_file(), *FAST, *fixed).error
    assert "'enhanced-dls'" in refused


def test_unsolved_grasp_is_explained(run: Command, far_away: Path, tmp_path: Path) -> None:
    out = tmp_path / "far.json"
    done = run("solve", far_away, *FAST, "--out", out)
    assert (done.exit, done.err) == (1, "")
    assert done.out.startswith(json.loads(out.read_text())["status"])
    assert "\x1b" not in done.out
    assert max(len(line) for line in done.out.splitlines() if str(out) not in line) <= 80
    done = run("solve", far_away, "--out", out)
    assert (done.exit, done.err) == (1, "")
    assert done.out.startswith("UNREACHABLE")
    report = json.loads(out.read_text())
    diagnosis = report["diagnosis"]
    # A tolerance above 20 mm and 15 deg is not suggested.
    assert "solvable within" not in " ".join(done.out.split())
    assert diagnosis["enough"]["position"] > 0.02
    assert (report["status"], diagnosis["reason"]) == ("UNREACHABLE", "REACH")
    assert diagnosis["established"] is True
    assert diagnosis["proof"]["kind"]
    assert diagnosis["reach"]["distance"] > diagnosis["reach"]["farthest"]
    assert set(diagnosis["nearest"]) == {"thumb", "finger_2", "finger_3"}
    assert len(diagnosis["q"]) == len(report["actuators"])


def test_a_scene(run: Command, tmp_path: Path) -> None:
    out, scene = tmp_path / "cup.json", tmp_path / "balloon.yaml"
    done = run("solve", "cup", "--scene", "table", "--out", out).fine()
    answer = json.loads(out.read_text())
    assert answer["clearance"] >= 0
    assert len(answer["closest"]) == 2
    assert answer["collision"] is None
    balloon = "{kind: sphere, radius: 300 mm, xyz: [-820 mm, 127 mm, 410 mm]}"
    scene.write_text(f"solids:\n  balloon: {balloon}\n")
    done = run("solve", "cup", "--scene", scene)
    assert done.exit == 1
    assert done.out.startswith("COLLISION  cup")
    assert "balloon" in done.out
    scene.write_text("solids:\n  a: {kind: box, size: [1 m, 1 m]}\n")
    assert "balloon.yaml: solids.a.size" in run("solve", "cup", "--scene", scene).error


@pytest.mark.opengl
def test_picture_is_drawn(run: Command, grasp_file: GraspFile, tmp_path: Path) -> None:
    picture = tmp_path / "pinch.png"
    assert run("solve", grasp_file(), *FAST, "--picture", picture).exit == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_missing_picture_libraries_are_reported_before_solving(
    run: Command, grasp_file: GraspFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ik.Solver, "solve", None)
    picture = ("--picture", tmp_path / "pinch.png")
    path = grasp_file(object={"name": "nothing"})
    error = run("solve", path, *FAST, *picture).error
    assert error.startswith(f"{path}: object.name: ")
    for name in [name for name in sys.modules if name.startswith("casadi_ik.app.pictures")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "casadi-ik[plots]" in run("solve", grasp_file(), *FAST, *picture).error


def test_a_free_finger(
    run: Command, grasp_file: GraspFile, contacts: dict[str, Any], tmp_path: Path
) -> None:
    out = tmp_path / "two.json"
    two = {name: contacts[name] for name in ("thumb", "finger_2")}
    done = run("solve", grasp_file(contacts=two), "--out", out)
    contact = json.loads(out.read_text())["contacts"]["finger_3"]
    assert contact == {"position_error": None, "angle_error": None, "ok": True}
    (line,) = (line for line in done.out.splitlines() if line.split()[:1] == ["finger_3"])
    assert line.split() == ["finger_3", "free", "free", "ok"]


def test_limits_that_are_ignored(
    run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    q = POSTURE.copy()
    q[8] = robot.upper[8] + np.deg2rad(20)
    points, normals = robot.contacts(q)
    rows = zip(robot.fingers, points.tolist(), normals.tolist(), strict=True)
    path = grasp_file(contacts={name: {"point": p, "normal": n} for name, p, n in rows})
    done = run("solve", path, *FAST, "--limits", "ignore", "--q0", *q)
    assert done.exit == 0
    (line,) = (line for line in done.out.splitlines() if " deg above" in line)
    assert line.split()[0] == robot.actuators[8]


def test_joints_beyond_their_limits_are_named(
    coupled_robot: ik.ArmHand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Coupled joints beyond their limits are named once each."""
    monkeypatch.setitem(sys.modules, "casadi_ik.app.pictures.thumbnail", None)
    description = coupled_robot.description
    for q in coupled_robot.random(np.random.default_rng(0), 20):
        theta = np.array(list(coupled_robot.joints(q).values()))
        below, above = description.joint_lower - 1e-6, description.joint_upper + 1e-6
        outside = set(np.array(description.joint_names)[(theta < below) | (theta > above)])
        page = ik.Solution(
            *(False, ik.Status.STALLED, q, 0, 0, 0.0, {}, {}, False, "", ""),
            actuators=coupled_robot.actuators,
            arm_hand=coupled_robot,
        )._repr_html_()
        (_, _, line) = page.partition("joints beyond a limit: ")
        named = [part.split()[0] for part in line.partition("<")[0].split(", ") if part]
        assert set(named) == outside.difference(coupled_robot.actuators)
        rows = [row for row in page.split("<tr>") if " below" in row or " above" in row]
        for name in outside.intersection(coupled_robot.actuators):
            assert any(f">{name}<" in row for row in rows)


def test_contacts_go_with_the_object(
    run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path
) -> None:
    """Without an object in the file, its contacts are in the frame of --object-pose."""
    out = tmp_path / "pinch.json"
    turn = ["0.0", "0.0", "-0.01", "0", "0", "0.2"]
    done = run("solve", grasp_file(), *FAST, "--out", out, "--object-pose", *turn)
    assert done.exit == 0
    points, _ = robot.contacts(json.loads(out.read_text())["q"])
    stored_points, _ = robot.contacts(POSTURE)
    c, s = math.cos(0.2), math.sin(0.2)
    expected_points = stored_points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0, 0, -0.01]
    assert np.linalg.norm(points - expected_points, axis=1).max() < 5e-3


@pytest.mark.filterwarnings("default:q0")
def test_effort_is_limited_and_degrees_are_detected(run: Command, robot: ik.ArmHand) -> None:
    degrees = [f"{value:g}" for value in np.rad2deg(robot.home)]
    done = run("solve", "cup", "--q0", *degrees, "--max-rounds", "1")
    assert done.exit == 0
    (line,) = done.err.splitlines()
    assert re.search("q0: lwr_joint_2 .*30 rad", line)


@pytest.mark.slow
def test_units(run: Command, grasp_file: GraspFile, robot: ik.ArmHand, tmp_path: Path) -> None:
    """Degrees and mm are used on request; the answer is the same, and files are in rad and m."""
    path, out = grasp_file(), tmp_path / "o.json"
    start = [f"{value:.17g}" for value in np.rad2deg(robot.home)]
    tolerances = ("--tolerance-position", "2", "--tolerance-angle", "1")
    done = run("solve", path, "--out", out, "--deg", "--mm", *tolerances, "--q0", *start).fine()
    assert (done.out.count(" 2 mm "), done.out.count(" 1 deg ")) == (3, 3)
    in_mm = json.loads(out.read_text())
    tolerances = ("--tolerance-position", "0.002", "--tolerance-angle", f"{math.radians(1):.17g}")
    done = run("solve", path, "--out", out, *tolerances, "--no-deg", "--no-mm", "--q0", *robot.home)
    assert (done.out.count(" 0.002 m "), done.out.count(" 0.01745 rad ")) == (3, 3)
    in_m = json.loads(out.read_text())
    assert in_mm["q"] == pytest.approx(in_m["q"], abs=1e-9)
    pose = ("--object-pose", "0", "0", "-10", "0", "0", "5", "--mm", "--deg")
    assert run("solve", path, "--out", out, *pose).exit == 0
    in_mm = json.loads(out.read_text())["q"]
    run("solve", path, "--out", out, "--object-pose", 0, 0, -0.01, 0, 0, math.radians(5))
    assert in_mm == pytest.approx(json.loads(out.read_text())["q"], abs=1e-9)
    arm_and_sliders = ik.load_robot("baxter_ar10")
    units = [actuator.unit for actuator in arm_and_sliders.description.actuators]
    home = arm_and_sliders.home.tolist()
    start = [1e3 * value if unit == "m" else value for value, unit in zip(home, units, strict=True)]
    assert run("solve", "ar10_cup", "--mm", "--out", out, "--q0", *start).exit == 0
    in_mm = json.loads(out.read_text())["q"]
    run("solve", "ar10_cup", "--out", out, "--q0", *home)
    assert in_mm == pytest.approx(json.loads(out.read_text())["q"], abs=1e-9)


def test_report_and_file_state_the_same_time(run: Command, tmp_path: Path) -> None:
    out = tmp_path / "o.json"
    done = run("solve", "cup", "--out", out)
    seconds = json.loads(out.read_text())["time"]
    assert f"{seconds * 1e6:.3g} us" in done.out or f"{seconds * 1e3:.3g} ms" in done.out


def test_overlapping_object_is_reported_without_a_scene(run: Command, tmp_path: Path) -> None:
    shipped = Path(__file__).parents[2] / "models" / "grasps" / "cup.yaml"
    text = shipped.read_text(encoding="utf-8")
    assert "0.126889040887" in text
    moved_file = tmp_path / "moved.yaml"
    moved_file.write_text(text.replace("0.126889040887", "0.086889040887"), encoding="utf-8")
    assert "overlap" not in run("solve", shipped).out
    assert re.search(
        r"the shapes of \w+ and cup overlap by [\d.]+ mm", run("solve", moved_file).out
    )


def test_best_effort_writes_the_nearest_configuration(run: Command, tmp_path: Path) -> None:
    out, errors = tmp_path / "far.json", {}
    for flags, status in ((["--best-effort"], "NEAREST"), ([], "STALLED")):
        pose = ("--object-pose", 1, 0, 2, 0, 0, 0)
        done = run("solve", "cup", *pose, "--no-diagnose", "--out", out, *flags)
        assert done.exit == 1
        report = json.loads(out.read_text())
        assert report["status"] == status
        errors[status] = max(item["position_error"] for item in report["contacts"].values())
        if status == "NEAREST":
            ratio = re.search(r"([\d.]+) times its tolerance", done.out)
            assert ratio is not None
            assert float(ratio[1]) >= 0.99 * errors[status] / 5e-3
    assert errors["NEAREST"] < errors["STALLED"]
