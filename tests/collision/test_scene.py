"""Scenes are read, moved, and refused in one line."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from capsule_arm import SCENE, write_robot

import casadi_ik as ik
from casadi_ik import errors

DescriptionError, InputError = errors.DescriptionError, errors.InputError
UnknownNameError = errors.UnknownNameError

BOX = {"kind": "box", "size": [1, 1, 1]}


@pytest.mark.parametrize(
    ("solids", "message"),
    [
        ({"a": {"kind": "box", "size": [1, float("nan"), 1]}}, r"solids.a.size\[1\]: found nan"),
        ({"a": {"kind": "box", "size": [1, 0, 1]}}, r"solids.a.size\[1\]: found 0, expected > 0"),
        ({"a": {"kind": "ball", "radius": 1}}, "solids.a.kind: .*'ball'"),
        ({"a": {"kind": "sphere", "radius": "3 stone"}}, "solids.a.radius: found '3 stone'"),
        ({"a": {"kind": "object", "object": "teapot"}}, "solids.a.object: no shipped object"),
        ({"a": {"kind": "mesh", "file": "no.stl"}}, "solids.a.file: no such file"),
        ({"a": {"kind": "convex", "points": [[0, 0, 0]] * 3}}, "found 3 points, expected at least"),
        (
            {"a": {"kind": "convex", "points": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]}},
            "coplanar",
        ),
    ],
)
def test_bad_solids_are_named(solids, message):
    with pytest.raises(DescriptionError, match=message) as caught:
        ik.Scene(solids)
    assert "\n" not in str(caught.value)


def test_an_empty_mesh_is_refused(tmp_path):
    path = tmp_path / "empty.stl"
    path.write_text("solid empty\nendsolid empty\n")
    with pytest.raises(DescriptionError, match="empty"):
        ik.Scene({"a": {"kind": "mesh", "file": str(path)}})


def test_grasped_object_must_exist():
    with pytest.raises(DescriptionError, match=r"grasped:.*'cup'"):
        ik.Scene({"a": BOX}, grasped="cup")
    with pytest.raises(DescriptionError, match=r"margin:.*-1.*>= 0"):
        ik.Scene(margin=-1)


def test_shipped_and_unknown_scenes():
    assert list(ik.load_scene("table").items) == ["table"]
    with pytest.raises(UnknownNameError, match="'moon'; shipped:"):
        ik.load_scene("moon")


def test_scene_errors_name_the_file(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text("solids:\n  a: {kind: box, size: [1 m, 1 m, 1 deg]}\n")
    with pytest.raises(DescriptionError, match=r"scene.yaml: solids.a.size\[2\]: found '1 deg'"):
        ik.load_scene(path)


def test_moving_an_object_copies_the_scene():
    scene = ik.Scene({"a": BOX}, margin=0.01)
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    moved_scene = scene.moved("a", pose)
    np.testing.assert_array_equal(moved_scene.items["a"].pose, pose)
    np.testing.assert_array_equal(scene.items["a"].pose, np.eye(4))
    assert pickle.loads(pickle.dumps(moved_scene)).margin == 0.01
    with pytest.raises(UnknownNameError, match=r"'b'"):
        scene.moved("b", pose)
    with pytest.raises(InputError, match="is not a rotation"):
        scene.moved("a", np.ones((4, 4)))


def test_obstacles_at_the_base_are_refused(tmp_path):
    robot = ik.load_robot(write_robot(tmp_path))
    post_in_base = {"post": {"kind": "box", "size": [0.1, 0.1, 0.1], "xyz": [0, 0, 0.1]}}
    with pytest.raises(DescriptionError, match=r"solids.post:.*'base'"):
        ik.Solver(robot, scene=ik.Scene(post_in_base))
    post_in_base["post"]["xyz"][0] = 0.05 - 1e-5
    with pytest.raises(DescriptionError, match=r"solids.post:.*'base'"):
        ik.Solver(robot, scene=ik.Scene(post_in_base))
    with pytest.raises(DescriptionError, match=r"touching.*'moon' is unknown"):
        ik.Solver(robot, scene=ik.Scene(SCENE, touching=[{"links": ["moon", "l1"], "reason": "x"}]))


def test_a_scene_before_a_robot_with_one_motor():
    """A configuration of one entry also has the shape of a batch of scalars."""
    robot = ik.load_robot("robotiq_2f85")
    points, normals = robot.contacts(q := np.array([0.4]))
    contacts = [ik.Contact(*contact) for contact in zip(points, normals, strict=True)]
    grasp = ik.Grasp(dict(zip(robot.fingers, contacts, strict=True)))
    far = {"post": {"kind": "box", "size": [0.1, 0.1, 0.1], "xyz": [0, 0, 1.0]}}
    solution = ik.Solver(robot, scene=ik.Scene(far)).solve(grasp)
    assert solution.success
    np.testing.assert_allclose(solution.q, q, atol=0.05)
    at_pad = {"post": {"kind": "box", "size": [0.05, 0.05, 0.05], "xyz": points[0]}}
    solution = ik.Solver(robot, scene=ik.Scene(at_pad)).solve(grasp)
    assert not solution.success
    assert solution.status is ik.Status.COLLISION
