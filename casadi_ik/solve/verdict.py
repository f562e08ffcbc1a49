"""The verdict: whether a configuration solves its target, computed from q alone.

The errors are computed by formulas independent of those in `kinematics.contacts`, which the methods
minimise, so that a fault there is detected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import TargetBatch

LIMIT_SLACK = 1e-9
"""Limit violation that counts as rounding [rad or m]: couplings may end slightly beyond a limit."""

TOLERANCE_SLACK = 1e-9
"""Relative excess over a tolerance that counts as rounding, so that graphs and verdict agree."""


@dataclass(slots=True)
class ContactVerdict:
    """Errors of one finger's contact.

    Attributes:
        position_error: Distance from the contact point [m]; NaN if the point is free.
        angle_error: Angle from the normal [rad]; NaN if the normal is free.
        ok: Whether the errors are within tolerance; True for free errors.
        tolerance: Tolerance of the contact.

    Example:
        >>> verdict = solution.contacts["thumb"]
        >>> verdict.ok, verdict.position_error < verdict.tolerance.position
        (True, True)
    """

    position_error: float
    angle_error: float
    ok: bool
    tolerance: Tolerance


def contact_verdicts(
    fingers: Sequence[str],
    tolerances: Sequence[Tolerance],
    position_error: Sequence[float],
    angle_error: Sequence[float],
    ok: Sequence[bool],
) -> dict[str, ContactVerdict]:
    """Return the verdict of a configuration by finger.

    Args:
        fingers: Names of the fingers.
        tolerances: Tolerance by finger.
        position_error: Distance of each fingertip [m].
        angle_error: Angle of each fingertip [rad].
        ok: True for each finger whose errors are within tolerance.
    """
    columns = zip(position_error, angle_error, ok, tolerances, strict=True)
    return {name: ContactVerdict(*row) for name, row in zip(fingers, columns, strict=True)}


@dataclass(frozen=True)
class PalmVerdict:
    """Errors of a palm pose.

    Attributes:
        position_error: Distance of the origin from the target pose [m].
        angle_error: Rotation angle to the target pose [rad].
        ok: Whether the errors are within the largest tolerance of the fingers.

    Example:
        >>> motors = [name for name in robot.actuators if name.startswith("bh_")]
        >>> posture = dict(zip(motors, robot.home[-len(motors):]))
        >>> palm = solver.solve(ik.Grasp(palm=robot.palm(robot.home), posture=posture)).palm
        >>> palm.ok, palm.position_error < 1e-6
        (True, True)
    """

    position_error: float
    angle_error: float
    ok: bool


@dataclass(frozen=True, eq=False)
class PalmVerdicts:
    """Errors of k palm poses.

    Attributes:
        position_error: (k,) distances of the origins [m].
        angle_error: (k,) rotation angles [rad].
        ok: (k,) whether the errors are within the largest tolerance of the fingers.
    """

    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]

    def row(self, row: int) -> PalmVerdict:
        """Return the verdict of a row."""
        errors = float(self.position_error[row]), float(self.angle_error[row])
        return PalmVerdict(*errors, bool(self.ok[row]))


@dataclass(frozen=True, eq=False)
class Verdict:
    """Errors of k configurations against their targets; arrays as in `BatchSolution`."""

    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]
    limits_ok: NDArray[np.bool_]
    palm: PalmVerdicts | None = None

    @property
    def all_ok(self) -> NDArray[np.bool_]:
        """(k,) True if every contact is within tolerance; for palm targets, if the palm pose is.

        The contacts of a palm target are derived from its palm pose and the hand posture. Their
        errors are reported, but only the palm pose is required.
        """
        if self.palm is not None:
            return self.palm.ok
        contacts_ok: NDArray[np.bool_] = np.logical_and.reduce(self.ok, axis=1)
        return contacts_ok

    def contacts(
        self, row: int, fingers: Sequence[str], tolerances: Sequence[Tolerance]
    ) -> dict[str, ContactVerdict]:
        """Return the verdict of a row by finger.

        Args:
            row: Index of the configuration.
            fingers: Names of the fingers.
            tolerances: Tolerance by finger.
        """
        errors = (array[row].tolist() for array in (self.position_error, self.angle_error, self.ok))
        return contact_verdicts(fingers, tolerances, *errors)

    def solved(self, limits: bool) -> NDArray[np.bool_]:
        """Return (k,) True if the target is solved, and q is within limits if `limits`."""
        return self.all_ok & self.limits_ok if limits else self.all_ok


def judge(robot: ArmHand, targets: TargetBatch, q: Array) -> Verdict:
    """Compare configurations with their targets.

    Args:
        robot: The robot.
        targets: k targets, or one target for all configurations.
        q: (k, n) configurations [rad or m].
    """
    points, normals = targets.points, targets.normals
    if len(targets) == 1:
        points, normals = points[0], normals[0]
    position, angle, excess = deviations(robot, targets, q)
    slack = 1 + TOLERANCE_SLACK
    position_ok = position <= targets.position_tolerance * slack
    angle_ok = angle <= targets.angle_tolerance * slack
    ok = position_ok & angle_ok
    if not ok.all():
        # NaN is accepted only where the target is free; other NaN errors are failures.
        ok = (position_ok | np.isnan(points[..., 0])) & (angle_ok | np.isnan(normals[..., 0]))
    return Verdict(position, angle, ok, excess <= LIMIT_SLACK, judge_palms(robot, targets, q))


def judge_palms(robot: ArmHand, targets: TargetBatch, q: Array) -> PalmVerdicts | None:
    """Compare palm poses with their targets; None for targets without palm poses.

    Args:
        robot: The robot.
        targets: k targets, or one target for all configurations. The tolerance of a palm is the
            largest tolerance of the fingers.
        q: (k, n) configurations [rad or m]; NaN gives NaN.
    """
    if targets.palms is None:
        return None
    palms = np.full((len(q), 4, 4), np.nan)
    finite = np.isfinite(q).all(axis=1)
    if finite.any():
        palms[finite] = robot.palm(q[finite])
    position = np.linalg.norm(palms[:, :3, 3] - targets.palms[:, :3, 3], axis=1)
    target_rotations = np.broadcast_to(targets.palms[:, :3, :3], (len(q), 3, 3))
    angle = _rotation_angle(palms[:, :3, :3], target_rotations)
    tolerance, slack = targets.largest_tolerance, 1 + TOLERANCE_SLACK
    ok = (position <= tolerance.position * slack) & (angle <= tolerance.angle * slack)
    return PalmVerdicts(position, angle, ok)


def deviations(robot: ArmHand, targets: TargetBatch, q: Array) -> tuple[Array, Array, Array]:
    """Return contact errors and limit violations of configurations.

    Args:
        robot: The robot.
        targets: k targets, or one for all.
        q: (k, n) or (n,) configurations [rad or m]; NaN gives NaN.

    Returns:
        (k, f) or (f,) distances [m] from the point, line or plane (for a ball pad, from touching
        the point along its normal); angles [rad] of the same shape between the normals, or between
        the contact frames if there is a tangent; NaN where free; (k,) or () largest limit
        violation of an actuator or joint [rad or m].
    """
    points, normals = targets.points, targets.normals
    if len(targets) == 1:
        points, normals = points[0], normals[0]
    position, angle, excess = robot.deviations(q, points, normals)
    if not targets.extra_vectors:
        return position, angle, excess
    frames = robot.frames_at(q)
    offset = frames[..., :3, 3] - points
    for name, array in targets.extra_vectors.items():
        vectors = array[0] if len(targets) == 1 else array
        is_present = np.broadcast_to(~np.isnan(vectors[..., 0]), position.shape)
        if name == "lines":
            distance = np.linalg.norm(np.cross(vectors, offset), axis=-1)
            position = np.where(is_present, distance, position)
        elif name == "planes":
            distance = np.abs(np.sum(vectors * offset, axis=-1))
            position = np.where(is_present, distance, position)
        elif name == "balls":
            radii = np.array([[finger.radius] for finger in robot.description.fingers])
            rolling = radii * (vectors - frames[..., :3, 0])
            distance = np.linalg.norm(offset + rolling, axis=-1)
            position = np.where(is_present, distance, position)
        elif name == "tangents":
            target = np.stack([normals, vectors, np.cross(normals, vectors)], axis=-1)
            rotation_angle = _rotation_angle(frames[..., :3, :3], target)
            angle = np.where(is_present, rotation_angle, angle)
        else:
            raise ValueError(f"deviations: contact vector {name!r} is not implemented")
    return position, angle, excess


def _rotation_angle(rotations: Array, targets: Array) -> Array:
    """Return the angle [rad] between rotations (..., 3, 3), accurate for small angles."""
    relative = np.swapaxes(rotations, -1, -2) @ targets
    axis = [relative[..., i, j] - relative[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    cosine = relative[..., 0, 0] + relative[..., 1, 1] + relative[..., 2, 2] - 1
    return np.arctan2(np.linalg.norm(np.stack(axis, axis=-1), axis=-1), cosine)
