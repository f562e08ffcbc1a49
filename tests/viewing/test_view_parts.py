"""Parts of pages: requests after a drag, the worker, surfaces, and saved texts."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.app.drawing import MESHES_VARIABLE
from casadi_ik.app.drawing.drawables import collision_bodies, item_drawables, visual_bodies
from casadi_ik.app.drawing.surfaces import arrow, split_sharp_edges
from casadi_ik.app.viewer import request_of
from casadi_ik.app.viewer.camera import cameras
from casadi_ik.app.viewer.pad_page import LinkPad, save_pads, with_corrected_pad
from casadi_ik.app.viewer.page import IDLE_DELAY, LatestOnly
from casadi_ik.app.viewer.panel import grasp_text
from casadi_ik.app.viewer.viser_scene import pose_of, quaternions
from casadi_ik.compile.cancellation import stop_if_cancelled
from casadi_ik.files.reading import Frame, frame_matrix


def rotated_pose(x: float, y: float, z: float, *angles: float) -> np.ndarray:
    return frame_matrix(Frame((x, y, z), angles or (0.3, -0.2, 0.9)))


def test_quaternions_of_any_rotation(rng: np.random.Generator) -> None:
    axes = rng.normal(size=(200, 3))
    angles = np.concatenate([rng.uniform(-np.pi, np.pi, 196), [0.0, np.pi, -np.pi, 1e-9]])
    half_angles = angles[:, None] / 2
    wxyz = np.hstack(
        [
            np.cos(half_angles),
            np.sin(half_angles) * axes / np.linalg.norm(axes, axis=1, keepdims=True),
        ]
    )
    poses = np.array([pose_of(np.zeros(3), quaternion) for quaternion in wxyz])
    poses_again = np.array(
        [pose_of(np.zeros(3), quaternion) for quaternion in quaternions(poses[:, :3, :3])]
    )
    assert np.allclose(poses_again, poses, atol=1e-12)


def test_each_hand_has_a_camera() -> None:
    robot = ik.load_robot("g1+dex3")
    found_cameras = cameras(robot, robot.home)
    assert list(found_cameras) == ["Robot", "Left", "Right"]
    for side, fingers in robot.hands.items():
        camera = found_cameras[side.capitalize()]
        tips = robot.contacts(robot.home)[0]
        is_in_view = np.linalg.norm(tips - camera.target, axis=1) < camera.radius
        assert [i for i, is_near in enumerate(is_in_view) if is_near] == list(fingers)
        assert camera.radius < 0.5 * found_cameras["Robot"].radius


def test_one_finger_may_be_free_but_not_all(robot: ik.ArmHand) -> None:
    request = request_of(robot, ik.load_grasp("cup"), None)
    for finger in robot.fingers[:-1]:
        request = request.with_use(finger, is_used=False, uses_normal=True)
    last = robot.fingers[-1]
    assert set(request.grasp.contacts) == {last}
    assert set(request.with_use(last, is_used=False, uses_normal=True).grasp.contacts) == {last}
    loose = request.with_use(last, is_used=True, uses_normal=False).grasp.contacts[last]
    assert loose.normal is None


@pytest.mark.parametrize(
    "vectors",
    [{"normal": [0, 0, 1]}, {"line": [0, 0, 1]}, {"plane": [0, 0, 1]}, {"ball": [0, 0, 1]}],
)
def test_every_contact_kind_is_requested_and_turned(robot: ik.ArmHand, vectors) -> None:
    (kind,), contact = vectors, ik.Contact([0.3, 0.1, 0.5], **vectors)
    request = request_of(robot, ik.Grasp({"thumb": contact}), None)
    contact_read = request.grasp.contacts["thumb"]
    for name in ("point", "normal", "line", "plane", "ball"):
        vector, vector_read = getattr(contact, name), getattr(contact_read, name)
        assert (vector is None) == (vector_read is None)
        assert vector is None or np.allclose(vector, vector_read, atol=1e-12)
    turn = rotated_pose(0.0, 0.0, 0.0)
    turned_contact = request.with_pose("thumb", turn @ request.poses["thumb"]).grasp.contacts[
        "thumb"
    ]
    assert np.allclose(getattr(turned_contact, kind), turn[:3, :3] @ [0, 0, 1], atol=1e-12)
    if kind in ("normal", "ball"):  # they have an arrow, which is where the hand takes it
        faced = request.with_normal("thumb", np.array([0.6, 0.0, 0.8])).grasp.contacts["thumb"]
        assert np.allclose(getattr(faced, kind), [0.6, 0.0, 0.8], atol=1e-12)


def test_saved_grasp_is_read_back(robot: ik.ArmHand, tmp_path: Path) -> None:
    shipped = ik.load_grasp("cup")
    special = ik.Contact([1 / 3, 0.1, -0.2], [0, 0, 1], ik.Tolerance(1e-3, 0.02), tangent=[1, 0, 0])
    contacts = dict(shipped.contacts) | {
        "finger_2": special,
        "finger_3": ik.Contact(direction=[0.0, 1.0, 0.5]),
    }
    grasp = ik.Grasp(contacts, "kuka_lwr_barrett", "mine", "cup", rotated_pose(0.1, 0.2, 0.3))
    path = tmp_path / "mine.yaml"
    path.write_text(grasp_text(grasp, "a comment"), encoding="utf-8")
    saved_grasp = ik.load_grasp(path)
    assert (saved_grasp.robot, saved_grasp.object, saved_grasp.name) == (
        grasp.robot,
        grasp.object,
        "mine",
    )
    assert np.allclose(saved_grasp.object_pose, grasp.object_pose, atol=1e-12)
    for finger, contact in grasp.contacts.items():
        contact_read = saved_grasp.contacts[finger]
        for name in ("point", "normal", "tangent", "line", "plane"):
            vector, vector_read = getattr(contact, name), getattr(contact_read, name)
            assert (vector is None) == (vector_read is None)
            assert vector is None or np.allclose(vector, vector_read, atol=1e-15, equal_nan=True)
        assert contact_read.tolerance == contact.tolerance


def test_only_the_newest_change_is_applied() -> None:
    begun, go_on, done = threading.Event(), threading.Event(), []

    def first() -> None:
        begun.set()
        go_on.wait(120)
        done.append("first")

    work = LatestOnly(lambda: done.append("drawn"), ((IDLE_DELAY, lambda: done.append("later")),))
    work.submit("thumb", first)
    assert begun.wait(120)
    for i in range(5):
        work.submit("thumb", lambda i=i: done.append(f"thumb {i}"))
    work.submit("cup", lambda: done.append("cup"))
    go_on.set()
    assert work.settle(300)
    # The first was running; of the five waiting ones the last is run, and drawn once with "cup".
    assert done == ["first", "drawn", "thumb 4", "cup", "drawn", "later"]
    assert work.dropped_count == 4
    work.stop()


def test_deferred_work_is_cancelled() -> None:
    begun, done = threading.Event(), []

    def long() -> None:
        begun.set()
        while not done:
            stop_if_cancelled()
            time.sleep(0.001)
        done.append("later")

    work = LatestOnly(lambda: None, ((IDLE_DELAY, long),))
    work.submit("thumb", lambda: None)
    assert begun.wait(120)
    work.submit("thumb", lambda: done.append("thumb"))
    assert work.settle(300)
    assert done == ["thumb", "later"]
    work.stop()


def test_failing_change_does_not_end_the_page(caplog: pytest.LogCaptureFixture) -> None:
    done = []
    work = LatestOnly(lambda: done.append("drawn"))
    work.submit("bad", lambda: 1 / 0)
    assert work.settle(300)
    work.submit("good", lambda: done.append("good"))
    assert work.settle(300)
    assert done == ["drawn", "good", "drawn"]
    assert "ZeroDivisionError" in caplog.text
    work.stop()


def test_bodies_are_closed_and_wind_outwards() -> None:
    scene = ik.Scene(
        {
            "box": {"kind": "box", "size": [0.1, 0.2, 0.3]},
            "drum": {"kind": "cylinder", "radius": 0.1, "length": 0.2},
            "ball": {"kind": "sphere", "radius": 0.1},
            "tube": {"kind": "capsule", "radius": 0.1, "length": 0.2},
            "floor": {"kind": "half-space"},
            "seen": {"kind": "point-cloud", "radius": 0.01, "points": [[0.1, 0, 0], [0, 0.1, 0]]},
            "banana": {"kind": "object", "object": "banana"},
            "can": {"kind": "object", "object": "mustard_bottle"},
        }
    )
    drawables = [drawable for item in scene.items.values() for drawable in item_drawables(item)]
    surfaces = [drawable.surface for drawable in drawables]
    for body in [*surfaces, arrow(np.zeros(3), np.array([1.0, 0, 0]), 0.05, 0.005).surface]:
        for surface in (body, split_sharp_edges(body)):
            a, b, c = (surface.points[surface.triangles[:, i]] for i in range(3))
            assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 > 0
            # The area vectors of a closed surface sum to zero.
            assert np.allclose(np.cross(b - a, c - a).sum(axis=0), 0, atol=1e-9)


def test_unstated_pads_are_not_written(description: Path) -> None:
    text = description.read_text()
    with pytest.raises(ik.errors.DescriptionError, match=r"fingers\.third"):
        save_pads(description, {"third": LinkPad(np.zeros(3), np.array([1.0, 0.0, 0.0]))})
    assert description.read_text() == text
    with pytest.raises(ik.errors.DescriptionError, match=r"fingers\.third:"):
        with_corrected_pad(text, "third", np.zeros(3), np.ones(3))


def test_links_look_like_their_files(description: Path) -> None:
    surfaces = {body.name: body.surface for body in visual_bodies(ik.load_robot(description))}
    assert {"pad first", "pad second"} <= set(surfaces)
    for link in ("first_2", "second_2"):
        assert np.allclose(np.ptp(surfaces[link].points, axis=0), [0.02, 0.016, 0.04])
        assert np.allclose(surfaces[link].points.mean(axis=0), [0, 0, 0.02])


def test_visual_meshes_can_be_disabled(description: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = ik.load_robot(description)
    monkeypatch.setenv(MESHES_VARIABLE, "off")
    shapes = {body.frame: body.surface for body in collision_bodies(robot)}
    for body in visual_bodies(robot):
        if body.role != "pad" and body.frame in shapes:
            assert np.allclose(body.surface.points, shapes[body.frame].points)
    monkeypatch.delenv(MESHES_VARIABLE)
    surfaces = {body.name: body.surface for body in visual_bodies(robot)}
    assert np.allclose(np.ptp(surfaces["first_2"].points, axis=0), [0.02, 0.016, 0.04])
