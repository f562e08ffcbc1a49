"""Descriptions of users: relative paths, couplings as data, a hand without an arm."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from processes import MODELS, ROOT
from toy_robots import copy_shipped_robot, replace, write_coupled_robot

import casadi_ik as ik


def test_copy_with_relative_paths_is_the_same_robot(own_robot, robot, rng, monkeypatch):
    q = robot.random(rng, 5)
    expected = robot.contacts(q)
    for path in (own_robot, str(own_robot)):
        np.testing.assert_array_equal(ik.load_robot(path).contacts(q), expected)
    monkeypatch.chdir(own_robot.parent)
    np.testing.assert_array_equal(ik.load_robot("robot.yaml").contacts(q), expected)


def test_mount_turns_and_shifts_the_hand(own_robot, robot, rng):
    replace(own_robot, "mount: {xyz: [0, 0, 0], rpy: [0, 0, 0]}", "mount: {xyz: [0, 0, 1 cm]}")
    own_robot_model = ik.load_robot(own_robot)
    q = robot.random(rng, 3)
    shift = robot.palm(q)[:, :3, 2] * 0.01
    np.testing.assert_allclose(
        own_robot_model.contacts(q)[0], robot.contacts(q)[0] + shift[:, None], atol=1e-15
    )


def test_joint_order_is_free(tmp_path, rng):
    path = copy_shipped_robot(tmp_path)
    hand = tmp_path / "hand.yaml"
    lines = hand.read_text().split("joints:\n")
    body, remainder = lines[1].split("\npalm:")
    entries = ["  - " + entry for entry in body.split("  - ")[1:]]
    hand.write_text(lines[0] + "joints:\n" + "\n".join(reversed(entries)) + "\npalm:" + remainder)
    own_robot_model, shipped = ik.load_robot(path), ik.load_robot("kuka_lwr_barrett")
    q = shipped.random(rng, 3)
    assert own_robot_model.actuators == shipped.actuators
    np.testing.assert_allclose(own_robot_model.contacts(q), shipped.contacts(q), atol=1e-15)


def test_couplings_follow_their_closed_formulas(coupled_robot, rng):
    q = coupled_robot.random(rng, 200)
    assert coupled_robot.actuators == (
        "spread", "screw_1", "screw_2", "thumb_turn", "thumb_slide", "thumb_bend",
    )  # fmt: skip
    assert [a.unit for a in coupled_robot.description.actuators] == [
        "rad", "m", "m", "rad", "m", "rad",
    ]  # fmt: skip
    spread, s_1, s_2, turn, slide, bend = q.T

    def triangle(s, b, c):
        return np.arccos((b * b + c * c - s * s) / (2 * b * c))

    left_2 = triangle(s_2, 0.0498, 0.014) - 0.81437063
    # Chandra, eq. (9), with the printed branch, lengths in cm.
    p, bar_q, g, h = 2.97, 3.47, 0.84, 0.72
    phi = 3.32939008 + left_2
    a, b = 2 * p * bar_q * np.cos(phi) - 2 * g * bar_q, 2 * p * bar_q * np.sin(phi)
    c = g * g + p * p + bar_q * bar_q - h * h - 2 * p * g * np.cos(phi)
    psi = np.arctan2(b, a) - np.arccos(c / np.hypot(a, b))
    theta_3 = (
        np.arctan2(bar_q * np.sin(psi) - p * np.sin(phi), g + bar_q * np.cos(psi) - p * np.cos(phi))
        - phi
    )
    left_3 = (theta_3 - 4.1110 + np.pi) % (2 * np.pi) - np.pi
    expected = {
        "left_spread": 0.8 * spread + 0.1,
        "left_1": triangle(s_1, 0.0522, 0.013) - 0.58,
        "left_2": left_2,
        "left_3": left_3,
        "left_4": -0.5 * left_3 + 0.05,
        "right_spread": 1.2 * spread - 0.1,
        "right_1": 2 * (-0.5 * left_3 + 0.05) + 0.3,
        "thumb_turn": turn,
        "thumb_slide": slide,
        "thumb_bend": bend,
    }
    joints = coupled_robot.joints(q)
    assert set(joints) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(joints[name], values, atol=2e-13, err_msg=name)
        assert np.ptp(values) > 1e-3


def test_finger_actuators_follow_the_couplings(coupled_robot):
    description = coupled_robot.description
    assert description.finger_actuators("left") == (0, 1, 2)
    assert description.finger_actuators("right") == (0, 2)
    assert description.finger_actuators("thumb") == (3, 4, 5)
    assert description.arm_actuators == ()
    assert [finger.name for finger in description.fingers] == ["right", "thumb", "left"]
    assert description.finger("right").joints == ("right_spread", "right_1")


def test_home_defaults_to_the_nearest_attainable_zero(coupled_robot):
    np.testing.assert_array_equal(coupled_robot.home, [0.2, 0.042, 0.0415, 0, 0, 0.1])


def test_finger_begins_at_the_palm(tmp_path):
    """Joints between the hand's root and the palm belong to no finger."""
    path = write_coupled_robot(tmp_path)
    replace(tmp_path / "parts" / "hand.yaml", "palm: {link: hand", "palm: {link: thumb_0")
    finger = ik.load_robot(path).description.finger("thumb")
    assert finger.joints == ("thumb_slide", "thumb_bend")


def test_sources_with_the_same_tag_are_distinguished(own_robot):
    arm = own_robot.with_name("arm.yaml")
    replace(arm, "  centro:", "  mdh: of the arm\n  centro:")
    sources = ik.load_robot(own_robot).description.sources
    assert sources["mdh"] == "of the arm"
    assert "Craig" in sources["barrett_bh8_280.mdh"]


def test_names_are_arbitrary(tmp_path, rng):
    path = copy_shipped_robot(tmp_path)
    replace(path, "name: kuka_lwr_barrett", 'name: "7 dwarfs & a hand-1"')
    replace(path, "[thumb, finger_2", "[thumb, ring-finger")
    replace(tmp_path / "hand.yaml", "  finger_2:", "  ring-finger:")
    own_robot_model = ik.load_robot(path)
    points, normals = own_robot_model.contacts(own_robot_model.home)
    for finger_step in ("closed-form", "ipopt"):
        solver = ik.Solver(
            own_robot_model,
            "enhanced-dls",
            finger_step=finger_step,
            compiled=False,
            options={"max_iterations": 3},
        )
        assert solver.solve_batch(points[None], normals[None]).success.all()
    assert 'name="7 dwarfs &amp; a hand-1"' in own_robot_model.urdf()


def test_the_documented_robot_is_solved(tmp_path):
    """The robot of docs/add_a_robot.md is as the page states."""
    page = (ROOT / "docs" / "add_a_robot.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    path = tmp_path / "pincher.yaml"
    path.write_text(text, encoding="utf-8")
    documented = ik.load_robot(str(path))
    assert documented.fingers == ("left", "right")
    assert len(documented.actuators) == 7 + 3
    joints = documented.joints(documented.home)
    assert joints["right_tip"] == pytest.approx(np.deg2rad(10))
    q = documented.random(np.random.default_rng(0), 20)
    assert ik.Solver(documented).solve_batch(*documented.contacts(q)).success.all()


# A hand that is written in full in the robot's file.


def in_full(folder: Path, name: str = "kuka_lwr_barrett", **changes: Any) -> Path:
    """Write a shipped robot with its hand in full; keyword arguments replace keys of the hand."""
    robot = yaml.safe_load((MODELS / "arm_hands" / f"{name}.yaml").read_text())
    hand = yaml.safe_load((MODELS / "hands" / f"{robot['hand']}.yaml").read_text())
    path = folder / "whole.yaml"
    path.write_text(yaml.safe_dump(robot | {"hand": hand | changes}, sort_keys=False))
    return path


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "ar10"])
def test_full_description_gives_the_same_robot(name, tmp_path, rng):
    robot_in_full, named = ik.load_robot(in_full(tmp_path, name)), ik.load_robot(name)
    assert robot_in_full.actuators == named.actuators
    q = named.random(rng, 5)
    for ours, theirs in zip(robot_in_full.contacts(q), named.contacts(q), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"palm": {"link": "nowhere", "source": "jhu"}}, "palm.link: unknown link 'nowhere'"),
        ({"joints": [1]}, r"hand\.joints\[0\]: expected `object`, got `int`"),
        ({"colour": "red"}, "hand: object contains unknown field `colour`"),
    ],
)
def test_errors_name_file_and_key(changes, words, tmp_path):
    path = in_full(tmp_path, **changes)
    with pytest.raises(ik.errors.DescriptionError, match=words) as caught:
        ik.load_robot(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_missing_name_and_hand_are_refused(tmp_path):
    path = tmp_path / "whole.yaml"
    path.write_text("name: a\nhand: 3\nthumb: b\nfingers: [b]\n")
    with pytest.raises(
        ik.errors.DescriptionError, match=r"hand: expected `str \| object`, got `int`"
    ):
        ik.load_robot(path)
