"""Write the built-in keypoints: both hands of a person who moves a box, seen by a headset.

Nobody was recorded. A Unitree G1 with Dex3 hands takes a box forward, up, to both sides and back,
its waist with it; the keypoints are those of a person whose hands go the same way, `PERSON` times
as large, in OpenXR's frame and joints (x to the right, y up, z to the back)::

    python tools/make_keypoints.py
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.motion.retarget import OPENXR, RATE

PERSON = 0.8
"""Ratio of the person's motion to the robot's."""

KNOTS = (
    # time [s], forward, up [m], yaw [rad], closed
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (1.5, 0.06, 0.0, 0.0, 0.0),
    (2.0, 0.06, 0.0, 0.0, 1.0),
    (3.5, 0.04, 0.10, 0.0, 1.0),
    (5.0, 0.04, 0.10, 0.5, 1.0),
    (7.0, 0.04, 0.10, -0.5, 1.0),
    (8.5, 0.06, 0.0, 0.0, 1.0),
    (9.0, 0.06, 0.0, 0.0, 0.0),
    (10.0, 0.0, 0.0, 0.0, 0.0),
)
"""Key frames of the box, interpolated smoothly."""

TO_XR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Rotation from the robot base (x forward, y left, z up) to the frame of OpenXR."""

TIPS = {"thumb": 4, "index": 8, "middle": 12}


def box_motion(times: Array) -> tuple[Array, Array]:
    """Return the poses of the box (k, 4, 4), and the closing of the hands (k,), 0 to 1."""
    knots = np.array(KNOTS)
    values = np.empty((len(times), 4))
    for first, last in pairwise(knots):
        in_segment = (times >= first[0]) & (times <= last[0])
        share = (times[in_segment, None] - first[0]) / (last[0] - first[0])
        smooth = share**3 * (10 - 15 * share + 6 * share**2)
        values[in_segment] = first[1:] + smooth * (last[1:] - first[1:])
    poses = [
        frame_matrix(Frame(rpy=(0.0, 0.0, yaw))) @ frame_matrix(Frame(xyz=(forward, 0.0, up)))
        for forward, up, yaw, _ in values
    ]
    return np.array(poses), values[:, 3]


def path(robot: ik.ArmHand, times: Array) -> Array:
    """Return the (k, n) configurations in which the robot carries the box."""
    sides = robot.description.sides
    hands = [motor for side in sides for motor in side.hand]
    opened = {motor: robot.home[robot.actuators.index(motor)] for motor in hands}
    start = {side.name: robot.palm(robot.home, side.name) for side in sides}
    poses, closed = box_motion(times)
    grasps = []
    for pose, share in zip(poses, closed, strict=True):
        posture = {motor: value * (1 + 0.25 * share) for motor, value in opened.items()}
        grasps.append(ik.Grasp(palm=start, posture=posture).at(pose))
    track = ik.Solver(robot).track(grasps, q0=robot.home)
    if not track.success.all() or track.jumps:
        raise SystemExit(
            f"{(~track.success).sum()} poses are not reached, {len(track.jumps)} jumps"
        )
    return track.q


def openxr_joints(robot: ik.ArmHand, q: Array, side: str) -> Array:
    """Return the (k, 26, 3) joints of a hand in the order of OpenXR [m]."""
    rng = np.random.default_rng([0, *side.encode()])
    palms, points = robot.palm(q, side), robot.contacts(q)[0]
    in_segment = 0.08 * rng.normal(size=(26, 3))
    in_segment[OPENXR[0]] = 0.0  # the wrist
    joints = palms[:, None, :3, 3] + in_segment @ palms[:, :3, :3].swapaxes(1, 2)
    for finger, key in TIPS.items():
        joints[:, OPENXR[key]] = points[:, robot.fingers.index(f"{side}_{finger}")]
    return PERSON * joints @ TO_XR.T + [0.0, 1.1, 0.0]


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description="Write the shipped keypoints of two hands.")
    parser.add_argument("--out", type=Path, default=Path("models/keypoints/two_hands_box.npz"))
    options = parser.parse_args()
    robot = ik.load_robot("g1+dex3")
    times = np.arange(round(KNOTS[-1][0] * RATE) + 1) / RATE
    q = path(robot, times)
    arrays: dict[str, Any] = {
        f"keypoints_{side.name}": openxr_joints(robot, q, side.name).astype(np.float32)
        for side in robot.description.sides
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(options.out, times=times, **arrays)
    print(options.out, f"{options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
