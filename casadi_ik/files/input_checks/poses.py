"""Checks of rotations and rigid poses: rounded ones are corrected, others are refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, InvalidPoseError
from casadi_ik.files.arrays import Array, Bools

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
