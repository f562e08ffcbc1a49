"""Limits of coupled joints limit their motors: in bounds, random configurations and methods."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from processes import MODELS
from toy_robots import COUPLED_HAND, copy_shipped_robot, write_coupled_robot

import casadi_ik as ik

NARROW = {
    "left_spread": [-0.1, 0.5],
    "left_1": [0.3, 1.1],
    "left_3": [0.05, 0.3],
    "right_1": [0.1, 0.4],
    "right_spread": [-0.3, 0.4],
    "thumb_bend": [0.4, 1.2],
}
"""Limits of joints that their motors could exceed."""


def narrow_robot(folder):
    path = write_coupled_robot(folder)
    hand = yaml.safe_load(COUPLED_HAND)
    for joint in hand["joints"]:
        joint["limits"] = NARROW.get(joint["name"], joint["limits"])
    (folder / "parts" / "hand.yaml").write_text(yaml.safe_dump(hand))
    return path


@pytest.fixture
def narrow(tmp_path):
    return ik.load_robot(narrow_robot(tmp_path))


def narrow_barrett(folder):
    """Shipped arm with the coupled hand, whose distal joints are limited to 8 to 30 deg."""
    path = copy_shipped_robot(folder)
    models = MODELS
    hand = yaml.safe_load((models / "hands" / "barrett_bh8_280_coupled.yaml").read_text())
    for joint in hand["joints"]:
        if joint["name"].endswith("distal"):
            joint["limits"] = ["8 deg", "30 deg"]
    (folder / "hand.yaml").write_text(yaml.safe_dump(hand))
    data = yaml.safe_load((models / "arm_hands" / "kuka_lwr_barrett_coupled.yaml").read_text())
    data |= {"name": "narrow", "arm": "arm.yaml", "hand": "hand.yaml"}
    data["home"] |= {f"bh_{finger}_proximal": "60 deg" for finger in ("thumb", "finger_2")}
    data["home"]["bh_finger_3_proximal"] = "60 deg"
    path.write_text(yaml.safe_dump(data))
    return ik.load_robot(path)


def test_random_configurations_keep_joint_limits(narrow, rng):
    assert narrow.beyond_limits(narrow.random(rng, 20_000)).max() <= 1e-9


def test_the_range_is_as_wide_as_the_joints_allow(narrow):
    """At either end of every narrowed motor range, some joint is at its own limit."""
    strokes = narrow.description.actuator_limits
    narrowed = set()
    for side, ends in enumerate((narrow.lower, narrow.upper)):
        for i, name in enumerate(narrow.actuators):
            q = narrow.home.copy()
            q[i] = ends[i]
            assert abs(narrow.beyond_limits(q)) <= 1e-9
            if ends[i] != strokes[side][i]:
                narrowed.add(name)
                q[i] += (2 * side - 1) * 1e-6 * (strokes[1] - strokes[0])[i]
                assert narrow.beyond_limits(q) > 1e-9
    assert narrowed == {"spread", "screw_1", "screw_2", "thumb_bend"}


def test_shipped_robots_keep_their_exact_strokes():
    for name in ik.shipped_names("arm_hands"):
        robot = ik.load_robot(name)
        np.testing.assert_array_equal(robot.lower, robot.description.actuator_limits[0])
        np.testing.assert_array_equal(robot.upper, robot.description.actuator_limits[1])


def test_non_monotonic_coupling_keeps_the_interval_of_home(tmp_path):
    """A four-bar turns back where rod and ground align; home's interval is kept."""
    path = narrow_robot(tmp_path)
    hand = yaml.safe_load((tmp_path / "parts" / "hand.yaml").read_text())
    joints = {joint["name"]: joint for joint in hand["joints"]}
    joints["left_2"] |= {"coupling": {"kind": "linear", "of": "screw_2"}, "limits": [-3, 3]}
    hand["actuators"]["screw_2"] = {"limits": [-1.2, 1.2], "unit": "rad", "source": "toy"}
    for name in ("left_3", "left_4", "right_1"):
        joints[name]["limits"] = [-6, 6]
    (tmp_path / "parts" / "hand.yaml").write_text(yaml.safe_dump(hand))
    wide = ik.load_robot(path)
    place = wide.actuators.index("screw_2")
    q = np.tile(wide.home, (4001, 1))
    q[:, place] = np.linspace(wide.lower[place], wide.upper[place], 4001)
    theta = wide.joints(q)["left_3"]
    lowest = int(theta.argmin())
    assert 100 < lowest < 3900
    # Both sides of the turning point reach the same angle, but only one contains home.
    joints["left_3"]["limits"] = [float(theta[lowest]) + 0.02, 6]
    (tmp_path / "parts" / "hand.yaml").write_text(yaml.safe_dump(hand))
    for home in (q[50, place], q[3950, place]):
        path.write_text(path.read_text().split("home:")[0] + f"home: {{screw_2: {home}}}\n")
        robot = ik.load_robot(path)
        assert robot.lower[place] <= home <= robot.upper[place]
        turn = q[lowest, place]
        assert (robot.upper[place] < turn) if home < turn else (robot.lower[place] > turn)
        assert robot.beyond_limits(robot.random(np.random.default_rng(0), 5000)).max() <= 1e-9


def test_motor_without_range_is_refused(tmp_path):
    path = narrow_robot(tmp_path)
    hand = tmp_path / "parts" / "hand.yaml"
    data = yaml.safe_load(hand.read_text())
    next(j for j in data["joints"] if j["name"] == "left_spread")["limits"] = [0.9, 1]
    hand.write_text(yaml.safe_dump(data))
    with pytest.raises(ik.errors.DescriptionError, match=r"actuators\.spread: limits:.*-0\.4"):
        ik.load_robot(path)


def test_home_beyond_a_limit_is_refused(tmp_path):
    path = narrow_robot(tmp_path)
    path.write_text(path.read_text().replace("spread: 0.2", "spread: 0.8"))
    with pytest.raises(
        ik.errors.DescriptionError, match=r"home\.spread: 0\.8 is outside the limits \["
    ):
        ik.load_robot(path)


def test_default_home_is_within_limits(tmp_path):
    path = narrow_robot(tmp_path)
    path.write_text(path.read_text().split("home:")[0])
    robot = ik.load_robot(path)
    assert robot.beyond_limits(robot.home) <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [ik.Tolerance(), ik.Tolerance(1e-6, 1e-6)])
@pytest.mark.parametrize("method", ["hand-first", "thumb-first"])
def test_solutions_keep_follower_limits(tmp_path, rng, method, tolerance):
    robot = narrow_barrett(tmp_path)
    q = robot.random(rng, 60)
    for end in (robot.lower, robot.upper) if method == "hand-first" else ():
        q = np.where(rng.random(q.shape) < 0.2, end, q)
    points, normals = robot.contacts(q)
    batch = ik.Solver(robot, method, tolerance).solve_batch(points, normals)
    # Thumb-first misses one in a thousand targets of any robot.
    assert (~batch.success).sum() <= (method == "thumb-first")
    assert robot.beyond_limits(batch.q).max() <= 1e-9


def test_ignored_limits_free_the_joints(tmp_path, rng):
    robot = narrow_barrett(tmp_path)
    wide = ik.load_robot("kuka_lwr_barrett_coupled")
    points, normals = wide.contacts(wide.random(rng, 60))
    batch = ik.Solver(robot, limits="ignore").solve_batch(points, normals)
    assert batch.success.mean() > 0.9
    assert not batch.limits_ok.all()
