"""Grasps of parallel grippers in the published layouts become grasps of any gripper."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import casadi_ik as ik

ROBOTS = ("panda+panda_hand", "ur5e+robotiq_2f85", "viperx_300s+so100_jaw")
COUNT = 8
HAND_TCP = 0.1034
"""Midpoint of the pads in front of the base of the Panda hand, as in `franka_hand.xacro` [m]."""


def grasp_frames(rng: np.random.Generator) -> np.ndarray:
    """Return poses (k, 4, 4): z approaches, y opens, the origin is midway between the pads."""
    frames = np.tile(np.eye(4), (COUNT, 1, 1))
    frames[:, :3, :3] = Rotation.random(COUNT, random_state=rng).as_matrix()
    frames[:, :3, 3] = rng.uniform(-0.1, 0.1, (COUNT, 3))
    return frames


def panda_bases(frames: np.ndarray) -> np.ndarray:
    """Return gripper poses as ACRONYM has them: x opens, z approaches, at the hand's base."""
    bases = frames.copy()
    bases[:, :3, 0], bases[:, :3, 1] = frames[:, :3, 1], -frames[:, :3, 0]
    bases[:, :3, 3] -= HAND_TCP * frames[:, :3, 2]
    return bases


def write(layout: str, folder: Path, frames: np.ndarray, widths: np.ndarray) -> Path:
    bases = panda_bases(frames)
    if layout == "graspnet":
        rows = np.zeros((COUNT, 17))
        rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 16] = 0.5, widths, 0.02, 0.03, 7
        x, y, z = frames[:, :3, 2], frames[:, :3, 1], -frames[:, :3, 0]
        rows[:, 4:13] = np.stack([x, y, z], axis=2).reshape(COUNT, 9)
        # The fingertips of the Panda hand end 8.8 mm beyond the middle of the pads.
        rows[:, 13:16] = frames[:, :3, 3] + (0.0088 - 0.03) * x
        path = folder / "graspnet.npy"
        np.save(path, rows)
        return path
    if layout == "poses.npz":
        path = folder / "grasps.npz"
        np.savez(path, poses=bases, widths=widths)
        return path
    path = folder / "grasps.json"
    data: dict[str, Any] = {"transforms": bases.tolist()}
    if layout == "acronym":
        success = [int(i != 2) for i in range(COUNT)]
        data |= {"object": "mug.obj", "object_scale": 0.5}
        data |= {"quality_flex_object_in_gripper": success}
    else:
        data["widths"] = widths.tolist()
    path.write_text(json.dumps(data))
    return path


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("layout", ["graspnet", "poses.npz", "poses.json", "acronym"])
def test_pads_are_where_the_grasp_has_them(name: str, layout: str, tmp_path: Path) -> None:
    robot, rng = ik.load_robot(name), np.random.default_rng(3)
    frames, widths = grasp_frames(rng), rng.uniform(0.01, 0.075, COUNT)
    path = write(layout, tmp_path, frames, widths)
    object_pose = grasp_frames(rng)[0]
    grasps = ik.load_candidates(path, robot, object_pose=object_pose)
    rows = [i for i in range(COUNT) if layout != "acronym" or i != 2]
    assert list(grasps.rows) == rows
    assert grasps.scale == (0.5 if layout == "acronym" else None)
    for row, grasp in zip(rows, grasps, strict=True):
        q = robot.home.copy()
        for motor, position in grasp.posture.items():
            q[robot.actuators.index(motor)] = position
        points, _ = robot.contacts(q)
        offset = np.asarray(grasp.palm) @ np.linalg.inv(robot.palm(q))
        points = points @ offset[:3, :3].T + offset[:3, 3]
        frame = object_pose @ frames[row]
        assert points.mean(axis=0) == pytest.approx(frame[:3, 3], abs=2e-4)
        width = 0.08 if layout == "acronym" else widths[row]
        assert np.linalg.norm(points[0] - points[1]) == pytest.approx(width, abs=1e-3)
        if name != "viperx_300s+so100_jaw":  # its jaw turns, so the pads are not face to face
            opens = (points[0] - points[1]) / np.linalg.norm(points[0] - points[1])
            assert opens == pytest.approx(frame[:3, 1], abs=1e-6)
            assert np.asarray(grasp.palm)[:3, 2] == pytest.approx(frame[:3, 2], abs=1e-6)


def test_arm_reaches_gripper_grasps(tmp_path: Path) -> None:
    robot = ik.load_robot("panda+panda_hand")
    frames = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (COUNT, 1, 1))
    frames[:, :3, 3] = np.linspace([0.35, -0.2, 0.1], [0.5, 0.2, 0.2], COUNT)
    path = write("poses.npz", tmp_path, frames, np.full(COUNT, 0.05))
    ranking = ik.Solver(robot).choose(ik.load_candidates(path, robot))
    assert ranking.answered == COUNT
    points, _ = robot.contacts(ranking[0].q)
    tip = frames[ranking[0].candidate, :3, 3]
    assert points.mean(axis=0) == pytest.approx(tip, abs=6e-3)


def test_unsuitable_gripper_data_are_refused(tmp_path: Path) -> None:
    frames, widths = grasp_frames(np.random.default_rng(0)), np.full(COUNT, 0.05)
    widths[1] = 0.12
    path = write("poses.npz", tmp_path, frames, widths)
    with pytest.raises(ik.errors.DescriptionError, match=r"row 1: width"):
        ik.load_candidates(path, "panda+panda_hand")
    dropped = ik.load_candidates(path, "panda+panda_hand", invalid="drop")
    assert (len(dropped), dropped.dropped) == (COUNT - 1, 1)
    clipped = ik.load_candidates(path, "panda+panda_hand", invalid="clip")
    assert clipped[1].posture["panda_finger_1"] == pytest.approx(0.04)
    with pytest.raises(ik.errors.UnsupportedError):
        ik.load_candidates(path, "panda+allegro_right")


def test_hdf5_of_acronym(tmp_path: Path) -> None:
    path = tmp_path / "Mug_0.5.h5"
    try:
        library: Any = importlib.import_module("h5py")
    except ImportError:
        path.write_bytes(b"\x89HDF\r\n\x1a\n")
        with pytest.raises(ik.errors.MissingExtraError, match="h5py"):
            ik.load_candidates(path, "panda+panda_hand")
        return
    frames = grasp_frames(np.random.default_rng(0))
    with library.File(path, "w") as file:
        file["grasps/transforms"] = panda_bases(frames)
        file["grasps/qualities/flex/object_in_gripper"] = np.arange(COUNT) % 2
        file["object/scale"], file["object/file"] = 0.5, "meshes/Mug/1.obj"
    grasps = ik.load_candidates(path, "panda+panda_hand")
    assert list(grasps.rows) == list(range(1, COUNT, 2))
    assert grasps.scale == 0.5
