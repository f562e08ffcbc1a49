"""Every shipped grasp, verified from the files alone."""

from __future__ import annotations

import subprocess
import sys
from itertools import combinations
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import grasps, robots
from casadi_ik.symbolic.kinematics import forward

NAMES = ik.shipped_grasps("kuka_lwr_barrett")
FINGERS = ("thumb", "finger_2", "finger_3")
SHARED = {"bh_finger_2_spread": "bh_spread", "bh_finger_3_spread": "bh_spread"}
TOOLS = Path(__file__).resolve().parents[2] / "tools"
PALM_SURFACE = 0.080  # [m] in frame W


@pytest.fixture(scope="module")
def robot() -> robots.RobotDescription:
    return robots.load_description("kuka_lwr_barrett")


@pytest.fixture(scope="module")
def in_palm(robot: robots.RobotDescription) -> ca.Function:
    """Contact points and normals (3, 3) each, in Barrett frame W, from theta."""
    theta = ca.SX.sym("theta", len(robot.joint_names))
    kin = forward(robot, theta)
    contacts = [kin.contact(name) for name in FINGERS]
    points = ca.horzcat(*(kin.links["bh_base"].inverse_apply(point) for point, _ in contacts))
    normals = ca.horzcat(*(kin.links["bh_base"].rotation.T @ normal for _, normal in contacts))
    return ca.Function("in_palm", [theta], [points, normals])


def posture_contacts(
    robot: robots.RobotDescription, in_palm: ca.Function, grasp: ik.Grasp
) -> tuple[np.ndarray, np.ndarray]:
    theta = [grasp.posture.get(SHARED.get(name, name), 0.0) for name in robot.joint_names]
    points, normals = (np.array(matrix).T for matrix in in_palm(theta))
    return points, normals


def local(grasp: ik.Grasp) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the contacts in the object's frame."""
    assert grasp.object_pose is not None
    points, normals = grasp.arrays(FINGERS)
    rotation, origin = grasp.object_pose[:3, :3], grasp.object_pose[:3, 3]
    return (points - origin) @ rotation, normals @ rotation


def frame_of(points: np.ndarray) -> np.ndarray:
    """(4, 4) frame spanned by three points."""
    x = points[1] - points[0]
    z = np.cross(x, points[2] - points[0])
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), points[0]
    return pose


def test_every_object_has_a_grasp() -> None:
    grasped = {ik.load_grasp(name).object for name in ik.shipped_names("grasps")}
    assert grasped == set(ik.shipped_names("objects"))


@pytest.mark.parametrize("name", NAMES)
def test_contacts_are_on_the_surface_and_face_into_it(name: str) -> None:
    grasp = ik.load_grasp(name)
    assert grasp.robot == "kuka_lwr_barrett"
    assert grasp.object == name
    item = grasps.load_object(grasp.object)
    points, normals = local(grasp)
    assert np.abs(item.signed_distance(points)).max() < 1e-9
    np.testing.assert_allclose(normals, -item.normal(points), atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_contacts_keep_away_from_edges(name: str) -> None:
    points, _ = local(ik.load_grasp(name))
    shape = grasps.load_object(name).shape
    if isinstance(shape, (grasps.Cylinder, grasps.EllipticCylinder)):
        assert np.all(shape.height / 2 - np.abs(points[:, 2]) > 0.0048)
    elif isinstance(shape, grasps.Box):
        gaps = np.sort(np.asarray(shape.size) / 2 - np.abs(points), axis=1)
        np.testing.assert_allclose(gaps[:, 0], 0.0, atol=1e-9)
        assert np.all(gaps[:, 1] > 0.0099)


@pytest.mark.parametrize("name", NAMES)
def test_posture_is_within_limits(name: str, robot: robots.RobotDescription) -> None:
    posture = ik.load_grasp(name).posture
    assert set(posture) == {n for n in robot.actuator_names if n.startswith("bh_")}
    for actuator, value in posture.items():
        index = robot.actuator_index(actuator)
        # A parallel pinch has the spread at its stop; everything else keeps 2 degrees.
        margin = 0.0 if actuator == "bh_spread" else np.deg2rad(2.0)
        assert robot.lower[index] + margin <= value <= robot.upper[index] - margin


@pytest.mark.parametrize("name", NAMES)
def test_posture_reproduces_the_contacts(
    name: str, robot: robots.RobotDescription, in_palm: ca.Function
) -> None:
    grasp = ik.load_grasp(name)
    points, normals = grasp.arrays(FINGERS)
    hand_points, hand_normals = posture_contacts(robot, in_palm, grasp)
    for i, j in combinations(range(3), 2):
        wanted, given = points[j] - points[i], hand_points[j] - hand_points[i]
        assert np.linalg.norm(given) == pytest.approx(np.linalg.norm(wanted), abs=1e-9)
        assert hand_normals[i] @ hand_normals[j] == pytest.approx(normals[i] @ normals[j], abs=1e-9)
    # Not its mirror image either: normals and points in the frame of the three points.
    for p, n, q, m in [(points, normals, hand_points, hand_normals)]:
        np.testing.assert_allclose(n @ frame_of(p)[:3, :3], m @ frame_of(q)[:3, :3], atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_object_keeps_clear_of_the_palm_and_above_the_table(
    name: str, robot: robots.RobotDescription, in_palm: ca.Function
) -> None:
    grasp = ik.load_grasp(name)
    assert grasp.object_pose is not None
    points, _ = grasp.arrays(FINGERS)
    hand_points, _ = posture_contacts(robot, in_palm, grasp)
    palm = frame_of(points) @ np.linalg.inv(frame_of(hand_points))
    vertices, _ = grasps.load_object(name).mesh(64)
    world = vertices @ grasp.object_pose[:3, :3].T + grasp.object_pose[:3, 3]
    assert world[:, 2].min() > -1e-6
    heights = (world - palm[:3, 3]) @ palm[:3, 2]
    assert heights.min() > PALM_SURFACE + 0.01
    assert 0.3 < np.linalg.norm(grasp.object_pose[:2, 3]) < 0.9


@pytest.mark.parametrize("name", NAMES)
def test_thumb_opposes_the_fingers(name: str) -> None:
    """The squeeze is an equilibrium inside friction cones: tensions along the triangle's sides."""
    points, normals = ik.load_grasp(name).arrays(FINGERS)
    thumb, second, third = points
    between = np.linspace(-4, 4, 4001)[:, None]
    forces = {
        0: np.broadcast_to(second + third - 2 * thumb, (len(between), 3)),
        1: thumb - second + between * (third - second),
        2: thumb - third + between * (second - third),
    }
    total = sum(forces.values(), np.zeros(3))
    assert np.abs(total).max() < 1e-12
    cosines = [f @ normals[i] / np.linalg.norm(f, axis=1) for i, f in forces.items()]
    friction = np.tan(np.arccos(np.min(cosines, axis=0).clip(-1, 1).max()))
    # Barrett's pads tilt towards the palm below 131 mm, the more the smaller the object.
    assert friction < {"box": 0.01}.get(kind(name), 1.3)


def kind(name: str) -> str:
    return "box" if isinstance(grasps.load_object(name).shape, grasps.Box) else "round"


def test_the_script_agrees_and_refuses_a_broken_file(tmp_path: Path) -> None:
    script = [sys.executable, str(TOOLS / "make_grasps.py"), "--check", "--only", "cup"]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "cup: good")
    source = (TOOLS.parent / "models" / "grasps" / "cup.yaml").read_text()
    spread = "bh_spread: 0.0"
    assert spread in source
    (tmp_path / "cup.yaml").write_text(source.replace(spread, "bh_spread: 0.1"))
    done = subprocess.run(
        [*script, "--out", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "the posture does not give the points" in done.stdout
