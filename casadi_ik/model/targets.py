"""Targets as arrays: contacts, tolerances, limits, start configurations and preference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError, RowError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import checked_mapping, checked_pose
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import (
    EXTRA_VECTORS,
    Tolerance,
    invalid_mask,
    invalid_reason,
    orthogonal_tangents,
    real_array,
    unit_vectors,
)

EXTRA_ARRAY_NAMES = tuple(f"{name}s" for name in EXTRA_VECTORS)
"""Names of the arrays of extra target vectors."""

LIMIT_MODES = ("enforce", "ignore")
"""Treatment of joint limits. "enforce": a solution is within them; "ignore": they do not matter, as
in Qiu & Kermani 2021."""

Q0, CLEARANCE, MANIPULABILITY = "q0", "clearance", "manipulability"

PREFERENCES = ("limits", MANIPULABILITY, Q0, CLEARANCE)
"""Orders among solutions: distance from the limits, manipulability of the arm, distance to q0,
clearance (requires a scene)."""

NO_PREFERENCE = "none"
"""Preference of methods that return the first solution they find."""


@dataclass(slots=True, eq=False)
class TargetBatch:
    """A batch of k targets: everything that determines their solutions for a robot and a method.

    Attributes:
        points: (k, f, 3) contact points [m], base frame; NaN marks a free finger.
        normals: (k, f, 3) unit outward pad normals, base frame; NaN marks a free normal.
        tolerance: Tolerance of all fingers, or one per finger.
        enforce_limits: True if a solution must be within limits.
        first_row: Number of the first target in the complete batch; with the seed it determines the
            random numbers of a target, so that a part of a batch gives the same solutions.
        fixed: (n,) or (k, n) positions of fixed actuators, NaN for free ones; None if all are
            free.
        extra_vectors: (k, f, 3) arrays of contacts besides points and normals ("tangents", "lines",
            "planes", "balls"), NaN where free; arrays that are free everywhere are omitted.
        row_numbers: (k,) numbers of the targets if they are not contiguous.
        q0: (n,) or (k, n) start configurations [rad or m]; None: the robot's home.
        prefer: Order among several solutions: one of `PREFERENCES`, or `NO_PREFERENCE`. "q0" refers
            to the start configurations.
        seed: Seed of all random numbers.
        object: Name of the grasped object, for collisions; "" if unknown.
        object_pose: (k, 4, 4) poses of the object in the base frame; None: its pose in the scene.
        palms: (k, 4, 4) palm poses, base frame; None: contacts determine them.
    """

    points: Array
    normals: Array
    tolerance: Tolerance | tuple[Tolerance, ...]
    enforce_limits: bool
    first_row: int = 0
    fixed: Array | None = None
    extra_vectors: Mapping[str, Array] = field(default_factory=dict)
    row_numbers: NDArray[np.intp] | None = None
    q0: Array | None = None
    prefer: str = "limits"
    seed: int = 0
    object: str = ""
    object_pose: Array | None = None
    palms: Array | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def prefers_q0(self) -> bool:
        """True if solutions near the start configurations are preferred."""
        return self.prefer == Q0

    @property
    def tolerances(self) -> tuple[Tolerance, ...]:
        """Tolerance of each finger."""
        if isinstance(self.tolerance, Tolerance):
            return (self.tolerance,) * self.points.shape[1]
        return self.tolerance

    @property
    def position_tolerance(self) -> Array:
        """Position tolerances (f,) [m]."""
        return np.array([tolerance.position for tolerance in self.tolerances])

    @property
    def angle_tolerance(self) -> Array:
        """Angle tolerances (f,) [rad]."""
        return np.array([tolerance.angle for tolerance in self.tolerances])

    @property
    def largest_tolerance(self) -> Tolerance:
        """Largest position and angle tolerance of any finger."""
        return Tolerance(float(self.position_tolerance.max()), float(self.angle_tolerance.max()))

    def rows(self, rows: slice | NDArray[np.intp]) -> TargetBatch:
        """Return some of the targets.

        Args:
            rows: A slice without a step keeps the numbers of the targets. With an index array
                targets are numbered from 0, unless the batch has `row_numbers`.
        """
        first_row = 0
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(len(self))
            if start == 0 and stop == len(self):
                return self
            first_row = self.first_row + start
        points, normals = self.points[rows], self.normals[rows]
        extra_vectors = (
            {name: array[rows] for name, array in self.extra_vectors.items()}
            if self.extra_vectors
            else self.extra_vectors
        )
        row_numbers = None if self.row_numbers is None else self.row_numbers[rows]
        pose = None if self.object_pose is None else self.object_pose[rows]
        fixed, q0 = (
            array if array is None or array.ndim == 1 else array[rows]
            for array in (self.fixed, self.q0)
        )
        return replace(
            self,
            points=points,
            normals=normals,
            first_row=first_row,
            extra_vectors=extra_vectors,
            row_numbers=row_numbers,
            object_pose=pose,
            fixed=fixed,
            q0=q0,
            palms=None if self.palms is None else self.palms[rows],
        )

    def starting_at(self, q0: Array) -> TargetBatch:
        """Return the targets with other start configurations (n,) or (k, n) [rad or m]."""
        return replace(self, q0=q0)

    def for_part(self, fingers: Sequence[int], motors: Sequence[int] | None = None) -> TargetBatch:
        """Return the targets of a part of the robot.

        Args:
            fingers: Indices of the fingers of the part.
            motors: Indices of its motors; None: all motors are free and start at home.
        """
        fixed, q0 = (
            None if array is None or motors is None else array[..., motors]
            for array in (self.fixed, self.q0)
        )
        return replace(
            self,
            points=self.points[:, fingers],
            normals=self.normals[:, fingers],
            tolerance=tuple(self.tolerances[i] for i in fingers),
            fixed=fixed,
            q0=q0,
            extra_vectors={name: array[:, fingers] for name, array in self.extra_vectors.items()},
        )

    def holding(self, name: str, object_pose: ArrayLike) -> TargetBatch:
        """Return the same targets with an object grasped at poses (4, 4) or (k, 4, 4).

        Raises:
            InputError: A pose is not a rigid motion, or their number differs from that of the
                targets.
        """
        poses = checked_pose(object_pose)
        if poses.ndim == 3 and len(poses) != len(self):
            raise InputError(
                f"object_pose: found {len(poses)} poses, expected {len(self)}, one per target"
            )
        expanded = np.broadcast_to(poses, (len(self), 4, 4))
        return replace(self, object=name, object_pose=expanded)

    def row_number(self, row: int) -> int:
        """Return the number of a target in the complete batch."""
        return self.first_row + row if self.row_numbers is None else int(self.row_numbers[row])

    def vectors(self, name: str) -> Array:
        """Return the array (k, f, 3) "points", "normals" or an extra one; NaN where free."""
        if name in ("points", "normals"):
            array: Array = getattr(self, name)
            return array
        return (
            self.extra_vectors[name]
            if name in self.extra_vectors
            else np.full_like(self.points, np.nan)
        )

    def starts(self, robot: RobotDescription) -> Array:
        """Return the start configurations (k, n) [rad or m]."""
        q0 = robot.home if self.q0 is None else self.q0
        if q0.ndim == 2:
            return q0
        return q0[None] if len(self) == 1 else np.repeat(q0[None], len(self), axis=0)

    def bounds(self, robot: RobotDescription, unbounded: float = 1e3) -> tuple[Array, Array]:
        """Return the bounds that a method enforces: limits, or mechanical ranges without limits.

        The bounds are (n,), or (k, n) if targets fix actuators at different positions.

        Args:
            robot: The robot.
            unbounded: Bound of a coordinate without limit [rad or m].
        """
        lower, upper = robot.lower, robot.upper
        if not self.enforce_limits:
            lower, upper = (
                np.clip(bound, -unbounded, unbounded) for bound in robot.mechanical_limits
            )
        if self.fixed is None:
            return lower, upper
        free = np.isnan(self.fixed)
        return np.where(free, lower, self.fixed), np.where(free, upper, self.fixed)


def fixed_array(
    fixed: Mapping[str, float], actuators: Sequence[str], lower: Array, upper: Array
) -> Array | None:
    """Return the positions of fixed actuators as an array for `TargetBatch.fixed`.

    Args:
        fixed: Position by name of the actuator [rad or m].
        actuators: Names of all actuators, in the order of q.
        lower: (n,) lower limits.
        upper: (n,) upper limits.

    Raises:
        UnknownNameError: An actuator does not exist.
        InputError: A value is not a number within the actuator's limits.
    """
    if not fixed:
        return None
    values = np.full(len(actuators), np.nan)
    for name, value in checked_mapping(fixed, "fixed", "from actuators to positions").items():
        if name not in actuators:
            raise UnknownNameError(
                f"fixed: unknown actuator {name!r}; expected one of {', '.join(actuators)}"
            )
        i = list(actuators).index(name)
        is_number = isinstance(value, (int, float, np.integer, np.floating))
        if not (is_number and lower[i] <= value <= upper[i]):
            raise InputError(
                f"fixed.{name}: found {value!r}, expected a number from {lower[i]:g} to "
                f"{upper[i]:g}"
            )
        values[i] = value
    return values


DIRECTIONS_KEY = "directions"
"""Name of the array of contacts that are directions without points."""


def target_arrays(
    points: ArrayLike,
    normals: ArrayLike,
    f: int,
    first_row: int = 0,
    directions: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Return checked points and unit normals of a batch.

    Args:
        points: (k, f, 3) [m].
        normals: (k, f, 3) of any length but zero.
        f: Number of the robot's fingers.
        first_row: Number of the first row, for messages.
        directions: (k, f, 3) nonzero pad normals of fingertips whose position is free; NaN for
            other fingertips. None: no directions.

    Returns:
        Points and unit normals, (k, f, 3); a direction is a normal without a point.

    Raises:
        RowError: A number is infinite, a vector is partly NaN, a normal or direction is zero, a
            normal has no point, a direction has a point, or a row has no contact. The message names
            row and finger.
        InputError: An array has another shape or type.
    """
    arrays = []
    inputs = {"points": points, "normals": normals}
    if directions is not None:
        inputs[DIRECTIONS_KEY] = directions
    for name, value in inputs.items():
        try:
            array = real_array(value)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected an array of numbers: {error}") from error
        if array.ndim != 3 or array.shape[1:] != (f, 3):
            raise InputError(f"{name}: found shape {array.shape}, expected (k, {f}, 3)")
        if np.isfinite(array).all():
            arrays.append(array)
            continue
        free = np.isnan(array)
        partly = np.any(free, axis=2) & ~np.all(free, axis=2)
        infinite = np.any(np.isinf(array), axis=2)
        _refuse(partly, first_row, name, "is partly NaN, expected three numbers or three NaN")
        _refuse(infinite, first_row, name, "is infinite, expected finite numbers")
        arrays.append(array)
    p, n, *direction_arrays = arrays
    for name, array in zip(list(inputs)[1:], arrays[1:], strict=True):
        if len(p) != len(array):
            raise InputError(
                f"points and {name}: found {len(p)} and {len(array)} rows, expected equal numbers"
            )
    # Unit normals are not normalised again, so that arrays and a `Grasp` give the same target.
    unit, zero = unit_vectors(n)
    _refuse(zero, first_row, "normals", "is zero, expected a direction")
    free_point = np.isnan(p[..., 0])
    without_point = free_point & ~np.isnan(n[..., 0])
    _refuse(without_point, first_row, "normals", "has a normal but no point")
    if direction_arrays:
        unit_directions, zero = unit_vectors(direction_arrays[0])
        _refuse(zero, first_row, DIRECTIONS_KEY, "is zero, expected a direction")
        has_direction = ~np.isnan(unit_directions[..., 0])
        _refuse(
            has_direction & ~free_point,
            first_row,
            DIRECTIONS_KEY,
            "has a point and a direction; expected one of them",
        )
        unit = np.where(has_direction[..., None], unit_directions, unit)
        free_point = free_point & ~has_direction
    empty = np.flatnonzero(free_point.all(axis=1))
    if len(empty):
        row = first_row + int(empty[0])
        raise RowError(f"points: row {row} has no contact; expected at least one", row)
    return p, unit


def _refuse(invalid: NDArray[np.bool_], first_row: int, name: str, problem: str) -> None:
    indices = np.argwhere(invalid)
    if len(indices):
        row, finger = first_row + int(indices[0, 0]), indices[0, 1]
        raise RowError(f"{name}: row {row}, finger {finger} {problem}", row)


def check_extra_vectors(
    extra_vectors: Mapping[str, ArrayLike | None], points: Array, normals: Array, first_row: int = 0
) -> dict[str, Array]:
    """Validate the extra vectors of a batch.

    Args:
        extra_vectors: (k, f, 3) by name; NaN where free, None if absent.
        points: (k, f, 3) checked [m].
        normals: (k, f, 3) checked, unit.
        first_row: Index of the first row, for messages.

    Returns:
        Unit vectors (k, f, 3) by name, without arrays that are NaN everywhere.

    Raises:
        UnknownNameError: The name of an array is unknown.
        RowError: A vector is partly NaN, infinite, zero or inconsistent with other vectors of the
            contact; the message names row and finger.
        InputError: An array has a wrong shape or is not numeric.
    """
    arrays: dict[str, Array] = {}
    for name, value in extra_vectors.items():
        if name not in EXTRA_ARRAY_NAMES:
            expected = ", ".join((*EXTRA_ARRAY_NAMES, DIRECTIONS_KEY))
            raise UnknownNameError(f"{name!r} does not exist; expected one of {expected}")
        if value is None:
            continue
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected an array of numbers") from error
        if array.shape != points.shape:
            raise InputError(f"{name}: found shape {array.shape}, expected {points.shape}")
        if not np.isnan(array).all():
            arrays[name] = array
    if not arrays:
        return arrays
    is_invalid, units = np.zeros(points.shape[:2], dtype=bool), dict[str, Array]()
    for name, array in arrays.items():
        is_constrained = ~np.isnan(array).all(axis=2)
        with np.errstate(invalid="ignore"):
            units[name], zero = unit_vectors(array)
        is_invalid |= is_constrained & (zero | ~np.isfinite(array).all(axis=2))
    vectors = {name[:-1]: array for name, array in units.items()}
    is_invalid |= invalid_mask({"point": points, "normal": normals, **vectors})
    for row, finger in np.argwhere(is_invalid)[:1].tolist():
        all_arrays = {"points": points, "normals": normals, **arrays}
        problem = _describe_problem(
            {name: array[row, finger] for name, array in all_arrays.items()}
        )
        raise RowError(f"row {first_row + row}, finger {finger}: {problem}", first_row + row)
    if "tangents" in units:
        units["tangents"] = orthogonal_tangents(units["tangents"], normals)
    return units


def _describe_problem(vectors: Mapping[str, Array]) -> str:
    """Return the problem of an invalid contact."""
    units: dict[str, Array] = {}
    for name, vector in vectors.items():
        if np.isnan(vector).all():
            continue
        if not np.isfinite(vector).all():
            return f"{name[:-1]}: found {vector.tolist()}, expected finite numbers, or all NaN"
        unit, zero = unit_vectors(vector)
        if name in EXTRA_ARRAY_NAMES and zero:
            return f"{name[:-1]}: found {vector.tolist()}, expected a direction, not zero"
        units[name[:-1]] = unit if name in EXTRA_ARRAY_NAMES else vector
    return invalid_reason(units) or "malformed"
