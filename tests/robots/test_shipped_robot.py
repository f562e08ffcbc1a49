"""The shipped robots compared with an independent computation of the published tables."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import yaml
from processes import MODELS

import casadi_ik as ik
from casadi_ik import model as robots

DEG = np.pi / 180


def rot(axis: int, angle: float) -> np.ndarray:
    pose = np.eye(4)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    pose[i, i] = pose[j, j] = np.cos(angle)
    pose[i, j], pose[j, i] = -np.sin(angle), np.sin(angle)
    return pose


def shift(axis: int, length: float) -> np.ndarray:
    pose = np.eye(4)
    pose[axis, 3] = length
    return pose


# Offset of theta [deg], d [m], a [m], alpha [deg]; standard DH.
LWR = [
    *((0, 0.3105, 0, 90), (0, 0, 0, -90), (0, 0.4, 0, -90), (0, 0, 0, 90)),
    *((0, 0.39, 0, 90), (0, 0, 0, -90), (0, 0.078, 0, 0)),
]
BAXTER = [
    *((0, 0.27035, 0.069, -90), (90, 0, 0, 90), (0, 0.36442, 0.069, -90), (0, 0, 0, 90)),
    *((0, 0.37429, 0.010, -90), (0, 0, 0, 90), (0, 0.229525, 0, 0)),
]


def chain(thetas: np.ndarray, table: list[tuple[float, ...]]) -> np.ndarray:
    """Return the pose of the last frame by standard DH: Rz(theta) Tz(d) Tx(a) Rx(alpha)."""
    pose = np.eye(4)
    for theta, (offset, d, a, alpha) in zip(thetas, table, strict=True):
        pose = pose @ rot(2, theta + offset * DEG) @ shift(2, d) @ shift(0, a) @ rot(0, alpha * DEG)
    return pose


def lwr(theta: np.ndarray) -> np.ndarray:
    """Return the pose of the flange."""
    return chain(theta, LWR)


R_SIGN, J_SIGN = {1: -1, 2: 1, 3: 0}, {1: 1, 2: 1, 3: -1}
NUMBER = {"thumb": 3, "finger_2": 2, "finger_3": 1}


def barrett(k: int, spread: float, proximal: float, distal: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frames {3} and {T} of finger k in frame W by modified DH (manual, Table 9)."""
    r, j = R_SIGN[k], J_SIGN[k]
    phi_2, phi_3 = 2.456 * DEG, 37.544 * DEG
    rows = [
        (r * 0.025, 0.0, 0.0754, r * spread - np.pi / 2 * j),
        (0.050, np.pi / 2, 0.0, proximal + phi_2),
        (0.070, 0.0, 0.0, distal + phi_3),
        (0.050, -np.pi / 2, 0.0095, 0.0),
    ]
    frames, pose = [], np.eye(4)
    for a, alpha, d, theta in rows:
        pose = pose @ shift(0, a) @ rot(0, alpha) @ rot(2, theta) @ shift(2, d)
        frames.append(pose)
    return frames[2], frames[3]


def test_contacts_by_denavit_hartenberg(robot, rng):
    q = rng.uniform(-np.pi, np.pi, (60, 14))
    q[:30] = robot.random(rng, 30)
    points, normals = robot.contacts(q)
    for row, theta in enumerate(q):
        flange = lwr(theta[:7])
        for column, (name, k) in enumerate(NUMBER.items()):
            assert robot.fingers[column] == name
            proximal, distal = theta[8 + 2 * column : 10 + 2 * column]
            third, tip = barrett(k, theta[7], proximal, distal)
            expected = flange @ tip
            np.testing.assert_allclose(points[row, column], expected[:3, 3], atol=1e-12)
            np.testing.assert_allclose(normals[row, column], (flange @ third)[:3, 1], atol=1e-12)
            np.testing.assert_allclose(normals[row, column], expected[:3, 2], atol=1e-12)


def test_palm_frame_is_on_the_flange(robot, rng):
    """Frame W is that of the flange; the palm frame is parallel to it, on the palm."""
    for q in robot.random(rng, 10):
        flange, surface = lwr(q[:7]), np.eye(4)
        surface[2, 3] = 0.080
        np.testing.assert_allclose(robot.links(q)["bh_base"], flange, atol=1e-12)
        np.testing.assert_allclose(robot.links(q)["lwr_flange"], flange, atol=1e-12)
        np.testing.assert_allclose(robot.palm(q), flange @ surface, atol=1e-12)
    np.testing.assert_allclose(robot.palm(np.zeros(14))[:3, 3], [0, 0, 1.2585], atol=1e-15)


def test_published_tips_of_the_open_hand(robot):
    """Tips and normals at spread 0 and proximal 0 are as published."""
    palm = robot.links(np.zeros(14))["bh_base"]
    points, normals = robot.contacts(np.zeros(14))
    local = (points - palm[:3, 3]) @ palm[:3, :3]
    expected = [[0, 0.1521, 0.1178], [0.025, -0.1521, 0.1178], [-0.025, -0.1521, 0.1178]]
    np.testing.assert_allclose(local, expected, atol=5e-5)
    np.testing.assert_allclose(
        normals @ palm[:3, :3],
        [[0, -0.643, 0.766], [0, 0.643, 0.766], [0, 0.643, 0.766]],
        atol=5e-4,
    )


def test_names_and_order(robot):
    assert robot.name == "kuka_lwr_barrett"
    assert robot.fingers == ("thumb", "finger_2", "finger_3")
    assert robot.thumb == "thumb"
    assert robot.actuators == (
        *(f"lwr_joint_{i}" for i in range(1, 8)),
        "bh_spread",
        "bh_thumb_proximal",
        "bh_thumb_distal",
        "bh_finger_2_proximal",
        "bh_finger_2_distal",
        "bh_finger_3_proximal",
        "bh_finger_3_distal",
    )


def test_limits_and_home(robot):
    upper = [170, 120, 170, 120, 170, 120, 170, 180, 140, 48, 140, 48, 140, 48]
    lower = [-x for x in upper[:7]] + [0] * 7
    home = [0, 30, 0, -90, 0, 60, 0, 30, 90, 10, 90, 10, 90, 10]
    np.testing.assert_allclose(robot.upper, np.radians(upper), rtol=1e-15)
    np.testing.assert_allclose(robot.lower, np.radians(lower), rtol=1e-15)
    np.testing.assert_allclose(robot.home, np.radians(home), rtol=1e-15)
    velocity = [actuator.velocity for actuator in robot.description.actuators]
    np.testing.assert_allclose(np.degrees(velocity[:7]), [110, 110, 128, 128, 204, 184, 184])
    assert velocity[7:] == [2.0] * 7
    for joint in robot.description.movable:
        if joint.name in robot.actuators:
            i = robot.actuators.index(joint.name)
            assert (joint.lower, joint.upper) == (robot.lower[i], robot.upper[i])


def test_arrays_are_read_only(robot):
    for array in (robot.lower, robot.upper, robot.home, robot.description.palm_placement):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_one_motor_spreads_two_fingers_mirrored(robot):
    q = robot.home.copy()
    q[7] = 0.7
    joints = robot.joints(q)
    assert set(joints) == set(robot.actuators) - {"bh_spread"} | {
        "bh_finger_2_spread",
        "bh_finger_3_spread",
    }
    assert joints["bh_finger_2_spread"] == joints["bh_finger_3_spread"] == 0.7
    points, _ = robot.contacts(q)
    palm = robot.palm(q)
    local = (points - palm[:3, 3]) @ palm[:3, :3]
    np.testing.assert_allclose(local[1] * [-1, 1, 1], local[2], atol=1e-15)


@pytest.mark.parametrize("kind", ["arms", "hands"])
def test_every_number_has_a_source(kind):
    for path in (MODELS / kind).glob("*.yaml"):
        text = yaml.safe_load(path.read_text())
        entries = [*text["joints"], *text.get("fingers", {}).values()]
        entries += [text[key] for key in ("tip", "palm") if key in text]
        entries += [a for a in (text.get("actuators") or {}).values() if "limits" in a]
        assert len(entries) >= 2  # a tool has a tip and a palm
        for entry in entries:
            tags = entry["source"].split()
            assert tags, entry
            assert set(tags) <= set(text["sources"]), entry


@pytest.mark.parametrize("name", ik.shipped_names("arm_hands"))
def test_every_shipped_robot_loads(name):
    robot = ik.load_robot(name)
    assert robot.name == name
    assert robot.thumb in robot.fingers
    assert np.all(robot.lower < robot.upper)
    assert robot.home.shape == (len(robot.actuators),)
    assert robots.load_description(name).sources
    points, normals = robot.contacts(robot.home)
    assert points.shape == (len(robot.fingers), 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-14)


def test_batches_equal_singles(robot, rng):
    q = robot.random(rng, 5)
    points, normals = robot.contacts(q)
    joints, links, palms = robot.joints(q), robot.links(q), robot.palm(q)
    for i in range(5):
        single = robot.contacts(q[i])
        np.testing.assert_array_equal(points[i], single[0])
        np.testing.assert_array_equal(normals[i], single[1])
        np.testing.assert_array_equal(palms[i], robot.palm(q[i]))
        assert robot.joints(q[i]) == {name: values[i] for name, values in joints.items()}
        for name, pose in robot.links(q[i]).items():
            np.testing.assert_array_equal(links[name][i], pose)
    empty_points, _ = robot.contacts(np.empty((0, 14)))
    assert empty_points.shape == (0, 3, 3)


@pytest.mark.parametrize(
    ("q", "says"),
    [
        (np.zeros(13), r"q: found shape \(13,\), expected \(14,\) or \(k, 14\)"),
        (np.zeros((2, 2, 14)), r"found shape \(2, 2, 14\)"),
        (np.full(14, np.nan), "NaN"),
        (np.full(14, np.inf), "finite"),
        (["a"] * 14, "expected numbers"),
        ([[1.0], [1.0, 2.0]], "expected numbers"),
        (1.0, r"found shape \(\)"),
    ],
)
def test_bad_configurations(robot, q, says):
    for ask in (robot.contacts, robot.joints, robot.palm, robot.links):
        with pytest.raises(ik.CasadiIKError, match=says):
            ask(q)


def test_random_configurations_lie_within_limits(robot):
    q = robot.random(np.random.default_rng(1), 500)
    assert np.all((q >= robot.lower) & (q <= robot.upper))
    assert np.all(np.ptp(q, axis=0) > 0.9 * (robot.upper - robot.lower))
    np.testing.assert_array_equal(q, robot.random(np.random.default_rng(1), 500))


def test_unknown_names_list_the_known(robot):
    with pytest.raises(ik.CasadiIKError, match=r"'pinky'.*fingers:.*finger_2"):
        robot.description.finger("pinky")
    with pytest.raises(ik.CasadiIKError, match=r"'x'.*actuators: lwr_joint_1"):
        robot.description.actuator_index("x")
    with pytest.raises(ik.CasadiIKError, match="no link 'x'"):
        robot.description.chain("x")


def test_derived_data_are_not_pickled() -> None:
    """Derived data in pickles would give every solver kernels of its own."""
    description = ik.load_robot("kuka_lwr_barrett").description
    data_before = pickle.dumps(description)
    assert description.movable
    assert description.arm_actuators
    assert pickle.dumps(description) == data_before
    assert pickle.loads(data_before).actuator_names == description.actuator_names


# Right arm of Baxter with the AR10.


@pytest.fixture(scope="module")
def baxter() -> ik.ArmHand:
    return ik.load_robot("baxter_ar10")


def test_arm_and_mount(baxter, rng):
    base = rot(2, -0.7854)
    base[:3, 3] = 0.024645, -0.219645, 0.118588
    base = base @ shift(0, 0.055695) @ shift(2, 0.011038)
    for q in baxter.random(rng, 20):
        hand = base @ chain(q[:7], BAXTER) @ shift(2, -0.0021) @ rot(2, -np.pi / 2)
        np.testing.assert_allclose(baxter.links(q)["hand_base"], hand, atol=1e-14)


def test_hand_equals_the_ar10(baxter, rng):
    hand_alone = ik.load_robot("ar10")
    assert baxter.actuators[7:] == hand_alone.actuators
    assert baxter.actuators[:7] == (
        "right_s0", "right_s1", "right_e0", "right_e1", "right_w0", "right_w1", "right_w2",
    )  # fmt: skip
    assert baxter.fingers == hand_alone.fingers
    q = baxter.random(rng, 20)
    hand = baxter.links(q)["hand_base"]
    points, normals = hand_alone.contacts(q[:, 7:])
    found_points, found_normals = baxter.contacts(q)
    expected_points = np.einsum("kij,kfj->kfi", hand[:, :3, :3], points) + hand[:, None, :3, 3]
    np.testing.assert_allclose(found_points, expected_points, atol=1e-14)
    turned_normals = np.einsum("kij,kfj->kfi", hand[:, :3, :3], normals)
    np.testing.assert_allclose(found_normals, turned_normals, atol=1e-14)
    np.testing.assert_allclose(baxter.palm(q), hand @ hand_alone.palm(hand_alone.home), atol=1e-14)


# The Barrett hand with its four motors: distal joints follow at a third of the proximal ones.

BARRETT_FINGERS = ("thumb", "finger_2", "finger_3")


@pytest.fixture(scope="module")
def coupled() -> ik.ArmHand:
    return ik.load_robot("kuka_lwr_barrett_coupled")


def independent(coupled: ik.ArmHand, robot: ik.ArmHand, q: np.ndarray) -> np.ndarray:
    """Return the posture in the coordinates of the hand with independent distal joints."""
    joints = coupled.joints(q)
    positions = dict(zip(coupled.actuators, q.T, strict=True)) | joints
    return np.stack([positions[name] for name in robot.actuators], axis=1)


def test_eleven_motors(coupled, robot):
    names = [name for name in robot.actuators if not name.endswith("distal")]
    assert list(coupled.actuators) == names
    assert coupled.fingers == BARRETT_FINGERS
    for end in ("lower", "upper"):
        values = dict(zip(robot.actuators, getattr(robot, end), strict=True))
        np.testing.assert_array_equal(getattr(coupled, end), [values[name] for name in names])


def test_distal_joints_follow_within_their_limits(coupled, rng):
    q = np.concatenate([coupled.random(rng, 20), coupled.upper[None], coupled.lower[None]])
    joints = coupled.joints(q)
    limits = {joint.name: (joint.lower, joint.upper) for joint in coupled.description.movable}
    for finger in BARRETT_FINGERS:
        distal, proximal = (joints[f"bh_{finger}_{name}"] for name in ("distal", "proximal"))
        np.testing.assert_allclose(distal, proximal / 3, rtol=1e-15)
        assert np.all(distal <= limits[f"bh_{finger}_distal"][1])
    np.testing.assert_allclose(np.degrees(joints["bh_thumb_distal"][-2]), 140 / 3, rtol=1e-12)


def test_coupled_hand_matches_the_uncoupled(coupled, robot, rng):
    q = coupled.random(rng, 20)
    ours, theirs = coupled.contacts(q), robot.contacts(independent(coupled, robot, q))
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-14)
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-14)
    np.testing.assert_allclose(
        coupled.palm(q), robot.palm(independent(coupled, robot, q)), atol=1e-14
    )


@pytest.mark.parametrize("method", ["enhanced-dls", "enhanced-sdls"])
def test_paper_methods_explain_refusal(coupled, method):
    """Eq. (5) distributes a sum over two flexions, which this hand does not have."""
    with pytest.raises(ik.errors.UnsupportedError) as caught:
        ik.Solver(coupled, method)
    assert str(caught.value) == (
        "robot 'kuka_lwr_barrett_coupled': finger 'finger_2' is not a planar finger: "
        "bh_finger_2_distal follows 'bh_finger_2_proximal'; expected a separate motor"
    )


def test_grasps_of_other_robots_are_unreachable(coupled, robot):
    """Eleven motors cannot meet fifteen equations of a pinch of independent distal joints."""
    grasp = ik.load_grasp("cup")
    assert ik.Solver(robot).solve(grasp).success
    assert not ik.Solver(coupled, tolerance=ik.Tolerance(1e-4, 1e-3)).solve(grasp).success
