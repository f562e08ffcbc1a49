"""Multi-arm robots: their files, and sides as robots of their own."""

from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik

NAMES = [f"{name}+leap" if name == "two_ur10e" else name for name in ik.shipped_names("bodies")]


def anywhere(robot, seed=1):
    rng = np.random.default_rng(seed)
    return robot.lower + rng.random(len(robot.lower)) * (robot.upper - robot.lower)


@pytest.mark.parametrize("name", NAMES)
def test_side_alone_matches_the_body(name):
    robot = ik.load_robot(name)
    body, q = robot.description, anywhere(robot)
    trunk = list(body.trunk_actuators)
    assert np.all((body.lower[trunk] <= 0) & (body.upper[trunk] >= 0))
    q[trunk] = 0.0
    base = np.eye(4)
    for joint in body.chain(body.trunk_link):
        base = base @ joint.placement
    points, normals = robot.contacts(q)
    motors = set(body.trunk)
    for side in body.sides:
        side_robot = ik.ArmHand(body.side(side.name))
        assert not motors & set(side_robot.actuators)
        motors |= set(side_robot.actuators)
        columns = [body.actuator_index(motor) for motor in side_robot.actuators]
        side_points, facing = side_robot.contacts(q[columns])
        fingers = [body.finger_names.index(finger) for finger in side.fingers]
        np.testing.assert_allclose(
            side_points @ base[:3, :3].T + base[:3, 3], points[fingers], atol=1e-9
        )
        np.testing.assert_allclose(facing @ base[:3, :3].T, normals[fingers], atol=1e-9)
    assert motors == set(robot.actuators)


@pytest.mark.parametrize("name", ["g1+dex3", "g1+inspire", "h1_2+inspire"])
def test_mirrored_sides_reflect(name):
    """A grasp by one side is the mirror image of the grasp by the other side."""
    robot = ik.load_robot(name)
    body, q = robot.description, robot.home.copy()
    left, right = (
        [body.actuator_index(motor) for motor in (*side.arm, *side.hand)] for side in body.sides
    )
    rng = np.random.default_rng(2)
    q[left] = (body.lower + rng.random(len(q)) * (body.upper - body.lower))[left]
    # A motor whose range is the other's turned round runs the other way; of ranges that are
    # symmetric the axis tells.
    for left_vector, right_vector in zip(left, right, strict=True):
        joints = [
            next(j for j in body.movable if j.name == body.actuator_names[i])
            for i in (left_vector, right_vector)
        ]
        mirrored = -joints[0].axis * [1, -1, 1]
        q[right_vector] = q[left_vector] * np.sign(mirrored @ joints[1].axis)
    points, normals = robot.contacts(q)
    half_count = len(points) // 2
    across = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(points[:half_count] * across, points[half_count:], atol=1e-9)
    np.testing.assert_allclose(normals[:half_count] * across, normals[half_count:], atol=1e-9)
    np.testing.assert_array_less(robot.lower[right] - 1e-9, q[right])
    np.testing.assert_array_less(q[right], robot.upper[right] + 1e-9)


BODY = """
name: pair
trunk: lift
sides:
  left: {arm: panda, hand: allegro_left, at: {xyz: [0, 0.3 m, 0.6 m]}}
  right: {arm: panda, hand: allegro_right, at: {xyz: [0, -0.3 m, 0.6 m]}}
"""


def test_a_body_from_parts(tmp_path: Path):
    path = tmp_path / "pair.yaml"
    path.write_text(BODY)
    body = ik.load_robot(path).description
    assert body.trunk == ("lift",)
    assert [side.name for side in body.sides] == ["left", "right"]
    assert body.finger_names[0] == "left_thumb"
    assert len(body.actuators) == 1 + 2 * 23


URDF = """
<robot name="two">
  <link name="base"/><link name="torso"/><link name="head"/>
  <joint name="waist" type="revolute"><parent link="base"/><child link="torso"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="neck" type="revolute"><parent link="torso"/><child link="head"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <link name="end"/>
  <joint name="tail" type="revolute"><parent link="base"/><child link="end"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  {sides}
</robot>
"""
SIDE = """
  <link name="{s}_arm"/><link name="{s}_palm"/><link name="{s}_tip"/>
  <joint name="{s}_shoulder" type="revolute"><parent link="torso"/><child link="{s}_arm"/>
    <origin xyz="0 {y} 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="{s}_wrist" type="revolute"><parent link="{s}_arm"/><child link="{s}_palm"/>
    <origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="{s}_finger" type="revolute"><parent link="{s}_palm"/><child link="{s}_tip"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
"""
FILE = """
name: two
robot: {file: two.urdf, locked: {neck: 0, tail: 0}}
sides:
  left: {palm: left_palm, fingers: {tip: {link: left_tip, normal: [0, 0, 1]}}}
  right: {palm: right_palm, fingers: {tip: {link: right_tip, normal: [0, 0, 1]}}}
"""


@pytest.fixture
def in_a_file(tmp_path: Path) -> Path:
    sides = "".join(SIDE.format(s=s, y=y) for s, y in (("left", 0.2), ("right", -0.2)))
    (tmp_path / "two.urdf").write_text(URDF.format(sides=sides))
    path = tmp_path / "two.yaml"
    path.write_text(FILE)
    return path


def test_trunk_and_sides_are_read_from_a_file(in_a_file: Path):
    body = ik.load_robot(in_a_file).description
    assert (body.trunk, body.trunk_link) == (("waist",), "torso")
    left, right = body.sides
    assert (left.arm, left.hand, left.fingers) == (
        ("left_shoulder", "left_wrist"),
        ("left_finger",),
        ("left_tip",),
    )
    assert right.palm_link == "right_palm"


@pytest.mark.parametrize(
    ("old", "new", "expected_words"),
    [
        (
            ", locked: {neck: 0, tail: 0}",
            "",
            "move no side; write them under locked: {neck: 0, tail: 0}",
        ),
        ("sides:", "trunk: left_arm\nsides:", "does not carry the palm of 'right'"),
        ("link: left_tip", "link: right_tip", "fingers.tip.link: 'right_tip' is not below"),
        (
            "right: {palm: right_palm, fingers: {tip: {link: right_tip",
            "right: {palm: left_palm, fingers: {tip: {link: left_tip",
            "sides.left.palm: found 'left_palm', which carries the palm of 'right' too",
        ),
        (
            "palm: left_palm",
            "palm: no_such",
            "sides.left.palm: unknown link 'no_such'; known",
        ),
        ("link: left_tip", "link: nope", "sides.left.fingers.tip.link: unknown link 'nope'"),
        ("{tip: {link: left_tip, normal: [0, 0, 1]}}", "{}", "sides.left.fingers: is empty"),
        ("{palm: left", "{thumb: toe, palm: left", "sides.left.thumb: side 'left' has no finger"),
        ("sides:", "trunk: nowhere\nsides:", "trunk: unknown link 'nowhere'; known: base"),
        ("sides:", "trunk: base\nsides:", "joint 'waist' beyond it moves every palm; expected"),
        ("two.urdf", "tow.urdf", "robot.file: {folder}/tow.urdf: no such file"),
        ("two.urdf", "two.urdf, palm: torso", "robot.palm: is not allowed"),
        ("sides:", "colour: red\nsides:", "colour"),
    ],
)
def test_errors_of_body_files(in_a_file: Path, old: str, new: str, expected_words: str):
    in_a_file.write_text(FILE.replace(old, new, 1))
    refused(in_a_file, expected_words.replace("{folder}", str(in_a_file.parent)))


def test_arm_placements_must_all_be_given(tmp_path: Path):
    path, part_template = tmp_path / "pair.yaml", "{arm: panda, hand: allegro_left%s}"
    sides = ", at: {xyz: [0, 0.3, 0]}", ""
    text = (
        "name: pair\ntrunk: lift\nsides:\n  left: "
        + part_template
        + "\n  right: "
        + part_template
        + "\n"
    )
    path.write_text(text % sides)
    refused(path, "sides.right.at: missing; expected a pose as in sides.left")
    path.write_text(text % (sides[0], ", at: {}"))
    robot = ik.load_robot(path)
    separation = robot.palm(robot.home, "left") - robot.palm(robot.home, "right")
    np.testing.assert_allclose(separation[:3, 3], [0, 0.3, 0], atol=1e-12)


def refused(path: Path, expected_words: str):
    """Assert that the robot is refused with one line that names the file."""
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_robot(path)
    assert expected_words in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("follower", "leader", "expected_words"),
    [
        ("right_finger", "left_finger", "sides.right: {} which belongs to side 'left'"),
        ("left_wrist", "right_finger", "sides.left: {} which belongs to side 'right'"),
        ("right_shoulder", "waist", "sides.right: {} which belongs to the trunk"),
        ("waist", "left_wrist", "trunk: {} which belongs to side 'left'"),
    ],
)
def test_a_motor_of_two_sides_is_refused(
    in_a_file: Path, follower: str, leader: str, expected_words: str
):
    file = in_a_file.with_suffix(".urdf")
    joint = f'<joint name="{follower}" type="revolute">'
    file.write_text(file.read_text().replace(joint, f'{joint}<mimic joint="{leader}"/>'))
    refused(in_a_file, expected_words.format(f"joint {follower!r} follows motor {leader!r},"))


@pytest.mark.parametrize(
    ("old", "new", "expected_words"),
    [
        ("hand: allegro_left, ", "", "sides.left.hand: missing"),
        ("arm: panda, hand: allegro_left", "arm: pandora, hand: allegro_left", "pandora"),
        ("trunk: lift", "trunk: lyft", "trunk: no shipped trunk is called 'lyft'"),
        ("hand: allegro_left", "hand: allegro_left, mirror: [foot]", "expected 'arm' or 'hand'"),
        (
            "hand: allegro_left",
            "hand: allegro_left, fingers: [thumb, toe]",
            "sides.left.fingers: allegro_left has no finger 'toe'; expected one of: thumb, index, ",
        ),
        (
            "hand: allegro_left",
            "hand: allegro_left, fingers: [index], thumb: thumb",
            "sides.left.thumb: 'thumb' is not one of the fingers",
        ),
    ],
)
def test_errors_of_bodies_from_parts(tmp_path: Path, old: str, new: str, expected_words: str):
    path = tmp_path / "pair.yaml"
    path.write_text(BODY.replace(old, new, 1))
    refused(path, expected_words)


def test_missing_side_is_named():
    with pytest.raises(ik.errors.UnknownNameError, match=r"'middle'.*left, right"):
        ik.load_robot("g1+dex3").description.side("middle")
