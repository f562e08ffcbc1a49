"""Orders of keypoints of other data sets are recognised by the lengths of bones, and converted."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from commands import main
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_hand import hand

import casadi_ik as ik
from casadi_ik.errors import InputWarning
from casadi_ik.files.keypoints import (
    KEYPOINT_ORDERS,
    STANDARD_ORDER,
    recognise_order,
)

OTHER_ORDERS = [name for name in KEYPOINT_ORDERS if name != STANDARD_ORDER]


def keypoint_frame(i: int = 0) -> np.ndarray:
    """Return a hand (21, 3) that moves and bends, with noise of a millimetre."""
    noise = np.random.default_rng(i).normal(0, 1e-3, (21, 3))
    return hand(0.2 + 0.05 * i, np.array([0.5, 0.01 * i, 0.9]), 0.1 * i) + noise


def reordered(frames: np.ndarray, name: str) -> np.ndarray:
    """Return frames (..., 21, 3) in another order."""
    result = np.empty_like(frames)
    result[..., KEYPOINT_ORDERS[name], :] = frames
    return result


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("retarget") / "hand.yaml"
    path.write_text("fingers: {thumb: 4, finger_2: 8, finger_3: 12}")
    return ik.motion.load_retarget(path)


@settings(max_examples=40)
@given(
    st.sampled_from(list(KEYPOINT_ORDERS)),
    st.floats(0.0, 1.2),
    st.floats(0.6, 1.3),
    st.integers(0, 10_000),
    st.booleans(),
)
def test_every_order_is_recognised_in_one_frame(name, bend, size, seed, mirrored):
    """Orders are recognised for any posture, size and place, with noise of a millimetre."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn = turn @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0])
    frame = size * hand(bend, rng.normal(size=3)) @ turn + rng.normal(0, 1e-3, (21, 3))
    assert recognise_order(reordered(frame, name)[None]) == name


@pytest.mark.parametrize("name", OTHER_ORDERS)
def test_retargeter_converts_keypoint_orders(robot, config, name):
    plain, converting = (ik.motion.Retargeter(config, robot) for _ in range(2))
    expected = [plain(keypoint_frame(i)) for i in range(4)]
    with pytest.warns(InputWarning, match="order"):
        targets = [converting(reordered(keypoint_frame(0), name))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        targets += [converting(reordered(keypoint_frame(i), name)) for i in range(1, 4)]
    for target, expected_target in zip(targets, expected, strict=True):
        np.testing.assert_array_equal(target.points, expected_target.points)
        np.testing.assert_array_equal(target.palm, expected_target.palm)


def test_lost_frames_do_not_decide_the_order(robot, config):
    plain, converting = (ik.motion.Retargeter(config, robot) for _ in range(2))
    for lost_frame in (np.zeros((21, 3)), -np.ones((21, 3)), np.full((21, 3), np.nan)):
        assert converting(lost_frame).reason
    with pytest.warns(InputWarning, match="MANO"):
        target = converting(reordered(keypoint_frame(), "MANO, HO-3D"))
    np.testing.assert_array_equal(target.points, plain(keypoint_frame()).points)


def test_standard_and_unknown_orders(robot, config):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ik.motion.Retargeter(config, robot)(keypoint_frame())
    mixed = keypoint_frame()[np.random.default_rng(0).permutation(21)]
    with pytest.warns(InputWarning, match="none of the known orders"):
        ik.motion.Retargeter(config, robot)(mixed)


def test_recording_in_mano_order(tmp_path, capsys):
    frames = np.array([keypoint_frame(i) for i in range(12)])
    motions = []
    for keypoints in (frames, reordered(frames, "MANO, HO-3D")):
        path, out = tmp_path / "frames.npz", tmp_path / "motion.npz"
        np.savez(path, keypoints=keypoints)
        words = ["follow", path, "--robot", "kuka_lwr_barrett", "--period", "0.02", "--out", out]
        assert main([str(word) for word in words]) in (0, 1)
        motions.append((np.load(out)["q"], capsys.readouterr().err))
    np.testing.assert_array_equal(motions[0][0], motions[1][0])
    assert motions[0][1] == ""
    assert motions[1][1].startswith("casadi-ik: warning: ")
    assert "MANO" in motions[1][1]
