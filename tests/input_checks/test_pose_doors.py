"""Every entrance for poses takes rounded rotations, and refuses others with one class of error."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import MAX_SKEW, checked_pose, matrix_skew
from casadi_ik.papers.chandra.calibration import read_measurements

POINT = np.array([0.4, 0.1, 0.3])
BOX = {"kind": "box", "size": [0.1, 0.1, 0.1]}
CONTACT = ik.Contact([0.0, 0.0, 0.1], normal=[1, 0, 0], tangent=[0, 1, 0])
ALLEGRO = "panda+allegro_right"


robot_of = cache(ik.load_robot)


def pose_of(matrix: Array) -> Array:
    """Return the pose (4, 4) of a rotation matrix."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix, POINT
    return pose


def frame_of(contact: ik.Contact) -> Array:
    """Return the axes (3, 3) of the frame of a contact."""
    assert contact.normal is not None
    assert contact.tangent is not None
    return np.stack(
        [contact.normal, contact.tangent, np.cross(contact.normal, contact.tangent)], axis=1
    )


def turned_palm(pose: Any) -> Array:
    """Return the rotation (3, 3) of the palm of a grasp."""
    palm = ik.Grasp(palm=pose, posture={"bh_spread": 0.1}).single_palm
    assert palm is not None
    return palm[:3, :3]


def scene_file(text: str) -> Array:
    """Return the rotation (3, 3) of the solid of a scene file."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(text)
        return ik.load_scene(path).items["a"].pose[:3, :3]


def palm_of_data_set(matrix: Array) -> Array:
    """Return the rotation (3, 3) of the palm of a data set of matrices."""
    row = {
        "trans": POINT[None],
        "rot": matrix[None],
        "joint_angles": np.full((1, 16), 0.4),
        "grasp_orientations": np.tile(np.eye(3), (1, 4, 1, 1)),
    }
    with TemporaryDirectory() as folder:
        path = Path(folder) / "set.npy"
        np.save(path, np.array(row, dtype=object))
        palm = ik.load_candidates(path, robot_of(ALLEGRO), take="palm").grasps[0].single_palm
    assert palm is not None
    return palm[:3, :3]


@cache
def frame_of_data_set() -> Array:
    """Return the rotation (3, 3) of the palm where the data set has the identity."""
    return palm_of_data_set(np.eye(3))


MATRICES: dict[str, Callable[[Array], Array]] = {
    "pose": lambda R: checked_pose(pose_of(R))[:3, :3],
    "poses": lambda R: checked_pose(np.stack([np.eye(4), pose_of(R)]))[1, :3, :3],
    "fingertip": lambda R: frame_of(ik.Contact.from_pose(pose_of(R))),
    "contact": lambda R: frame_of(CONTACT.at(pose_of(R))),
    "axes of a contact": lambda R: frame_of(
        ik.Contact(POINT, normal=R[:, 0], tangent=R[:, 1]) if matrix_skew(R) < 1 else CONTACT
    ),
    "grasp": lambda R: frame_of(ik.Grasp({"thumb": CONTACT}).at(pose_of(R)).contacts["thumb"]),
    "palm": lambda R: turned_palm(pose_of(R)),
    "palm as lists": lambda R: turned_palm(pose_of(R).tolist()),
    "scene": lambda R: ik.Scene({"a": BOX | {"pose": pose_of(R)}}).items["a"].pose[:3, :3],
    "scene file": lambda R: scene_file(
        yaml.safe_dump({"solids": {"a": BOX | {"pose": pose_of(R).tolist()}}})
    ),
    "moved in a scene": lambda R: (
        ik.Scene({"a": BOX}).moved("a", pose_of(R)).items["a"].pose[:3, :3]
    ),
    "held in a scene": lambda R: (
        ik.Scene({"a": BOX}).holding("a", pose_of(R)).items["a"].pose[:3, :3]
    ),
    "data set": lambda R: palm_of_data_set(R) @ frame_of_data_set().T,
}
"""Entrances for matrices: the rotation that each makes of a matrix (3, 3)."""


def measurement(wxyz: Array) -> Array:
    """Return the rotation (3, 3) of a measured fingertip."""
    values = ",".join(map(str, (0.0485, 0.0512, *POINT, *wxyz)))
    head = "finger,index_proximal_slider,index_middle_slider,x,y,z,qw,qx,qy,qz\n"
    with TemporaryDirectory() as folder:
        path = Path(folder) / "measured.csv"
        path.write_text(f"{head}index,{values}\n")
        pose = read_measurements(path, robot_of("ar10").description).poses[0]
    return matrix_of(pose[:4])


def table(wxyz: Array) -> Array:
    """Return the rotation (3, 3) of a palm in a table."""
    robot = robot_of(ALLEGRO)
    columns = dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), (*POINT, *wxyz), strict=True))
    columns |= dict.fromkeys(robot.description.finger_motors, 0.3)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "grasps.csv"
        path.write_text(",".join(columns) + "\n" + ",".join(map(str, columns.values())) + "\n")
        palm = ik.load_candidates(path, robot, take="palm").grasps[0].single_palm
    assert palm is not None
    return palm[:3, :3]


QUATERNIONS: dict[str, Callable[[Array], Array]] = {
    "scene, w first": lambda q: (
        ik.Scene({"a": BOX | {"quaternion_wxyz": q}}).items["a"].pose[:3, :3]
    ),
    "scene, w last": lambda q: (
        ik.Scene({"a": BOX | {"quaternion_xyzw": np.roll(q, -1)}}).items["a"].pose[:3, :3]
    ),
    "scene file": lambda q: scene_file(
        yaml.safe_dump({"solids": {"a": BOX | {"quaternion_wxyz": q.tolist()}}})
    ),
    "measurement": measurement,
    "table": table,
}
"""Entrances for quaternions w x y z (4,)."""


def matrix_of(wxyz: Array) -> Array:
    """Return the rotation (3, 3) of a quaternion of any length."""
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def angle_between(first: Array, second: Array) -> float:
    """Return the angle between two rotations [deg]."""
    return float(np.rad2deg(np.linalg.norm(first - second) / np.sqrt(2)))


FEW = settings(max_examples=15)
"""Settings: each example goes through all entrances, some of which read files."""

numbers = st.floats(-1, 1, allow_nan=False, allow_subnormal=False)
unit = (
    st.tuples(numbers, numbers, numbers, numbers)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


@FEW
@given(unit, st.integers(3, 6))
def test_rounded_rotations_are_taken_at_every_entrance(wxyz, decimals):
    exact = matrix_of(wxyz)
    for name, entrance in MATRICES.items():
        rotation = entrance(np.round(exact, decimals))
        assert matrix_skew(rotation) < 1e-12, name
        assert np.linalg.det(rotation) > 0, name
        assert angle_between(rotation, exact) < 0.1, name


@FEW
@given(unit, st.integers(3, 6))
def test_rounded_quaternions_are_taken_at_every_entrance(wxyz, decimals):
    for name, entrance in QUATERNIONS.items():
        rotation = entrance(np.round(wxyz, decimals))
        assert matrix_skew(rotation) < 1e-12, name
        assert angle_between(rotation, matrix_of(wxyz)) < 0.15, name


@FEW
@given(unit, unit, st.floats(MAX_SKEW * 1.01, 10.0), st.booleans())
def test_the_limit_is_the_same_at_every_entrance(wxyz, other_axis, skew, mirrored):
    """Stretched and mirrored rotations are refused by the largest entry of |R^T R - I|."""
    stretch = np.diag([1.0, 1.0, np.sqrt(1 + skew)])
    matrix = matrix_of(wxyz) @ stretch
    if mirrored:
        matrix = matrix_of(other_axis) @ np.diag([1.0, -1.0, 1.0])
    for name, entrance in MATRICES.items():
        if name == "axes of a contact":
            continue  # whose third axis follows from the others
        try:
            entrance(matrix)
        except ik.errors.InvalidPoseError:
            continue
        pytest.fail(f"{name}: took {matrix.tolist()}")


@pytest.mark.parametrize("length", [0.0, 0.5, 0.98, 1.02, 3.0])
@pytest.mark.parametrize("name", QUATERNIONS)
def test_quaternions_of_another_length_are_refused(name, length):
    with pytest.raises(ik.errors.InvalidPoseError):
        QUATERNIONS[name](length * np.array([0.5, 0.5, -0.5, 0.5]))


def test_a_tangent_that_is_not_across_the_normal_is_refused():
    with pytest.raises(ik.errors.InputError):
        ik.Contact(POINT, normal=[1, 0, 0], tangent=[0.01, 1, 0])


def test_rounded_half_square_roots_are_accepted():
    """Rotations with four decimals are accepted."""
    turn = [[0.7071, -0.7071, 0, 0.5], [0.7071, 0.7071, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]]
    c = np.sqrt(0.5)
    rotation = scene_file(yaml.safe_dump({"solids": {"a": BOX | {"pose": turn}}}))
    np.testing.assert_allclose(rotation, [[c, -c, 0], [c, c, 0], [0, 0, 1]], atol=1e-12)


@pytest.fixture(scope="module")
def setting(robot):
    """Solver with a scene, and its arguments."""
    scene = ik.Scene({"a": BOX | {"xyz": [0.9, 0.9, 0.9]}}, grasped="a")
    grasp = ik.load_grasp("cup")
    points, normals = grasp.arrays(robot.fingers)
    return SimpleNamespace(
        robot=robot,
        solver=ik.Solver(robot, scene=scene),
        grasp=grasp,
        arrays=(points[None], normals[None]),
        hands={name: [robot.home[i]] for i, name in enumerate(robot.actuators) if i >= 7},
    )


CALLS: dict[str, Callable[[Any, Array], Any]] = {
    "choose": lambda s, T: s.solver.choose([s.grasp], object_pose=T, limit=1, per_candidate=1),
    "solve_batch": lambda s, T: s.solver.solve_batch(*s.arrays, object_pose=T),
    "solve_palms": lambda s, T: s.solver.solve_palms(T[None], s.hands),
    "moved": lambda s, T: s.solver.moved("a", T),
}
"""Calls of a solver that take a pose."""


@pytest.mark.parametrize("name", CALLS)
def test_solver_calls_apply_the_same_rule(setting, name):
    rounded = pose_of(np.round(matrix_of(np.array([0.9, 0.1, -0.3, 0.3])), 3))
    CALLS[name](setting, rounded)
    stretched = pose_of(np.diag([1.0, 1.0, 1.0 + 2 * MAX_SKEW]))
    with pytest.raises(ik.errors.InvalidPoseError):
        CALLS[name](setting, stretched)
