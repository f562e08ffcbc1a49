"""The Barrett hand as it is driven: four motors, distal joints a third of the proximal ones."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik

FINGERS = ("thumb", "finger_2", "finger_3")


@pytest.fixture(scope="module")
def coupled() -> ik.ArmHand:
    return ik.load_robot("kuka_lwr_barrett_coupled")


def independent(coupled: ik.ArmHand, robot: ik.ArmHand, q: np.ndarray) -> np.ndarray:
    """The same posture in the coordinates of the hand with independent distal joints."""
    joints = coupled.joints(q)
    known = dict(zip(coupled.actuators, q.T, strict=True)) | joints
    return np.stack([known[name] for name in robot.actuators], axis=1)


def test_eleven_motors(coupled, robot):
    names = [name for name in robot.actuators if not name.endswith("distal")]
    assert list(coupled.actuators) == names
    assert coupled.fingers == FINGERS
    for end in ("lower", "upper"):
        values = dict(zip(robot.actuators, getattr(robot, end), strict=True))
        np.testing.assert_array_equal(getattr(coupled, end), [values[name] for name in names])


def test_distal_joints_follow_within_their_limits(coupled, rng):
    q = np.concatenate([coupled.random(rng, 20), coupled.upper[None], coupled.lower[None]])
    joints = coupled.joints(q)
    limits = {joint.name: (joint.lower, joint.upper) for joint in coupled.description.movable}
    for finger in FINGERS:
        distal, proximal = (joints[f"bh_{finger}_{name}"] for name in ("distal", "proximal"))
        np.testing.assert_allclose(distal, proximal / 3, rtol=1e-15)
        assert np.all(distal <= limits[f"bh_{finger}_distal"][1])
    np.testing.assert_allclose(np.degrees(joints["bh_thumb_distal"][-2]), 140 / 3, rtol=1e-12)


def test_the_same_hand_otherwise(coupled, robot, rng):
    q = coupled.random(rng, 20)
    ours, theirs = coupled.contacts(q), robot.contacts(independent(coupled, robot, q))
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-14)
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-14)
    np.testing.assert_allclose(
        coupled.palm(q), robot.palm(independent(coupled, robot, q)), atol=1e-14
    )


@pytest.mark.parametrize("method", ["enhanced-dls", "enhanced-sdls"])
def test_the_papers_methods_say_why_not(coupled, method):
    """Eq. (5) distributes a sum over two flexions; here there is nothing to distribute."""
    with pytest.raises(ik.errors.UnsupportedError) as caught:
        ik.Solver(coupled, method)
    assert str(caught.value) == (
        "robot 'kuka_lwr_barrett_coupled': finger 'finger_2' is not a planar finger: "
        "bh_finger_2_distal follows 'bh_finger_2_proximal'; expected its own motor"
    )


def test_other_grasps_are_out_of_its_reach(coupled, robot):
    """Fifteen equations for eleven motors: a cup pinched with free distal joints does not fit."""
    grasp = ik.load_grasp("cup")
    assert ik.Solver(robot).solve(grasp).success
    assert not ik.Solver(coupled, tolerance=ik.Tolerance(1e-4, 1e-3)).solve(grasp).success
