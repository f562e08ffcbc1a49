"""Checks of numbers, units, times, rotations and poses of input data.

All interfaces (Python, command line, files, streams, adapters) use these functions, so that each
rule is implemented once:

- A value of another type, or out of range, is an `InputError`.
- A length or an angle in a probable other unit causes an `InputWarning` only, because a large
  obstacle or a wide tolerance may be intended.
- Times that are not in seconds, and motions of too many cycles, are an `InputError`.
- A matrix or quaternion that is nearly a rotation becomes the nearest rotation; any other is an
  `InvalidPoseError`.

Frames of a tracker are checked by `casadi_ik.files.keypoints`.
"""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, InputWarning, InvalidPoseError
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit


def checked_number(
    value: Any, location: str, expected: str, low: float = -math.inf, high: float = math.inf
) -> float:
    """Return an argument as a finite number.

    Args:
        value: The argument.
        location: Name of the argument, for the message.
        expected: Kind and range of the number, for the message.
        low: Smallest value.
        high: Largest value.

    Raises:
        InputError: The argument is not a number, or out of range.
    """
    is_number = isinstance(value, (int, float, np.integer, np.floating))
    if not is_number or isinstance(value, bool) or not (low <= value <= high):
        raise InputError(f"{location}: found {value!r}, expected {expected}")
    number = float(value) if abs(value) <= 1e300 else math.inf
    if not math.isfinite(number):
        raise InputError(f"{location}: found {value!r}, expected {expected}")
    return number


def checked_mapping(value: Any, location: str, expected: str) -> Mapping[Any, Any]:
    """Return an argument that is a mapping.

    Args:
        value: The argument.
        location: Name of the argument, for the message.
        expected: Keys and values of the mapping, for the message.

    Raises:
        InputError: The argument is not a mapping.
    """
    if not isinstance(value, Mapping):
        raise InputError(f"{location}: found {type(value).__name__}, expected a mapping {expected}")
    return value


def checked_integer(value: Any, location: str, minimum: int) -> int:
    """Return an argument as an integer.

    Args:
        value: The argument.
        location: Name of the argument, for the message.
        minimum: Smallest value.

    Raises:
        InputError: The argument is not an integer, or smaller.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = minimum - 1
    if isinstance(value, bool) or number < minimum:
        raise InputError(f"{location}: found {value!r}, expected an integer >= {minimum}")
    return number


MAX_FRAME_INTERVAL = 1.0
"""Median time between frames of a hand at and above which times are not in seconds [s].

Trackers send at least ten frames a second; in milliseconds these are 100 apart, and at 1 kHz they
are 1 apart.
"""

MAX_WAYPOINT_INTERVAL = 5.0
"""Same limit for contacts [s], which may be waypoints of a slow motion."""

MIN_FRAMES = 3
"""Smallest number of frames that is checked; fewer do not determine the unit."""

INTERVAL_UNITS = (
    (1e6, "nanoseconds", 1e-9),
    (1e3, "microseconds", 1e-6),
    (0.0, "milliseconds", 1e-3),
)
"""Median interval from which times are probably in a unit, the unit, and its length [s]."""


def check_time_unit(times: Array, location: str, max_interval: float = MAX_FRAME_INTERVAL) -> None:
    """Refuse times of frames that are probably not in seconds.

    Args:
        times: (k,) increasing numbers.
        location: File and key.
        max_interval: Median interval at and above which they are refused [s].

    Raises:
        InputError: The message names the interval and the likely unit.
    """
    if len(times) < MIN_FRAMES:
        return
    interval = float(np.median(np.diff(times)))
    if interval < max_interval:
        return
    unit, factor = next(
        (name, factor) for start, name, factor in INTERVAL_UNITS if interval >= start
    )
    raise InputError(
        f"{location}: frames are {interval:.4g} s apart; expected seconds, less than "
        f"{max_interval:g} between frames (numbers in {unit}? multiply by {factor:g})"
    )


def cycle_count(seconds: float, period: float, location: str) -> int:
    """Return the number of cycles of a motion, rounded up.

    Args:
        seconds: Duration of the motion [s].
        period: Duration of a cycle [s].
        location: Name of the argument, or file and key.

    Raises:
        InputError: There are more cycles than `FileLimits.stream_cycles`.
    """
    count, max_count = seconds / period, scaled_limit(LIMITS.stream_cycles)
    if not count <= max_count:
        raise InputError(
            f"{location}: {seconds:.4g} s in cycles of {period:.4g} s are {count:.4g} cycles; "
            f"expected at most {max_count:,} {RAISE_HINT}"
        )
    return math.ceil(count)


@dataclass(frozen=True)
class UsualSizes:
    """Largest values that cause no warning.

    Attributes:
        contact: Distance of a contact from the base [m].
        obstacle: Edge or diameter of an obstacle [m].
        obstacle_away: Distance of an obstacle from the base [m].
        mesh: Edge of the box around a mesh [m].
        position: Tolerance of a contact point [m].
        angle: Tolerance of a normal [rad].
        joint_offset: Distance of a joint from its parent [m].
        joint_limit: Limit of a revolute joint [rad].
    """

    contact: float = 10.0
    obstacle: float = 10.0
    obstacle_away: float = 100.0
    mesh: float = 10.0
    position: float = 0.1
    angle: float = math.radians(30.0)
    joint_offset: float = 10.0
    joint_limit: float = 30.0


MAX_DEGREES = 720.0
"""Largest limit of a joint that may be meant in degrees; a larger one means no limit."""

USUAL_SIZES = UsualSizes()

MAX_COORDINATE = 1e9
"""Largest coordinate of a contact [m]: squared errors do not overflow in single precision."""

ROUNDING_MARGIN = 1e-9
"""Relative excess that causes no warning, such as the rounding of 30 deg in radians [-]."""


def _warn(message: str) -> None:
    warnings.warn(message, InputWarning, stacklevel=3)


def check_contact_distances(points: Array, location: str, base_travel: float = 0.0) -> None:
    """Warn of contact points (..., 3) more than `UsualSizes.contact` from the base.

    Args:
        points: Contact points [m]; NaN where free.
        location: Name of the argument, or file and key.
        base_travel: Distance that a mobile base travels [m].

    Raises:
        InputError: A coordinate is larger than `MAX_COORDINATE`.
    """
    max_distance = USUAL_SIZES.contact + base_travel
    is_beyond = np.abs(points) > max_distance  # the test of a box is cheaper than lengths
    if not is_beyond.any():
        return
    largest = float(np.abs(points[is_beyond]).max())
    if largest > MAX_COORDINATE:
        raise InputError(
            f"{location}: found a coordinate of {largest:.4g} m; expected at most "
            f"{MAX_COORDINATE:g} m"
        )
    distance = float(np.linalg.norm(points[is_beyond.any(axis=-1)][0]))
    _warn(
        f"{location}: a contact is {distance:.4g} m from the robot's base; expected at most "
        f"{max_distance:.4g} m (numbers in mm? 1 mm is 0.001)"
    )


def warn_of_wide_tolerance(position: float, angle: float, location: str = "tolerance") -> None:
    """Warn of a tolerance above `UsualSizes.position` or `UsualSizes.angle`.

    Args:
        position: Largest distance of the contact point [m].
        angle: Largest angle of the normal [rad].
        location: Name of the argument, or file and key.
    """
    if position > USUAL_SIZES.position * (1 + ROUNDING_MARGIN):
        _warn(
            f"{location}.position: found {position:g} m; expected at most "
            f"{USUAL_SIZES.position:g} m (a number in mm? 1 mm is 0.001)"
        )
    if angle > USUAL_SIZES.angle * (1 + ROUNDING_MARGIN):
        _warn(
            f"{location}.angle: found {angle:g} rad ({math.degrees(angle):.4g} deg); expected "
            f"at most {USUAL_SIZES.angle:.3g} rad (30 deg; a number in degrees? use "
            f"np.deg2rad({angle:g}))"
        )


def warn_of_angles(angles: Sequence[float], location: str) -> None:
    """Warn of angles of a rotation of more than a turn, which are probably in degrees.

    Args:
        angles: Angles [rad].
        location: Name of the argument, or file and key.
    """
    largest = max(map(abs, angles), default=0.0)
    if largest > math.tau * (1 + ROUNDING_MARGIN):
        _warn(
            f"{location}: found an angle of {largest:.4g} rad; expected at most {math.tau:.4g} "
            f"rad, a turn (numbers in degrees? multiply by {math.radians(1):.7g})"
        )


def warn_of_joint_offset(offset: float, location: str) -> None:
    """Warn of a joint that is more than `UsualSizes.joint_offset` from its parent.

    Args:
        offset: Distance of the joint [m].
        location: File and joint.
    """
    if offset > USUAL_SIZES.joint_offset:
        _warn(
            f"{location}: the joint is {offset:.4g} m from its parent; expected at most "
            f"{USUAL_SIZES.joint_offset:g} m (numbers in mm? 1 mm is 0.001)"
        )


def warn_of_joint_limit(limit: float, location: str) -> None:
    """Warn of a limit between `UsualSizes.joint_limit` and `MAX_DEGREES`.

    Args:
        limit: Limit of a revolute joint [rad].
        location: File and joint.
    """
    if USUAL_SIZES.joint_limit < limit <= MAX_DEGREES:
        _warn(
            f"{location}: found a limit of {limit:.4g} rad; expected at most "
            f"{USUAL_SIZES.joint_limit:g} rad (numbers in degrees? multiply by "
            f"{math.radians(1):.7g})"
        )


def warn_of_obstacle(distance: float, size: float, location: str) -> None:
    """Warn of an obstacle that is very large or very far away.

    Args:
        distance: Distance of its origin from the base [m].
        size: Its edge or diameter [m].
        location: Name of the scene or file, and key.
    """
    if size > USUAL_SIZES.obstacle * (1 + ROUNDING_MARGIN):
        problem, bound = f"a solid is {size:.4g} m large", USUAL_SIZES.obstacle
    elif distance > USUAL_SIZES.obstacle_away:
        problem = f"a solid is {distance:.4g} m from the robot's base"
        bound = USUAL_SIZES.obstacle_away
    else:
        return
    _warn(f"{location}: {problem}; expected at most {bound:g} m (numbers in mm? 1 mm is 0.001)")


def warn_of_large_mesh(points: Array, location: str) -> None:
    """Warn of a mesh with corners (k, 3) whose box has an edge above `UsualSizes.mesh`.

    Args:
        points: Corners, scaled [m].
        location: File, or file and key.
    """
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if size > USUAL_SIZES.mesh * (1 + ROUNDING_MARGIN):
        _warn(
            f"{location}: the mesh is {size:.4g} m large; expected at most "
            f"{USUAL_SIZES.mesh:g} m (a mesh in mm? its scale is 0.001)"
        )


MAX_SKEW = 2e-3
"""Largest entry of |R^T R - I| of a matrix that is taken as a rotation [-].

A rotation with three decimals has at most 1.74e-3, and the nearest rotation is at most 0.07 deg
away."""

EXACT_SKEW = 1e-12
"""Largest skew of a rotation that is not changed: rounding of double precision [-]."""

MAX_LENGTH_ERROR = 1e-2
"""Largest difference of a quaternion's length from 1: two decimals change it by up to 0.01 [-]."""

LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
"""Last row of a rigid pose."""

LAST_ROW_ERROR = 1e-6
"""Rounding error of the last row, as a matrix inverse leaves it [-]."""


def matrix_skew(matrices: Array) -> Array:
    """Return the largest entry of |R^T R - I| of matrices (..., 3, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):  # of matrices that are refused
        product = np.swapaxes(matrices, -1, -2) @ matrices
        return np.abs(product - np.eye(3)).max(axis=(-1, -2))


def nearest_rotations(matrices: Array) -> tuple[Array, Bools]:
    """Return the nearest rotation of each matrix, and which matrices are not rotations.

    Args:
        matrices: (..., 3, 3) finite numbers.

    Returns:
        (..., 3, 3) rotations, the identity where a matrix is not nearly one; (...) True there.
    """
    skew = matrix_skew(matrices)
    invalid = np.asarray(~((skew <= MAX_SKEW) & (np.linalg.det(matrices) > 0)))
    inexact = skew > EXACT_SKEW
    if not inexact.any():
        return matrices, invalid
    usable = np.where(invalid[..., None, None], np.eye(3), matrices)
    u, _, vt = np.linalg.svd(usable)
    return np.where((inexact | invalid)[..., None, None], u @ vt, matrices), invalid


def checked_rotations(matrices: Array, location: str) -> Array:
    """Return the nearest rotations (..., 3, 3) of finite matrices.

    Args:
        matrices: (..., 3, 3).
        location: Name of the argument, or file and key.

    Raises:
        InvalidPoseError: A matrix differs too much from a rotation.
    """
    rotations, invalid = nearest_rotations(matrices)
    if invalid.any():
        row = f"[{int(np.argmax(invalid))}]" if invalid.ndim else ""
        raise InvalidPoseError(f"{location}{row}: {rotation_problem(matrices[invalid][0])}")
    return rotations


def rotation_problem(matrix: Array) -> str:
    """Describe why a matrix (3, 3) is not a rotation."""
    expected = f"expected a rotation (R^T R = I within {MAX_SKEW:g}, determinant +1)"
    return (
        f"the matrix is not a rotation: R^T R differs from I by {matrix_skew(matrix):.3g}, the "
        f"determinant is {np.linalg.det(matrix):.3g}; {expected}"
    )


def checked_pose(pose: ArrayLike, name: str = "object_pose") -> Array:
    """Return a pose (4, 4), or poses (k, 4, 4), with exact rotations.

    Args:
        pose: Poses of a user or a file.
        name: Name of the argument, or file and key.

    Raises:
        InputError: The array has another shape.
        InvalidPoseError: A number is not finite, a matrix is not nearly a rotation, or the last row
            is not 0 0 0 1.
    """
    try:
        array = np.asarray(pose, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array of numbers: {error}") from error
    if array.ndim not in (2, 3) or array.shape[-2:] != (4, 4):
        raise InputError(f"{name}: found shape {array.shape}, expected (4, 4)")
    if not np.isfinite(array).all():
        raise InvalidPoseError(f"{name}: holds NaN or infinity, expected finite numbers")
    matrices = array[..., :3, :3]
    rotations = checked_rotations(matrices, name)
    if not (np.abs(array[..., 3, :] - LAST_ROW) <= LAST_ROW_ERROR).all():
        raise InvalidPoseError(f"{name}: the last row is not 0 0 0 1; expected a rigid pose (4, 4)")
    if rotations is matrices and (array[..., 3, :] == LAST_ROW).all():
        return array
    exact = array.copy()
    exact[..., :3, :3], exact[..., 3, :] = rotations, LAST_ROW
    return exact


def single_pose(pose: ArrayLike, name: str = "pose") -> Array:
    """Return a single pose (4, 4); see `checked_pose`.

    Raises:
        InputError: The array is not a single pose.
    """
    array = checked_pose(pose, name)
    if array.ndim != 2:
        raise InputError(f"{name}: found shape {array.shape}, expected (4, 4)")
    return array


def unit_quaternions(quaternions: Array) -> tuple[Array, Bools]:
    """Return normalised quaternions, and which of the quaternions do not have length 1.

    Args:
        quaternions: (..., 4) in any order of components.

    Returns:
        (..., 4), NaN where a quaternion is not nearly of length 1; (...) True there.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(quaternions, axis=-1)
    invalid = np.asarray(~(np.abs(lengths - 1.0) <= MAX_LENGTH_ERROR))
    divisors = np.where(invalid, np.nan, lengths)
    return quaternions / divisors[..., None], invalid


def checked_quaternion(quaternion: ArrayLike, location: str) -> Array:
    """Return a quaternion (4,) normalised, with its order of components.

    Raises:
        InputError: The array has another shape.
        InvalidPoseError: The length differs too much from 1.
    """
    values = np.asarray(quaternion, dtype=float)
    if values.shape != (4,):
        raise InputError(f"{location}: found shape {values.shape}, expected a quaternion (4,)")
    unit, invalid = unit_quaternions(values)
    if invalid:
        length = float(np.linalg.norm(values))
        raise InvalidPoseError(
            f"{location}: found length {length:.6g}, expected 1 (within {MAX_LENGTH_ERROR:g})"
        )
    return unit


def rotations_from_quaternions(quaternions: Array) -> Array:
    """Return the rotations (k, 3, 3) of quaternions (k, 4), w x y z, of nearly length 1.

    Rows of another length give NaN, which callers report as invalid rows.
    """
    w, x, y, z = unit_quaternions(np.asarray(quaternions, dtype=float))[0].T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
