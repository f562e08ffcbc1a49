"""Postures of hands in data sets, and the nearest postures that a robot's hand can take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks import nearest_rotations, rotation_problem
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import joint_motion, link_poses
from casadi_ik.model.pose import inverse


@dataclass(frozen=True)
class PostureFitSettings:
    """Settings of the fit of data set postures to a robot's motors.

    Attributes:
        max_distance: Distance of a hand from its object above which the data are in mm [m].
        limit_tolerance: Violation of a joint limit that is clipped without notice [rad or m].
        coupling_tolerance: Largest deviation of a joint from its coupling [rad or m].
        max_steps: Maximum number of steps of the fit.
        step_of_derivative: Step of numerical derivatives [rad or m].
        regularisation: Weight of the squared motion of a motor [m^2/rad^2], which selects among
            postures with equal fingertips.
        step_tolerance: The fit ends when no motor moves farther [rad or m].
    """

    max_distance: float = 5.0
    limit_tolerance: float = 0.02
    coupling_tolerance: float = 0.02
    max_steps: int = 40
    step_of_derivative: float = 1e-7
    regularisation: float = 1e-6
    step_tolerance: float = 1e-6


POSTURE_FIT = PostureFitSettings()

MAX_ANGLE = 4 * np.pi
"""Joint angle above which the data are in degrees [rad]."""


@dataclass(frozen=True, eq=False)
class HandPoses:
    """k grasps by one hand.

    Invalid rows (numbers that are not finite or in other units, invalid rotations) are listed in
    `faults`; their numbers are zeros, and their rotations identities.

    Attributes:
        location: File and key, for messages.
        position: (k, 3) origin of the hand frame in the object frame [m].
        rotation: (k, 3, 3) rotation of the hand frame.
        joints: (k, m) joint positions [rad or m].
        names: Joint names in the file; empty: the order of the hand's description.
        objects: Name of the object of each grasp; empty: one object.
        scales: Scale of the object of each grasp relative to its mesh; empty: not stated.
        rows: (k,) row numbers in the file.
        faults: Problems by row number.
        pregrasp: The hands before they close; None if not stated.
        squeeze: The hands while they squeeze; None if not stated.
    """

    location: str
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
        """Check shapes and rows.

        Raises:
            DescriptionError: There are no grasps, or the numbers of poses and postures differ.
        """
        count = len(self.position)
        shapes = {"position": (count, 3), "rotation": (count, 3, 3)}
        for name, shape in shapes.items():
            shape_found = getattr(self, name).shape
            if shape_found != shape:
                self._fail(f"{name}: found shape {shape_found}, expected {shape}")
        if not count:
            self._fail("found no grasps, expected at least one")
        if self.joints.ndim != 2 or len(self.joints) != count:
            self._fail(f"joints: found shape {self.joints.shape}, expected ({count}, joints)")
        object.__setattr__(self, "rows", self.rows or tuple(range(count)))
        faults = {**self._find_faults(), **self.faults}
        for stage in ("pregrasp", "squeeze"):
            stage_poses = getattr(self, stage)
            if stage_poses is not None:
                faults = {
                    row: f"{stage}: {text}" for row, text in stage_poses.faults.items()
                } | faults
        object.__setattr__(self, "faults", faults)

    def for_object(self, name: str | None) -> HandPoses:
        """Return the grasps of one object.

        Args:
            name: Name in the file; None: there is only one object.

        Raises:
            DescriptionError: There are several objects, or none of that name.
        """
        if name is None and len(set(self.objects)) <= 1:
            return self
        names = sorted(set(self.objects))
        description = f"{len(names)} objects ({', '.join(names[:3])}{', ...' if names[3:] else ''})"
        if name is None:
            self._fail(f"found grasps of {description}, expected one; select it by `of`")
        if name not in names:
            self._fail(f"of: found {name!r}, expected one of {description}")
        selected = self.select(np.flatnonzero(np.array(self.objects) == name))
        return replace(selected, location=f"{self.location}: {name}")

    def for_scale(self, scale: float | None) -> HandPoses:
        """Return the grasps of one size of the object.

        Args:
            scale: Scale of the object; None: there is only one size.

        Raises:
            DescriptionError: There are several sizes, or none of that scale.
        """
        if not self.scales:
            if scale is not None:
                self._fail(f"scale: found {scale:g}, but the file states no sizes")
            return self
        digits = np.array([float(f"{value:.5g}") for value in self.scales])
        sizes, counts = np.unique(digits, return_counts=True)
        pairs = zip(sizes, counts, strict=True)
        description = (
            f"{len(sizes)} sizes (scale {', '.join(f'{s:g}: {n} rows' for s, n in pairs)})"
        )
        if scale is None:
            if len(sizes) > 1:
                self._fail(
                    f"found grasps of {description}, expected one; select it by `scale` (--scale)"
                )
            return self
        selected = np.flatnonzero(np.isclose(digits, scale, rtol=1e-4, atol=0.0))
        if not len(selected):
            self._fail(f"scale: found {scale:g}, expected one of {description}")
        return self.select(selected)

    def select(self, indices: NDArray[np.intp]) -> HandPoses:
        """Return grasps by their indices."""

        def selected(values: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(values[i] for i in indices) if values else ()

        rows = selected(self.rows)
        return replace(
            self,
            position=self.position[indices],
            rotation=self.rotation[indices],
            joints=self.joints[indices],
            objects=selected(self.objects),
            scales=selected(self.scales),
            rows=rows,
            faults={row: text for row, text in self.faults.items() if row in rows},
            pregrasp=None if self.pregrasp is None else self.pregrasp.select(indices),
            squeeze=None if self.squeeze is None else self.squeeze.select(indices),
        )

    def _find_faults(self) -> dict[int, str]:
        """Return the problems of rows; set invalid rows to zero and make rotations exact."""
        faults: dict[int, str] = {}

        def note(bad: Bools, texts: Callable[[int], str]) -> None:
            for i in np.flatnonzero(bad):
                faults.setdefault(self.rows[i], texts(int(i)))

        for name in ("position", "rotation", "joints"):
            finite = np.isfinite(getattr(self, name)).reshape(len(self.position), -1).all(axis=1)
            hint = " (and quaternions of length 1)" if name == "rotation" else ""
            text = f"{name}: holds NaN or infinity, expected finite numbers{hint}"
            note(np.asarray(~finite), lambda _, text=text: text)
        distance = np.linalg.norm(self.position, axis=1)
        note(
            distance > POSTURE_FIT.max_distance,
            lambda i: (
                f"position: found {distance[i]:.4g} m from the object, expected at most "
                f"{POSTURE_FIT.max_distance:g} m (numbers in mm?)"
            ),
        )
        note(
            np.asarray((np.abs(self.joints) > MAX_ANGLE).any(axis=1)),
            lambda _: (
                "joints: found angles beyond two turns, expected radians (numbers in degrees?)"
            ),
        )
        is_valid = np.array([row not in faults for row in self.rows])
        rotation = np.where(is_valid[:, None, None], self.rotation, np.eye(3))
        exact, invalid = nearest_rotations(rotation)
        note(invalid, lambda i: f"rotation: {rotation_problem(rotation[i])}")
        is_valid = np.array([row not in faults for row in self.rows])
        object.__setattr__(self, "rotation", np.where(is_valid[:, None, None], exact, np.eye(3)))
        for name in ("position", "joints"):
            object.__setattr__(self, name, np.where(is_valid[:, None], getattr(self, name), 0.0))
        return faults

    def _fail(self, problem: str) -> NoReturn:
        raise DescriptionError(f"{self.location}: {problem}")

    @property
    def poses(self) -> Array:
        """Poses of the hand frame in the object frame, (k, 4, 4)."""
        poses = np.tile(np.eye(4), (len(self.position), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.rotation, self.position
        return poses


def rotations_from_rpy(angles: Array) -> Array:
    """Return rotations (k, 3, 3) from roll, pitch, yaw (k, 3) about fixed axes [rad]."""
    x, y, z = (joint_motion("revolute", axis, angles[:, i]) for i, axis in enumerate(np.eye(3)))
    return (z @ y @ x)[:, :3, :3]


def rotations_from_columns(columns: Array) -> Array:
    """Return rotations (k, 3, 3) from their first two columns (k, 6).

    Both columns are corrected by the same angle, since their sum and difference are always
    orthogonal. Zero or equal columns give NaN. Source:
    `robust_compute_rotation_matrix_from_ortho6d` of GenDexGrasp.
    """

    def unit(vectors: Array) -> Array:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    with np.errstate(invalid="ignore", divide="ignore"):
        first, second = unit(columns[:, :3]), unit(columns[:, 3:])
        middle, orthogonal = unit(first + second), unit(first - second)
        first, second = unit(middle + orthogonal), unit(middle - orthogonal)
    return np.stack([first, second, np.cross(first, second)], axis=2)


def palms_and_pads(
    robot: ArmHand, link: str, frames: Array, joints: Mapping[str, Array]
) -> tuple[Array, Array, Array]:
    """Return palms and pads of hands from poses of one of their links.

    Args:
        robot: The robot.
        link: Name of the link.
        frames: (k, 4, 4) poses of the link.
        joints: Positions (k,) by joint.

    Returns:
        Palm poses (k, 4, 4), contact points (k, f, 3) and normals (k, f, 3), in the frame of the
        poses.
    """
    described = robot.description
    poses = link_poses(described.root, described.joints, joints)
    link_inverse = inverse(poses[link])
    root_pose = frames @ link_inverse
    palms = root_pose @ poses[described.palm_link] @ described.palm_placement
    pads = np.stack([root_pose @ poses[f.link] @ f.placement for f in described.fingers], axis=1)
    normals = [pads[:, i, :3, :3] @ f.normal for i, f in enumerate(described.fingers)]
    return palms, pads[:, :, :3, 3], np.stack(normals, axis=1)


@dataclass(frozen=True, eq=False)
class HandPostures:
    """Postures of a hand that its motors can take.

    Attributes:
        motors: Names of the finger motors.
        positions: (k, m) positions within limits [rad or m].
        out_of_limits: Violated limits in the data, by row.
        shift: (k,) largest distance of a fingertip from its position in the data [m].
        joints: Positions (k,) of all joints: those of the data, and those that follow from them
            [rad or m].
    """

    motors: tuple[str, ...]
    positions: Array
    out_of_limits: Mapping[int, str]
    shift: Array
    joints: Mapping[str, Array]


def hand_postures(robot: ArmHand, location: str, joints: Mapping[str, Array]) -> HandPostures:
    """Return the nearest postures that a hand can take.

    Positions are clipped to limits. If a joint contradicts its coupling, the motors of its finger
    bring the fingertip as near as possible to its position in the data, in the palm frame.

    Args:
        robot: The robot.
        location: File, for messages.
        joints: Positions (k,) by joint or motor.

    Raises:
        DescriptionError: A motor is not among the joints and does not follow from them.
    """
    described = robot.description
    motors = described.finger_motors
    motor_values = _motors_of(described, joints)
    for name in motors:
        if name not in motor_values:
            raise DescriptionError(f"{location}: {name}: missing, expected a position")
    columns = [robot.actuators.index(name) for name in motors]
    stated = np.stack([motor_values[name] for name in motors], axis=1)
    positions = np.clip(stated, robot.lower[columns], robot.upper[columns])
    stated_joints = {name: joints[name] for name in described.finger_joints if name in joints}
    all_joints = joints_of_motors(robot, motors, positions) | stated_joints
    target_tips = _tips_of_joints(robot, all_joints)
    free = _inconsistent_motors(
        robot, columns, stated_joints, joints_of_motors(robot, motors, stated)
    )
    rows = np.flatnonzero(free.any(axis=1))
    if len(rows):
        positions[rows] = _nearest_postures(
            robot, columns, positions[rows], free[rows], target_tips[rows]
        )
    shift = np.linalg.norm(_tips(robot, columns, positions) - target_tips, axis=2).max(axis=1)
    return HandPostures(
        motors,
        positions,
        _limit_violations(robot, motors, stated, stated_joints),
        shift,
        all_joints,
    )


def joints_of_motors(robot: ArmHand, motors: tuple[str, ...], positions: Array) -> dict[str, Array]:
    """Return the positions (k,) of all joints for motors (k, m); other motors are at home."""
    return robot.joints(
        _configurations(robot, [robot.actuators.index(n) for n in motors], positions)
    )


def _configurations(robot: ArmHand, columns: list[int], positions: Array) -> Array:
    q = np.tile(robot.home, (len(positions), 1))
    q[:, columns] = positions
    return q


def _motors_of(robot: RobotDescription, joints: Mapping[str, Array]) -> dict[str, Array]:
    """Return positions of joints, and of motors that follow from a coupled joint."""
    values = dict(joints)
    for joint in robot.movable:
        slope = joint.coupling.slope if joint.coupling is not None else None
        if joint.coupling is None or slope is None or joint.name not in joints:
            continue
        if joint.coupling.of in robot.actuator_names:
            values.setdefault(joint.coupling.of, (joints[joint.name] - slope[1]) / slope[0])
    return values


def _limit_violations(
    robot: ArmHand, motors: tuple[str, ...], stated: Array, stated_joints: Mapping[str, Array]
) -> dict[int, str]:
    """Return for each row the joint or motor with the largest limit violation."""
    described = robot.description
    joint_indices = [
        described.joint_names.index(name) for name in stated_joints if name not in motors
    ]
    columns = [robot.actuators.index(name) for name in motors]
    names = (*motors, *(described.joint_names[i] for i in joint_indices))
    lower = np.concatenate([robot.lower[columns], described.joint_lower[joint_indices]])
    upper = np.concatenate([robot.upper[columns], described.joint_upper[joint_indices]])
    values = np.column_stack(
        [stated, *(stated_joints[described.joint_names[i]] for i in joint_indices)]
    )
    excess = np.maximum(lower - values, values - upper)
    worst = excess.argmax(axis=1)
    return {
        int(
            row
        ): f"{names[i]}: found {values[row, i]:.4g}, expected {lower[i]:.4g} to {upper[i]:.4g}"
        for row, i in enumerate(worst)
        if excess[row, i] > POSTURE_FIT.limit_tolerance
    }


def _inconsistent_motors(
    robot: ArmHand,
    columns: list[int],
    stated_joints: Mapping[str, Array],
    coupled_joints: Mapping[str, Array],
) -> Bools:
    """Return (k, m) True for motors of fingers with joints that contradict their couplings."""
    described = robot.description
    free = np.zeros((len(next(iter(coupled_joints.values()))), len(columns)), dtype=bool)
    for finger in described.fingers:
        is_of_finger = np.isin(columns, described.finger_actuators(finger.name))
        for name in finger.joints:
            if name in stated_joints:
                free |= (
                    np.abs(stated_joints[name] - coupled_joints[name])
                    > POSTURE_FIT.coupling_tolerance
                )[:, None] & is_of_finger
    return free


def _tips_of_joints(robot: ArmHand, joints: Mapping[str, Array]) -> Array:
    """Return fingertips (k, f, 3) in the palm frame for joints, regardless of couplings."""
    described = robot.description
    identity = np.tile(np.eye(4), (len(next(iter(joints.values()))), 1, 1))
    palms, points, _ = palms_and_pads(robot, described.palm_link, identity, joints)
    return (points - palms[:, None, :3, 3]) @ palms[:, :3, :3]


def _tips(robot: ArmHand, columns: list[int], positions: Array) -> Array:
    """Return fingertips (k, f, 3) in the palm frame for motors (k, m)."""
    q = _configurations(robot, columns, positions)
    points, palms = robot.contacts(q)[0], robot.palm(q)
    return (points - palms[:, None, :3, 3]) @ palms[:, :3, :3]


def _nearest_postures(
    robot: ArmHand, columns: list[int], start: Array, free: Bools, target_tips: Array
) -> Array:
    """Return postures (k, m) within limits whose fingertips are nearest to the targets.

    Each row makes damped steps (Levenberg-Marquardt); motors that would leave their limits are
    held.

    Args:
        robot: The robot.
        columns: Indices of the motors.
        start: (k, m) initial postures, to which the regularisation refers.
        free: (k, m) True for motors that may move.
        target_tips: (k, f, 3) target fingertips in the palm frame [m].
    """
    lower, upper = robot.lower[columns], robot.upper[columns]
    count, m = start.shape

    def tip_errors(x: Array) -> Array:
        return (target_tips - _tips(robot, columns, x)).reshape(count, -1)

    def cost(x: Array, error: Array) -> Array:
        return (error**2).sum(axis=1) + POSTURE_FIT.regularisation * ((x - start) ** 2).sum(axis=1)

    x, error = start.copy(), tip_errors(start)
    best_cost, damping = cost(x, error), np.full(count, 1e-4)
    for _ in range(POSTURE_FIT.max_steps):
        differences = [
            error - tip_errors(x + POSTURE_FIT.step_of_derivative * unit) for unit in np.eye(m)
        ]
        jacobian = np.stack(differences, axis=2) / POSTURE_FIT.step_of_derivative
        gradient = np.einsum("krm,kr->km", jacobian, error) - POSTURE_FIT.regularisation * (
            x - start
        )
        is_held = ~free | ((x <= lower) & (gradient < 0)) | ((x >= upper) & (gradient > 0))
        jacobian = np.where(is_held[:, None], 0.0, jacobian)
        square = np.swapaxes(jacobian, 1, 2) @ jacobian + (damping + POSTURE_FIT.regularisation)[
            :, None, None
        ] * np.eye(m)
        step = np.linalg.solve(square, np.where(is_held, 0.0, gradient)[..., None])[..., 0]
        trial = np.clip(np.asarray(x + step, dtype=np.float64), lower, upper)
        new = tip_errors(trial)
        value = cost(trial, new)
        better = value < best_cost
        step_size = np.abs(trial - x).max(axis=1)
        x, error = np.where(better[:, None], trial, x), np.where(better[:, None], new, error)
        best_cost = np.where(better, value, best_cost)
        damping = np.where(better, damping / 10, damping * 10)
        if (step_size < POSTURE_FIT.step_tolerance).all():
            break
    return x
