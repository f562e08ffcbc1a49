"""The page on which contacts are dragged; its handlers are called like by a browser."""

from __future__ import annotations

import re
import socket
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik import errors


def shifted(pose: np.ndarray, *by: float) -> np.ndarray:
    moved_pose = pose.copy()
    moved_pose[:3, 3] += by
    return moved_pose


def test_page_starts_solved_and_local(cup: Any) -> None:
    page = cup.page
    assert page.result.success
    assert page.result.clearance is not None
    assert page.result.closest is not None
    assert cup.url.startswith("http://127.0.0.1:")
    assert cup.url in cup._repr_html_()
    port = int(cup.url.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), 5) as connection:
        assert connection.getpeername()[0] == "127.0.0.1"
    with pytest.raises(errors.InputError, match=str(port)):
        page.robot.view(port=port)


def test_a_dragged_contact_and_normal_are_reached(cup: Any) -> None:
    page, robot = cup.page, cup.page.robot
    q_before = page.result.q
    page.drag("thumb", shifted(page.request.contacts["thumb"].control, 0.004, 0.008, 0.004))
    normal = page.request.grasp.contacts["thumb"].normal + np.array([0.0, 0.0, 0.12])
    page.drag_normal("thumb", normal)
    assert page.work.settle(300)
    assert page.result.success
    tip, faced = (values[robot.fingers.index("thumb")] for values in robot.contacts(page.result.q))
    assert faced @ normal / np.linalg.norm(normal) >= np.cos(np.deg2rad(3.0))
    point_target = page.request.grasp.contacts["thumb"].point
    assert np.linalg.norm(tip - point_target) <= page.request.settings.tolerance.position
    # The answer is the nearest one: no motor moves far for a centimetre.
    assert np.abs(page.result.q - q_before).max() < 0.5


def test_links_match_the_kinematics(cup: Any, rng: np.random.Generator) -> None:
    """Link poses that a browser composes equal the robot's kinematics."""
    page, robot = cup.page, cup.page.robot
    page.drag_motors(robot.random(rng, 1)[0])
    assert page.work.settle(300)
    frames = {frame.name: frame for frame in page._robot_view._frames}
    poses: dict[str, np.ndarray] = {"/robot": np.eye(4)}
    for name, mesh in frames.items():
        on = poses[name.rpartition("/")[0]]
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(mesh.wxyz, scalar_first=True).as_matrix()
        pose[:3, 3] = mesh.position
        poses[name] = on @ pose
    links = robot.links(page.result.q)
    assert len(frames) == len(robot.description.links)
    for name, place in poses.items():
        if name != "/robot":
            assert np.abs(place - links[name.rpartition("/")[2]]).max() < 1e-8


def test_unreachable_contact_shows_reason_and_nearest(cup: Any) -> None:
    page, robot = cup.page, cup.page.robot
    page.drag("object", shifted(page.request.object_pose, -0.6, 0.0, 0.0))
    assert page.work.settle(300)
    result = page.result
    assert not result.success
    assert result.headline == "UNREACHABLE"
    # The nearest configuration is drawn, and the verdict is that of the drawn configuration.
    points, normals = page.request.grasp.arrays(robot.fingers)
    position, _ = robot.errors(result.q, points, normals)
    errors_shown = [result.verdicts[finger].position_error for finger in robot.fingers]
    assert np.allclose(position, errors_shown)
    assert result.reasons[0].split(":")[0] in page._panel._results.content


def test_drag_beyond_reach_does_not_wait_for_the_diagnosis(
    cup: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, results_drawn, draw = cup.page, [], cup.page.draw
    monkeypatch.setattr(page, "draw", lambda result: (results_drawn.append(result), draw(result)))
    page.drag("thumb", shifted(page.request.contacts["thumb"].control, 0.0, 0.0, 0.05))
    assert page.work.settle(300)
    at_once, at_rest = results_drawn
    assert at_once.headline == "NOT MET"
    assert len(at_once.reasons) == 1
    assert at_once.needs_diagnosis
    # The first drawn configuration is as near as the one of the diagnosis.
    far_error, nearest = (
        max(verdict.position_error for verdict in result.verdicts.values())
        for result in results_drawn
    )
    assert nearest > 5e-3
    assert far_error <= 1.05 * nearest
    # Without a nearer configuration, the arm stays when the reason appears.
    assert np.array_equal(at_rest.q, at_once.q)
    assert at_rest is page.result
    assert at_rest.headline == "UNREACHABLE"
    assert not at_rest.needs_diagnosis
    assert any("thumb" in line for line in at_rest.reasons)


def test_answers_avoid_a_dragged_table(cup: Any) -> None:
    page = cup.page
    pose = page.request.scene.items["table"].pose
    page.drag("table", shifted(pose, -1.3, 0.0, 0.36))
    assert page.work.settle(300)
    scene = page.request.scene
    fresh = ik.Solver(page.robot, scene=scene)
    clear = fresh.check(page.result.q, page.request.grasp)
    assert clear is not None
    assert float(clear.distance[0]) == pytest.approx(page.result.clearance, abs=1e-12)
    assert page.result.success == bool(clear.free[0]) is False
    assert page.result.headline == "COLLISION"
    # The table cannot overlap the robot's base: the page reports it and keeps running.
    page.drag("table", shifted(pose, 0.0, 0.0, 0.07))
    assert page.work.settle(300)
    assert page.result.headline == "INVALID REQUEST"
    page.drag("table", pose)
    assert page.work.settle(300)
    assert page.result.success


def test_all_solutions_can_be_browsed(cup: Any) -> None:
    page = cup.page
    # Solutions are listed after the drag is answered.
    page.drag("thumb", shifted(page.request.contacts["thumb"].control, 0.0, 0.0, 0.001))
    assert page.work.settle(300)
    assert len(page.solutions) > 1
    q_shown = []
    for number in range(len(page.solutions)):
        page.show_solution(number)
        assert page.work.settle(300)
        assert page.result.success
        q_shown.append(page.result.q)
    differences = [np.abs(a - b).max() for i, a in enumerate(q_shown) for b in q_shown[:i]]
    assert min(differences) > 0.01
    assert f"{len(q_shown)} of {len(q_shown)}" in page._panel._solution.content


def test_solutions_and_methods_are_shown_together(cup: Any) -> None:
    page, scene = cup.page, cup._server.scene
    page.show_ghosts(True)
    page.compare("enhanced-dls")
    assert page.work.settle(300)
    names_drawn = set(scene._handle_from_node_name)
    assert sum(name.startswith("/ghosts/") for name in names_drawn) == min(len(page.solutions), 10)
    assert any(name.startswith("/beside/robot/") for name in names_drawn)
    assert "enhanced-dls" in page._panel._comparison_html.content
    page.show_ghosts(False)
    page.compare("none")
    assert page.work.settle(300)
    left = set(scene._handle_from_node_name)
    assert not any(name.startswith(("/ghosts/", "/beside")) for name in left)


def test_undo_and_redo(cup: Any) -> None:
    page = cup.page
    poses = [page.request.object_pose[:3, 3]]
    for step in (0.01, 0.02):
        page.drag("object", shifted(page.request.object_pose, 0.0, step, 0.0))
        assert page.work.settle(300)
        poses.append(page.request.object_pose[:3, 3])
    for do, expected in ((page.undo, 1), (page.undo, 0), (page.redo, 1), (page.reset, 0)):
        do()
        assert page.work.settle(300)
        assert np.allclose(page.request.object_pose[:3, 3], poses[expected])
        assert page.result.success


def test_dragged_object_stays_grasped(cup: Any) -> None:
    page = cup.page
    start, point_before = page.request.object_pose, page.request.grasp.contacts["thumb"].point
    for angle in np.linspace(0.0, 2 * np.pi, 12):
        page.drag("object", shifted(start, *(0.05 * np.cos([angle, angle - 1.6, 2 * angle]))))
        assert page.work.settle(300)
        assert page.result.success
        shift = page.request.object_pose[:3, 3] - start[:3, 3]
        assert np.allclose(page.request.grasp.contacts["thumb"].point - point_before, shift)


def test_written_page_needs_no_server(cup: Any, tmp_path: Path) -> None:
    text = cup.to_html(tmp_path / "scene.html")
    assert (tmp_path / "scene.html").read_text(encoding="utf-8") == text
    assert "<title>cup</title>" in text
    assert "__VISER_EMBED_DATA__" in text
    assert not re.search(r'(src|href)="https?://', text)


def test_robot_grasp_and_scene_can_be_opened(view: Any) -> None:
    viewer = view("cup")
    assert "collision not checked" in viewer.page.result.sentence
    opened = (
        ({"scene": "table"}, "cup", "table"),
        ({"grasp": "mug"}, "mug", "table"),
        ({"robot": "ar10"}, "", "table"),
        ({"scene": ""}, "", None),
    )
    for expected_robot, grasp, scene in opened:
        page_before = viewer.page
        page_before.open(**expected_robot)
        end = time.monotonic() + 300
        while viewer.page is page_before and time.monotonic() < end:
            time.sleep(0.02)
        page = viewer.page
        assert page is not page_before
        assert page.work.settle(300)
        assert page.request.name == grasp
        assert (page.request.scene and page.request.scene.name) == scene
        assert page.result.success
    viewer.page.open(robot="no such robot")
    assert viewer.page.work.settle(300)
    assert viewer.page.robot.name == "ar10"


def test_moved_scene_is_saved(cup: Any, tmp_path: Path) -> None:
    page = cup.page
    page.drag("table", shifted(page.request.scene.items["table"].pose, 0.1, 0.0, -0.05))
    assert page.work.settle(300)
    (tmp_path / "moved.yaml").write_text(page.request.scene.text())
    saved_scene = ik.load_scene(tmp_path / "moved.yaml")
    assert np.allclose(saved_scene.items["table"].pose, page.request.scene.items["table"].pose)


def test_manually_moved_motors_are_judged_not_solved(cup: Any) -> None:
    page = cup.page
    q = page.result.q.copy()
    q[0] += 0.2
    page.drag_motors(q)
    assert page.work.settle(300)
    assert np.array_equal(page.result.q, q)
    assert page.result.headline == "NOT MET"
    assert all(verdict.position_error > 5e-3 for verdict in page.result.verdicts.values())


def test_settings_reach_the_solver(cup: Any) -> None:
    page = cup.page
    tight = ik.Tolerance(1e-6, 1e-6)
    tightly = replace(page.request.settings, tolerance=tight, prefer="limits")
    page.change("settings", lambda request: replace(request, settings=tightly))
    assert page.work.settle(300)
    assert page.result.success
    assert {verdict.tolerance for verdict in page.result.verdicts.values()} == {tight}
    assert max(verdict.position_error for verdict in page.result.verdicts.values()) <= 1e-6


def test_solver_moves_scene_objects(robot: ik.ArmHand) -> None:
    solver, grasp = ik.Solver(robot, scene=ik.load_scene("table")), ik.load_grasp("cup")
    pose = shifted(solver.scene.items["table"].pose, -1.3, 0.0, 0.36)
    moved_solver = solver.moved("table", pose)
    fresh = ik.Solver(robot, scene=solver.scene.moved("table", pose))
    moved_solution, fresh_solution = moved_solver.solve(grasp), fresh.solve(grasp)
    assert np.array_equal(moved_solution.q, fresh_solution.q)
    assert moved_solution.clearance == fresh_solution.clearance
    assert moved_solution.status is ik.Status.COLLISION
    assert solver.solve(grasp).success
    with pytest.raises(errors.InputError, match="has no scene"):
        ik.Solver(robot).moved("table", pose)
