"""The question in numbers: targets of a batch, and when a contact counts as reached."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError, RowError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.poses import checked_pose
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Tolerance, real_array, unit_vectors

LIMIT_MODES = ("enforce", "ignore")
"""How joint limits are taken: as part of being solved, or not at all (the paper's reading)."""


@dataclass(frozen=True, eq=False)
class TargetBatch:
    """A batch of targets.

    Attributes:
        points: (k, f, 3) contact points [m], base frame; NaN marks a free finger.
        normals: (k, f, 3) unit outward pad normals, base frame; NaN marks a free normal.
        tolerance: When a contact counts as reached: one for all fingers, or one per finger.
        enforce_limits: Whether limits are part of being solved.
        first_row: Number of the first target in the whole batch; with the seed it decides the
            random numbers of a target, so that a part of a batch gets those of the whole.
        fixed: (n,) or (k, n) positions of locked actuators, NaN where one may move; None: all may.
        more: (k, f, 3) what contacts have beside point and normal ("tangents", "lines",
            "planes", "balls"), NaN where free; nothing that is free everywhere.
        picked: (k,) numbers of the targets where they are not one after the other.
        prefer: Which of several solutions is wanted, one of `PREFERENCES`, or `NO_PREFERENCE`.
        object: Name of what is grasped, for collisions; "": not said.
        object_pose: (k, 4, 4) where it is in the base frame; None: where the scene has it.
        palms: (k, 4, 4) where the palm has to be, base frame; None: where the contacts put it.
    """

    points: Array
    normals: Array
    tolerance: Tolerance | tuple[Tolerance, ...]
    enforce_limits: bool
    first_row: int = 0
    fixed: Array | None = None
    more: Mapping[str, Array] = field(default_factory=dict)
    picked: NDArray[np.intp] | None = None
    prefer: str = "limits"
    object: str = ""
    object_pose: Array | None = None
    palms: Array | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def tolerances(self) -> tuple[Tolerance, ...]:
        """The tolerance of each finger."""
        if isinstance(self.tolerance, Tolerance):
            return (self.tolerance,) * self.points.shape[1]
        return self.tolerance

    @property
    def position_tolerance(self) -> Array:
        """(f,) [m]."""
        return np.array([tolerance.position for tolerance in self.tolerances])

    @property
    def angle_tolerance(self) -> Array:
        """(f,) [rad]."""
        return np.array([tolerance.angle for tolerance in self.tolerances])

    @property
    def largest_tolerance(self) -> Tolerance:
        """What every contact keeps to that is within its own tolerance."""
        return Tolerance(float(self.position_tolerance.max()), float(self.angle_tolerance.max()))

    def rows(self, rows: slice | NDArray[np.intp]) -> TargetBatch:
        """Some of the targets.

        Args:
            rows: A slice without a step keeps the targets' numbers; rows picked one by one are
                numbered anew from 0.
        """
        first_row = 0
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(len(self))
            if start == 0 and stop == len(self):
                return self
            first_row = self.first_row + start
        points, normals = self.points[rows], self.normals[rows]
        more = {name: array[rows] for name, array in self.more.items()} if self.more else self.more
        picked = None if self.picked is None else self.picked[rows]
        pose = None if self.object_pose is None else self.object_pose[rows]
        fixed = self.fixed if self.fixed is None or self.fixed.ndim == 1 else self.fixed[rows]
        return replace(
            self,
            points=points,
            normals=normals,
            first_row=first_row,
            more=more,
            picked=picked,
            object_pose=pose,
            fixed=fixed,
            palms=None if self.palms is None else self.palms[rows],
        )

    def of_fingers(self, fingers: Sequence[int]) -> TargetBatch:
        """The part that some fingers have, all motors free."""
        return replace(
            self,
            points=self.points[:, fingers],
            normals=self.normals[:, fingers],
            tolerance=tuple(self.tolerances[i] for i in fingers),
            fixed=None,
            more={name: array[:, fingers] for name, array in self.more.items()},
        )

    def holding(self, name: str, object_pose: ArrayLike) -> TargetBatch:
        """The same targets, which grasp an object at poses (4, 4) or (k, 4, 4).

        Raises:
            InputError: No rigid motion, or another number of them.
        """
        poses = checked_pose(object_pose)
        if poses.ndim == 3 and len(poses) != len(self):
            raise InputError(f"object_pose: found {len(poses)} for {len(self)} targets")
        every = np.broadcast_to(poses, (len(self), 4, 4))
        return replace(self, object=name, object_pose=every)

    def number(self, row: int) -> int:
        """Number of a target in the whole batch."""
        return self.first_row + row if self.picked is None else int(self.picked[row])

    def vectors(self, name: str) -> Array:
        """(k, f, 3) "points", "normals" or something more; NaN where free."""
        if name in ("points", "normals"):
            found: Array = getattr(self, name)
            return found
        return self.more[name] if name in self.more else np.full_like(self.points, np.nan)

    def bounds(self, robot: RobotDescription, unbounded: float = 1e3) -> tuple[Array, Array]:
        """Bounds that a method has to keep to: limits, or what the mechanisms permit.

        (n,), or (k, n) where targets lock different positions.

        Args:
            robot: The robot.
            unbounded: What stands for no limit [rad or m].
        """
        lower, upper = robot.lower, robot.upper
        if not self.enforce_limits:
            lower, upper = (np.clip(ends, -unbounded, unbounded) for ends in robot.mechanical)
        if self.fixed is None:
            return lower, upper
        free = np.isnan(self.fixed)
        return np.where(free, lower, self.fixed), np.where(free, upper, self.fixed)


def fixed_array(
    fixed: Mapping[str, float], actuators: Sequence[str], lower: Array, upper: Array
) -> Array | None:
    """Locked actuators as an array for `TargetBatch.fixed`.

    Args:
        fixed: Position by name of the actuator [rad or m].
        actuators: Names of all actuators, in the order of q.
        lower: (n,) limits.
        upper: (n,).

    Raises:
        UnknownNameError: No such actuator.
        InputError: Not a number within the actuator's limits.
    """
    if not fixed:
        return None
    values = np.full(len(actuators), np.nan)
    for name, value in fixed.items():
        if name not in actuators:
            raise UnknownNameError(
                f"fixed: no actuator {name!r}, expected one of {', '.join(actuators)}"
            )
        i = list(actuators).index(name)
        number = isinstance(value, (int, float, np.integer, np.floating))
        if not (number and lower[i] <= value <= upper[i]):
            raise InputError(
                f"fixed.{name}: found {value!r}, expected a number from {lower[i]:g} to "
                f"{upper[i]:g}"
            )
        values[i] = value
    return values


DIRECTIONS_KEY = "directions"
"""Name of the array of contacts that are a direction alone."""


def target_arrays(
    points: ArrayLike,
    normals: ArrayLike,
    f: int,
    first_row: int = 0,
    directions: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Checked batch targets.

    Args:
        points: (k, f, 3) [m].
        normals: (k, f, 3), any length but zero.
        f: Number of the robot's fingers.
        first_row: Number of the first row, for messages.
        directions: (k, f, 3) which way fingertips face that may be anywhere, any length but zero;
            NaN, or None for all, where there is none.

    Returns:
        Points and unit normals, (k, f, 3); a direction is a normal without a point.

    Raises:
        RowError: Infinite numbers, partly NaN vectors, a zero normal or direction, a normal
            without a point, a direction with one, a row with no contact. The message names row
            and finger.
        InputError: Wrong shape, no numbers.
    """
    arrays = []
    given = {"points": points, "normals": normals}
    if directions is not None:
        given[DIRECTIONS_KEY] = directions
    for name, value in given.items():
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
    p, n, *lone = arrays
    for name, array in zip(list(given)[1:], arrays[1:], strict=True):
        if len(p) != len(array):
            found = f"{len(p)} and {len(array)} rows"
            raise InputError(f"points and {name}: found {found}, expected as many")
    # What is a unit normal stays as it is: a contact gives the same target here and in a `Grasp`.
    unit, zero = unit_vectors(n)
    _refuse(zero, first_row, "normals", "is zero, expected a direction")
    free_point = np.isnan(p[..., 0])
    placeless = free_point & ~np.isnan(n[..., 0])
    _refuse(placeless, first_row, "normals", "is given for a finger without a point")
    if lone:
        ways, zero = unit_vectors(lone[0])
        _refuse(zero, first_row, DIRECTIONS_KEY, "is zero, expected a direction")
        faces = ~np.isnan(ways[..., 0])
        _refuse(
            faces & ~free_point, first_row, DIRECTIONS_KEY, "has a point too, expected it alone"
        )
        unit = np.where(faces[..., None], ways, unit)
        free_point = free_point & ~faces
    empty = np.flatnonzero(free_point.all(axis=1))
    if len(empty):
        row = first_row + int(empty[0])
        raise RowError(f"points: row {row} has no contact at all", row)
    return p, unit


def _refuse(bad: NDArray[np.bool_], first_row: int, name: str, problem: str) -> None:
    found = np.argwhere(bad)
    if len(found):
        row, finger = first_row + int(found[0, 0]), found[0, 1]
        raise RowError(f"{name}: row {row}, finger {finger} {problem}", row)
