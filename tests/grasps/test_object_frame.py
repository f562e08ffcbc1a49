"""Grasps in the frame of a placed object."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import casadi_ik as ik

turns = st.floats(-3.1, 3.1)
shifts = st.floats(-2.0, 2.0)


def pose_of(shift, rpy):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), shift
    return pose


poses = st.builds(pose_of, st.tuples(*[shifts] * 3), st.tuples(*[turns] * 3))

ALL_KINDS = ik.Grasp(
    {
        "a": ik.Contact([0.1, 0.2, 0.3], [0, 0, 2], ik.Tolerance(1e-3, 0.1), tangent=[1, 0, 0]),
        "b": ik.Contact([0.0, 0.1, 0.0], [1, 1, 0], line=[0, 1, 1]),
        "c": ik.Contact([0.3, 0.0, 0.1], plane=[0, 0, 1]),
        "d": ik.Contact(direction=[0, 1, 0]),
    },
    object="cup",
)
FINGERS = ("a", "b", "c", "d", "free")


def assert_same(grasp: ik.Grasp, other_grasp: ik.Grasp) -> None:
    arrays = (*grasp.arrays(FINGERS), *grasp.extra_vectors(FINGERS).values())
    other_arrays = (*other_grasp.arrays(FINGERS), *other_grasp.extra_vectors(FINGERS).values())
    for left, right in zip(arrays, other_arrays, strict=True):
        np.testing.assert_allclose(left, right, atol=1e-12)


@given(poses)
def test_points_and_directions_go_with_the_object(pose):
    placed = ALL_KINDS.at(pose)
    np.testing.assert_allclose(
        placed.contacts["a"].point, (pose @ [0.1, 0.2, 0.3, 1.0])[:3], atol=1e-12
    )
    for finger, name, given_as in (
        ("a", "normal", [0, 0, 1]),
        ("a", "tangent", [1, 0, 0]),
        ("b", "line", [0, np.sqrt(0.5), np.sqrt(0.5)]),
        ("c", "plane", [0, 0, 1]),
        ("d", "normal", [0, 1, 0]),
    ):
        vector = getattr(placed.contacts[finger], name)
        np.testing.assert_allclose(vector, pose[:3, :3] @ given_as, atol=1e-12)
    assert placed.contacts["a"].tolerance == ik.Tolerance(1e-3, 0.1)
    assert placed.contacts["c"].normal is None
    np.testing.assert_allclose(placed.object_pose, pose)


@given(poses, poses)
def test_successive_poses_compose(first, then):
    assert_same(ALL_KINDS.at(first).at(then), ALL_KINDS.at(then @ first))


@given(poses)
def test_inverse_pose_restores_the_grasp(pose):
    assert_same(ALL_KINDS.at(pose).at(np.linalg.inv(pose)), ALL_KINDS)
    assert_same(ALL_KINDS.at(pose).in_object_frame(), ALL_KINDS)


def test_grasp_moves_with_its_object(robot):
    grasp = ik.load_grasp("cup")
    object_pose = np.eye(4)
    object_pose[:3, 3] = [0.02, -0.03, 0.04]
    assert grasp.object_pose is not None
    moved_grasp = grasp.in_object_frame().at(object_pose @ grasp.object_pose)
    assert_same(
        ik.Grasp(dict(zip(FINGERS, moved_grasp.contacts.values(), strict=False))),
        ik.Grasp(dict(zip(FINGERS, grasp.at(object_pose).contacts.values(), strict=False))),
    )
    assert ik.Solver(robot).solve(moved_grasp).success


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        (np.eye(3), r"pose: found shape \(3, 3\), expected \(4, 4\)"),
        (np.stack([np.eye(4)] * 2), r"pose: found shape \(2, 4, 4\)"),
        (np.full((4, 4), np.nan), "pose: holds NaN"),
        (2 * np.eye(4), "pose: .* not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "pose: .* not a rotation"),
        ("here", "pose: expected an array"),
        (np.vstack([np.eye(4)[:3], [0.5, 0, 0, 1]]), "pose: .*last row"),
    ],
)
def test_malformed_poses_are_refused(pose, says):
    with pytest.raises(ik.errors.InputError, match=says):
        ALL_KINDS.at(pose)


def test_deprecated_names_return_the_same_as_the_new_ones():
    contact, pose = ALL_KINDS.contacts["a"], pose_of([1.0, 0.0, 0.2], [0.3, 0.1, 2.0])
    with pytest.warns(DeprecationWarning, match="transformed"):
        assert np.array_equal(contact.at(pose).point, contact.transformed(pose).point)
    with pytest.warns(DeprecationWarning, match="from_pose"):
        whole_pose = ik.Contact.at(pose)
    assert np.array_equal(whole_pose.tangent, ik.Contact.from_pose(pose).tangent)
    with pytest.warns(DeprecationWarning, match="extra_vectors"):
        assert ALL_KINDS.more(FINGERS).keys() == ALL_KINDS.extra_vectors(FINGERS).keys()
