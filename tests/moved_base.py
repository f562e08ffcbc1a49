"""Robots written to URDF with their base moved by a fixed joint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

import casadi_ik as ik

IDENTITY = np.eye(4)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    """Return a pose (4, 4) with a uniform rotation and an origin within 1 m."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(None, rng).as_matrix()
    pose[:3, 3] = rng.uniform(-1, 1, 3)
    return pose


def on_pedestal(
    robot: ik.ArmHand,
    folder: Path,
    base: np.ndarray = IDENTITY,
    continuous: tuple[str, ...] = (),
) -> ik.ArmHand:
    """Return the robot imported from a URDF in which a fixed joint carries its root.

    Args:
        robot: The robot; its couplings must be linear, and its hand the tool if it has no motors.
        folder: Folder for the files.
        base: (4, 4) pose of the robot's root in the root of the file.
        continuous: Names of the joints that the file gives no limits.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text, body = robot.urdf(), robot.description
    xyz, rpy = (" ".join(map(repr, map(float, three))) for three in xyz_rpy(base))
    pedestal = (
        f'<link name="floor_below"/><joint name="pedestal" type="fixed">'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><parent link="floor_below"/>'
        f'<child link="{body.root}"/></joint></robot>'
    )
    for name in continuous:
        revolute = f'<joint name="{name}" type="revolute">'
        assert revolute in text
        text = text.replace(revolute, revolute.replace("revolute", "continuous"))
    (folder / "robot.urdf").write_text(text.replace("</robot>", pedestal))

    def frame(link: str, placement: np.ndarray) -> dict:
        origin, angles = xyz_rpy(placement)
        return {"link": link, "xyz": origin.tolist(), "rpy": list(map(float, angles))}

    def pads(names: tuple[str, ...], prefix: str = "") -> dict:
        return {
            finger.name.removeprefix(prefix): frame(finger.link, finger.placement)
            | {"normal": finger.normal.tolist()}
            for finger in map(body.finger, names)
        }

    entry = {"name": body.name.replace("+", "_"), "robot": {"file": "robot.urdf"}}
    if body.sides:
        entry["trunk"] = body.trunk_link
        entry["sides"] = {
            side.name: {
                "palm": frame(side.palm_link, side.palm_placement),
                "fingers": pads(side.fingers, f"{side.name}_"),
            }
            for side in body.sides
        }
    elif body.hand_actuators:
        entry["robot"]["palm"] = frame(body.palm_link, body.palm_placement)
        entry["fingers"] = pads(robot.fingers)
    else:
        tip = next(joint.parent for joint in body.joints if joint.child == body.palm_link)
        entry = {"name": entry["name"], "arm": {"file": "robot.urdf", "tip": tip}}
        entry |= {"hand": "tool", "fingers": list(robot.fingers)}
    entry["home"] = dict(zip(robot.actuators, robot.home.tolist(), strict=True))
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(entry))
    return ik.load_robot(path)


def xyz_rpy(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin and the angles about fixed axes of a pose."""
    return pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
