"""Where fingertips can be while motors are within boxes, in numpy: the bounds of a check of proofs.

They share nothing with `proofs.boxes`, the bounds of the search for proofs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from casadi_ik.arrays import Array, Bools, Rows
from casadi_ik.robots.description import RobotDescription
from casadi_ik.robots.poses import link_poses
from casadi_ik.symbolic.couplings import joint_bounds


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


def contact_balls(
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
    names = robot.finger_joints
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
    poses = link_poses(robot.root, chain, middles)
    kinds = {joint.name: joint for joint in robot.movable}
    points, normals, radius, angle, bend, curl = [], [], [], [], [], []
    carried = np.zeros((2, count, len(fingers), len(wanted), 3))
    shares = np.zeros((2, count, len(fingers), len(motors)))
    for place, i in enumerate(fingers):
        finger = robot.fingers[i]
        pad = np.broadcast_to(poses[finger.link] @ finger.placement, (count, 4, 4))
        point, normal = pad[:, :3, 3], pad[:, :3, :3] @ finger.normal
        far, turned, left_out = np.zeros(count), np.zeros(count), np.zeros(count)
        nearer = sum((ranges[name][1] for name in finger.joints), np.zeros(count))
        for name in reversed(finger.joints):
            joint, half = kinds[name], ranges[name][1]
            frame = poses[joint.child]
            sine = np.sin(np.minimum(half, np.pi) / 2)
            axis, origin = frame[..., :3, :3] @ joint.axis, frame[..., :3, 3]
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
            palm = poses[robot.palm_link] @ robot.palm_placement
            turned_back = palm[:3, :3]
            point = (point - palm[:3, 3]) @ turned_back
            normal = normal @ turned_back
            carried[:, :, place] = carried[:, :, place] @ turned_back
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


def seen_distances(
    found: Balls, asked: tuple[Array, Array], loose: tuple[Array, Array], base: Array, palm: Array
) -> tuple[Array, Array]:
    """Smallest and largest distance (k,) of a point of the base from one of the palm [m].

    In the palm frame the wrist stands still, and it is known which way a joint carries what is
    seen.
    The point of the base is a sum of what is asked for, with coefficients; the palm sees the same
    sum of its contacts.

    Args:
        found: The contacts of k boxes, palm frame.
        asked: Points and normals (f, 3), normals NaN where free.
        loose: By how much contacts may be off: (f,) [m], and (f,) chords.
        base: (3,) in the base frame [m].
        palm: (3,) in the palm frame [m].
    """
    points, normals = asked
    known = ~np.isnan(normals[:, 0])
    radius = found.radius + loose[0]
    chord = 2 * np.sin(np.minimum(found.angle, np.pi) / 2) + loose[1]
    goals = np.concatenate([points[1:] - points[0], normals[known]])
    each = np.concatenate([radius[:, 1:] + radius[:, :1], chord[:, known]], axis=1)
    A, across = goals / each[:, :, None], base - points[0]
    normal = np.einsum("kfi,kfj->kij", A, A)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    solved = np.linalg.solve(normal, np.tile(across, (len(A), 1))[:, :, None])[:, :, 0]
    share = np.einsum("kfi,ki->kf", A, solved) / each
    n = len(points) - 1
    p = np.concatenate([1 - share[:, :n].sum(axis=1, keepdims=True), share[:, :n]], axis=1)
    b = np.zeros_like(p)
    b[:, known] = share[:, n:]
    centre = np.einsum("kf,kfi->ki", p, found.points) + np.einsum("kf,kfi->ki", b, found.normals)
    slopes = np.einsum("kf,kfmi->kmi", p, found.slopes) + np.einsum("kf,kfmi->kmi", b, found.turns)
    give = np.linalg.norm(across - share @ goals, axis=1)
    give += (np.abs(p) * (found.bend + loose[0]) + np.abs(b) * (found.curl + loose[1])).sum(axis=1)
    away = centre - palm
    length = np.linalg.norm(away, axis=1)
    line = away / np.maximum(length, 1e-300)[:, None]
    along = np.einsum("kmi,ki->km", slopes, line)
    aside = np.linalg.norm(slopes - along[:, :, None] * line[:, None], axis=2).sum(axis=1)
    ahead = np.abs(along).sum(axis=1)
    return length - ahead - give, np.hypot(length + ahead, aside) + give


def halved(boxes: Array, widest: Rows) -> Array:
    """Boxes (k, 2, h) cut in the middle of one motor each (k,): (2 k, 2, h)."""
    rows = np.arange(len(boxes))
    middle = boxes.mean(axis=1)[rows, widest]
    low, high = boxes.copy(), boxes.copy()
    low[rows, 1, widest], high[rows, 0, widest] = middle, middle
    return np.concatenate([low, high])


def angle_of(a: Array, b: Array) -> Array:
    """Angles of vectors along the last axis [rad]; NaN where one is NaN."""
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    apart, together = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    return 2 * np.arctan2(apart, together)


def _motor(robot: RobotDescription, name: str) -> str:
    """The actuator that a joint follows in the end."""
    joints = {joint.name: joint for joint in robot.movable}
    while name in joints and (coupling := joints[name].coupling) is not None:
        name = coupling.of
    return name
