"""Check a grasp file from the file, the object and the robot alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from casadi_ik.model.load_grasp import load_grasp
from casadi_ik.model.objects import load_object
from grasp_synthesis.clearance import clearance
from grasp_synthesis.closure import friction_needed
from grasp_synthesis.hand import FINGERS, ArmHand

EXACT = 1e-6  # [m] or [rad]
PALM_GAP, FINGER_GAP, BETWEEN_GAP = 0.010, 0.0, 0.002  # [m] smallest gaps allowed
MAX_FRICTION = 1.5


def problems(hand: ArmHand, path: Path) -> list[str]:
    """Return all faults of a grasp file; empty if it is valid."""
    grasp = load_grasp(path)
    if grasp.known_pose is None or set(grasp.posture) != set(hand.hand_names):
        return ["it lacks the object or some of the hand's actuators"]
    item = load_object(grasp.object)
    points, normals = grasp.arrays(FINGERS)
    posture = np.array([grasp.posture[name] for name in hand.hand_names])
    palm, hand_points, hand_normals, lines, _ = hand.evaluate(np.zeros(7), posture)
    rotation, origin = grasp.known_pose[:3, :3], grasp.known_pose[:3, 3]
    local, local_normals = (points - origin) @ rotation, normals @ rotation
    # The rigid motion that carries the posture's contacts onto the file's.
    motion = _fit(
        np.concatenate([hand_points, hand_points + 0.05 * hand_normals]),
        np.concatenate([points, points + 0.05 * normals]),
    )
    posture_points = hand_points @ motion[:3, :3].T + motion[:3, 3]
    posture_normals = hand_normals @ motion[:3, :3].T
    in_palm = np.linalg.inv(motion @ palm) @ grasp.known_pose
    local_lines = (lines - palm[:3, 3]) @ palm[:3, :3]
    gaps = clearance(item, in_palm, local_lines)
    friction = friction_needed(points, normals)
    outside = np.any((posture < hand.lower) | (posture > hand.upper))
    checks = {
        "a contact is off the surface": np.abs(item.signed_distance(local)).max() > EXACT,
        "a pad does not face the surface": np.abs(item.normal(local) + local_normals).max() > EXACT,
        "the posture is outside the limits": bool(outside),
        "the posture does not give the points": np.abs(posture_points - points).max() > EXACT,
        "the posture does not give the normals": np.abs(posture_normals - normals).max() > EXACT,
        f"the palm gap is {gaps.palm:.4f} m": gaps.palm < PALM_GAP,
        f"the phalanges' gap is {gaps.fingers:.4f} m": gaps.fingers < FINGER_GAP,
        f"the fingers' gap is {gaps.between:.4f} m": gaps.between < BETWEEN_GAP,
        f"it needs a friction coefficient of {friction:.2f}": friction > MAX_FRICTION,
    }
    return [text for text, wrong in checks.items() if wrong]


def _fit(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the (4, 4) rigid motion that best maps source (k, 3) onto target (k, 3) (Kabsch)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    pose = np.eye(4)
    pose[:3, :3] = vt.T @ sign @ u.T
    pose[:3, 3] = b - pose[:3, :3] @ a
    return pose
