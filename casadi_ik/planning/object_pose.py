"""Search for an object pose within bounds at which the robot can reach the grasp.

The proof that no pose is possible bisects the range: within a box of poses a contact moves by at
most the radius of the box, so a proof for the central pose with tolerances that are wider by this
radius is valid for all poses of the box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casadi_ik.files.arrays import Array, Counts, spread_points
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.pose import Free
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.premises import required_points
from casadi_ik.solve.proofs.proof import Proof, ProofKind
from casadi_ik.solve.solution import BatchSolution, Solution
from casadi_ik.solve.status import Status

POSE_BATCHES = (1, 15, 240)
"""Numbers of poses per batch, until one is solved; all but the first get a single restart."""

Prove = Callable[[TargetBatch, Counts], Sequence[Proof | None]]
"""Function from targets and their maximum numbers of hand boxes to proofs of impossibility."""


@dataclass(frozen=True)
class PoseProofEffort:
    """Limits of the proof that no object pose within bounds can be reached.

    Attributes:
        max_pose_boxes: Maximum number of boxes of object poses.
        max_hand_boxes: Maximum number of boxes of hand postures for each box of object poses.
        radian_length: Displacement that counts as much as a rotation by one radian [m].
        margin: Margin against rounding errors [m, rad].
    """

    max_pose_boxes: int = 512
    max_hand_boxes: int = 200
    radian_length: float = 0.1
    margin: float = 1e-9


POSE_PROOF_EFFORT = PoseProofEffort()


def pose_matrices(values: Array) -> Array:
    """Return poses (k, 4, 4) of components (k, 6): x, y, z [m], angles about x, y, z [rad]."""
    return np.array([frame_matrix(Frame(tuple(row[:3]), tuple(row[3:]))) for row in values])


def poses_within(free: Free, count: int) -> Array:
    """Return (count, 4, 4) poses spread evenly within the bounds, the central one first."""
    lower, upper = np.asarray(free.lower), np.asarray(free.upper)
    fractions = spread_points(count, 6)
    fractions[0] = 0.5
    return pose_matrices(lower + fractions * (upper - lower))


def place_targets(targets: TargetBatch, poses: Array) -> TargetBatch:
    """Return a target in the object frame as k targets at object poses (k, 4, 4)."""
    rotation, fixed = np.swapaxes(poses[:, :3, :3], 1, 2), targets.fixed
    return replace(
        targets,
        points=targets.points[0] @ rotation + poses[:, None, :3, 3],
        normals=targets.normals[0] @ rotation,
        extra_vectors={name: array[0] @ rotation for name, array in targets.extra_vectors.items()},
        fixed=fixed if fixed is None or fixed.ndim == 1 else fixed[0],
        palms=None if targets.palms is None else poses @ targets.palms[0],
        object_pose=poses if targets.object else None,
        q0=targets.q0 if targets.q0 is None or targets.q0.ndim == 1 else targets.q0[0],
    )


def is_unreachable_throughout(
    prove: Prove, targets: TargetBatch, free: Free, robot: RobotDescription
) -> bool:
    """Return True if a proof shows that no object pose within the bounds can be reached.

    Args:
        prove: Search for proofs.
        targets: One target, in the object frame.
        free: Bounds of the object pose.
        robot: Description of the robot.
    """
    effort = POSE_PROOF_EFFORT
    lower, upper = np.array([free.lower]), np.array([free.upper])
    levers = np.nan_to_num(np.linalg.norm(required_points(robot, targets)[0][0], axis=1))
    sizes = np.repeat([1.0, effort.radian_length + float(levers.max())], 3)
    count = 0
    while len(lower):
        count += len(lower)
        if count > effort.max_pose_boxes:
            return False
        half_widths = (upper[0] - lower[0]) / 2
        rotation = float(half_widths[3:].sum())
        chord = 2 * np.sin(min(rotation, np.pi) / 2)
        radii = float(np.linalg.norm(half_widths[:3])) + chord * levers + effort.margin
        tolerance = tuple(
            Tolerance(item.position + radius, item.angle + rotation + effort.margin)
            for item, radius in zip(targets.tolerances, radii.tolist(), strict=True)
        )
        centers = place_targets(targets, pose_matrices((lower + upper) / 2))
        centers = replace(centers, tolerance=tolerance)
        proofs = prove(centers, np.full(len(lower), effort.max_hand_boxes))
        is_open = np.array([proof is None for proof in proofs])
        widest = int(np.argmax(half_widths * sizes))
        if is_open.any() and half_widths[widest] == 0.0:
            return False
        lower, upper = (np.repeat(end[is_open], 2, axis=0) for end in (lower, upper))
        lower[1::2, widest] += half_widths[widest]
        upper[::2, widest] -= half_widths[widest]
    return True


def solve_with_object(
    solve: Callable[[TargetBatch, bool], BatchSolution],
    screen: Callable[[TargetBatch], BatchSolution],
    prove: Prove,
    targets: TargetBatch,
    free: Free,
    robot: ArmHand,
) -> Solution:
    """Solve a grasp at the preferred object pose among several attempts.

    Args:
        solve: Solves targets; the flag enables the diagnosis.
        screen: Solves targets with a single restart.
        prove: Searches for proofs.
        targets: One target, in the object frame.
        free: Bounds of the object pose.
        robot: The robot.

    Returns:
        The solved pose whose configuration is nearest to q0 if the preference is "q0", else the
        solved pose nearest to the center of the bounds. Without a solution: the central pose with
        its diagnosis, which is `Status.UNREACHABLE` only if a proof covers all poses within the
        bounds.
    """
    poses, first = poses_within(free, sum(POSE_BATCHES)), 0
    span = np.maximum(np.asarray(free.upper) - np.asarray(free.lower), 1e-12)
    center, offsets = poses[0], spread_points(sum(POSE_BATCHES), 6) - 0.5
    for count in POSE_BATCHES:
        rows = np.arange(first, first + count)
        batch_targets = place_targets(targets, poses[rows])
        batch = screen(batch_targets) if first else solve(batch_targets, False)
        solved = np.flatnonzero(batch.status == Status.SOLVED)
        if len(solved):
            if targets.prefers_q0:
                travel = batch.q[solved] - targets.starts(robot.description)
                distance = np.abs(travel / (robot.upper - robot.lower)).max(axis=1)
            else:
                distance = np.linalg.norm(offsets[rows[solved]] * (span > 1e-9), axis=1)
            best = int(solved[np.argmin(distance)])
            return replace(batch.solution(best), object_pose=poses[rows[best]])
        first += count
        if free.lower == free.upper:
            break
    solution = solve(place_targets(targets, center[None]), True).solution(0)
    diagnosis = solution.diagnosis
    if solution.status is Status.UNREACHABLE and free.lower != free.upper and diagnosis is not None:
        # A contradiction within the hand does not depend on the pose of the contacts.
        is_of_hand = diagnosis.proof is not None and diagnosis.proof.kind is ProofKind.HAND
        if not is_of_hand and not is_unreachable_throughout(
            prove, targets, free, robot.description
        ):
            diagnosis = replace(diagnosis, proof=None, searches=diagnosis.searches + len(poses))
            solution = replace(solution, status=Status.NOT_FOUND, diagnosis=diagnosis)
    return replace(solution, object_pose=center)
