"""Numbers in other units than metres and radians are named in a warning at every entrance."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
import yaml
from commands import main

import casadi_ik as ik

WALL = {"kind": "box", "size": [2.0, 0.02, 2.0], "xyz": [0.6, 0.5, 0.5]}


def scaled(entry, factor):
    """Return a solid of a scene with lengths in other units."""
    lengths = {"size", "radius", "length", "xyz", "points"}
    return {k: (factor * np.array(v)).tolist() if k in lengths else v for k, v in entry.items()}


SOLIDS = {
    "wall": WALL,
    "ball": {"kind": "sphere", "radius": 0.05, "xyz": [0.5, 0.4, 0.1]},
    "post": {"kind": "cylinder", "radius": 0.02, "length": 1.0, "xyz": [0.5, 0.4, 0.5]},
    "pipe": {"kind": "capsule", "radius": 0.02, "length": 0.5, "xyz": [0.5, 0.4, 0.5]},
    "hull": {"kind": "convex", "points": [[0, 0, 0.5], [0.1, 0, 0.5], [0, 0.1, 0.5], [0, 0, 0.6]]},
    "cloud": {"kind": "point-cloud", "radius": 0.01, "points": [[0.5, 0.4, 0.3], [0.5, 0.2, 0.3]]},
    "floor": {"kind": "half-space", "xyz": [0.0, 0.0, -0.5]},
}


@pytest.mark.parametrize("name", SOLIDS)
def test_scenes_in_millimetres(name, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ik.Scene({name: SOLIDS[name]})
    wrong = scaled(SOLIDS[name], 1e3)
    with pytest.warns(ik.errors.InputWarning, match=rf"solids\.{name}.*mm"):
        ik.Scene({name: wrong})
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump({"solids": {name: wrong}}))
    with pytest.warns(ik.errors.InputWarning, match=rf"scene\.yaml: solids\.{name}.*mm"):
        ik.load_scene(path)


def test_a_pose_in_millimetres():
    pose = np.eye(4)
    pose[:3, 3] = [600.0, 500.0, 500.0]
    with pytest.warns(ik.errors.InputWarning, match="wall"):
        ik.Scene({"wall": WALL}).moved("wall", pose)


def test_shipped_scenes_cause_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ik.shipped_names("scenes"):
            ik.load_scene(name)


def test_a_mesh_in_millimetres(tmp_path):
    box = [[x, y, z] for x in (0, 90) for y in (0, 90) for z in (0, 90)]
    faces = "1 2 4,1 4 3,5 7 8,5 8 6,1 5 6,1 6 2,3 4 8,3 8 7,1 3 7,1 7 5,2 6 8,2 8 4"
    lines = [f"v {x} {y} {z}" for x, y, z in box] + [f"f {face}" for face in faces.split(",")]
    path = tmp_path / "box.obj"
    path.write_text("\n".join(lines) + "\n")
    with pytest.warns(ik.errors.InputWarning, match=r"box\.obj.*mm"):
        ik.Scene({"a": {"kind": "mesh", "file": str(path), "parts": True}})
    with pytest.warns(ik.errors.InputWarning, match="mm"), pytest.raises(ik.errors.InputError):
        ik.load_surface(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ik.load_surface(path, scale=1e-3)


def test_contacts_in_millimetres(robot):
    solver = ik.Solver(robot)
    points, normals = robot.contacts(robot.home)
    grasp = ik.Grasp(
        {
            name: ik.Contact(1e3 * point, normal)
            for name, point, normal in zip(robot.fingers, points, normals, strict=True)
        }
    )
    for ask in (
        lambda: solver.solve(grasp, diagnose=False),
        lambda: solver.solve_batch(1e3 * points[None], normals[None]),
    ):
        with pytest.warns(ik.errors.InputWarning, match=r"m from the robot's base.*mm"):
            ask()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver.solve_batch(points[None], normals[None])


@pytest.mark.parametrize(
    ("position", "angle", "match"),
    [(5.0, 0.05, r"tolerance\.position: found 5 m.*mm"), (5e-3, 3.0, r"angle: found 3 rad.*deg")],
)
def test_tolerances_in_other_units(robot, tmp_path, capsys, position, angle, match):
    tolerance = ik.Tolerance(position, angle)
    with pytest.warns(ik.errors.InputWarning, match=match):
        ik.Solver(robot, tolerance=tolerance)
    with pytest.warns(ik.errors.InputWarning, match="thumb"):
        ik.Solver(robot, tolerance={"thumb": tolerance})
    with pytest.warns(ik.errors.InputWarning, match=match):
        ik.Contact([0.5, 0.1, 0.4], tolerance=tolerance)
    words = ["solve", "cup", "--tolerance-position", str(position), "--tolerance-angle", str(angle)]
    assert main(words) == 0
    assert "warning: tolerance" in capsys.readouterr().err


def test_tolerances_that_cause_no_warning(robot):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ik.Solver(robot, tolerance=ik.Tolerance(0.1, np.deg2rad(30.0)))


def test_a_mobile_base_may_go_far():
    body = ik.load_robot("mobile_kuka_lwr_barrett")
    points, normals = body.contacts(body.home)
    travel = [
        body.upper[i]
        for i, actuator in enumerate(body.description.actuators)
        if actuator.unit == "m"
    ]
    far_points = points + np.array([max(travel), 0.0, 0.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ik.Solver(body).solve_batch(far_points[None], normals[None])


def test_angles_in_degrees(tmp_path, capsys):
    with pytest.warns(ik.errors.InputWarning, match=r"solids\.wall\.rpy: .*90 .*degrees"):
        ik.Scene({"wall": WALL | {"rpy": [0.0, 0.0, 90.0]}})
    text = (
        "robot: kuka_lwr_barrett\n"
        "object: {name: cup, pose: {xyz: [-0.8, 0.1, 0.4], rpy: [0, 0, -45]}}\n"
        "contacts: {thumb: {point: [-0.83, 0.15, 0.41]}}\n"
    )
    path = tmp_path / "grasp.yaml"
    path.write_text(text)
    with pytest.warns(ik.errors.InputWarning, match=r"grasp\.yaml: object\.pose\.rpy: .*45 "):
        ik.load_grasp(path)
    path.write_text(text.replace("-45", "-45 deg"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ik.load_grasp(path)
        ik.Scene({"wall": WALL | {"rpy": [0.0, 0.0, 2 * np.pi]}})
    main(["solve", str(path), "--object-pose", "-0.8", "0.1", "0.4", "0", "0", "-45"])
    assert "--object-pose: found an angle of 45 rad" in " ".join(capsys.readouterr().err.split())


ARM = """<robot name="arm"><link name="base"/><link name="a"/><link name="b"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 {}"/>
<axis xyz="0 0 1"/><limit lower="-{}" upper="3" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.2"
rpy="0 0 {}"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        (("350", "3", "0"), "joint 'shoulder': .*350 m .*mm"),
        (("0.35", "170", "0"), "joint 'shoulder': .*170 rad.*degrees"),
        (("0.35", "3", "90"), "joint 'elbow': origin: rpy: .*90 rad.*degrees"),
        (("0.35", "1000", "3.14159"), ""),
    ],
)
def test_a_robot_in_other_units(tmp_path, numbers, words):
    path, robot = tmp_path / "arm.urdf", tmp_path / "robot.yaml"
    path.write_text(ARM.format(*numbers))
    robot.write_text(
        "name: arm\nrobot: {file: arm.urdf, palm: {link: a}}\n"
        "fingers: {tip: {link: b, xyz: [0, 0, 0.1], normal: [1, 0, 0]}}\n"
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ik.load_robot(robot)
    messages = [str(item.message) for item in caught]
    assert len(messages) == (1 if words else 0)
    assert not words or re.search(words, messages[0])
