"""Postures of a hand as a data set has them, and the nearest that a robot's hand can take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks.poses import nearest_rotations, rotation_problem
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.linkage import joint_motion, link_poses
from casadi_ik.model.pose import inverse


@dataclass(frozen=True)
class PostureFit:
    """How postures of data sets become what a robot's motors can take.

    Attributes:
        far: A hand farther from its object than this [m] is one in millimetres.
        beyond: A joint may be so far beyond its limits [rad or m]; it is then at the limit.
        apart: How far a joint may be from where its coupling puts it [rad or m].
        steps: Of the search for the nearest posture, at most.
        difference: A motor moves so far for a derivative [rad or m].
        stay: Squared metres at a fingertip that a radian of a motor counts as: what decides between
            postures whose fingertips are as near.
        settled: Steps are over when no motor moves farther [rad or m].
    """

    far: float = 5.0
    beyond: float = 0.02
    apart: float = 0.02
    steps: int = 40
    difference: float = 1e-7
    stay: float = 1e-6
    settled: float = 1e-6


FIT = PostureFit()

LARGE = 4 * np.pi
"""A joint that is turned farther than this [rad] is one in degrees."""


@dataclass(frozen=True, eq=False)
class HandPoses:
    """k grasps by one hand.

    A row that is none (numbers that are not finite or in other units, no rotation) is among
    `faults`; its numbers are zeros, and its rotation is none.

    Attributes:
        where: File and key, for messages.
        position: (k, 3) origin of the hand's frame in the object's [m].
        rotation: (k, 3, 3) its axes, exact rotations.
        joints: (k, m) joint positions [rad or m].
        names: Of the joints as the file calls them; none: the order of the hand's description.
        objects: What each grasp is of, as the file calls it; none: all are of one thing.
        scales: By what factor the object of each grasp is larger than its mesh; none: not said.
        rows: (k,) their numbers in the file.
        faults: What is wrong with a row, by its number in the file.
        pregrasp: The same hands before they close; None: not said.
        squeeze: The same hands as they squeeze; None: not said.
    """

    where: str
    position: Array
    rotation: Array
    joints: Array
    names: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    scales: tuple[float, ...] = ()
    rows: tuple[int, ...] = ()
    faults: Mapping[int, str] = field(default_factory=dict)
    pregrasp: HandPoses | None = None
    squeeze: HandPoses | None = None

    def __post_init__(self) -> None:
        """Check what is given.

        Raises:
            DescriptionError: No grasps, or another number of poses than postures.
        """
        count = len(self.position)
        shapes = {"position": (count, 3), "rotation": (count, 3, 3)}
        for name, shape in shapes.items():
            found = getattr(self, name).shape
            if found != shape:
                self._fail(f"{name}: found shape {found}, expected {shape}")
        if not count:
            self._fail("found no grasps, expected at least one")
        if self.joints.ndim != 2 or len(self.joints) != count:
            self._fail(f"joints: found shape {self.joints.shape}, expected ({count}, joints)")
        object.__setattr__(self, "rows", self.rows or tuple(range(count)))
        faults = {**self._faults(), **self.faults}
        for stage in ("pregrasp", "squeeze"):
            other = getattr(self, stage)
            if other is not None:
                faults = {row: f"{stage}: {text}" for row, text in other.faults.items()} | faults
        object.__setattr__(self, "faults", faults)

    def of(self, name: str | None) -> HandPoses:
        """The grasps of one thing.

        Args:
            name: What the file calls it; None: there is only one.

        Raises:
            DescriptionError: There are several, or none of that name.
        """
        if name is None and len(set(self.objects)) <= 1:
            return self
        known = sorted(set(self.objects))
        said = f"{len(known)} objects ({', '.join(known[:3])}{', ...' if known[3:] else ''})"
        if name is None:
            self._fail(f"found grasps of {said}, expected one; say which (of)")
        if name not in known:
            self._fail(f"of: found {name!r}, expected one of {said}")
        kept = self.select(np.flatnonzero(np.array(self.objects) == name))
        return replace(kept, where=f"{self.where}: {name}")

    def of_scale(self, scale: float | None) -> HandPoses:
        """The grasps of one size of the object.

        Args:
            scale: Which; None: there is only one.

        Raises:
            DescriptionError: There are several, or none of that size.
        """
        if not self.scales:
            if scale is not None:
                self._fail(f"scale: found {scale:g}, but the file says of no size")
            return self
        digits = np.array([float(f"{one:.5g}") for one in self.scales])
        sizes, counts = np.unique(digits, return_counts=True)
        pairs = zip(sizes, counts, strict=True)
        said = f"{len(sizes)} sizes (scale {', '.join(f'{s:g}: {n} rows' for s, n in pairs)})"
        if scale is None:
            if len(sizes) > 1:
                self._fail(f"found grasps of {said}, expected one; say which (scale, --scale)")
            return self
        kept = np.flatnonzero(np.isclose(digits, scale, rtol=1e-4, atol=0.0))
        if not len(kept):
            self._fail(f"scale: found {scale:g}, expected one of {said}")
        return self.select(kept)

    def select(self, kept: NDArray[np.intp]) -> HandPoses:
        """Some of the grasps, by their places."""

        def some(values: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(values[i] for i in kept) if values else ()

        rows = some(self.rows)
        return replace(
            self,
            position=self.position[kept],
            rotation=self.rotation[kept],
            joints=self.joints[kept],
            objects=some(self.objects),
            scales=some(self.scales),
            rows=rows,
            faults={row: text for row, text in self.faults.items() if row in rows},
            pregrasp=None if self.pregrasp is None else self.pregrasp.select(kept),
            squeeze=None if self.squeeze is None else self.squeeze.select(kept),
        )

    def _faults(self) -> dict[int, str]:
        """What is wrong with rows; these are zeros from now on, and rotations exact."""
        found: dict[int, str] = {}

        def note(bad: Bools, texts: Callable[[int], str]) -> None:
            for i in np.flatnonzero(bad):
                found.setdefault(self.rows[i], texts(int(i)))

        for name in ("position", "rotation", "joints"):
            finite = np.isfinite(getattr(self, name)).reshape(len(self.position), -1).all(axis=1)
            more = " (and quaternions of length 1)" if name == "rotation" else ""
            text = f"{name}: holds NaN or infinity, expected finite numbers{more}"
            note(np.asarray(~finite), lambda _, text=text: text)
        away = np.linalg.norm(self.position, axis=1)
        note(
            away > FIT.far,
            lambda i: (
                f"position: found {away[i]:.4g} m from the object, expected at most {FIT.far:g} m "
                "(numbers in mm?)"
            ),
        )
        note(
            np.asarray((np.abs(self.joints) > LARGE).any(axis=1)),
            lambda _: (
                "joints: found angles beyond two turns, expected radians (numbers in degrees?)"
            ),
        )
        whole = np.array([row not in found for row in self.rows])
        rotation = np.where(whole[:, None, None], self.rotation, np.eye(3))
        exact, invalid = nearest_rotations(rotation)
        note(invalid, lambda i: f"rotation: {rotation_problem(rotation[i])}")
        whole = np.array([row not in found for row in self.rows])
        object.__setattr__(self, "rotation", np.where(whole[:, None, None], exact, np.eye(3)))
        for name in ("position", "joints"):
            object.__setattr__(self, name, np.where(whole[:, None], getattr(self, name), 0.0))
        return found

    def _fail(self, problem: str) -> NoReturn:
        raise DescriptionError(f"{self.where}: {problem}")

    @property
    def poses(self) -> Array:
        """(k, 4, 4)."""
        poses = np.tile(np.eye(4), (len(self.position), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.rotation, self.position
        return poses


def of_fixed_axes(angles: Array) -> Array:
    """(k, 3, 3) rotations about fixed axes by (k, 3) roll, pitch, yaw [rad], as URDF has them."""
    x, y, z = (joint_motion("revolute", axis, angles[:, i]) for i, axis in enumerate(np.eye(3)))
    return (z @ y @ x)[:, :3, :3]


def of_two_columns(columns: Array) -> Array:
    """(k, 3, 3) rotations of (k, 6) two columns, from whose right angle both are as far as before.

    Their sum and their difference are at a right angle whatever they are. Columns that are none, or
    the same, become NaN. After `robust_compute_rotation_matrix_from_ortho6d` of GenDexGrasp.
    """

    def unit(vectors: Array) -> Array:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    with np.errstate(invalid="ignore", divide="ignore"):
        first, second = unit(columns[:, :3]), unit(columns[:, 3:])
        middle, across = unit(first + second), unit(first - second)
        first, second = unit(middle + across), unit(middle - across)
    return np.stack([first, second, np.cross(first, second)], axis=2)


def palms_of(
    robot: ArmHand, link: str, frames: Array, joints: Mapping[str, Array]
) -> tuple[Array, Array, Array]:
    """Palms and fingertips of hands whose frames are given.

    Args:
        robot: The robot.
        link: The link whose frames are given.
        frames: (k, 4, 4) its poses.
        joints: Positions (k,) by joint.

    Returns:
        Poses (k, 4, 4) of the robot's palm frame, contact points (k, f, 3) and normals (k, f, 3),
        in the frame in which the link's are given.
    """
    described = robot.description
    poses = link_poses(described.root, described.joints, joints)
    back = inverse(poses[link])
    moved = frames @ back
    palms = moved @ poses[described.palm_link] @ described.palm_placement
    pads = np.stack([moved @ poses[f.link] @ f.placement for f in described.fingers], axis=1)
    normals = [pads[:, i, :3, :3] @ f.normal for i, f in enumerate(described.fingers)]
    return palms, pads[:, :, :3, 3], np.stack(normals, axis=1)


@dataclass(frozen=True, eq=False)
class HandPostures:
    """Postures of a hand that its motors can take.

    Attributes:
        motors: That move fingers.
        positions: (k, m) of these, within their limits [rad or m].
        beyond: By row what is beyond its limits in the data.
        shift: (k,) how far the fingertip that is moved farthest is from where the data have it [m].
        joints: Positions (k,) of all joints as the data have them, what they do not say as it
            follows [rad or m].
    """

    motors: tuple[str, ...]
    positions: Array
    beyond: Mapping[int, str]
    shift: Array
    joints: Mapping[str, Array]


def hand_postures(robot: ArmHand, where: str, joints: Mapping[str, Array]) -> HandPostures:
    """The nearest postures that a hand can take.

    What is beyond its limits is put there. Where a joint is not where its coupling has it, the
    motors of its finger are those that bring the fingertip nearest to where the data have it, in
    the frame of the palm.

    Args:
        robot: The robot.
        where: File, for messages.
        joints: Positions (k,) by joint or motor.

    Raises:
        DescriptionError: A motor is not among the joints, nor follows from them.
    """
    described = robot.description
    motors = described.finger_motors
    moved = _motors_of(described, joints)
    for name in motors:
        if name not in moved:
            raise DescriptionError(f"{where}: {name}: missing, expected a position")
    columns = [robot.actuators.index(name) for name in motors]
    given = np.stack([moved[name] for name in motors], axis=1)
    found = np.clip(given, robot.lower[columns], robot.upper[columns])
    said = {name: joints[name] for name in described.finger_joints if name in joints}
    whole = joints_at(robot, motors, found) | said
    wanted = _tips_of_joints(robot, whole)
    free = _free(robot, columns, said, joints_at(robot, motors, given))
    rows = np.flatnonzero(free.any(axis=1))
    if len(rows):
        found[rows] = _nearest(robot, columns, found[rows], free[rows], wanted[rows])
    shift = np.linalg.norm(_tips(robot, columns, found) - wanted, axis=2).max(axis=1)
    return HandPostures(motors, found, _beyond(robot, motors, given, said), shift, whole)


def joints_at(robot: ArmHand, motors: tuple[str, ...], positions: Array) -> dict[str, Array]:
    """Positions (k,) of all joints with motors at (k, m), the others where they are at home."""
    return robot.joints(
        _configurations(robot, [robot.actuators.index(n) for n in motors], positions)
    )


def _configurations(robot: ArmHand, columns: list[int], positions: Array) -> Array:
    q = np.tile(robot.home, (len(positions), 1))
    q[:, columns] = positions
    return q


def _motors_of(robot: RobotDescription, joints: Mapping[str, Array]) -> dict[str, Array]:
    """The joints, and the motors whose joints are given alone: by the first that follows them."""
    found = dict(joints)
    for joint in robot.movable:
        slope = joint.coupling.slope if joint.coupling is not None else None
        if joint.coupling is None or slope is None or joint.name not in joints:
            continue
        if joint.coupling.of in robot.actuator_names:
            found.setdefault(joint.coupling.of, (joints[joint.name] - slope[1]) / slope[0])
    return found


def _beyond(
    robot: ArmHand, motors: tuple[str, ...], given: Array, said: Mapping[str, Array]
) -> dict[int, str]:
    """By row the joint or motor that is farthest beyond its limits."""
    described = robot.description
    places = [described.joint_names.index(name) for name in said if name not in motors]
    columns = [robot.actuators.index(name) for name in motors]
    names = (*motors, *(described.joint_names[i] for i in places))
    lower = np.concatenate([robot.lower[columns], described.joint_lower[places]])
    upper = np.concatenate([robot.upper[columns], described.joint_upper[places]])
    values = np.column_stack([given, *(said[described.joint_names[i]] for i in places)])
    excess = np.maximum(lower - values, values - upper)
    worst = excess.argmax(axis=1)
    return {
        int(
            row
        ): f"{names[i]}: found {values[row, i]:.4g}, expected {lower[i]:.4g} to {upper[i]:.4g}"
        for row, i in enumerate(worst)
        if excess[row, i] > FIT.beyond
    }


def _free(
    robot: ArmHand, columns: list[int], said: Mapping[str, Array], reached: Mapping[str, Array]
) -> Bools:
    """(k, m) motors of the fingers whose joints are not where their couplings have them."""
    described = robot.description
    free = np.zeros((len(next(iter(reached.values()))), len(columns)), dtype=bool)
    for finger in described.fingers:
        mine = np.isin(columns, described.finger_actuators(finger.name))
        for name in finger.joints:
            if name in said:
                free |= (np.abs(said[name] - reached[name]) > FIT.apart)[:, None] & mine
    return free


def _tips_of_joints(robot: ArmHand, joints: Mapping[str, Array]) -> Array:
    """(k, f, 3) fingertips in the palm frame, of joints whatever couples them."""
    described = robot.description
    here = np.tile(np.eye(4), (len(next(iter(joints.values()))), 1, 1))
    palms, points, _ = palms_of(robot, described.palm_link, here, joints)
    return (points - palms[:, None, :3, 3]) @ palms[:, :3, :3]


def _tips(robot: ArmHand, columns: list[int], positions: Array) -> Array:
    """(k, f, 3) fingertips in the palm frame, with motors at (k, m)."""
    q = _configurations(robot, columns, positions)
    points, palms = robot.contacts(q)[0], robot.palm(q)
    return (points - palms[:, None, :3, 3]) @ palms[:, :3, :3]


def _nearest(robot: ArmHand, columns: list[int], start: Array, free: Bools, wanted: Array) -> Array:
    """Postures (k, m) within limits whose fingertips are nearest to where they are wanted.

    Damped steps (Levenberg-Marquardt), by row; a motor at its limit that would go beyond is held.

    Args:
        robot: The robot.
        columns: Of the motors.
        start: (k, m) where to begin, and what to stay near where fingertips are as near.
        free: (k, m) motors that may move.
        wanted: (k, f, 3) fingertips in the palm frame [m].
    """
    lower, upper = robot.lower[columns], robot.upper[columns]
    count, m = start.shape

    def off(x: Array) -> Array:
        return (wanted - _tips(robot, columns, x)).reshape(count, -1)

    def cost(x: Array, miss: Array) -> Array:
        return (miss**2).sum(axis=1) + FIT.stay * ((x - start) ** 2).sum(axis=1)

    x, miss = start.copy(), off(start)
    least, damping = cost(x, miss), np.full(count, 1e-4)
    for _ in range(FIT.steps):
        slopes = [miss - off(x + FIT.difference * one) for one in np.eye(m)]
        jacobian = np.stack(slopes, axis=2) / FIT.difference
        pull = np.einsum("krm,kr->km", jacobian, miss) - FIT.stay * (x - start)
        held = ~free | ((x <= lower) & (pull < 0)) | ((x >= upper) & (pull > 0))
        jacobian = np.where(held[:, None], 0.0, jacobian)
        square = np.swapaxes(jacobian, 1, 2) @ jacobian + (damping + FIT.stay)[
            :, None, None
        ] * np.eye(m)
        step = np.linalg.solve(square, np.where(held, 0.0, pull)[..., None])[..., 0]
        tried = np.clip(np.asarray(x + step, dtype=np.float64), lower, upper)
        new = off(tried)
        value = cost(tried, new)
        better = value < least
        moved = np.abs(tried - x).max(axis=1)
        x, miss = np.where(better[:, None], tried, x), np.where(better[:, None], new, miss)
        least = np.where(better, value, least)
        damping = np.where(better, damping / 10, damping * 10)
        if (moved < FIT.settled).all():
            break
    return x
