"""Shapes in descriptions: read, checked, told apart; and those of the shipped robots."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import yaml
from capsule_arm import ARM, write_robot

import casadi_ik as ik
from casadi_ik.collision.model import collision_model
from casadi_ik.errors import DescriptionError, UnsupportedError
from casadi_ik.robots import load_description
from casadi_ik.robots.collision import capsules_of
from casadi_ik.robots.schema import BoxEntry, CylinderEntry


def test_shapes_come_with_the_parts(tmp_path):
    shapes = load_description(write_robot(tmp_path)).shapes
    assert [one.link for one in shapes.capsules if one.covers < 0] == [
        *("l1", "l3", "l3"),
        *("tip1", "tip2"),
    ]
    assert [(one.link, one.kind) for one in shapes.solids] == [
        ("base", "cylinder"),
        ("l2", "box"),
        ("palm", "box"),
    ]
    covers = {
        one.link: shapes.solids[one.covers].link for one in shapes.capsules if one.covers > -1
    }
    assert covers == {"base": "base", "l2": "l2", "palm": "palm"}


@pytest.mark.parametrize(
    "shape",
    [
        BoxEntry(size=(0.3, 0.1, 0.08), xyz=(0.1, 0.2, 0.3), rpy=(0.3, 0.2, 0.1)),
        BoxEntry(size=(0.2, 0.2, 0.01)),
        CylinderEntry(radius=0.05, length=0.3, rpy=(1.0, 0, 0)),
        CylinderEntry(radius=0.1, length=0.02),
    ],
)
def test_capsules_hold_boxes_and_cylinders(shape, rng):
    unit = rng.uniform(-1, 1, (4000, 3))
    if isinstance(shape, BoxEntry):
        inside = unit * np.array(shape.size) / 2
    else:
        inside = unit[np.hypot(unit[:, 0], unit[:, 1]) <= 1]
        inside = inside * [shape.radius, shape.radius, shape.length / 2]
    from casadi_ik.files.reading import Frame, frame_matrix

    pose = frame_matrix(Frame(shape.xyz, shape.rpy))
    points = inside @ pose[:3, :3].T + pose[:3, 3]
    apart = []
    for center, half, radius in capsules_of(shape):
        t = np.clip((points - center) @ half / max(half @ half, 1e-30), -1, 1)
        apart.append(np.linalg.norm(points - center - t[:, None] * half, axis=1) - radius)
    assert np.min(apart, axis=0).max() <= 1e-9


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("links", "l9"), [], "collision.links.l9: unknown link 'l9'; known: base, l1"),
        (
            ("links", "l1", 0, "radius"),
            -1,
            r"collision.links.l1\[0\].radius: found -1.0, expected >",
        ),
        (("links", "l1", 0, "kind"), "cone", "'cone'"),
        (("links", "l1", 0, "radius"), "5 deg", "found '5 deg', expected m"),
        (("touching",), [{"links": ["l1", "x"], "reason": "a"}], "unknown link 'x'"),
        (("touching",), [{"links": ["l1", "l3"], "reason": " "}], "reason: is empty"),
        (("source",), "nobody", "unknown tag 'nobody'"),
        (("srdf",), "none.srdf", "none.srdf: cannot be read"),
    ],
)
def test_bad_shapes_are_named(tmp_path, place, value, message):
    path = write_robot(tmp_path)
    arm = copy.deepcopy(ARM)
    at = arm["collision"]
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(arm))
    with pytest.raises(DescriptionError, match=message) as caught:
        load_description(path)
    assert "\n" not in str(caught.value)
    assert "three.yaml" in str(caught.value) or "none.srdf" in str(caught.value)


def test_an_srdf_says_what_may_touch(tmp_path):
    path = write_robot(tmp_path)
    arm = copy.deepcopy(ARM)
    arm["collision"]["srdf"] = "three.srdf"
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(arm))
    (tmp_path / "three.srdf").write_text(
        "<robot name='three'><disable_collisions link1='base' link2='l3' reason='Never'/>"
        "<disable_collisions link1='base' link2='elsewhere' reason='Never'/></robot>"
    )
    excluded = collision_model(load_description(path)).excluded
    assert ("base", "l3", "three.srdf: Never") in [(*one.links, one.reason) for one in excluded]


def test_a_robot_without_shapes_works_but_takes_no_scene(tmp_path):
    path = write_robot(tmp_path)
    arm = {key: value for key, value in ARM.items() if key != "collision"}
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(arm))
    robot = ik.load_robot(path)
    with pytest.raises(UnsupportedError, match="its arm has no shapes, which a scene needs"):
        ik.Solver(robot, scene=ik.Scene())


@pytest.mark.parametrize(
    "name",
    [
        "kuka_lwr_barrett",
        "kuka_lwr_barrett_coupled",
        "panda+allegro_right",
        "ur5e+shadow",
        "iiwa14+leap",
        "sawyer+robotiq_3f",
        "xarm6+unitree_dex3",
        "ar10",
    ],
)
def test_shipped_robots_stand_free_at_home(name):
    """At home no two links touch that are checked: the shapes are not too large to be of use."""
    from casadi_ik.problem.clearance import SceneCheck

    robot = ik.load_robot(name)
    check = SceneCheck(robot, ik.Scene(), compiled=False)
    points, normals = robot.contacts(robot.home)
    asked = ik.Solver(robot, compiled=False)._questions.of_arrays(points[None], normals[None], None)
    found = check.around(asked).check(robot.home[None])
    assert found.free[0], found.pair(0)
    assert all(one.reason for one in check.model.excluded)


@pytest.mark.parametrize(
    ("arm", "link", "corner"),
    [
        # Corners [mm] of what is seen of them: dexsuite/dex-urdf at 93505db3c0b2 (iiwa),
        # example-robot-data 6.0.0 (Jaco, UR10), robosuite 1.5.2 (Sawyer, bullet_data).
        ("iiwa14", "iiwa14_link_2", [-55.0, -237.3, 40.0]),
        ("iiwa7", "iiwa7_link_2", [34.0, -216.8, -58.9]),
        ("jaco2", "jaco2_link_2", [42.7, -3.5, 11.5]),
        ("ur10", "ur10_link_2", [-664.1, 101.6, 253.6]),
        ("sawyer", "sawyer_link_1", [-67.9, 2.9, 1.0]),
    ],
)
def test_shapes_hold_what_is_seen_of_an_arm(arm, link, corner):
    """The corners that stood out the most of shapes fitted to what is there for collisions."""
    shapes = ik.load_robot(f"{arm}+barrett_bh8_280").description.shapes
    point = np.array(corner) / 1e3
    apart = []
    for one in shapes.capsules:
        if one.link == link:
            square = one.half @ one.half
            along = np.clip((point - one.center) @ one.half / square, -1, 1) if square else 0.0
            apart.append(np.linalg.norm(point - one.center - along * one.half) - one.radius)
    assert min(apart) < 1e-4
