"""Grippers of the catalogue: pads that face each other, and a jaw that no joint moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.files.shipped import resolve

OPENED = {
    "widowx_gripper": ((0.015, 0.012), (0.037, 0.056)),
    "so100_jaw": ((0.0, 0.0158),),
}
"""By gripper the motor's position and how far apart [m] its parallel pads then are."""


@pytest.mark.parametrize("gripper", OPENED)
def test_pads_face_each_other(gripper: str) -> None:
    robot = ik.load_robot(gripper)
    for motor, apart in OPENED[gripper]:
        points, normals = robot.contacts(np.array([motor]))
        np.testing.assert_allclose(points[0] + apart * normals[0], points[1], atol=1e-6)
        np.testing.assert_allclose(points[1] + apart * normals[1], points[0], atol=1e-6)


@pytest.mark.parametrize("pair", ["ur5e+so100_jaw", "widowx_250s+widowx_gripper"])
def test_random_contacts_are_solved(pair: str, rng: np.random.Generator) -> None:
    robot = ik.load_robot(pair)
    batch = ik.Solver(robot).solve_batch(*robot.contacts(robot.random(rng, 100)))
    assert batch.success.all()


def test_what_is_held_may_touch_the_fixed_jaw_but_not_what_it_is_fixed_to() -> None:
    """A ball between the tips is free; as far in as the motor it is not."""
    robot = ik.load_robot("ur5e+so100_jaw")
    q = robot.home.copy()
    q[robot.actuators.index("so100_jaw")] = 0.2
    points, normals = robot.contacts(q)
    palm = robot.palm(q)
    ball = {"kind": "sphere", "radius": 0.015}
    free = []
    for out in (0.077, 0.0):
        pose = palm.copy()
        pose[:3, 3] = palm[:3, 3] + out * palm[:3, 2]
        scene = ik.Scene({"ball": {**ball, "pose": pose}}, grasped="ball")
        free.append(
            bool(
                ik.Solver(robot, scene=scene).solve_batch(points[None], normals[None]).success.all()
            )
        )
    assert free == [True, False]


def test_a_pad_that_no_joint_moves_is_on_the_palms_link(tmp_path: Path) -> None:
    text = resolve("so100_jaw", "hands").read_text()
    (tmp_path / "hand.yaml").write_text(
        text.replace("palm: {link: so100_fixed_jaw", "palm: {link: so100_gripper")
    )
    (tmp_path / "robot.yaml").write_text(
        "name: changed\narm: ur5e\nhand: hand.yaml\nmount: {xyz: [0, 0, 0]}\n"
        "fingers: [moving, fixed]\nthumb: moving\n"
    )
    with pytest.raises(ik.errors.DescriptionError, match="no joint moves 'so100_fixed_jaw'"):
        ik.load_robot(tmp_path / "robot.yaml")
