"""Viewer files and logs, read by what Foxglove and Lichtblick are made of."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
from made_up_solves import make_block
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
    """The URDF as pinocchio reads it, set to the joint states, agrees with the transforms."""
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
        found = np.array([getattr(message, name) for message in messages])
        np.testing.assert_array_equal(found, solve.rows[name])


def test_contacts_turn_green_when_they_are_reached(
    decoded: Decoded, solve: logs.SolveRecord
) -> None:
    def green(message: Any) -> list[bool]:
        return [entity.arrows[0].color.g > 0.5 for entity in message.entities]

    contacts = [green(message) for _, message in decoded.topics["/ik/contacts"]]
    reached = (solve.rows["position_error"] <= solve.position_tolerance) & (
        solve.rows["angle_error"] <= solve.angle_tolerance
    )
    np.testing.assert_array_equal(contacts, reached)
    assert contacts[-1] == [True, True, True]
    assert contacts[0] == [False, False, False]
    targets = decoded.last("/ik/targets").entities
    assert [entity.id for entity in targets] == [f"{name} target" for name in solve.fingers]
    for entity, point, normal in zip(
        targets, solve.target_points, solve.target_normals, strict=True
    ):
        pose = matrix(entity.arrows[0].pose.position, entity.arrows[0].pose.orientation)
        np.testing.assert_allclose(pose[:3, [3, 0]].T, [point, normal], atol=1e-12)


def test_messages_tell_the_story(decoded: Decoded, solve: logs.SolveRecord) -> None:
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
    for other in (urdf.replace(number, f"{float(number) + 1e-3}"), urdf.replace("bh_", "hand_")):
        with pytest.raises(errors.LogError, match=r"cup\.mcap: robot 'kuka_lwr_barrett'"):
            logs.solve.check_robot(robot, other, "cup.mcap")


def test_nothing_to_show_and_nowhere_to_write(
    solve: logs.SolveRecord, robot: ik.ArmHand, tmp_path: Path
) -> None:
    empty = dataclasses.replace(solve, rows=solve.rows[:0])
    with pytest.raises(errors.LogError, match="solve 1 of "):
        write_view(tmp_path / "view.mcap", empty, robot)
    with pytest.raises(errors.LogError, match="cannot write the viewer file: No such file"):
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


PACKAGES = (
    "@mcap/core@2.2.2",
    "@foxglove/rosmsg@5.0.5",
    "@foxglove/rosmsg2-serialization@3.1.0",
    "fzstd@0.1.1",
    "protobufjs@7.4.0",
)


@pytest.fixture(scope="module")
def packages() -> Path:
    """A folder with the packages, made once per machine; without node or registry, no test."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("needs node and npm")
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    folder = cache / "casadi_ik_tests" / "-".join(name.rpartition("@")[2] for name in PACKAGES)
    if not (folder / "complete").exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [npm, "install", "--no-audit", "--no-fund", "--prefix", folder, *PACKAGES]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=120)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            pytest.skip(f"npm cannot install: {error}")
        (folder / "complete").touch()
    return folder


def read(packages: Path, path: Path) -> list[dict[str, Any]]:
    """Topic, time and values of every message, by time."""
    script = Path(__file__).parent / "read_log.mjs"
    done = subprocess.run(
        ["node", script, packages, path], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def numbers(value: Any) -> np.ndarray:
    """Numbers as the script prints them."""
    names = {"NaN": np.nan, "Infinity": np.inf, "-Infinity": -np.inf}
    items = value if isinstance(value, list) else [value]
    return np.array([names[x] if isinstance(x, str) else x for x in items], dtype=float)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_mcap_core_and_rosmsg2_serialization(
    packages: Path, tmp_path: Path, write: Callable[..., Path], compression: str
) -> None:
    path = write(make_block(40, 7), urdf="<robot/>", compression=compression)
    messages = read(packages, path)
    log = logs.open(path)
    for kind, table in (
        ("iteration", log.iterations()),
        ("solve", log.solves()),
        ("event", log.events()),
    ):
        found = [m for m in messages if m["topic"] == f"/ik/enhanced-dls/{kind}"]
        assert len(found) == len(table) > 0
        for message, row in zip(found, table.rows, strict=True):
            for name in table.names:
                np.testing.assert_array_equal(numbers(message["values"][name]), row[name].ravel())
    times = [int(message["time"]) for message in messages]
    assert times == sorted(times)


def test_the_viewer_file(packages: Path, view: Path, decoded: Decoded) -> None:
    """Every message of every topic is deserialised, to the same values."""
    topics: dict[str, list[dict[str, Any]]] = {}
    for message in read(packages, view):
        topics.setdefault(message["topic"], []).append(message["values"])
    assert {name: len(found) for name, found in topics.items()} == {
        name: len(found) for name, found in decoded.topics.items()
    }
    ours = {name: decoded.topics[name][-1][1] for name in topics}
    theirs = {name: found[-1] for name, found in topics.items()}
    assert theirs["/robot_description"]["data"] == ours["/robot_description"].data
    assert theirs["/joint_states"]["name"] == list(ours["/joint_states"].name)
    for topic, name in (("/joint_states", "position"), ("/ik/iteration", "q")):
        np.testing.assert_array_equal(
            numbers(theirs[topic][name]), np.asarray(getattr(ours[topic], name))
        )
    for message, expected in zip(
        theirs["/ik/targets"]["entities"], ours["/ik/targets"].entities, strict=True
    ):
        position, ours_at = message["spheres"][0]["pose"]["position"], expected.spheres[0].pose
        assert message["id"] == expected.id
        assert [position[axis] for axis in "xyz"] == [
            getattr(ours_at.position, axis) for axis in "xyz"
        ]
    children = [frame["child_frame_id"] for frame in theirs["/tf"]["transforms"]]
    assert children == [frame.child_frame_id for frame in ours["/tf"].transforms]
    assert theirs["/ik/messages"]["message"] == ours["/ik/messages"].message
