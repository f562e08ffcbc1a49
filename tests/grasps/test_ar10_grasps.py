"""The pinches shipped for baxter_ar10, verified from the files alone, and solved as a user does."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import grasps

NAMES = ik.shipped_grasps("baxter_ar10")
BALLS = {"ar10_golf_ball", "ar10_orange", "ar10_tennis_ball"}


@pytest.fixture(scope="module")
def baxter() -> ik.ArmHand:
    return ik.load_robot("baxter_ar10")


def touching(grasp: ik.Grasp) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The fingers that touch, their points and normals."""
    fingers = tuple(grasp.contacts)
    return fingers, *grasp.arrays(fingers)


def test_six_grasps() -> None:
    assert set(NAMES) == BALLS | {"ar10_cup", "ar10_mug", "ar10_tomato_soup_can"}
    for name in NAMES:
        fingers = ("thumb", "index") if name in BALLS else ("thumb", "index", "middle")
        assert tuple(ik.load_grasp(name).contacts) == fingers
    assert not set(NAMES) & set(ik.shipped_grasps("kuka_lwr_barrett"))


@pytest.mark.parametrize("name", NAMES)
def test_contacts_are_on_the_surface_and_face_into_it(name: str) -> None:
    grasp = ik.load_grasp(name)
    item = grasps.load_object(grasp.object)
    _, points, normals = touching(grasp)
    assert grasp.object_pose is not None
    rotation, origin = grasp.object_pose[:3, :3], grasp.object_pose[:3, 3]
    local = (points - origin) @ rotation
    assert np.abs(item.signed_distance(local)).max() < 1e-9
    np.testing.assert_allclose(normals @ rotation, -item.normal(local), atol=1e-9)
    if isinstance(item.shape, grasps.Cylinder):
        assert np.all(item.shape.height / 2 - np.abs(local[:, 2]) > 0.0049)
        np.testing.assert_allclose(grasp.object_pose[2, 2], 1.0, atol=1e-9)  # stands upright


@pytest.mark.parametrize("name", NAMES)
def test_posture_reproduces_the_contacts(name: str, baxter: ik.ArmHand) -> None:
    """Distances and angles between the contacts are those of the posture, wherever the arm is."""
    grasp = ik.load_grasp(name)
    fingers, points, normals = touching(grasp)
    q = baxter.home.copy()
    for i, actuator in enumerate(baxter.actuators[7:], start=7):
        q[i] = grasp.posture[actuator]
    assert np.all((q >= baxter.lower) & (q <= baxter.upper))
    rows = [baxter.fingers.index(finger) for finger in fingers]
    found_points, found_normals = (array[rows] for array in baxter.contacts(q))
    for i, j in combinations(range(len(rows)), 2):
        line, found = points[j] - points[i], found_points[j] - found_points[i]
        assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(line), abs=1e-9)
        for k in (i, j):
            assert found_normals[k] @ found == pytest.approx(normals[k] @ line, abs=1e-9)
        assert found_normals[i] @ found_normals[j] == pytest.approx(
            normals[i] @ normals[j], abs=1e-9
        )


@pytest.mark.parametrize("name", NAMES)
def test_the_squeeze_stays_inside_friction_cones(name: str) -> None:
    """Tensions along the lines between the contacts balance; the best of them is inside."""
    _, points, normals = touching(ik.load_grasp(name))
    lines = {(i, j): points[j] - points[i] for i, j in combinations(range(len(points)), 2)}
    best = -1.0
    for tension in np.linspace(0, 2, 201) if len(points) == 3 else (0.0,):
        for between in np.linspace(-3, 3, 201) if len(points) == 3 else (0.0,):
            tensions = {(0, 1): 2 - tension, (0, 2): tension, (1, 2): between}
            forces = np.zeros_like(points)
            for (i, j), line in lines.items():
                forces[i] += tensions[i, j] * line
                forces[j] -= tensions[i, j] * line
            size = np.maximum(np.linalg.norm(forces, axis=1), 1e-12)
            best = max(best, float((np.sum(forces * normals, axis=1) / size).min()))
    assert np.tan(np.arccos(best)) < 0.8


@pytest.mark.parametrize("name", NAMES)
def test_solved_exactly(name: str, baxter: ik.ArmHand) -> None:
    solver = ik.Solver(baxter, tolerance=ik.Tolerance(1e-6, 1e-6))
    solution = solver.solve(ik.load_grasp(name))
    assert solution.success, solution.status
    theta = list(baxter.joints(solution.q).values())
    assert np.all(np.array(theta) >= baxter.description.joint_lower)
    assert np.all(np.array(theta) <= baxter.description.joint_upper)


def test_from_the_command_line_with_a_log(tmp_path: Path, baxter: ik.ArmHand) -> None:
    log, out = tmp_path / "cup.mcap", tmp_path / "cup.json"
    command = [sys.executable, "-m", "casadi_ik", "solve", "ar10_cup", "--robot", "baxter_ar10"]
    command += ["--log", str(log), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    answer = json.loads(out.read_text())
    assert answer["success"]
    assert answer["actuators"] == list(baxter.actuators)
    found = ik.logs.open(log)
    (solve,) = found.solves().rows
    np.testing.assert_array_equal(solve["q"], answer["q"])
    assert solve["iterations"] == len(found.iterations()) == answer["iterations"]
    assert found.attachment("robot.urdf").decode() == baxter.urdf()


def test_the_script_makes_the_shipped_file(tmp_path: Path) -> None:
    """To nine digits: the optimiser may differ in the last ones from machine to machine."""
    script = Path(__file__).resolve().parents[2] / "tools" / "make_ar10_grasps.py"
    command = [sys.executable, str(script), "--only", "golf_ball", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("golf_ball: friction 0.6")
    _, points, normals = touching(ik.load_grasp(tmp_path / "ar10_golf_ball.yaml"))
    _, shipped_points, shipped_normals = touching(ik.load_grasp("ar10_golf_ball"))
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(points, axis=0)), np.linalg.norm(np.diff(shipped_points, axis=0)),
        atol=1e-6,
    )  # fmt: skip
    assert normals[0] @ normals[1] == pytest.approx(
        shipped_normals[0] @ shipped_normals[1], abs=1e-5
    )
