"""A proof that a target is impossible: what was proved, of what, and its check by other means.

The check shares with the search for proofs what a proof starts from (`proofs.premises`) and none of
its bounds: it proves the target impossible again, in numpy, by simpler bounds and finer boxes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cached_property
from itertools import combinations

import numpy as np

from casadi_ik.files.arrays import Array, Bools, Rows
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.kinematics.couplings import joint_bounds
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.linkage import link_poses
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.premises import (
    NO_CONE,
    OUTWARDS,
    ArmCones,
    arm_cones,
    arm_span,
    endless_fingers,
    joint_limits,
    motor_box,
    motor_ends,
)

SLACK = 1e-8
"""Ten times the search's own slack for rounding [m, rad]."""


@dataclass(frozen=True)
class CheckEffort:
    """How long a check goes on.

    Attributes:
        boxes: After so many the proof counts as not confirmed.
        together: Boxes that are looked at in one go.
        swivels: Places of the elbow that are looked at.
        finest: A box is not divided any more where its contacts move by less [0.1 m, rad]: the
            proof is not confirmed.
    """

    boxes: int = 400_000
    together: int = 512
    swivels: int = 180
    finest: float = 1e-5


class ProofKind(StrEnum):
    """What contradicts what."""

    FINGER = "a finger of the fixed hand comes nowhere near its contact"
    HAND = "no posture of the hand fits the contacts, wherever the palm is"
    REACH = "every posture of the hand that may fit puts the wrist out of the arm's reach"


@dataclass(frozen=True, eq=False)
class Proof:
    """A proof of impossibility by guaranteed bounds.

    The hand's postures are covered by boxes, and in each of them a bound on what the contacts keep
    (distances, angles, heights, their best rigid fit) or on where the wrist comes to lie excludes
    the target, tolerances and rounding included.

    Attributes:
        kind: What contradicts what.
        fingers: The fingers whose contacts contradict each other; the others play no part.
        boxes: How many boxes cover the hand's postures, 1 if none had to be divided.
        tolerance: Within which the target is impossible, by finger; at least those asked for.
        target: The target that was proved impossible, one row.
        seal: Of all the others, see `sealed`.
    """

    kind: ProofKind
    fingers: tuple[str, ...]
    boxes: int
    tolerance: tuple[Tolerance, ...]
    target: TargetBatch = field(repr=False)
    seal: str = field(default="", repr=False)

    def sealed(self) -> Proof:
        """The same with a seal by which `check` sees whether something was changed since."""
        return replace(self, seal=self._seal())

    def _seal(self) -> str:
        parts = (self.kind.name, self.fingers, self.boxes, self.tolerance)
        digest = hashlib.sha256(repr(parts).encode())
        for array in (self.target.points, self.target.normals):
            digest.update(np.ascontiguousarray(array, dtype=float).tobytes())
        return digest.hexdigest()[:32]

    @property
    def lines(self) -> tuple[str, ...]:
        """What is proved, in short lines."""
        who = ", ".join(self.fingers)
        parts = "at once" if self.boxes == 1 else f"in each of {self.boxes} parts of its postures"
        return (f"proved for {who} {parts}: {self.kind}",)

    @property
    def lines_of_palm(self) -> tuple[str, ...]:
        """The same where a palm was asked for, with the hand as it is."""
        if self.kind is ProofKind.REACH:
            return ("proved: the palm has the wrist where the arm does not reach",)
        return (f"proved: {self.kind}",)

    def check(self, robot: ArmHand, target: TargetBatch | None = None) -> bool:
        """Prove it again by other means: whether the proof holds and says what it said.

        The seal is compared, and the hand's postures are divided anew with another arithmetic, in
        numpy and not compiled, in boxes as fine as it takes. Takes up to some seconds, of hard
        targets up to a minute.

        Args:
            robot: The robot.
            target: One target that the proof has to be about; None: the one it names.
        """
        description, about = robot.description, target
        for side in description.sides:
            # What is proved of a body is proved of one of its sides.
            if set(self.fingers) <= set(side.fingers):
                fingers = [robot.fingers.index(finger) for finger in side.fingers]
                about = None if target is None else target.of_fingers(fingers)
                description = description.side(side.name, carried=True)
                break
        return self.seal == self._seal() and _holds(self, description, about)


def _holds(proof: Proof, robot: RobotDescription, target: TargetBatch | None) -> bool:
    """Whether a proof is about a target, states it rightly, and can be proved again."""
    about = proof.target
    if len(about) != 1 or (target is not None and not _same(about, target)):
        return False
    numbers = [
        robot.finger_names.index(name) for name in proof.fingers if name in robot.finger_names
    ]
    known = ~np.isnan(about.points[0, :, 0])
    if len(numbers) != len(proof.fingers) or not numbers or not known[numbers].all():
        return False
    pairs = zip(proof.tolerance, about.tolerances, strict=True)
    if any(p.position < a.position or p.angle < a.angle for p, a in pairs):
        return False
    asked = replace(about, tolerance=tuple(proof.tolerance))
    return _Search(robot, asked, numbers, proof.kind.name).refutes()


def _same(one: TargetBatch, other: TargetBatch) -> bool:
    arrays = ((one.points, other.points), (one.normals, other.normals))
    fixed = [np.zeros(0) if item.fixed is None else item.fixed for item in (one, other)]
    return (
        all(np.array_equal(a, b, equal_nan=True) for a, b in arrays)
        and np.array_equal(fixed[0], fixed[1], equal_nan=True)
        and one.tolerances == other.tolerances
        and one.enforce_limits == other.enforce_limits
    )


class _Search:
    """Divides the hand's box until every part is refuted."""

    def __init__(
        self, robot: RobotDescription, asked: TargetBatch, fingers: list[int], kind: str
    ) -> None:
        self.robot, self.asked, self.fingers, self.kind = robot, asked, fingers, kind
        self.motors = robot.finger_motors
        self.effort = CheckEffort()
        self.in_palm = any(j.type != "fixed" for j in robot.chain(robot.palm_link))
        self.limits = joint_limits(robot, asked)
        self.points, self.normals = asked.points[0, fingers], asked.normals[0, fingers]
        self.loose = asked.position_tolerance[fingers] + SLACK
        self.turned = asked.angle_tolerance[fingers] + SLACK

    def refutes(self) -> bool:
        ends = motor_box(self.robot, self.asked)
        endless = endless_fingers(self.robot, ends)
        if any(endless[i] for i in self.fingers):
            return False
        waiting, seen = [ends[None]], 0
        while waiting:
            boxes = waiting.pop()
            seen += len(boxes)
            if seen > self.effort.boxes:
                return False
            found = contact_balls(
                self.robot,
                self.motors,
                (boxes[:, 0], boxes[:, 1]),
                self.limits,
                self.fingers,
                self.in_palm,
            )
            refuted, scores = self._refuted(found)
            left = np.flatnonzero(~(found.empty | refuted))
            boxes, scores = boxes[left], scores[left]
            widest = scores.argmax(axis=1)
            if (found.effect[left][np.arange(len(left)), widest] < self.effort.finest).any():
                return False
            halves, size = halved(boxes, widest), self.effort.together
            waiting += [halves[i : i + size] for i in range(0, len(halves), size)]
        return True

    def _refuted(self, found: Balls) -> tuple[Bools, Array]:
        """Which boxes are impossible, and what each motor leaves open (k, h)."""
        radius, angle = found.radius + self.loose, found.angle + self.turned
        if not self.in_palm:
            apart = np.linalg.norm(self.points - found.points, axis=2) > radius
            facing = angle_of(self.normals, found.normals) > angle
            return (apart | facing).any(axis=1), found.effect
        refuted, scores = self._pairs(found, radius, angle)
        refuted[~refuted] = self._rigid(found, radius, angle, ~refuted)
        if self.kind == "REACH":
            refuted |= self._reach(found, radius)
            rows = np.flatnonzero(~refuted)
            refuted[rows] = self._beyond_cones(found.rows(rows), radius[rows])
        return refuted, scores

    def _pairs(self, found: Balls, radius: Array, angle: Array) -> tuple[Bools, Array]:
        """Distances of points, angles of normals, angles of normals and lines.

        What is nearly broken counts most for where boxes are divided.
        """
        refuted, scores = np.zeros(len(radius), dtype=bool), 0.1 * found.effect
        for i, j in combinations(range(len(self.fingers)), 2):
            asked, here = self.points[j] - self.points[i], found.points[:, j] - found.points[:, i]
            give = radius[:, i] + radius[:, j]
            far, length = np.linalg.norm(asked), np.linalg.norm(here, axis=1)
            moved = found.moved[:, i] + found.moved[:, j]
            tests = [(np.abs(length - far) - SLACK * far, give, moved)]
            between = angle_of(self.normals[i], self.normals[j])
            now = angle_of(found.normals[:, i], found.normals[:, j])
            swung = found.swung[:, i] + found.swung[:, j]
            tests.append((np.abs(now - between), angle[:, i] + angle[:, j], swung))
            # The line between the points turns by no more than asin(give / length).
            with np.errstate(divide="ignore", invalid="ignore"):
                tilt = np.arcsin(np.clip(give / far, 0.0, 1.0))
                tilt[give >= far] = np.pi
                for n in (i, j):
                    off = np.abs(
                        angle_of(found.normals[:, n], here) - angle_of(self.normals[n], asked)
                    )
                    shares = found.swung[:, n] + moved / far
                    tests.append((off, angle[:, n] + tilt, shares))
                for off, width, shares in tests:
                    ratio = np.nan_to_num(off / width)
                    refuted |= ratio > 1
                    scores += np.nan_to_num(ratio[:, None] ** 4 * shares / width[:, None])
        return refuted, scores

    def _rigid(self, found: Balls, radius: Array, angle: Array, rows: Bools) -> Bools:
        """The best weighted rigid fit (Kabsch) against what the balls would allow."""
        w = 1 / radius[rows] ** 2
        chord = 2 * np.sin(np.minimum(angle[rows], np.pi) / 2)
        known = ~np.isnan(self.normals[:, 0])
        v = known / chord**2
        facing = np.nan_to_num(self.normals)
        total = w.sum(axis=1, keepdims=True)
        x = found.points[rows] - ((w[:, :, None] * found.points[rows]).sum(axis=1) / total)[:, None]
        y = self.points - ((w[:, :, None] * self.points).sum(axis=1) / total)[:, None]
        S = np.einsum("kf,kfi,kfj->kij", w, x, y)
        S += np.einsum("kf,kfi,fj->kij", v, found.normals[rows], facing)
        sizes = np.linalg.svd(S, compute_uv=False)
        trace = sizes[:, 0] + sizes[:, 1] + np.sign(np.linalg.det(S)) * sizes[:, 2]
        size = (w * ((x**2).sum(axis=2) + (y**2).sum(axis=2)) + 2 * v).sum(axis=1)
        allowed = len(self.fingers) + known.sum()
        return size * (1 - 1e-9) - 2 * trace > allowed

    def _reach(self, found: Balls, radius: Array) -> Bools:
        """Where the wrist can be, from each contact and from all, against the arm's span."""
        shoulder, wrist, near, far = self._arm
        away = np.linalg.norm(self.points - shoulder, axis=1)
        arm = np.linalg.norm(wrist - found.points, axis=2)
        out = (away - arm - radius > far) | (arm - radius - away > far)
        out |= away + arm + radius < near
        centre, give = self._carried(found, radius, wrist, 1)
        distance = np.linalg.norm(centre - shoulder, axis=1)
        out = out.any(axis=1) | (distance - give > far) | (distance + give < near)
        loose = self.loose + SLACK, 2 * np.sin(np.minimum(self.turned, np.pi) / 2) + SLACK
        least, most = seen_distances(found, (self.points, self.normals), loose, shoulder, wrist)
        return out | (least > far) | (most < near)

    def _carried(self, found: Balls, radius: Array, palm: Array, whole: int) -> tuple[Array, Array]:
        """A ball (k, 3), (k,) that holds a point of the palm (whole 1) or a direction (0).

        A weighted sum of contacts and normals.
        """
        known = ~np.isnan(self.normals[:, 0])
        chord = 2 * np.sin(np.minimum(found.angle + self.turned, np.pi) / 2)
        first, origin = found.points[:, :1], self.points[0]
        # The first contact, and from there along the differences of the others and the normals.
        columns = np.concatenate([found.points[:, 1:] - first, found.normals[:, known]], axis=1)
        goals = np.concatenate([self.points[1:] - origin, self.normals[known]])
        loose = np.concatenate([radius[:, 1:] + radius[:, :1], chord[:, known]], axis=1)
        A = columns / loose[:, :, None]
        normal = np.einsum("kfi,kfj->kij", A, A)
        normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(3)
        across = palm - whole * first[:, 0]
        solved = np.linalg.solve(normal, across[:, :, None])[:, :, 0]
        share = np.einsum("kfi,ki->kf", A, solved) / loose
        rest = across - np.einsum("kf,kfi->ki", share, columns)
        n = len(self.fingers) - 1
        give = np.linalg.norm(rest, axis=1) + SLACK
        give += radius[:, 0] * np.abs(whole - share[:, :n].sum(axis=1))
        give += (np.abs(share[:, :n]) * radius[:, 1:]).sum(axis=1)
        give += (np.abs(share[:, n:]) * chord[:, known]).sum(axis=1)
        return whole * origin + share @ goals, give

    def _beyond_cones(self, found: Balls, radius: Array) -> Bools:
        """Whether at every swivel of the elbow a limit of shoulder or wrist is passed."""
        beyond = np.zeros(len(radius), dtype=bool)
        if self._cones is None or not len(radius):
            return beyond
        cones, (_, _, near, far) = self._cones, self._arm
        centre, give = self._carried(found, radius, cones.wrist, 1)
        reach, length = centre - cones.shoulder, np.linalg.norm(centre - cones.shoulder, axis=1)
        rows = np.flatnonzero(give < length)
        least = np.clip(length - give, max(near, 1e-6), None)[rows]
        most = np.maximum(np.clip(length + give, None, far)[rows], least)
        tilt = np.arcsin(give[rows] / length[rows]) + SLACK
        line = reach[rows] / length[rows, None]
        axis, loose = self._carried(found.rows(rows), radius[rows], cones.last, 0)
        side = np.eye(3)[np.abs(line).argmin(axis=1)]
        x = np.cross(line, side)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        y, step = np.cross(line, x), 2 * np.pi / self.effort.swivels
        left = np.zeros(len(rows), dtype=bool)
        (upper, wide), (fore, open_) = (
            _opening(one, other, least, most)
            for one, other in (cones.lengths, reversed(cones.lengths))
        )
        limits = self._cosines
        for psi in step * np.arange(self.effort.swivels):
            out = np.cos(psi) * x + np.sin(psi) * y
            arm = np.cos(upper)[:, None] * line + np.sin(upper)[:, None] * out
            hand = np.cos(fore)[:, None] * line - np.sin(fore)[:, None] * out
            # Between two swivels a direction turns by no more than half a step.
            one = arm @ cones.first + tilt + wide + step / 2
            other = (hand * axis).sum(axis=1) + loose + tilt + open_ + step / 2
            left |= (one >= limits[0]) & (other >= limits[1])
        beyond[rows] = ~left
        return beyond

    @cached_property
    def _cones(self) -> ArmCones | None:
        cones = arm_cones(self.robot)
        return None if cones is None or (cones.cosines(self.asked) == NO_CONE).all() else cones

    @cached_property
    def _cosines(self) -> Array:
        assert self._cones is not None
        return self._cones.cosines(self.asked)

    @cached_property
    def _arm(self) -> tuple[Array, Array, float, float]:
        """Shoulder, wrist in the palm, and what their distance can be [m]."""
        arm = srs_arm(self.robot)
        if arm is None:
            general = arm_span(self.robot)
            assert general is not None
            return general.shoulder, general.wrist, *general.span(self.asked)
        elbow = self.robot.arm_actuators[3]
        lower, upper = (np.clip(end, -1e3, 1e3) for end in motor_ends(self.robot, self.asked))
        ends = arm.reach(lower[elbow] - OUTWARDS, upper[elbow] + OUTWARDS)
        near, far = (float(end) for end in ends)
        return arm.shoulder, arm.wrist_in_palm, near - SLACK, far + SLACK


def _opening(a: float, b: float, least: Array, most: Array) -> tuple[Array, Array]:
    """Angle at the end of side a of a triangle with sides a, b and one between two lengths."""
    sides = [least, most]
    if a > b:
        sides.append(np.clip(np.sqrt(a * a - b * b), least, most))
    angles = [np.arccos(np.clip((c * c + a * a - b * b) / (2 * a * c), -1, 1)) for c in sides]
    low, high = np.min(angles, axis=0), np.max(angles, axis=0)
    return (low + high) / 2, (high - low) / 2 + SLACK


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
            (driver,) = robot.driving([name])
            k = list(motors).index(robot.actuator_names[driver])
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
    normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(3)
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
