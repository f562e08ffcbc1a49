"""A person's hand moves a robot: configuration, targets, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_up_hand import hand, like_robot
from msgspec.structs import replace
from processes import python

import casadi_ik as ik

TEN_LINES = """\
robot: kuka_lwr_barrett
fingers: {thumb: 4, finger_2: 8, finger_3: 12}
wrist: 0
scaling: 1.6
travel: 2.0
rpy: [0, 0, 90 deg]
xyz: [500 mm, 0, 600 mm]
low_pass: 0.3
wrist_weight: 0.02
"""


@pytest.fixture
def retarget(tmp_path):
    """Function that loads a retargeting file; default: thumb and two other fingers."""

    def read(robot=None, **keys):
        if robot is not None:
            other_fingers = [name for name in robot.fingers if name != robot.thumb]
            keys["fingers"] = dict(zip((robot.thumb, *other_fingers[:2]), (4, 8, 12), strict=True))
        path = tmp_path / "keys.yaml"
        path.write_text(json.dumps(keys))
        return ik.motion.load_retarget(path)

    return read


def test_ten_line_program(tmp_path):
    path = tmp_path / "hand.yaml"
    path.write_text(TEN_LINES)
    config = ik.motion.load_retarget(path)
    assert config.fingers == {"thumb": 4, "finger_2": 8, "finger_3": 12}
    assert (config.scaling, config.low_pass, config.robot) == (1.6, 0.3, "kuka_lwr_barrett")
    assert config.rpy == pytest.approx((0, 0, np.pi / 2))
    assert config.xyz == pytest.approx((0.5, 0, 0.6))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("thumb: 4", "thumb: 21", "fingers.thumb: found 21, expected a keypoint from 0 to 20"),
        ("low_pass: 0.3", "low_pass: 0", "low_pass: found 0, expected a number above 0 up to 1"),
        ("scaling: 1.6", "scaling: -1", "scaling: found -1, expected a number >= 0"),
        ("wrist: 0", "palm: 0", "palm"),
        ("fingers: {thumb: 4, finger_2: 8, finger_3: 12}", "fingers: {}", "fingers: "),
    ],
)
def test_a_bad_file_is_refused_by_key(tmp_path, old, new, message):
    path = tmp_path / "hand.yaml"
    path.write_text(TEN_LINES.replace(old, new))
    with pytest.raises(ik.errors.DescriptionError, match=message) as caught:
        ik.motion.load_retarget(path)
    assert str(caught.value).startswith(str(path))


def test_missing_finger_is_refused(robot, retarget):
    with pytest.raises(ik.errors.InputError, match=r"fingers\.little: "):
        ik.motion.Retargeter(retarget(fingers={"little": 20}), robot)


def test_motions_are_scaled_and_turned(robot, retarget):
    """The wrist's path is scaled by `travel`, the hand by `scaling`, both turned by `rpy`."""
    config = retarget(
        fingers={"thumb": 4, "finger_2": 8}, scaling=1.5, travel=2.0, rpy=(0, 0, np.pi / 2)
    )
    retargeter = ik.motion.Retargeter(config, robot)
    first = retargeter(hand(0.4, np.zeros(3)))
    second = retargeter(hand(0.4, np.array([0.1, 0.0, 0.0])))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(first.palm[:3, 3], robot.palm(robot.home)[:3, 3])
    np.testing.assert_allclose(first.palm[:3, :3], robot.palm(robot.home)[:3, :3], atol=1e-12)
    np.testing.assert_allclose(second.palm[:3, 3] - first.palm[:3, 3], [0.0, 0.2, 0.0], atol=1e-12)
    tips = hand(0.4, np.zeros(3))[[4, 8]]
    offsets = first.points[:2] - first.palm[:3, 3]
    np.testing.assert_allclose(offsets, 1.5 * tips @ turn.T, atol=1e-12)
    assert np.isnan(first.points[2]).all()
    target = retargeter(hand(0.4, np.array([0.1, 0.0, 0.0]), turn=0.3))
    relative = target.palm[:3, :3] @ second.palm[:3, :3].T
    assert np.arccos((np.trace(relative) - 1) / 2) == pytest.approx(0.3)


def test_first_frame_defines_the_frame(robot, retarget):
    """Fingertips of a person who holds the hand like the robot are those of the robot."""
    points, _ = robot.contacts(robot.home)
    palm = robot.palm(robot.home)
    frame = np.random.default_rng(0).normal(size=(21, 3))
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    frame[[4, 8, 12]] = (points - palm[:3, 3]) @ turn / 1.7 + frame[0]
    config = replace(retarget(robot), scaling=1.7)
    target = ik.motion.Retargeter(config, robot)(frame)
    np.testing.assert_allclose(target.points, points, atol=1e-9)


def spans(frame, target, robot, config):
    """Return the distances between thumb and index finger of a person and of a robot [m]."""
    thumb, index = (name for name, key in config.fingers.items() if key in (4, 8))
    tips = target.points[[robot.fingers.index(thumb), robot.fingers.index(index)]]
    return np.linalg.norm(frame[4] - frame[8]), np.linalg.norm(tips[0] - tips[1])


@pytest.mark.parametrize("name", ["panda+allegro_right", "kuka_lwr_barrett", "ur5e+robotiq_3f"])
def test_hand_size_is_measured_when_open(name, retarget):
    """The scale is independent of both first postures: a pinch is a pinch."""
    robot = ik.load_robot(name)
    config, place = retarget(robot), np.array([0.3, 0.1, 0.6])
    pinch = hand(0.9, place)
    pinch[4] = pinch[8] + [0.0, 0.0, -0.02]
    ratios = []
    for bend in (0.0, 0.4, 0.9):
        retargeter = ik.motion.Retargeter(config, robot)
        retargeter(hand(bend, place))
        person, robot_spans = spans(pinch, retargeter(pinch), robot, config)
        ratios.append(robot_spans / person)
    assert person == pytest.approx(0.02)
    assert 0.85 < ratios[0] < 1.15
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-9)
    # Without joints between, the fingers of the first frame are assumed to be straight.
    half_seen = hand(0.0, place)
    half_seen[[2, 6, 10, 14, 18]] = np.nan
    retargeter = ik.motion.Retargeter(config, robot)
    retargeter(half_seen)
    person, robot_spans = spans(pinch, retargeter(pinch), robot, config)
    assert robot_spans / person == pytest.approx(ratios[0], rel=0.25)


def seen_by_mediapipe(bend, wrist):
    """Return world landmarks of a hand: metres about its own centre."""
    frame = hand(bend, wrist)
    return frame - frame.mean(axis=0) + [0.004, -0.006, 0.002]


def test_wrist_of_world_landmarks_stays(robot, retarget):
    config = retarget(robot)
    home = robot.palm(robot.home)[:3, 3]
    bends = [(bend, np.array([0.2 * bend, 0.1, 0.5])) for bend in (0.1, 0.5, 0.9)]
    retargeter = ik.motion.Retargeter(config, robot)
    for bend, place in bends:
        target = retargeter(seen_by_mediapipe(bend, place))
        np.testing.assert_allclose(target.palm[:3, 3], home, atol=1e-12)
    assert retargeter.in_hand
    metric = ik.motion.Retargeter(config, robot)
    for bend, place in bends:
        goes = metric(hand(bend, place))
    # The fingers are where they are for a moving wrist.
    offsets = [posed_target.points - posed_target.palm[:3, 3] for posed_target in (target, goes)]
    np.testing.assert_allclose(*offsets, atol=1e-9)
    assert np.linalg.norm(goes.palm[:3, 3] - home) > 0.1
    assert not metric.in_hand
    # A given scale of the wrist's path is used.
    moving_retargeter = ik.motion.Retargeter(replace(config, travel=1.0), robot)
    palm_points = [
        moving_retargeter(seen_by_mediapipe(*bend_and_place)).palm[:3, 3]
        for bend_and_place in bends
    ]
    assert np.linalg.norm(palm_points[-1] - palm_points[0]) > 0.005


@pytest.mark.parametrize("size", [0.35, 0.1])
def test_image_landmarks_are_refused(robot, size, retarget):
    """Image landmarks are fractions of width and height with depths from the wrist."""
    frame = hand(0.3, np.zeros(3)) * size / 0.09 + [0.4, 0.5, 3e-7]
    with pytest.raises(ik.errors.InputError, match=r"landmarks"):
        ik.motion.Retargeter(retarget(robot), robot)(frame)
    pixels = 1800 * (hand(0.3, np.zeros(3)) + 0.2)
    with pytest.raises(
        ik.errors.InputError, match=r"a palm 163 m long, expected metres \(pixels, or mm\?\)"
    ):
        ik.motion.Retargeter(retarget(robot), robot)(pixels)


def test_a_left_hand_moves_a_right_robot_hand(robot, retarget):
    """The fingers equal those of a right hand, and the wrist moves and rotates alike."""
    config = replace(retarget(robot), rpy=(0.0, 0.0, 0.0))
    right, left = (
        ik.motion.Retargeter(config, robot),
        ik.motion.Retargeter(replace(config, mirror=True), robot),
    )
    plain = ik.motion.Retargeter(config, robot)
    for i, bend in enumerate((0.5, 0.3, 0.7)):
        place, turn = np.array([0.3, 0.1 * i, 0.5 + 0.05 * i]), 0.3 * i
        c, s = np.cos(turn), np.sin(turn)
        left_keypoints = hand(bend, np.zeros(3)) * [1.0, -1.0, 1.0]
        keypoints = left_keypoints @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + place
        expected, left_target = right(hand(bend, place, turn)), left(keypoints)
        np.testing.assert_allclose(left_target.palm, expected.palm, atol=1e-9)
        tips, left_tips = (target.points - target.palm[:3, 3] for target in (expected, left_target))
        np.testing.assert_allclose(left_tips @ left_tips.T, tips @ tips.T, atol=1e-9)
        # The order of thumb, index and middle finger.
        assert np.linalg.det(left_tips) == pytest.approx(np.linalg.det(tips))
        flipped = plain(keypoints)
        flat = flipped.points - flipped.palm[:3, 3]
        assert np.linalg.det(flat) == pytest.approx(-np.linalg.det(tips))


def test_smoothing_is_independent_of_the_call_rate(robot, retarget):
    """A frame at 30 Hz is used once or in every cycle of a follower at a kilohertz or two."""
    config = replace(retarget(robot), scaling=1.0, low_pass=0.3)
    frames = [hand(0.4, np.array([0.05 * i, 0.0, 0.4])) for i in range(5)]
    ends = []
    for cycles in (1, 33, 66):
        retargeter = ik.motion.Retargeter(config, robot)
        for frame in frames:
            for _ in range(cycles):
                target = retargeter(frame, elapsed=1 / 30 / cycles)
        ends.append(target.palm)
    np.testing.assert_allclose(ends[1:], [ends[0]] * 2, atol=1e-12)
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ik.errors.InputError, match="elapsed: found "):
            retargeter(frames[0], elapsed=bad)


def test_low_pass(robot, retarget):
    config = retarget(fingers={"thumb": 4}, scaling=1.0, rpy=(0.0, 0.0, 0.0), low_pass=0.25)
    retargeter = ik.motion.Retargeter(config, robot)
    start = retargeter(hand(0.4, np.zeros(3))).points[0]
    shifts = [retargeter(hand(0.4, np.array([0.1, 0, 0]))).points[0] - start for _ in range(3)]
    np.testing.assert_allclose([m[0] for m in shifts], 0.1 * (1 - 0.75 ** np.arange(1, 4)))


def test_arm_and_hand_follow_a_person(robot, retarget):
    """Fingertips and wrist follow a person who moves like the robot, at any scale."""
    excursion = 0.15 * np.sin(np.linspace(0, np.pi, 120))[:, None] * np.sin(np.arange(14))
    path = robot.home + excursion
    fingers = {"thumb": 4, "finger_2": 8, "finger_3": 12}
    config = retarget(fingers=fingers, scaling=1.7, travel=1.7)
    retargeter = ik.motion.Retargeter(config, robot)
    follower = ik.Solver(robot).follow(robot.home, 1 / 30)
    points, _ = robot.contacts(path)
    for keypoints, expected, palm in zip(
        like_robot(robot, path, 1.7), points, robot.palm(path), strict=True
    ):
        target = retargeter(keypoints)
        np.testing.assert_allclose(target.points, expected, atol=1e-9)
        np.testing.assert_allclose(target.palm, palm, atol=1e-9)
        q = follower(target.points, palm=target.palm, palm_weight=(0.05, 0.05))
        assert follower.state.status is ik.motion.FollowStatus.FOLLOWING
        np.testing.assert_allclose(robot.palm(q)[:3, 3], palm[:3, 3], atol=0.02)


KEYPOINTS = Path(__file__).parents[2] / "models" / "keypoints"


@pytest.fixture(scope="module")
def g1():
    return ik.load_robot("g1+dex3")


@pytest.fixture(scope="module")
def both_hands():
    """Keypoints by side, at 30 frames per second."""
    arrays = np.load(KEYPOINTS / "two_hands_box.npz")
    return {side: arrays[f"keypoints_{side}"].astype(float) for side in ("left", "right")}


def test_both_hands_move_a_body(g1, both_hands):
    config = ik.motion.load_retarget(KEYPOINTS / "two_hands_g1.yaml")
    retargeter = ik.motion.Retargeter(config, g1, g1.home)
    follower = ik.Solver(g1).follow(g1.home, period=1 / 30)
    errors, q = [], []
    for i in range(len(both_hands["left"])):
        target = retargeter({side: frames[i] for side, frames in both_hands.items()})
        q.append(follower(target.points, palm=target.palm, palm_weight=(0.05, 0.05)))
        errors.append(np.linalg.norm(g1.contacts(q[-1])[0] - target.points, axis=1))
    assert np.median(errors) < 1e-3
    # The box moves from side to side, which arms alone would not do.
    assert np.ptp(np.array(q)[:, g1.actuators.index("waist_yaw_joint")]) > 0.3


def test_both_hands_drive_a_body_in_mujoco(g1, both_hands):
    """In five seconds, springs of 31 motors move the robot as the follower commands."""
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_string(g1.urdf())
    spec.compiler.fusestatic = False
    spec.compiler.boundmass, spec.compiler.boundinertia = 0.05, 1e-4
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for body in spec.bodies:
        body.gravcomp = 1
    for joint in spec.joints:
        if joint.name in g1.actuators:
            of_hand = g1.actuators.index(joint.name) in g1.description.hand_actuators
            stiff = 3.0 if of_hand else 4000.0
            joint.armature, joint.damping = (1e-3, 0.15) if of_hand else (0.5, 200.0)
            spec.add_actuator(
                name=joint.name,
                target=joint.name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gainprm=[stiff, *[0] * 9],
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                biasprm=[0, -stiff, *[0] * 8],
            )
    model = spec.compile()
    data, step = mujoco.MjData(model), model.opt.timestep
    assert model.nu == len(g1.actuators) == 31
    motors = [model.actuator(name).id for name in g1.actuators]
    places = [model.joint(name).qposadr[0] for name in g1.actuators]
    data.qpos[places] = data.ctrl[motors] = g1.home
    config = ik.motion.load_retarget(KEYPOINTS / "two_hands_g1.yaml")
    retargeter = ik.motion.Retargeter(config, g1, g1.home)
    follower = ik.Solver(g1).follow(g1.home, period=step)
    wrong = []
    for cycle in range(int(5.0 / step)):
        newest = {side: frames[int(cycle * step * 30)] for side, frames in both_hands.items()}
        target = retargeter(newest, elapsed=step)
        data.ctrl[motors] = follower(target.points, palm=target.palm, palm_weight=(0.05, 0.05))
        mujoco.mj_step(model, data)
        points, _ = g1.contacts(data.qpos[places])
        wrong.append(np.linalg.norm(points - target.points, axis=1).max())
    # Most of it is the lag of the springs at up to half a metre per second.
    assert np.median(wrong) < 0.01
    assert max(wrong) < 0.05
    assert np.isfinite(data.qpos).all()


@pytest.mark.parametrize("sees_both_first", [True, False])
def test_unseen_hand_comes_to_rest(g1, both_hands, sees_both_first):
    config = ik.motion.load_retarget(KEYPOINTS / "two_hands_g1.yaml")
    retargeter = ik.motion.Retargeter(config, g1, g1.home)
    first = {side: frames[0] for side, frames in both_hands.items()}
    if sees_both_first:
        assert np.isfinite(retargeter(first).points).all()
    target = retargeter({"left": first["left"]})
    assert list(target.palm) == ["left"]
    left = [name.startswith("left") for name in g1.fingers]
    assert np.isfinite(target.points[left]).all()
    assert np.isnan(target.points[~np.array(left)]).all()


def test_joints_of_openxr_are_keypoints(robot, retarget):
    config = retarget(robot)
    joints = np.random.default_rng(0).normal(0, 0.05, (26, 3))
    joints[:, 2] += 1.0
    points = joints[[1, 2, 3, 4, 5, 7, 8, 9, 10, 12, 13, 14, 15, 17, 18, 19, 20, 22, 23, 24, 25]]
    keypoints = [
        ik.motion.Retargeter(config, robot)(frame).points for frame in (points, joints, joints[1:])
    ]
    assert np.array_equal(keypoints[0], keypoints[1], equal_nan=True)
    assert np.array_equal(keypoints[0], keypoints[2], equal_nan=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sides: {middle: {fingers: {thumb: 4}}}", r"sides\.middle: .*left, right"),
        ("sides: {left: {fingers: {toe: 4}}}", r"sides\.left\.fingers\.toe: "),
        ("fingers: {thumb: 4}", "sides: .*left, right"),
    ],
)
def test_missing_sides_are_refused(g1, tmp_path, text, message):
    (tmp_path / "hands.yaml").write_text(text)
    config = ik.motion.load_retarget(tmp_path / "hands.yaml")
    with pytest.raises(ik.errors.InputError, match=message):
        ik.motion.Retargeter(config, g1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sides: {left: {fingers: {}}}", r"sides\.left\.fingers: "),
        (
            "sides: {left: {fingers: {thumb: 4}}}\nfingers: {thumb: 4}",
            "fingers: ",
        ),
    ],
)
def test_a_bad_file_of_sides_is_refused(tmp_path, text, message):
    (tmp_path / "hands.yaml").write_text(text)
    with pytest.raises(ik.errors.DescriptionError, match=message):
        ik.motion.load_retarget(tmp_path / "hands.yaml")


def test_two_hands_are_passed_by_side(g1, both_hands):
    config = ik.motion.load_retarget(KEYPOINTS / "two_hands_g1.yaml")
    retargeter = ik.motion.Retargeter(config, g1)
    with pytest.raises(ik.errors.InputError, match="left, right"):
        retargeter(both_hands["left"][0])
    with pytest.raises(ik.errors.InputError, match=r"keypoints\.head: "):
        retargeter({"head": both_hands["left"][0]})
    with pytest.raises(ik.errors.InputError, match=r"keypoints\.left:.*\(20, 3\)"):
        retargeter({"left": np.zeros((20, 3))})


def test_palms_of_a_body_are_returned_by_side(g1):
    follower = ik.Solver(g1).follow(g1.home, period=0.01)
    points, _ = g1.contacts(g1.home)
    with pytest.raises(ik.errors.InputError, match=r"palm: .*left, right"):
        follower(points, palm=np.eye(4))
    with pytest.raises(ik.errors.InputError, match=r"palm:.*'head'"):
        follower(points, palm={"head": np.eye(4)})


def test_both_hands_from_a_file_on_the_command_line(tmp_path):
    run = python(
        *("-m", "casadi_ik", "follow", KEYPOINTS / "two_hands_box.npz"),
        *("--retarget", KEYPOINTS / "two_hands_g1.yaml", "--period", "0.01"),
        *("--out", tmp_path / "g1.csv"),
    )
    assert "g1+dex3" in run.stdout
    assert run.returncode in (0, 1), run.stderr
    assert len((tmp_path / "g1.csv").read_text().splitlines()) > 900
