"""Viewer files and logs, read by the libraries of Foxglove and Lichtblick."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
from mcap.reader import make_reader
from viewer_reader import Decoded, decode, layout_of, matrix, shipped_layout, write_view

import casadi_ik as ik
from casadi_ik import errors, logs


@pytest.fixture(scope="module")
def solve(tmp_path_factory: pytest.TempPathFactory, robot: ik.ArmHand) -> logs.SolveRecord:
    path = tmp_path_factory.mktemp("log") / "mug.mcap"
    solver = ik.Solver(robot, method="enhanced-dls", finger_step="closed-form")
    solver.solve(ik.load_grasp("mug"), log=path)
    return logs.one_solve(logs.open(path))


@pytest.fixture(scope="module")
def view(
    tmp_path_factory: pytest.TempPathFactory, solve: logs.SolveRecord, robot: ik.ArmHand
) -> Path:
    path = tmp_path_factory.mktemp("view") / "mug.mcap"
    write_view(path, solve, robot)
    return path


@pytest.fixture(scope="module")
def decoded(view: Path) -> Decoded:
    return decode(view)


def test_topics_and_times(decoded: Decoded, solve: logs.SolveRecord) -> None:
    assert decoded.schemas == {
        "/robot_description": "std_msgs/msg/String",
        "/tf": "foxglove.FrameTransforms",
        "/joint_states": "sensor_msgs/msg/JointState",
        "/ik/targets": "foxglove.SceneUpdate",
        "/ik/contacts": "foxglove.SceneUpdate",
        "/ik/iteration": "casadi_ik/msg/IterationEnhancedDlsQ14F3J5",
        "/ik/messages": "foxglove.Log",
    }
    expected = [solve.started + 10_000_000 * i for i in range(len(solve.rows))]
    for topic in ("/tf", "/joint_states", "/ik/contacts", "/ik/iteration"):
        assert [time for time, _ in decoded.topics[topic]] == expected
    for topic in ("/robot_description", "/ik/targets"):
        assert [time for time, _ in decoded.topics[topic]] == expected[:1]


def test_frames_are_where_the_robot_was(
    decoded: Decoded, solve: logs.SolveRecord, robot: ik.ArmHand
) -> None:
    for row in (0, len(solve.rows) // 2, -1):
        frames = decoded.frames(row)
        links = robot.links(solve.rows["q"][row])
        for name, pose in links.items():
            np.testing.assert_allclose(frames[name], pose, atol=1e-12)
        points, _ = robot.contacts(solve.rows["q"][row])
        for finger, point in zip(robot.fingers, points, strict=True):
            np.testing.assert_allclose(frames[f"{finger}_contact"][:3, 3], point, atol=1e-12)


def test_urdf_and_joint_states_give_the_same_frames(decoded: Decoded) -> None:
    """The URDF in pinocchio at the joint states gives the frames of the transforms."""
    model = pinocchio.buildModelFromXML(decoded.last("/robot_description").data)
    data = model.createData()
    state = decoded.last("/joint_states")
    theta = dict(zip(state.name, state.position, strict=True))
    q = np.array([theta[name] for name in list(model.names)[1:]])
    pinocchio.framesForwardKinematics(model, data, q)
    for name, pose in decoded.frames(-1).items():
        np.testing.assert_allclose(data.oMf[model.getFrameId(name)].homogeneous, pose, atol=1e-9)


def test_iterations_are_those_of_the_log(decoded: Decoded, solve: logs.SolveRecord) -> None:
    messages = [message for _, message in decoded.topics["/ik/iteration"]]
    for name in ("q", "position_error", "sigma_thumb", "phase"):
        values = np.array([getattr(message, name) for message in messages])
        np.testing.assert_array_equal(values, solve.rows[name])


def test_reached_contacts_turn_green(decoded: Decoded, solve: logs.SolveRecord) -> None:
    def green(message: Any) -> list[bool]:
        return [entity.arrows[0].color.g > 0.5 for entity in message.entities]

    contacts = [green(message) for _, message in decoded.topics["/ik/contacts"]]
    is_reached = (solve.rows["position_error"] <= solve.position_tolerance) & (
        solve.rows["angle_error"] <= solve.angle_tolerance
    )
    np.testing.assert_array_equal(contacts, is_reached)
    assert contacts[-1] == [True, True, True]
    assert contacts[0] == [False, False, False]
    targets = decoded.last("/ik/targets").entities
    assert [entity.id for entity in targets] == [f"{name} target" for name in solve.fingers]
    for entity, point, normal in zip(
        targets, solve.target_points, solve.target_normals, strict=True
    ):
        pose = matrix(entity.arrows[0].pose.position, entity.arrows[0].pose.orientation)
        np.testing.assert_allclose(pose[:3, [3, 0]].T, [point, normal], atol=1e-12)


def test_messages_describe_the_solve(decoded: Decoded, solve: logs.SolveRecord) -> None:
    lines = [message.message for _, message in decoded.topics["/ik/messages"]]
    assert lines[0] == "enhanced-dls on kuka_lwr_barrett, solve 1"
    assert "thumb-reaching" in lines
    assert "hand-alignment" in lines
    assert f"SOLVED after {len(solve.rows)} iterations" in lines
    assert re.fullmatch(r"finger_3 off by \d\.\d\d mm and \d\.\d\d deg", lines[-1])
    expected = sum(event.kind != "PHASE_CHANGE" for event in solve.events)
    assert len(lines) == 2 + len(solve.phase_spans) + expected + len(solve.fingers)


def test_free_contacts_are_left_out(
    solve: logs.SolveRecord, robot: ik.ArmHand, tmp_path: Path
) -> None:
    points, normals = solve.target_points.copy(), solve.target_normals.copy()
    points[1] = normals[1] = normals[2] = np.nan
    freed = dataclasses.replace(solve, target_points=points, target_normals=normals)
    write_view(tmp_path / "view.mcap", freed, robot)
    decoded = decode(tmp_path / "view.mcap")
    colors = [entity.spheres[0].color for entity in decoded.last("/ik/contacts").entities]
    assert [color.r == color.g == color.b for color in colors] == [False, True, False]
    entities = decoded.last("/ik/targets").entities
    assert [(entity.id, len(entity.arrows)) for entity in entities] == [
        ("thumb target", 1),
        ("finger_3 target", 0),
    ]


def test_another_robot_is_refused(robot: ik.ArmHand) -> None:
    urdf = robot.urdf()
    logs.solve.check_robot(robot, urdf, "cup.mcap")
    number = next(word for word in re.findall(r"\d+\.\d{6,}", urdf))
    logs.solve.check_robot(robot, urdf.replace(number, f"{float(number) + 1e-13}"), "cup.mcap")
    for changed_urdf in (
        urdf.replace(number, f"{float(number) + 1e-3}"),
        urdf.replace("bh_", "hand_"),
    ):
        with pytest.raises(errors.LogError, match=r"cup\.mcap: robot 'kuka_lwr_barrett'"):
            logs.solve.check_robot(robot, changed_urdf, "cup.mcap")


def test_nothing_to_show_and_nowhere_to_write(
    solve: logs.SolveRecord, robot: ik.ArmHand, tmp_path: Path
) -> None:
    empty = dataclasses.replace(solve, rows=solve.rows[:0])
    with pytest.raises(errors.LogError, match="solve 1 of "):
        write_view(tmp_path / "view.mcap", empty, robot)
    with pytest.raises(errors.LogError, match=r"file:.*No such file"):
        write_view(tmp_path / "nowhere" / "view.mcap", solve, robot)
    assert list(tmp_path.iterdir()) == []


def test_the_shipped_layout_is_the_one_of_the_shipped_robot(
    solve: logs.SolveRecord, robot: ik.ArmHand
) -> None:
    assert layout_of(solve, robot) == json.loads(shipped_layout().read_text())


def test_every_path_of_the_layout_is_in_the_file(view: Path, decoded: Decoded) -> None:
    layout = json.loads(shipped_layout().read_text())
    panels = layout["configById"]

    def leaves(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(panels)
    with view.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert set(panels["3D!robot"]["topics"]) <= topics
    assert panels["RosOut!messages"]["topicToRender"] in topics
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert len(paths) > 20
    for path in paths:
        match = re.fullmatch(r"(/[a-z_/]+)\.([a-z_0-9]+)(?:\[(\d+)\])?", path)
        assert match is not None
        value = getattr(decoded.last(match[1]), match[2])
        assert match[3] is None or len(value) > int(match[3])
