"""Made-up hand of a person that moves, as 21 keypoints of realistic size."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik

BONES = (0.045, 0.027, 0.022)
"""Lengths of the bones of a finger behind its knuckle [m]."""


def hand(bend: float, wrist: np.ndarray, turn: float = 0.0) -> np.ndarray:
    """(21, 3) keypoints [m].

    Args:
        bend: Of every joint of the fingers [rad].
        wrist: (3,) where the wrist is.
        turn: Of the hand about the vertical [rad].
    """
    points = [np.zeros(3)]
    for finger in range(5):
        across = 0.02 * (finger - 2)
        base = np.array([0.03, -0.05, -0.02]) if finger == 0 else np.array([0.09, across, 0.0])
        slope = 0.9 if finger == 0 else 0.0
        points.append(base)
        angle = 0.0
        for bone in BONES:
            angle += bend
            bone_vector = np.array([np.cos(angle), slope * np.cos(angle), -np.sin(angle)])
            points.append(points[-1] + bone * bone_vector / np.linalg.norm(bone_vector))
    c, s = np.cos(turn), np.sin(turn)
    return np.array(points) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + wrist


def like_robot(robot: ik.ArmHand, path: np.ndarray, size: float) -> np.ndarray:
    """(k, 21, 3) keypoints of a person who moves as a robot does along a path (k, n).

    The person is smaller by `size` and sits elsewhere; thumb, index and middle finger go with the
    robot's first three fingers.
    """
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    points, palms = robot.contacts(path)[0], robot.palm(path)
    frames = np.zeros((len(path), 21, 3))
    frames[:, 0] = palms[:, :3, 3] @ turn / size + [0.3, 0.1, 2.0]
    local = rng.normal(size=(21, 3))
    frames[:] = frames[:, :1] + local @ palms[:, :3, :3].swapaxes(1, 2) @ turn / size
    frames[:, 0] = palms[:, :3, 3] @ turn / size + [0.3, 0.1, 2.0]
    frames[:, [4, 8, 12]] = points[:, :3] @ turn / size + [0.3, 0.1, 2.0]
    return frames
