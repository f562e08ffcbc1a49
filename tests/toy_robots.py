"""Small robots as files, copies of the shipped one, and grasps of configurations."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from processes import MODELS

import casadi_ik as ik

COUPLED_HAND = """\
name: coupled_hand
root: hand
sources: {toy: made up for the tests}
actuators:
  spread: {limits: [-0.4, 0.9], source: toy, velocity: 1.5}
  screw_1: {limits: [42 mm, 60 mm], unit: m, source: toy}
  screw_2: {limits: [41.5 mm, 57.5 mm], unit: m, source: toy}
  thumb_turn: {}
  thumb_slide: {}
  thumb_bend: {limits: [0.1, 1.0]}
joints:
  - {name: left_spread, parent: hand, child: left_0, axis: [0, 0, 1], limits: [-1, 1], source: toy,
     origin: {xyz: [0.02, 0.01, 0.05], rpy: [0.1, -0.2, 0.3]},
     coupling: {kind: linear, of: spread, ratio: 0.8, offset: 0.1}}
  - {name: left_1, parent: left_0, child: left_a, axis: [-1, 0, 0], limits: [0, 1.6], source: toy,
     coupling: {kind: lead-screw, of: screw_1, b: 52.2 mm, c: 13 mm, theta_0: 0.58}}
  - {name: left_2, parent: left_a, child: left_b, axis: [-1, 0, 0], limits: [0, 1.3], source: toy,
     origin: {xyz: [0, 0.009, 0.0442]},
     coupling: {kind: lead-screw, of: screw_2, b: 49.8 mm, c: 14 mm, theta_0: 0.81437063}}
  - {name: left_3, parent: left_b, child: left_c, axis: [-1, 0, 0], limits: [-0.1, 1], source: toy,
     origin: {xyz: [0, 0.0115, 0.0274]},
     coupling: {kind: four-bar, of: left_2, p: 2.97 cm, q: 3.47 cm, g: 0.84 cm, h: 0.72 cm,
                phi_0: 3.32939008, theta_3_0: 4.1110}}
  - {name: left_4, parent: left_c, child: left_d, axis: [0, 1, 1], limits: [-2, 2], source: toy,
     origin: {xyz: [0, 0, 0.01]},
     coupling: {kind: linear, of: left_3, ratio: -0.5, offset: 0.05}}
  - {name: stem, parent: hand, child: stem, type: fixed, axis: [0, 0, 1], limits: [0, 0],
     origin: {xyz: [0, 0, 0.01], rpy: [0.3, 90 deg, 0.2]}, source: toy}
  - {name: right_spread, parent: stem, child: right_0, axis: [0, 0, -1], limits: [-1, 1],
     source: toy, coupling: {kind: linear, of: spread, ratio: 1.2, offset: -0.1}}
  - {name: right_1, parent: right_0, child: right_a, axis: [1, 0, 0], limits: [-2, 2], source: toy,
     origin: {xyz: [0, 0, 0.03]},
     coupling: {kind: linear, of: left_4, ratio: 2, offset: 0.3}}
  - {name: thumb_turn, parent: hand, child: thumb_0, axis: [1, 2, 3], limits: [-1, 1], source: toy,
     velocity: 3}
  - {name: thumb_slide, parent: thumb_0, child: thumb_1, type: prismatic, axis: [0, 1, 1],
     limits: [-0.02, 0.03], source: toy, velocity: 0.1}
  - {name: thumb_bend, parent: thumb_1, child: thumb_2, axis: [0, 1, 0], limits: [0, 1.2],
     source: toy, origin: {xyz: [0.01, 0.02, 0.03], rpy: [0, 0.5, 0]}}
palm: {link: hand, xyz: [0, 0, 0.02], rpy: [0.3, 0, 0], source: toy}
fingers:
  left: {link: left_d, xyz: [0.01, 0, 0.02], rpy: [0, 0, 1], normal: [0, 3, 4], source: toy}
  right: {link: right_a, xyz: [0, 0, 0.03], normal: [1, 0, 0], source: toy}
  thumb: {link: thumb_2, xyz: [0, 0.01, 0.02], rpy: [1, 0, 0], normal: [0, 0, -2], source: toy}
"""
"""Hand with a shared spread motor, sliders, a four-bar, followers, a prismatic thumb."""

COUPLED_ROBOT = """\
name: coupled robot-1
hand: parts/hand.yaml
thumb: thumb
fingers: [right, thumb, left]
mount: {xyz: [0.1, 0, 0.2], rpy: [0, 0, 90 deg]}
home: {spread: 0.2}
"""

EXACT = ik.Tolerance(1e-6, 1e-6)
"""Tolerance of numerically exact solutions."""

PAPER_METHODS = ("enhanced-dls", "enhanced-sdls", "original-dls", "original-sdls")
"""Methods of Qiu and Kermani."""

MULTI_ARM_ROBOTS = ("g1+dex3", "two_pandas+allegro", "two_ur10e+leap", "mobile_kuka_lwr_barrett")
"""Robots of several arm-hands, or of one on a trunk."""


def write_coupled_robot(folder: Path) -> Path:
    """Write the coupled robot, its hand in a folder beside it; return the path of its file."""
    (folder / "parts").mkdir()
    (folder / "parts" / "hand.yaml").write_text(COUPLED_HAND)
    path = folder / "robot.yaml"
    path.write_text(COUPLED_ROBOT)
    return path


def copy_shipped_robot(folder: Path) -> Path:
    """Copy the shipped robot, arm and hand as robot.yaml, arm.yaml, hand.yaml; return the first."""
    shutil.copy(MODELS / "arms" / "kuka_lwr4.yaml", folder / "arm.yaml")
    shutil.copy(MODELS / "hands" / "barrett_bh8_280.yaml", folder / "hand.yaml")
    text = (MODELS / "arm_hands" / "kuka_lwr_barrett.yaml").read_text()
    path = folder / "robot.yaml"
    path.write_text(
        text.replace("arm: kuka_lwr4", "arm: arm.yaml").replace(
            "hand: barrett_bh8_280", "hand: hand.yaml"
        )
    )
    return path


def replace(path: Path, old: str, new: str) -> None:
    """Replace the first occurrence of a text in a file, which must exist."""
    text = path.read_text()
    assert old in text, f"{path} has no {old!r}"
    path.write_text(text.replace(old, new, 1))


@contextmanager
def edited(path: Path) -> Iterator[Any]:
    """Yield the data of a YAML file for changes and write them back."""
    data = yaml.safe_load(path.read_text())
    yield data
    path.write_text(yaml.safe_dump(data, sort_keys=False))


def near_home(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return (count, n) configurations that every method can solve from home."""
    reach = 0.05 * (robot.upper - robot.lower)
    q = robot.home + rng.uniform(-1, 1, (count, len(reach))) * reach
    return np.clip(q, robot.lower, robot.upper)


def grasp_of(robot: ik.ArmHand, points: np.ndarray, normals: np.ndarray) -> ik.Grasp:
    """Return a grasp with a contact for every finger, from arrays (f, 3)."""
    contacts = map(ik.Contact, points, normals)
    return ik.Grasp(dict(zip(robot.fingers, contacts, strict=True)))


def grasp_at(robot: ik.ArmHand, q: np.ndarray) -> ik.Grasp:
    """Return the grasp of the contacts of a configuration."""
    return grasp_of(robot, *robot.contacts(q))


def grasps_of(robot: ik.ArmHand, points: np.ndarray, normals: np.ndarray) -> list[ik.Grasp]:
    """Return the grasps of arrays (k, f, 3)."""
    return [grasp_of(robot, *pair) for pair in zip(points, normals, strict=True)]


def moved_targets(targets, rng, metres, angle):
    """Return contacts (k, f, 3) displaced by these amounts in random directions."""
    points, normals = targets
    shift, turn = rng.normal(size=points.shape), rng.normal(size=normals.shape)
    points = points + metres * shift / np.linalg.norm(shift, axis=2, keepdims=True)
    turn -= (turn * normals).sum(axis=2, keepdims=True) * normals
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    return points, normals * np.cos(angle) + turn * np.sin(angle)
