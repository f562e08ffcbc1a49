"""Baxter's right arm with the AR10: the arm against its Denavit-Hartenberg table."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik

QUARTER = np.pi / 2
# theta offset [rad], d [m], a [m], alpha [rad]; standard DH.
ARM = (
    (0, 0.27035, 0.069, -QUARTER),
    (QUARTER, 0, 0, QUARTER),
    (0, 0.36442, 0.069, -QUARTER),
    (0, 0, 0, QUARTER),
    (0, 0.37429, 0.010, -QUARTER),
    (0, 0, 0, QUARTER),
    (0, 0.229525, 0, 0),
)


@pytest.fixture(scope="module")
def baxter() -> ik.ArmHand:
    return ik.load_robot("baxter_ar10")


def turned(angle: float, xyz: tuple[float, float, float]) -> np.ndarray:
    """Pose turned about z and then placed at xyz."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = xyz
    return pose


def denavit_hartenberg(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    twist = np.eye(4)
    twist[1:3, 1:3] = [[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]]
    twist[0, 3] = a
    return turned(theta, (0, 0, d)) @ twist


def test_arm_and_mount(baxter, rng):
    base = turned(-0.7854, (0.024645, -0.219645, 0.118588)) @ turned(0, (0.055695, 0, 0.011038))
    for q in baxter.random(rng, 20):
        hand = base
        for theta, (offset, *row) in zip(q[:7], ARM, strict=True):
            hand = hand @ denavit_hartenberg(theta + offset, *row)
        hand = hand @ turned(-QUARTER, (0, 0, -0.0021))
        np.testing.assert_allclose(baxter.links(q)["hand_base"], hand, atol=1e-14)


def test_the_hand_is_the_ar10(baxter, rng):
    alone = ik.load_robot("ar10")
    assert baxter.actuators[7:] == alone.actuators
    assert baxter.actuators[:7] == (
        "right_s0", "right_s1", "right_e0", "right_e1", "right_w0", "right_w1", "right_w2",
    )  # fmt: skip
    assert baxter.fingers == alone.fingers
    q = baxter.random(rng, 20)
    hand = baxter.links(q)["hand_base"]
    points, normals = alone.contacts(q[:, 7:])
    found_points, found_normals = baxter.contacts(q)
    moved = np.einsum("kij,kfj->kfi", hand[:, :3, :3], points) + hand[:, None, :3, 3]
    np.testing.assert_allclose(found_points, moved, atol=1e-14)
    turned_normals = np.einsum("kij,kfj->kfi", hand[:, :3, :3], normals)
    np.testing.assert_allclose(found_normals, turned_normals, atol=1e-14)
    np.testing.assert_allclose(baxter.palm(q), hand @ alone.palm(alone.home), atol=1e-14)
