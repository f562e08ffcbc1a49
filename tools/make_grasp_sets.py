"""Write small files in the layouts of grasp data sets, with hands of this project.

    python tools/make_grasp_sets.py FOLDER

The data sets are not part of any package. The layouts are those of their repositories, which
`models/datasets/*.yaml` names. The grasps are random postures at random poses with a seed, so
that a test can compare the loaded grasps with the written ones.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from torch_zip import write_torch

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.integrations.datasets.layouts import Convention, load_convention
from casadi_ik.integrations.datasets.postures import HandPoses
from casadi_ik.model.pose import inverse

ROBOTS = {
    "allegro": "panda+allegro_right",
    "leap": "panda+leap",
    "shadow": "ur5e+shadow",
    "panda_hand": "panda+panda_hand",
    "robotiq_2f85": "ur5e+robotiq_2f85",
}
COUNT = 6


@dataclass(frozen=True, eq=False)
class Written:
    """A file and its contents.

    Attributes:
        path: The file.
        robot: Robot with the hand of the grasps.
        q: (k, n) configurations.
        palms: (k, 4, 4) palm poses in the object frame.
    """

    path: Path
    robot: ik.ArmHand
    q: Array
    palms: Array


def made(name: str, folder: Path, seed: int = 0, robot: ik.ArmHand | None = None) -> Written:
    """Write a file of a built-in convention, or a table.

    Args:
        name: Name of the convention, or "table" with the suffix ".csv", ".npz" or ".parquet".
        folder: Output folder.
        seed: Random seed of postures and poses.
        robot: Robot with the hand; None: one with the hand of the convention.
    """
    stem, _, kind = name.partition(".")
    layout, _, hand = stem.partition("_")
    robot_of_file = robot or ik.load_robot(ROBOTS.get(hand, "kuka_lwr_barrett"))
    rng = np.random.default_rng(seed)
    q = robot_of_file.random(rng, COUNT)
    palms = np.tile(np.eye(4), (COUNT, 1, 1))
    palms[:, :3, :3] = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0]
    palms[:, :3, 0] *= np.linalg.det(palms[:, :3, :3])[:, None]
    palms[:, :3, 3] = rng.uniform(-0.15, 0.15, (COUNT, 3))
    kind = kind or {"multidex": "pt", "isaac": "yaml"}.get(layout, "npy")
    path = folder / f"{stem}.{kind}"
    if layout == "table":
        motors = robot_of_file.description.finger_motors
        values = q[:, [robot_of_file.actuators.index(name) for name in motors]]
        if kind == "npz":
            joints = tuple(n for n in robot_of_file.description.finger_joints if n not in motors)
            motors, values = (
                (*motors, *joints),
                np.hstack([values, _joints(robot_of_file, q, joints)]),
            )
        _table(path, palms, motors, values)
    else:
        convention = load_convention(stem)
        links = robot_of_file.links(q)[convention.link]
        frames = palms @ np.stack([inverse(pose) for pose in robot_of_file.palm(q)]) @ links
        frames = frames @ convention.pose
        joints = _theirs(convention, robot_of_file, q)
        if convention.wrist:
            wrist = rng.uniform(-0.4, 0.4, (COUNT, len(convention.wrist)))
            joints = np.hstack([wrist, joints])
            bent = HandPoses("", np.zeros((COUNT, 3)), np.tile(np.eye(3), (COUNT, 1, 1)), joints)
            wrist_frames = convention.frames(bent) @ convention.pose
            frames = frames @ np.stack([inverse(pose) for pose in wrist_frames])
        WRITERS[layout](path, frames, convention, joints)
    return Written(path, robot_of_file, q, palms)


def _joints(robot: ik.ArmHand, q: Array, names: tuple[str, ...]) -> Array:
    joints = robot.joints(q)
    return np.stack([joints[name] for name in names], axis=1)


def _theirs(convention: Convention, robot: ik.ArmHand, q: Array) -> Array:
    signs = np.array([sign for _, sign in convention.joints.values()])
    return signs * _joints(robot, q, tuple(name for name, _ in convention.joints.values()))


def _getagrip(path: Path, frames: Array, convention: Convention, joints: Array) -> None:
    """Write a dictionary of arrays; the directions of fingers are those of the palm frame."""
    del convention
    turns = np.repeat(frames[:, None, :3, :3], 4, axis=1)
    arrays = {
        "trans": frames[:, :3, 3],
        "rot": frames[:, :3, :3],
        "joint_angles": joints,
        "grasp_orientations": turns,
    }
    np.save(path, np.array({name: a.astype(np.float32) for name, a in arrays.items()}))


def _dexgraspnet(path: Path, frames: Array, convention: Convention, joints: Array) -> None:
    entries = []
    for frame, row in zip(frames, joints, strict=True):
        qpos = dict(zip(convention.joints, row.tolist(), strict=True))
        angles = roll_pitch_yaw(frame[:3, :3])
        qpos |= zip(("WRJRx", "WRJRy", "WRJRz"), angles.tolist(), strict=True)
        qpos |= zip(("WRJTx", "WRJTy", "WRJTz"), frame[:3, 3].tolist(), strict=True)
        entries.append({"qpos": qpos, "scale": 0.06})
    np.save(path, np.array(entries, dtype=object))


OBJECT = np.array([0.3, -0.1, 0.05, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""Where the object is in files that say so: x y z, w x y z (a quarter turn about z)."""


def _rows(frames: Array, joints: Array) -> Array:
    """(k, 7 + joints), the poses those of hands about the object where it is."""
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], OBJECT[:3]
    poses = placed @ frames
    return np.hstack([poses[:, :3, 3], _quaternions(poses[:, :3, :3]), joints])


def _bodex(path: Path, frames: Array, convention: Convention, joints: Array) -> None:
    del convention
    rows = _rows(frames, joints).astype(np.float32)
    stages = np.stack([_scaled(rows, 0.5), rows, _scaled(rows, 2.0)], axis=1)
    robot_of_file = {
        "robot_pose": stages[None],
        "obj_pose": OBJECT[None],
        "obj_scale": np.array([0.06]),
    }
    np.save(path, np.array(robot_of_file, dtype=object))


def _dexgraspbench(path: Path, frames: Array, convention: Convention, joints: Array) -> None:
    del convention
    rows = _rows(frames, joints).astype(np.float32)
    stages = {"pregrasp_qpos": _scaled(rows, 0.5), "grasp_qpos": rows}
    stages |= {"squeeze_qpos": _scaled(rows, 2.0)}
    robot_of_file = stages | {
        "obj_pose": OBJECT,
        "obj_scale": np.float64(0.06),
        "obj_path": "assets",
    }
    np.save(path, np.array(robot_of_file, dtype=object))


def _multidex(path: Path, frames: Array, convention: Convention, joints: Array) -> None:
    """Columns of the rotation are neither units nor at a right angle, as optimisers leave them."""
    hand = convention.name.partition("_")[2]
    first, second = frames[:, :3, 0], frames[:, :3, 1]
    turns = [1.1 * (first + 0.05 * second), 0.9 * (second + 0.05 * first)]
    rows = np.hstack([frames[:, :3, 3], *turns, joints])
    metadata = [(row, "contactdb+apple", hand) for row in rows]
    info = {"num_total": len(rows), "num_per_object": {"contactdb+apple": len(rows)}}
    write_torch(path, {"info": info, "metadata": [*metadata]})


def _isaac(path: Path, frames: Array, convention: Convention, joints: Array) -> None:
    grasps = {}
    for i, (frame, row) in enumerate(zip(frames, joints, strict=True)):
        w, *xyz = _quaternions(frame[None, :3, :3])[0].tolist()
        position = dict(zip(convention.joints, row.tolist(), strict=True))
        grasps[f"grasp_{i}"] = {
            "confidence": 1.0,
            "position": frame[:3, 3].tolist(),
            "orientation": {"w": w, "xyz": xyz},
            "cspace_position": position,
            "pregrasp_cspace_position": position,
        }
    frames_of = {"object_frame": "/World/mug", "gripper_frame": "/World/gripper"}
    head = {"format": "isaac_grasp", "format_version": 1.0, **frames_of}
    path.write_text(yaml.safe_dump({**head, "grasps": grasps}), encoding="utf-8")


def _table(path: Path, palms: Array, names: tuple[str, ...], joints: Array) -> None:
    columns = dict(zip("xyz", palms[:, :3, 3].T, strict=True))
    if path.suffix == ".csv":
        turns = _quaternions(palms[:, :3, :3])
        columns |= zip(("qw", "qx", "qy", "qz"), turns.T, strict=True)
    else:
        angles = np.stack([roll_pitch_yaw(palm[:3, :3]) for palm in palms])
        columns |= zip(("roll", "pitch", "yaw"), angles.T, strict=True)
    columns |= zip(names, joints.T, strict=True)
    if path.suffix == ".npz":
        np.savez(path, **columns)  # pyright: ignore[reportArgumentType]
        return
    if path.suffix == ".parquet":
        import polars as pl

        pl.DataFrame(columns).write_parquet(path)
        return
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(np.stack(list(columns.values()), axis=1).tolist())


def _scaled(rows: NDArray[Any], factor: float) -> Array:
    """Return rows x y z, w x y z, joints with the joints scaled."""
    return np.hstack([rows[:, :7], factor * rows[:, 7:]])


def _quaternions(rotations: Array) -> Array:
    """(k, 4) w x y z: eigenvectors of a symmetric matrix (Bar-Itzhack 2000)."""
    joints = []
    for r in rotations:
        k = np.array(
            [
                [r[0, 0] - r[1, 1] - r[2, 2], 0.0, 0.0, 0.0],
                [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0.0, 0.0],
                [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0.0],
                [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
            ]
        )
        x, y, z, w = np.linalg.eigh(k)[1][:, -1]
        joints.append([w, x, y, z])
    return np.array(joints)


WRITERS: dict[str, Callable[[Path, Array, Convention, Array], None]] = {
    "getagrip": _getagrip,
    "dexgraspnet": _dexgraspnet,
    "bodex": _bodex,
    "dexgraspbench": _dexgraspbench,
    "multidex": _multidex,
    "isaac": _isaac,
}

TABLES = ("table.csv", "table.npz", "table.parquet")


def main() -> None:
    """Write one file of each kind."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*ik.shipped_names("datasets"), *TABLES):
        print(made(name, folder).path)


if __name__ == "__main__":
    main()
