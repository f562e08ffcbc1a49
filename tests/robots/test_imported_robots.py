"""Robots in URDF and MJCF files, whole and as parts."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import trimesh
from imported_files import FINGERS, arm, describe, hand, joint, link, urdf
from toy_robots import grasp_at

import casadi_ik as ik
from casadi_ik.integrations.importing.reference_kinematics import largest_difference
from casadi_ik.integrations.importing.robot_shapes import CollisionTree, robot_shapes
from casadi_ik.model.urdf_mjcf import read_tree

MOUNT = "mount: {xyz: [0.01, 0.02, 0.03], rpy: [0.1, 0.2, 0.3]}"


def both(tmp_path, arm_text="", hand_text="", hand_mount=MOUNT, hand_changes=(), joints=6):
    """Return the robot of an arm and a hand in files of their own."""
    arm(tmp_path, joints)
    hand(tmp_path, *hand_changes)
    path = describe(
        tmp_path,
        f"arm: {{file: arm.urdf{arm_text}}}\nhand: {{file: hand.urdf{hand_text}}}\n{hand_mount}",
    )
    return ik.load_robot(path)


def check(robot, path, rng, locked=None, beside=None, carried_file=None):
    pytest.importorskip("pinocchio")
    q = robot.random(rng, 5)
    trees = [
        None if path_or_none is None else read_tree(path_or_none)
        for path_or_none in (path, beside, carried_file)
    ]
    assert largest_difference(robot, trees[0], q, locked, *trees[1:]) < 1e-12
    assert (robot.beyond_limits(q) <= 1e-9).all()


def test_arm_and_hand_match_pinocchio(tmp_path, rng):
    robot = both(tmp_path)
    check(robot, tmp_path / "arm.urdf", rng)
    check(robot, tmp_path / "hand.urdf", rng, beside=tmp_path / "arm.urdf")
    names = [f"joint_{i}" for i in range(1, 7)]
    assert robot.actuators == (*names, "left_spread", "left_bend", "right_spread", "right_bend")
    q = robot.random(rng, 1)[0]
    poses = robot.links(q)
    # Both files name their first link base_link, so that the hand's gets a prefix.
    mount = np.linalg.inv(poses["flange"]) @ poses["hand_base_link"]
    np.testing.assert_allclose(mount[:3, 3], [0.01, 0.02, 0.03], atol=1e-15)
    tip = poses["left_tip"] @ [0, -0.01, 0.03, 1]
    np.testing.assert_allclose(robot.contacts(q)[0][0], tip[:3], atol=1e-15)
    assert robot.description.named_thumb is None
    np.testing.assert_allclose(robot.description.actuators[0].velocity, 2.0)
    assert robot.description.actuators[0].effort == 1.0


def test_clashing_joints_of_the_hand_get_a_prefix(tmp_path, rng):
    robot = both(tmp_path, hand_changes=[("left_bend", "joint_1")])
    assert "hand_joint_1" in robot.actuators
    # Its follower uses the new name, and pinocchio agrees.
    check(robot, tmp_path / "hand.urdf", rng, beside=tmp_path / "arm.urdf")


def test_links_beyond_the_tip_may_share_names(tmp_path, rng):
    """The file of an arm ends in a link whose name the hand's file also has."""
    path, box = arm(tmp_path, 6), '<geometry><box size="0.3 0.2 0.1"/></geometry>'
    extra_link = f'<link name="left_tip"><collision>{box}</collision></link>'
    extra_link += joint("wrist_plate", "flange", "left_tip", "fixed", xyz="0.3 0 0", rpy="0 1 0")
    path.write_text(path.read_text().replace("</robot>", f"{extra_link}</robot>"))
    hand_path = hand(tmp_path)
    text = f"arm: {{file: arm.urdf, tip: flange}}\nhand: {{file: hand.urdf}}\n{MOUNT}"
    robot = ik.load_robot(describe(tmp_path, text))
    assert "left_tip" in robot.description.links
    check(robot, path, rng, carried_file=hand_path)
    check(robot, hand_path, rng, beside=path)
    shapes, _, _ = robot_shapes(robot.description, (read_tree(path), read_tree(hand_path)))
    assert "left_tip" not in shapes


def test_mesh_contacts_match_coal(rng):
    coal = pytest.importorskip("coal")
    bodies = [
        trimesh.creation.icosphere(3, 1.0),
        trimesh.creation.torus(1, 0.2),
        trimesh.creation.box((1, 2, 0.1)),
        trimesh.creation.annulus(0.5, 0.6, 2.0),
        trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False),
    ]
    trees, models = [], []
    for body in bodies:
        trees.append(CollisionTree(np.asarray(body.triangles, dtype=float)))
        models.append(coal.BVHModelOBBRSS())
        models[-1].beginModel(len(body.faces), len(body.vertices))
        models[-1].addVertices(np.asarray(body.vertices))
        models[-1].addTriangles(np.asarray(body.faces))
        models[-1].endModel()
    intersections = 0
    for first, second in product(range(len(bodies)), repeat=2):
        poses = np.zeros((8, 4, 4))
        for pose in poses:
            pose[:] = trimesh.transformations.random_rotation_matrix(rng.random(3))
            pose[:3, 3] = rng.normal(0, 0.8, 3)
        expected = [
            bool(
                coal.collide(
                    models[first], coal.Transform3s(),
                    models[second], coal.Transform3s(pose[:3, :3], pose[:3, 3]),
                    coal.CollisionRequest(), coal.CollisionResult(),
                )
            )
            for pose in poses
        ]  # fmt: skip
        np.testing.assert_array_equal(trees[first].intersects(trees[second], poses), expected)
        at_least_one = trees[first].intersects(trees[second], poses, stop_at_first=True)
        assert at_least_one.any() == any(expected)
        assert not (at_least_one & ~np.array(expected)).any()
        intersections += sum(expected)
    assert 40 < intersections < 160


def test_one_file_with_its_palm(tmp_path, rng):
    text = link("world", "rail", "tool") + link("base_link", "left_1", "left_tip", "right_tip")
    text += joint("slide", "world", "rail", "prismatic", axis="0 1 1")
    text += joint("roll", "rail", "tool", "continuous", axis="0.6 0 0.8", rpy="0.4 0 0")
    text += joint("flange", "tool", "base_link", "fixed", rpy="0.1 0.2 0.3")
    text += joint("left_spread", "base_link", "left_1", axis="0 0 1")
    text += joint(
        "left_bend", "left_1", "left_tip", limit='velocity="0" effort="0"', attributes=MIMIC
    )
    text += joint("right_bend", "base_link", "right_tip", limit='upper="1" velocity="0" effort="0"')
    path = urdf(tmp_path / "whole.urdf", text)
    robot = ik.load_robot(describe(tmp_path, "robot: {file: whole.urdf, palm: base_link}"))
    check(robot, path, rng)
    assert robot.actuators == ("slide", "roll", "left_spread", "right_bend")
    assert robot.description.arm_actuators == (0, 1)
    assert robot.description.actuators[0].unit == "m"
    # A joint without limits has one turn to each side; a missing limit is 0; velocity 0 is none.
    np.testing.assert_allclose(robot.upper[1], 2 * np.pi)
    assert robot.description.actuators[3].lower == 0.0
    assert robot.description.actuators[3].velocity == np.inf
    assert robot.description.actuators[3].effort == np.inf


MIMIC = '<mimic joint="left_spread" multiplier="-2" offset="0.3"/>'


def test_follower_without_limits_takes_those_of_its_leader(tmp_path):
    path = urdf(
        tmp_path / "hand.urdf",
        link("base_link", "left_1", "left_tip", "right_tip"),
        joint("left_spread", "base_link", "left_1"),
        joint("left_bend", "left_1", "left_tip", "continuous", attributes=MIMIC),
        joint("right_bend", "base_link", "right_tip"),
    )
    robot = ik.load_robot(describe(path.parent, "hand: {file: hand.urdf}"))
    np.testing.assert_allclose([robot.lower[0], robot.upper[0]], [-1, 1.5])
    assert robot.joints(robot.upper)["left_bend"] == pytest.approx(-2 * 1.5 + 0.3)


def test_mimic_of_a_mimic(tmp_path, rng):
    change = ('joint="left_bend" multiplier', 'joint="right_end" multiplier')
    robot = both(tmp_path, hand_changes=[change])
    check(robot, tmp_path / "hand.urdf", rng, beside=tmp_path / "arm.urdf")
    q = robot.random(rng, 1)[0]
    angles = robot.joints(q)
    assert angles["right_end"] == pytest.approx(0.5 * angles["right_bend"] + 0.1)
    assert angles["left_end"] == pytest.approx(0.5 * angles["right_end"] + 0.1)


def test_joint_with_missing_leader_is_fixed(tmp_path, rng):
    change = ('joint="left_bend" multiplier="0.5"', 'joint="left_bend" multiplier="0"')
    robot = both(tmp_path, hand_changes=[change])
    assert "left_end" not in robot.joints(robot.home)
    check(robot, tmp_path / "hand.urdf", rng, beside=tmp_path / "arm.urdf")


def test_locked_joints_and_followers_are_fixed(tmp_path, rng):
    robot = both(tmp_path, hand_text=", locked: {left_bend: 0.4}")
    assert "left_bend" not in robot.actuators
    assert "left_end" not in robot.joints(robot.home)
    locked = {"left_bend": 0.4}
    check(robot, tmp_path / "hand.urdf", rng, locked, tmp_path / "arm.urdf")


def test_stated_limits_override_the_file(tmp_path):
    robot = both(tmp_path, arm_text=", limits: {joint_2: [-10 deg, 20 deg]}")
    np.testing.assert_allclose(np.rad2deg([robot.lower[1], robot.upper[1]]), [-10, 20])


def test_wrist_in_the_file_of_the_hand_moves_the_palm(tmp_path, rng):
    wrist = link("forearm") + joint("wrist", "forearm", "base_link", axis="0 1 0")
    hand(tmp_path, (link("base_link"), link("base_link") + wrist))
    arm(tmp_path, 5)
    text = "arm: {file: arm.urdf}\nhand: {file: hand.urdf, palm: base_link}"
    robot = ik.load_robot(describe(tmp_path, text))
    assert robot.description.arm_actuators == (0, 1, 2, 3, 4, 5)
    assert robot.actuators[5] == "wrist"
    assert robot.description.finger("left").joints == ("left_spread", "left_bend", "left_end")
    check(robot, tmp_path / "hand.urdf", rng, beside=tmp_path / "arm.urdf")
    q = robot.random(rng, 20)
    solver = ik.Solver(robot, compiled=False)
    assert solver.solve_batch(*robot.contacts(q)).success.mean() >= 0.9


def test_two_arms_in_one_file_with_one_chosen(tmp_path, rng):
    text = link("torso")
    for side in "ab":
        names = [f"{side}{i}" for i in range(7)]
        text += link(*names) + joint(f"{side}_start", "torso", f"{side}0", "fixed", xyz="0 1 0")
        for i in range(6):
            axis = ("0 0 1", "0 1 0")[i % 2]
            text += joint(f"{side}_joint{i}", names[i], names[i + 1], axis=axis)
    urdf(tmp_path / "arms.urdf", text)
    hand(tmp_path)
    description = "arm: {{file: arms.urdf{tip}}}\nhand: {{file: hand.urdf}}"
    with pytest.raises(ik.errors.DescriptionError, match=r"arm.tip:.*arms.urdf.*a6, b6"):
        ik.load_robot(describe(tmp_path, description.format(tip="")))
    robot = ik.load_robot(describe(tmp_path, description.format(tip=", tip: b6")))
    assert [name for name in robot.actuators if name[1] == "_"] == [f"b_joint{i}" for i in range(6)]
    check(robot, tmp_path / "arms.urdf", rng)


def test_shipped_arm_with_a_hand_from_a_file(tmp_path):
    hand(tmp_path)
    robot = ik.load_robot(describe(tmp_path, "arm: kuka_lwr4\nhand: {file: hand.urdf}"))
    assert robot.actuators[:2] == ("lwr_joint_1", "lwr_joint_2")
    assert len(robot.actuators) == 11


def test_arm_from_a_file_with_a_shipped_hand(tmp_path, rng):
    arm(tmp_path)
    text = "arm: {file: arm.urdf}\nhand: barrett_bh8_280_coupled\nthumb: thumb"
    robot = ik.load_robot(describe(tmp_path, text, "fingers: [thumb, finger_2, finger_3]"))
    assert len(robot.actuators) == 10
    check(robot, tmp_path / "arm.urdf", rng)


def test_thumb_methods_refuse_hands_without_thumb(tmp_path):
    robot = both(tmp_path)
    with pytest.raises(ik.errors.UnsupportedError, match=r"thumb.*'thumb: FINGER'.*left"):
        ik.Solver(robot, "enhanced-dls")


def test_a_robot_without_a_thumb_is_solved_and_logged(tmp_path, rng):
    robot = both(tmp_path)
    grasp = grasp_at(robot, robot.random(rng, 1)[0])
    solver = ik.Solver(robot, compiled=False)
    assert solver.solve(grasp, log=tmp_path / "solve.mcap").success
    assert (tmp_path / "solve.mcap").exists()


@pytest.mark.parametrize("kind", ["one finger", "one motor"])
def test_small_hands_are_solved(tmp_path, rng, kind):
    fingers = FINGERS if kind == "one motor" else "\n".join(FINGERS.splitlines()[:3])
    locked_text = "" if kind == "one finger" else ", locked: {left_spread: 0, right_spread: 0}"
    shared = ('joint="right_bend"', 'joint="left_bend"')
    robot = both(
        tmp_path,
        hand_text=locked_text,
        hand_changes=[shared] if locked_text else [],
        hand_mount="",
        joints=6,
    )
    if locked_text:
        hand(tmp_path, shared, ("<mimic", "<mimic"))
        text = (
            f"arm: {{file: arm.urdf}}\nhand: {{file: hand.urdf{locked_text[:-1]}, right_bend: 0}}}}"
        )
        robot = ik.load_robot(describe(tmp_path, text))
        assert len(robot.actuators) == 7
    else:
        robot = ik.load_robot(
            describe(tmp_path, "arm: {file: arm.urdf}\nhand: {file: hand.urdf}", fingers)
        )
        assert robot.fingers == ("left",)
    q = robot.random(rng, 10)
    solved = ik.Solver(robot, compiled=False).solve_batch(*robot.contacts(q))
    assert solved.success.mean() >= 0.9


MJCF = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="forearm" pos="0 0 0.1" quat="0.9 0.1 0.3 0.2">
      <body name="palm" pos="0 0.01 0.2">
        <joint name="wrist_a" axis="0 1 0" range="-0.5 0.4" actuatorfrcrange="-3 2"/>
        <joint name="wrist_b" axis="1 0 0" pos="0 0.01 0.02" range="-0.7 0.6"/>
        <geom type="box" size="0.03 0.03 0.01"/>
        <body name="left_1" pos="0 0.03 0.05" euler="0.1 0.2 0.3">
          <joint name="left_a" axis="1 0 0.5" range="-0.2 1.5" ref="0.3"/>
          <geom type="capsule" size="0.01 0.02"/>
          <body name="left_tip" pos="0 0 0.05">
            <joint name="left_b" axis="1 0 0" range="-0.5 2.6"/>
            <geom type="sphere" size="0.01"/>
          </body>
        </body>
        <body name="right_1" pos="0 -0.03 0.05">
          <joint name="right_a" axis="-1 0 0" range="0 1.5"/>
          <geom type="capsule" size="0.01 0.02"/>
          <body name="right_2" pos="0 0 0.04">
            <joint name="right_b" axis="-1 0 0" range="0 1.6"/>
            <geom type="sphere" size="0.01"/>
            <body name="right_tip" pos="0 0 0.03">
              <joint name="right_c" type="slide" axis="0 0 1" range="0 0.02" ref="0.005"/>
              <geom type="sphere" size="0.01"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left_b" joint2="left_a" polycoef="0.1 0.5 0.3 0 0"/></equality>
  <tendon>
    <fixed name="pull"><joint joint="right_a" coef="1"/><joint joint="right_b" coef="1"/></fixed>
  </tendon>
  <actuator>
    <position name="motor" tendon="pull"/>
    <position name="bend" joint="left_a" gear="2" forcerange="-0.4 0.4"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def mjcf(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "hand.xml").write_text(MJCF)
    return describe(tmp_path, "hand: {file: hand.xml, palm: palm}")


def test_mjcf_matches_mujoco(mjcf, rng):
    robot = ik.load_robot(mjcf)
    assert robot.actuators == ("wrist_a", "wrist_b", "left_a", "right_c", "pull")
    assert robot.description.arm_actuators == (0, 1)
    assert [actuator.effort for actuator in robot.description.actuators[:3]] == [3.0, np.inf, 0.8]
    q = robot.random(rng, 20)
    assert largest_difference(robot, read_tree(mjcf.parent / "hand.xml"), q) < 1e-12
    assert (robot.beyond_limits(q) <= 1e-9).all()


def test_equality_is_a_polynomial_of_displacements(mjcf, rng):
    robot = ik.load_robot(mjcf)
    joints = robot.joints(robot.random(rng, 10))
    displacement = joints["left_a"] - 0.3  # the initial position
    np.testing.assert_allclose(
        joints["left_b"], 0.1 + 0.5 * displacement + 0.3 * displacement**2, atol=1e-14
    )


def test_tendon_is_a_shared_motor(mjcf, rng):
    robot = ik.load_robot(mjcf)
    q = robot.random(rng, 10)
    joints = robot.joints(q)
    np.testing.assert_allclose(joints["right_a"] + joints["right_b"], q[:, 4], atol=1e-14)
    np.testing.assert_allclose(joints["right_a"] / 1.5, joints["right_b"] / 1.6, atol=1e-14)
    np.testing.assert_allclose([robot.lower[4], robot.upper[4]], [0, 3.1], atol=1e-9)


def test_unreadable_mjcf_meshes_are_skipped(mjcf, rng):
    path = mjcf.parent / "hand.xml"
    flat = "0 0 0  0.01 0 0  0 0.01 0  0.01 0.01 1e-9"
    assets = f"""<asset><mesh name="gone" file="assets/gone.stl"/>
      <mesh name="flat" vertex="{flat}"/><mesh name="torn" file="torn.stl"/>
      <texture name="wood" type="2d" file="wood.png"/><material name="wood" texture="wood"/></asset>
      <worldbody>"""
    text = path.read_text().replace("<worldbody>", assets)
    for mesh in ("gone", "torn"):
        geom = f'<geom type="mesh" mesh="{mesh}" material="wood"/><geom type="sphere" size="0.01"/>'
        text = text.replace('<geom type="sphere" size="0.01"/>', geom, 1)
    (mjcf.parent / "torn.stl").write_bytes(b"solid nothing")
    path.write_text(text)
    robot, tree = ik.load_robot(mjcf), read_tree(path)
    assert largest_difference(robot, tree, robot.random(rng, 5)) < 1e-12
    assert {name for note in tree.notes for name in ("gone", "torn", "flat") if name in note} >= {
        "gone",
        "torn",
    }


def test_mjcf_hand_on_an_arm_is_solved(mjcf, rng):
    arm(mjcf.parent, 4)
    path = describe(mjcf.parent, "arm: {file: arm.urdf}\nhand: {file: hand.xml, palm: palm}")
    robot = ik.load_robot(path)
    q = robot.random(rng, 10)
    solver = ik.Solver(robot, compiled=False)
    assert solver.solve_batch(*robot.contacts(q)).success.mean() >= 0.9


def test_xacro_is_expanded(tmp_path, rng):
    pytest.importorskip("xacro")
    text = hand(tmp_path).read_text()
    text = text.replace('<robot name="hand">', HEAD).replace('xyz="0 0.04 0.05"', 'xyz="0 ${y} 0"')
    (tmp_path / "hand.urdf.xacro").write_text(text)
    robot = ik.load_robot(describe(tmp_path, "hand: {file: hand.urdf.xacro}", FINGERS))
    np.testing.assert_allclose(robot.links(robot.home)["left_1"][:3, 3], [0, 0.06, 0], atol=1e-15)
    assert (
        largest_difference(robot, read_tree(tmp_path / "hand.urdf.xacro"), robot.random(rng, 3))
        < 1e-12
    )


XACRO = """<robot name="$(arg name)" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="side" default="left_"/>
<xacro:property name="at" value="${dict(y=0.06, z=0.0)}"/>
<xacro:property name="kinds" value="${python.set(['a', 'b'])}"/>
<xacro:macro name="place" params="prefix">
<xacro:if value="${prefix.find('right_') != -1}"><xacro:property name="z" value="0.5"/></xacro:if>
<xacro:if value="${prefix.find('right_') == -1 and isinstance(prefix, str)
  and len([c for c in prefix if c == '_']) == 1}">
  <xacro:include filename="$(find my_description)/parts/fingers.xacro"/></xacro:if>
</xacro:macro>
<xacro:place prefix="$(arg side)" sim="false"/>
<xacro:if value="${len(kinds) != 2}"><xacro:unknown/></xacro:if>
</robot>"""


def write_xacro(folder, text=XACRO):
    """Write a description of a maker into a folder with another name than its package."""
    pytest.importorskip("xacro")
    for name in ("clone/robots", "clone/parts"):
        (folder / name).mkdir(parents=True)
    (folder / "clone" / "package.xml").write_text("<package><name>my_description</name></package>")
    parts = hand(folder / "clone" / "parts").read_text()
    parts = parts.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"')
    parts = parts.replace('xyz="0 0.04 0.05"', "xyz=\"0 ${at['y']} $(arg height)\"")
    (folder / "clone" / "parts" / "fingers.xacro").write_text(parts)
    (folder / "clone" / "robots" / "my.urdf.xacro").write_text(text)


def test_a_maker_s_macros_are_expanded_with_arguments(tmp_path):
    write_xacro(tmp_path)
    text = "hand: {file: clone/robots/my.urdf.xacro, xacro: ['height:=0.05']}"
    robot = ik.load_robot(describe(tmp_path, text))
    np.testing.assert_allclose(robot.links(robot.home)["left_1"][:3, 3], [0, 0.06, 0.05])
    with pytest.raises(ik.errors.DescriptionError, match=r"'height'.* --xacro-args height:=VALUE"):
        ik.load_robot(describe(tmp_path, "hand: {file: clone/robots/my.urdf.xacro}"))


@pytest.mark.parametrize(
    "expression",
    ["open('/etc/passwd')", "''.__class__", "'x'.format(1)", "[].append(1)", "dict.x"],
)
def test_unsafe_expressions_are_not_evaluated(tmp_path, expression):
    write_xacro(tmp_path, XACRO.replace("len(kinds) != 2", expression))
    text = "hand: {file: clone/robots/my.urdf.xacro, xacro: ['height:=0.05']}"
    with pytest.raises(ik.errors.DescriptionError, match=r"is not (evaluated|defined)"):
        ik.load_robot(describe(tmp_path, text))


HEAD = """<robot name="hand" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:property name="y" value="${2 * 0.03}"/>"""
