"""Where fingertips can be while motors are within boxes, in numpy: balls for a check of proofs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from casadi_ik.arrays import Array, Bools, Rows
from casadi_ik.problem.hand_motors import finger_joints
from casadi_ik.problem.joint_bounds import joint_bounds
from casadi_ik.problem.joint_frames import link_frames, placed
from casadi_ik.robots.description import RobotDescription


@dataclass(frozen=True, eq=False)
class Balls:
    """All contacts of k boxes.

    Attributes:
        points: (k, f, 3) centres [m], palm frame; base frame if the palm does not move.
        normals: (k, f, 3) unit.
        radius: (k, f) how far the points can be from there [m].
        angle: (k, f) how far the normals can be turned from there [rad].
        moved: (k, f, h) what each motor adds to the radius [m].
        swung: (k, f, h) what it adds to the angle [rad].
        slopes: (k, f, m, 3) how a joint carries the point over half its range [m], joints of all
            fingers in turn.
        turns: (k, f, m, 3) how it carries the normal.
        bend: (k, f) what the slopes leave out of the point [m].
        curl: (k, f) what they leave out of the normal.
        empty: (k,) whether joint limits leave nothing.
    """

    points: Array
    normals: Array
    radius: Array
    angle: Array
    moved: Array
    swung: Array
    slopes: Array
    turns: Array
    bend: Array
    curl: Array
    empty: Bools

    def rows(self, rows: Rows) -> Balls:
        """Some of the boxes."""
        return Balls(*(getattr(self, item.name)[rows] for item in fields(self)))

    @property
    def effect(self) -> Array:
        """(k, h) what each motor adds at most, a radian counting as 0.1 m."""
        return (self.moved / 0.1 + self.swung).max(axis=1)


def balls(
    robot: RobotDescription,
    motors: Sequence[str],
    box: tuple[Array, Array],
    limits: tuple[Array, Array],
    fingers: Sequence[int],
    in_palm: bool,
) -> Balls:
    """Balls around the contacts in the middle of the joints' ranges.

    Args:
        robot: The description.
        motors: Names of the motors of the hand.
        box: Their lower and upper ends (k, h).
        limits: Of the joints of the fingers (m,).
        fingers: Numbers of the fingers wanted.
        in_palm: Whether in the palm frame.
    """
    count = len(box[0])
    ranges, empty = {}, np.zeros(count, dtype=bool)
    names = finger_joints(robot)
    used = {name for i in fingers for name in robot.fingers[i].joints}
    wanted = [name for name in names if name in used]
    for name, (low, high) in joint_bounds(robot, motors, *box, wanted).items():
        i = names.index(name)
        low, high = np.maximum(low, limits[0][i]), np.minimum(high, limits[1][i])
        empty |= low > high
        ranges[name] = (low + high) / 2, np.maximum(high - low, 0.0) / 2 + 1e-12
    links = [robot.palm_link, *(robot.fingers[i].link for i in fingers)]
    chained = {joint.name for link in links for joint in robot.chain(link)}
    chain = [joint for joint in robot.joints if joint.name in chained]
    middles = {name: middle for name, (middle, _) in ranges.items()}
    frames = link_frames(robot, middles, count, chain)
    kinds = {joint.name: joint for joint in robot.movable}
    points, normals, radius, angle, bend, curl = [], [], [], [], [], []
    carried = np.zeros((2, count, len(fingers), len(wanted), 3))
    shares = np.zeros((2, count, len(fingers), len(motors)))
    for place, i in enumerate(fingers):
        finger = robot.fingers[i]
        rotation, point = placed(frames[finger.link], finger.placement)
        normal = rotation @ finger.normal
        far, turned, left_out = np.zeros(count), np.zeros(count), np.zeros(count)
        nearer = sum((ranges[name][1] for name in finger.joints), np.zeros(count))
        for name in reversed(finger.joints):
            joint, half = kinds[name], ranges[name][1]
            frame, origin = frames[joint.child]
            sine, axis = np.sin(np.minimum(half, np.pi) / 2), frame @ joint.axis
            if joint.type == "prismatic":
                slope, turn, lever = axis, np.zeros((count, 3)), np.ones(count)
                moved, swung = half, np.zeros(count)
            else:
                slope, turn = np.cross(axis, point - origin), np.cross(axis, normal)
                lever = np.linalg.norm(slope, axis=1) + far
                moved, swung = 2 * sine * lever, half
            # A second derivative by two joints is no longer than the lever of the outer one.
            nearer = nearer - half
            left_out = left_out + lever * half * (half / 2 + nearer)
            m = wanted.index(name)
            carried[0, :, place, m] = slope * half[:, None]
            carried[1, :, place, m] = turn * half[:, None]
            far, turned = far + moved, turned + swung
            k = list(motors).index(_motor(robot, name))
            shares[0, :, place, k] += moved
            shares[1, :, place, k] += swung
        if in_palm:
            palm, centre = placed(frames[robot.palm_link], robot.palm_placement)
            point = np.einsum("kji,kj->ki", palm, point - centre)
            normal = np.einsum("kji,kj->ki", palm, normal)
            carried[:, :, place] = np.einsum("kji,akmj->akmi", palm, carried[:, :, place])
        points.append(point)
        normals.append(normal)
        radius.append(far)
        angle.append(turned)
        bend.append(left_out)
        curl.append(turned * turned / 2)
    parts = points, normals, radius, angle
    stacked = (np.stack(part, axis=1) for part in parts)
    return Balls(
        *stacked,
        moved=shares[0],
        swung=shares[1],
        slopes=carried[0],
        turns=carried[1],
        bend=np.stack(bend, axis=1),
        curl=np.stack(curl, axis=1),
        empty=empty,
    )


def _motor(robot: RobotDescription, name: str) -> str:
    """The actuator that a joint follows in the end."""
    joints = {joint.name: joint for joint in robot.movable}
    while name in joints and (coupling := joints[name].coupling) is not None:
        name = coupling.of
    return name
