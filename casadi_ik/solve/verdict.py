"""The verdict: is it solved? Recomputed from q alone, whatever a method believes.

Its errors are formulas of their own on purpose, not those of `kinematics.contacts` that the methods
minimise: a fault there must not be judged by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import TargetBatch

LIMIT_SLACK = 1e-9
"""Rounding allowed at a limit [rad or m]: a coupling's arithmetic may end a hair beyond it."""

TOLERANCE_SLACK = 1e-9
"""Relative rounding allowed at a tolerance, so that graph and verdict agree on its edge."""


@dataclass(frozen=True)
class ContactVerdict:
    """Errors of one finger's contact.

    Attributes:
        position_error: Distance from the contact point [m]; NaN if the finger is free.
        angle_error: Angle from the normal [rad]; NaN if it is free.
        ok: Within tolerance (what is free is).
        tolerance: What it was compared with.

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
    fingers: Sequence[str], tolerances: Sequence[Tolerance], *errors: NDArray[Any]
) -> list[dict[str, ContactVerdict]]:
    """Of k configurations the verdicts by finger.

    Args:
        fingers: Names.
        tolerances: By finger.
        errors: (k, f) distances [m], angles [rad], and whether they are within tolerance.
    """
    return [
        dict(zip(fingers, map(ContactVerdict, *row, tolerances), strict=True))
        for row in zip(*(column.tolist() for column in errors), strict=True)
    ]


@dataclass(frozen=True)
class PalmVerdict:
    """Errors of the palm's pose.

    Attributes:
        position_error: Distance of its origin [m].
        angle_error: Angle between its frame and the wanted one [rad].
        ok: Within the largest tolerance of the fingers.

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
    """How far k palms are from where they have to be: (k,) [m], (k,) [rad], (k,) near enough."""

    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]

    def of(self, row: int) -> PalmVerdict:
        """One of them."""
        errors = float(self.position_error[row]), float(self.angle_error[row])
        return PalmVerdict(*errors, bool(self.ok[row]))


@dataclass(frozen=True, eq=False)
class Verdict:
    """How k configurations meet their targets; arrays as in `BatchSolution`."""

    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]
    limits_ok: NDArray[np.bool_]
    palm: PalmVerdicts | None = None

    @property
    def all_ok(self) -> NDArray[np.bool_]:
        """(k,) True where every contact is met; of palm targets, where the palm pose is.

        The contacts of a palm target are derived from its palm pose and the hand posture. Their
        errors are reported, but only the palm pose is required.
        """
        if self.palm is not None:
            return self.palm.ok
        met: NDArray[np.bool_] = np.logical_and.reduce(self.ok, axis=1)
        return met

    def solved(self, limits: bool) -> NDArray[np.bool_]:
        """(k,) True where the target is met and, if `limits`, the robot's limits are kept."""
        return self.all_ok & self.limits_ok if limits else self.all_ok


@dataclass(frozen=True, eq=False)
class SolvedVerdict:
    """How one configuration meets all contacts of its target."""

    contacts: Sequence[ContactVerdict]
    limits_ok: bool


def judge(robot: ArmHand, targets: TargetBatch, q: Array) -> Verdict:
    """Compare configurations with their targets.

    Args:
        robot: The robot.
        targets: k targets, or one that all configurations are compared with.
        q: (k, n) configurations.
    """
    points, normals = targets.points, targets.normals
    if len(targets) == 1:
        points, normals = points[0], normals[0]
    position, angle, beyond = deviations(robot, targets, q)
    slack = 1 + TOLERANCE_SLACK
    placed = position <= targets.position_tolerance * slack
    faced = angle <= targets.angle_tolerance * slack
    ok = placed & faced
    if not ok.all():
        # Free is what the target leaves out; an error that is NaN for another reason is no success.
        ok = (placed | np.isnan(points[..., 0])) & (faced | np.isnan(normals[..., 0]))
    return Verdict(position, angle, ok, beyond <= LIMIT_SLACK, judge_palms(robot, targets, q))


def judge_palms(robot: ArmHand, targets: TargetBatch, q: Array) -> PalmVerdicts | None:
    """Compare palms with where they have to be; None where contacts alone decide.

    Args:
        robot: The robot.
        targets: k targets, or one that all configurations are compared with. A palm counts as
            reached within the largest tolerance of the fingers.
        q: (k, n) configurations; NaN gives NaN.
    """
    if targets.palms is None:
        return None
    found = np.full((len(q), 4, 4), np.nan)
    finite = np.isfinite(q).all(axis=1)
    if finite.any():
        found[finite] = robot.palm(q[finite])
    wanted = targets.palms
    position = np.linalg.norm(found[:, :3, 3] - wanted[:, :3, 3], axis=1)
    angle = _turn(found[:, :3, :3], np.broadcast_to(wanted[:, :3, :3], (len(q), 3, 3)))
    most, slack = targets.largest_tolerance, 1 + TOLERANCE_SLACK
    ok = (position <= most.position * slack) & (angle <= most.angle * slack)
    return PalmVerdicts(position, angle, ok)


def judge_one(robot: ArmHand, targets: TargetBatch, q: Array) -> SolvedVerdict | None:
    """The verdict on one configuration if everything asked is there and met; None: ask `judge`.

    Args:
        robot: The robot.
        targets: One target.
        q: (n,).
    """
    position, angle, beyond = deviations(robot, targets, q)
    return judge_errors(targets, position.tolist(), angle.tolist(), float(beyond))


def judge_errors(
    targets: TargetBatch, position: list[float], angle: list[float], beyond: float
) -> SolvedVerdict | None:
    """`judge_one` from what was measured.

    Args:
        targets: One target.
        position: Distances by finger [m].
        angle: Angles by finger [rad].
        beyond: By how much the worst actuator or joint is beyond its limits [rad or m].
    """
    limits_ok = beyond <= LIMIT_SLACK
    if targets.enforce_limits and not limits_ok:
        return None
    contacts = []
    slack = 1 + TOLERANCE_SLACK
    errors = zip(position, angle, targets.tolerances, strict=True)
    for distance, turn, tolerance in errors:
        if not (distance <= tolerance.position * slack and turn <= tolerance.angle * slack):
            return None
        contacts.append(
            made(
                ContactVerdict,
                position_error=distance,
                angle_error=turn,
                ok=True,
                tolerance=tolerance,
            )
        )
    return SolvedVerdict(contacts, limits_ok)


def deviations(robot: ArmHand, targets: TargetBatch, q: Array) -> tuple[Array, Array, Array]:
    """How far configurations are from their targets and beyond their limits.

    Args:
        robot: The robot.
        targets: k targets, or one for all.
        q: (k, n) or (n,); NaN gives NaN.

    Returns:
        (k, f) or (f,) distances [m] from the point, line or plane (of the pad's ball, from touching
        the point as it should); as many angles [rad] between
        the normals, or between the whole frames where there is a tangent; NaN where free; (k,) or
        () by how much the worst actuator or joint is beyond its limits [rad or m].
    """
    points, normals = targets.points, targets.normals
    if len(targets) == 1:
        points, normals = points[0], normals[0]
    position, angle, beyond = robot.deviations(q, points, normals)
    if not targets.more:
        return position, angle, beyond
    frames = robot.frames_at(q)
    off = frames[..., :3, 3] - points
    for name, array in targets.more.items():
        vectors = array[0] if len(targets) == 1 else array
        given = np.broadcast_to(~np.isnan(vectors[..., 0]), position.shape)
        if name == "lines":
            position = np.where(given, np.linalg.norm(np.cross(vectors, off), axis=-1), position)
        elif name == "planes":
            position = np.where(given, np.abs(np.sum(vectors * off, axis=-1)), position)
        elif name == "balls":
            radii = np.array([[finger.radius] for finger in robot.description.fingers])
            rolled = radii * (vectors - frames[..., :3, 0])
            position = np.where(given, np.linalg.norm(off + rolled, axis=-1), position)
        elif name == "tangents":
            wanted = np.stack([normals, vectors, np.cross(normals, vectors)], axis=-1)
            angle = np.where(given, _turn(frames[..., :3, :3], wanted), angle)
        else:
            raise ValueError(f"there is no verdict on {name}")
    return position, angle, beyond


def _turn(one: Array, other: Array) -> Array:
    """Angle [rad] between frames (..., 3, 3), exact where they nearly agree."""
    turned = np.swapaxes(one, -1, -2) @ other
    axis = [turned[..., i, j] - turned[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    cosine = turned[..., 0, 0] + turned[..., 1, 1] + turned[..., 2, 2] - 1
    return np.arctan2(np.linalg.norm(np.stack(axis, axis=-1), axis=-1), cosine)


T = TypeVar("T")


def made(kind: type[T], **fields: Any) -> T:
    """An object of a frozen dataclass as its `__init__` makes it, from fields that are sound.

    That sets every field by a call, which for the 17 of a solution takes as long as a hand's fit.

    Args:
        kind: A dataclass without `__post_init__` and slots.
        fields: By name; those with a plain default may be left out.
    """
    found = object.__new__(kind)
    vars(found).update(fields)
    return found
