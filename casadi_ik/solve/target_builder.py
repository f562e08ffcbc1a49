"""Conversion of grasps, palm poses and arrays into targets, with the defaults of a solver.

A palm pose with a hand posture determines all contacts; pose components that the contacts leave
free are constrained by tangents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import (
    check_contact_distances,
    checked_pose,
    warn_of_wide_tolerance,
)
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.model.pose import Free
from casadi_ik.model.targets import (
    CLEARANCE,
    DIRECTIONS_KEY,
    NO_PREFERENCE,
    PREFERENCES,
    Q0,
    TargetBatch,
    check_extra_vectors,
    fixed_array,
    target_arrays,
)
from casadi_ik.solve.hand_postures import hand_posture, stack_postures
from casadi_ik.solve.method import Method

MIN_CONTACT_MOTION = 0.15
"""Singular value of the map from palm motions (rotation [rad], translation by `LENGTH`) to contacts
below which the contacts leave the palm free. Source: hands with three fingers or more in the
catalogue have 0.17 or more."""


def contacts_from_palms(
    robot: ArmHand, palms: Array, postures: Array
) -> tuple[Array, Array, dict[str, Array]]:
    """Return the contacts of hands with these palm poses and postures.

    Args:
        robot: The robot.
        palms: (k, 4, 4) poses of the palm frame in the base frame.
        postures: (k, n) postures as `hand_posture` returns them.

    Returns:
        Contact points (k, f, 3) [m] and normals (k, f, 3), base frame; and "tangents" (k, f, 3)
        where points and normals leave the palm free, as with two opposed fingers: NaN for other
        rows, missing if there is no such row.
    """
    q = np.where(np.isnan(postures), robot.home, postures)
    points, normals = robot.contacts(q)
    home_palm = robot.palm(q)
    rotation = palms[:, :3, :3] @ np.swapaxes(home_palm[:, :3, :3], 1, 2)
    rotation_T = np.swapaxes(rotation, 1, 2)
    points = (points - home_palm[:, None, :3, 3]) @ rotation_T + palms[:, None, :3, 3]
    normals = normals @ rotation_T
    is_free = _palm_is_free(points, normals)
    if not is_free.any():
        return points, normals, {}
    tangents = robot.contact_frames(q)[..., :3, 1] @ rotation_T
    return points, normals, {"tangents": np.where(is_free[:, None, None], tangents, np.nan)}


CROSS_PRODUCTS = np.cross(np.eye(3)[:, None], np.eye(3)[None])
"""`v @ CROSS_PRODUCTS[i]` is the cross product of axis i with v."""


def _palm_is_free(points: Array, directions: Array) -> NDArray[np.bool_]:
    """Return (k,) whether contacts leave the palm free.

    Args:
        points: (k, f, 3) contact points [m]; NaN: none.
        directions: (k, m, 3) contact directions; NaN: none.
    """
    has_point, has_direction = (~np.isnan(vectors[..., :1]) for vectors in (points, directions))
    count = np.maximum(has_point.sum(axis=1, keepdims=True), 1)
    offsets = (points - np.nansum(points, axis=1, keepdims=True) / count) / LENGTH
    f = points.shape[1]
    jacobian = np.zeros((len(points), 6, f + directions.shape[1], 3))
    is_present = np.concatenate([has_point, has_direction], axis=1)
    vectors = np.where(is_present, np.hstack([offsets, directions]), 0.0)
    for i, axis in enumerate(np.eye(3)):
        jacobian[:, i, :f] = axis * has_point
        jacobian[:, 3 + i] = vectors @ CROSS_PRODUCTS[i]
    rows = jacobian.reshape(len(points), 6, 3 * jacobian.shape[2])
    smallest = np.linalg.eigvalsh(rows @ np.swapaxes(rows, 1, 2))[:, 0]
    return np.asarray(smallest < MIN_CONTACT_MOTION**2)


def merge_fixed(postures: Array, fixed: Array | None, actuators: Sequence[str]) -> Array:
    """Return (k, n) motor positions fixed by postures or by the caller; NaN for other motors.

    Raises:
        InputError: The caller fixes a motor of the hand.
    """
    if fixed is None:
        return postures
    both = ~np.isnan(fixed) & ~np.isnan(postures).all(axis=0)
    if both.any():
        name = actuators[int(np.flatnonzero(both)[0])]
        raise InputError(
            f"fixed.{name}: the motor is fixed by the grasp's posture; expected other motors"
        )
    return np.where(np.isnan(postures), fixed, postures)


@dataclass(frozen=True, eq=False)
class TargetBuilder:
    """Builder of targets from grasps, palm poses and arrays.

    Attributes:
        robot: The robot.
        tolerances: Tolerance by finger, in the robot's order.
        enforce_limits: Whether a solution has to be within the limits.
        method: Method that solves the targets and decides which preferences are supported; None:
            all of them are.
        has_scene: Whether solutions are checked for collisions.
    """

    robot: ArmHand
    tolerances: Mapping[str, Tolerance]
    enforce_limits: bool = True
    method: Method | None = None
    has_scene: bool = True

    def from_arrays(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        extra_vectors: Mapping[str, ArrayLike | None] | None = None,
        *,
        first_row: int = 0,
        fixed: Mapping[str, float] | None = None,
        q0: ArrayLike | None = None,
        prefer: str | None = None,
        seed: int = 0,
    ) -> TargetBatch:
        """Return targets given as arrays.

        Args:
            points: (k, f, 3) contact points [m].
            normals: (k, f, 3) pad normals.
            extra_vectors: (k, f, 3) further vectors by name, see `check_extra_vectors`, and
                directions.
            first_row: Number of the first target.
            fixed: Positions of fixed actuators by name.
            q0: (n,) or (k, n) start configurations; None: the robot's home.
            prefer: One of `PREFERENCES`; None: "q0" with start configurations, else "limits".
            seed: Seed of all random numbers, >= 0.

        Raises:
            InputError: An argument has a wrong shape or value, see `target_arrays`,
                `check_extra_vectors` and `fixed_array`.
            UnknownNameError: A fixed actuator does not exist.
            UnsupportedError: The method does not support the preference.
        """
        fixed_q, preference = self.fixed_vector(fixed), self.preference(prefer, q0 is not None)
        vectors = dict(extra_vectors or {})
        directions = vectors.pop(DIRECTIONS_KEY, None)
        p, n = target_arrays(points, normals, len(self.robot.fingers), first_row, directions)
        check_contact_distances(p, "points", self._base_travel)
        return TargetBatch(
            p,
            n,
            self._default_tolerances,
            self.enforce_limits,
            first_row,
            fixed_q,
            check_extra_vectors(vectors, p, n, first_row) if vectors else {},
            q0=self._starts(q0, len(p)),
            prefer=preference,
            seed=_checked_seed(seed),
        )

    def from_named_arrays(
        self, arrays: Mapping[str, ArrayLike], first_row: int = 0, **options: Any
    ) -> TargetBatch:
        """Return targets given as arrays by name; for options and errors see `from_arrays`."""
        vectors = dict(arrays)
        points, normals = vectors.pop("points"), vectors.pop("normals")
        return self.from_arrays(points, normals, vectors, first_row=first_row, **options)

    def from_grasps(
        self,
        grasps: Sequence[Grasp],
        *,
        fixed: Mapping[str, float] | None = None,
        q0: ArrayLike | None = None,
        prefer: str | None = None,
        seed: int = 0,
        allow_free_pose: bool = False,
    ) -> TargetBatch:
        """Return the targets of grasps, which share the tolerances of the first one.

        Args:
            grasps: At least one grasp.
            fixed: See `from_arrays`.
            q0: See `from_arrays`.
            prefer: See `from_arrays`.
            seed: See `from_arrays`.
            allow_free_pose: Whether object poses may be `Free`.

        Raises:
            InputError: An element is not a grasp, or names a finger or a side that the robot does
                not have; or see `from_arrays`.
            UnknownNameError: A fixed actuator does not exist.
            UnsupportedError: The method does not support the preference.
        """
        preference = self.preference(prefer, q0 is not None)
        has_palms = False
        for grasp in grasps:
            if not isinstance(grasp, Grasp):
                raise InputError(f"grasp: found {type(grasp).__name__}, expected a Grasp")
            if not allow_free_pose and isinstance(grasp.object_pose, Free):
                raise InputError("object_pose: a Free pose is only supported by Solver.solve")
            has_palms = has_palms or grasp.palm is not None
        palms = postures = None
        if has_palms:
            grasps, palms, postures = self._resolve_palms(grasps)
        if palms is None or postures is None:
            points, normals, vectors = self._contact_arrays(grasps)
        else:
            points, normals, vectors = contacts_from_palms(self.robot, palms, postures)
        fixed_q = self.fixed_vector(fixed) if fixed else None
        if postures is not None:
            fixed_q = merge_fixed(postures, fixed_q, self.robot.actuators)
        return TargetBatch(
            points,
            normals,
            self._tolerances_of(grasps[0]),
            self.enforce_limits,
            fixed=fixed_q,
            extra_vectors=vectors,
            q0=self._starts(q0, len(points)),
            prefer=preference,
            seed=_checked_seed(seed),
            object=grasps[0].object,
            object_pose=_object_poses(grasps),
            palms=palms,
        )

    def from_palms(
        self,
        palms: Array,
        postures: Array,
        *,
        fixed: Mapping[str, float] | None = None,
        q0: ArrayLike | None = None,
        prefer: str | None = None,
        seed: int = 0,
    ) -> TargetBatch:
        """Return targets given as palm poses with hand postures: only the arm is unknown.

        Args:
            palms: (k, 4, 4) poses of the palm frame in the base frame.
            postures: (k, n) postures as `hand_posture` returns them.
            fixed: Positions of other fixed actuators by name.
            q0: See `from_arrays`.
            prefer: See `from_arrays`.
            seed: See `from_arrays`.

        Raises:
            InputError: A motor of the hand is fixed; or see `from_arrays`.
            UnknownNameError: A fixed actuator does not exist.
            UnsupportedError: The method does not support the preference.
        """
        preference = self.preference(prefer, q0 is not None)
        points, normals, vectors = contacts_from_palms(self.robot, palms, postures)
        return TargetBatch(
            points,
            normals,
            self._default_tolerances,
            self.enforce_limits,
            fixed=merge_fixed(postures, self.fixed_vector(fixed), self.robot.actuators),
            extra_vectors=vectors,
            q0=self._starts(q0, len(points)),
            prefer=preference,
            seed=_checked_seed(seed),
            palms=palms,
        )

    def start(self, q0: ArrayLike | None, name: str = "q0") -> Array:
        """Return a start configuration (n,); None: the robot's home.

        Raises:
            InputError: The start is not a single configuration.
        """
        start = self.robot.start(q0, name)
        if start.ndim != 1:
            raise InputError(f"{name}: found shape {start.shape}, expected ({len(start[0])},)")
        return start

    def _starts(self, q0: ArrayLike | None, count: int) -> Array:
        """Return the start configurations (n,) or (k, n) of `count` targets.

        Raises:
            InputError: Wrong shape or numbers, or another number of rows than targets.
        """
        starts = self.robot.start(q0)
        if starts.ndim == 2 and len(starts) != count:
            raise InputError(
                f"q0: found {len(starts)} rows for {count} targets, expected {count}, or one (n,)"
            )
        return starts

    def preference(self, prefer: str | None, has_start: bool) -> str:
        """Return the preference of targets.

        Raises:
            InputError: The preference is unknown, or needs a scene.
            UnsupportedError: The method does not support it.
        """
        preference = resolve_preference(prefer, has_start)
        if preference == CLEARANCE and not self.has_scene:
            raise InputError(f"prefer: {preference!r} needs a solver with a scene")
        method = self.method
        if method is None or preference in method.preferences:
            return preference
        if method.preferences:
            raise UnsupportedError(
                f"prefer: {preference!r} is not supported by method {method.name!r}; expected one "
                f"of {', '.join(method.preferences)}"
            )
        if prefer is None:
            return NO_PREFERENCE
        raise UnsupportedError(
            f"prefer: {prefer!r} is not supported by method {method.name!r}, which returns the "
            "first solution it finds; expected None"
        )

    def _contact_arrays(self, grasps: Sequence[Grasp]) -> tuple[Array, Array, dict[str, Array]]:
        """Return points, normals and further vectors (k, f, 3) of grasps with contacts."""
        # The constructor of a contact has checked it.
        fingers = self.robot.fingers
        arrays = [grasp.arrays(fingers) for grasp in grasps]
        vectors = [grasp.extra_vectors(fingers) for grasp in grasps]
        # Adding a dimension is free; stacking takes as long as solving one grasp.
        points, normals = (
            (arrays[0][0][None], arrays[0][1][None])
            if len(arrays) == 1
            else (np.array(vectors) for vectors in zip(*arrays, strict=True))
        )
        check_contact_distances(points, grasps[0].name or "contacts", self._base_travel)
        return points, normals, _stack_vectors(vectors, len(fingers)) if any(vectors) else {}

    def _tolerances_of(self, grasp: Grasp) -> tuple[Tolerance, ...]:
        """Return the tolerance of every finger for the contacts of a grasp."""
        contacts = grasp.contacts
        if not any(contact.tolerance for contact in contacts.values()):
            return self._default_tolerances
        return tuple(
            (contacts[name].tolerance if name in contacts else None) or tolerance
            for name, tolerance in self.tolerances.items()
        )

    def _resolve_palms(
        self, grasps: Sequence[Grasp]
    ) -> tuple[Sequence[Grasp], Array | None, Array]:
        """Return grasps with palms by side as grasps with contacts; others by palms and postures.

        Returns:
            The grasps; (k, 4, 4) palm poses, None for a multi-arm robot; (k, n) positions of the
            motors of the hands, NaN for other motors.
        """
        sides = self.robot.sides
        if len(sides) == 1:
            grasps = [
                grasp
                if grasp.single_palm is None
                else replace(grasp, palm={sides[0]: grasp.single_palm})
                for grasp in grasps
            ]
        if any(isinstance(grasp.palm, Mapping) for grasp in grasps):
            converted, postures = self._replace_palms_by_contacts(grasps)
            return converted, None, postures
        palms = [grasp.single_palm for grasp in grasps if grasp.single_palm is not None]
        if len(palms) < len(grasps):
            raise InputError("grasps: found palms and contacts, expected the same in all")
        if sides:
            raise InputError(
                f"palm: found one pose, expected one by side (palms in a file): {', '.join(sides)}"
            )
        postures = stack_postures(self.robot, [grasp.posture for grasp in grasps])
        return grasps, checked_pose(np.stack(palms), "palms"), postures

    def _replace_palms_by_contacts(self, grasps: Sequence[Grasp]) -> tuple[list[Grasp], Array]:
        """Return grasps with contacts instead of palms by side, and their postures.

        Returns:
            The grasps, and (k, n) positions of the motors of their hands, NaN for other motors.
        """
        robot, converted = self.robot, list[Grasp]()
        postures = np.full((len(grasps), len(robot.actuators)), np.nan)
        for row, grasp in enumerate(grasps):
            if not isinstance(grasp.palm, Mapping):
                raise InputError(
                    "grasps: found grasps with and without palms by side, expected the same in all"
                )
            contacts = dict[str, Contact]()
            columns = {name: i for i, name in enumerate(robot.actuators)}
            used_motors = set[str]()
            for name, pose in grasp.palm.items():
                if name not in self._sides:
                    sides = ", ".join(self._sides) or "none"
                    raise InputError(f"palm.{name}: no such side; the robot's sides: {sides}")
                side = self._sides[name]
                positions = {
                    motor: grasp.posture[motor]
                    for motor in side.actuators
                    if motor in grasp.posture
                }
                posture = hand_posture(side, positions)
                points, normals, extra_vectors = contacts_from_palms(
                    side, pose[None], posture[None]
                )
                tangents = extra_vectors.get("tangents", [[None] * len(side.fingers)])[0]
                contacts |= {
                    finger: Contact(points[0, i], normals[0, i], tangent=tangents[i])
                    for i, finger in enumerate(side.fingers)
                }
                used_motors |= set(positions)
                for motor, value in zip(side.actuators, posture, strict=True):
                    postures[row, columns[motor]] = value
            extra = sorted(set(grasp.posture) - used_motors)
            if extra:
                raise InputError(
                    f"posture.{extra[0]}: not a motor of a hand with a palm; expected such motors"
                )
            converted.append(replace(grasp, palm=None, posture={}, contacts=contacts))
        return converted, postures

    @cached_property
    def _sides(self) -> dict[str, ArmHand]:
        robot = self.robot.description
        return {side.name: ArmHand(robot.side(side.name)) for side in robot.sides}

    @cached_property
    def _base_travel(self) -> float:
        """Total travel of the robot's linear motors [m]."""
        motors = [motor for motor in self.robot.description.actuators if motor.unit == "m"]
        return float(sum(max(abs(motor.lower), abs(motor.upper)) for motor in motors))

    @cached_property
    def _default_tolerances(self) -> tuple[Tolerance, ...]:
        return tuple(self.tolerances.values())

    def fixed_vector(self, fixed: Mapping[str, float] | None) -> Array | None:
        """Return the positions of fixed actuators as an array, see `fixed_array`."""
        robot = self.robot
        return fixed_array(fixed or {}, robot.actuators, *robot.description.motion_limits)


def resolve_preference(prefer: str | None, has_start: bool) -> str:
    """Return the preference of a solve.

    Args:
        prefer: One of `PREFERENCES`, or None: "q0" with a start, else "limits".
        has_start: Whether the caller passed a start.

    Raises:
        InputError: The preference is unknown.
    """
    if prefer is None:
        return Q0 if has_start else "limits"
    if prefer not in PREFERENCES:
        raise InputError(f"prefer: found {prefer!r}, expected one of {', '.join(PREFERENCES)}")
    return prefer


def _checked_seed(seed: int) -> int:
    """Return a seed as an integer.

    Raises:
        InputError: It is not an integer >= 0.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"seed: found {seed!r}, expected an integer >= 0")
    return int(seed)


def _object_poses(grasps: Sequence[Grasp]) -> Array | None:
    """Return (k, 4, 4) object poses; None unless all grasps state the pose of the same object."""
    if len(grasps) == 1:
        pose = grasps[0].known_pose
        return None if pose is None else pose[None]
    if len({grasp.object for grasp in grasps}) > 1:
        return None
    poses = [grasp.known_pose for grasp in grasps if grasp.known_pose is not None]
    return np.stack(poses) if poses and len(poses) == len(grasps) else None


def _stack_vectors(vectors: Sequence[Mapping[str, Array]], f: int) -> dict[str, Array]:
    """Return (k, f, 3) arrays of the further contact vectors of k grasps; NaN where missing."""
    missing = np.full((f, 3), np.nan)
    names = dict.fromkeys(name for by_name in vectors for name in by_name)
    return {name: np.array([by_name.get(name, missing) for by_name in vectors]) for name in names}


def tolerances_by_finger(
    tolerance: Tolerance | Mapping[str, Tolerance] | None, fingers: Sequence[str]
) -> dict[str, Tolerance]:
    """Return the tolerance of every finger; a missing one is the default.

    Raises:
        InputError: A value is not a tolerance, or a finger does not exist.
    """
    if tolerance is None or isinstance(tolerance, Tolerance):
        if tolerance is not None:
            warn_of_wide_tolerance(tolerance.position, tolerance.angle)
        return dict.fromkeys(fingers, tolerance or Tolerance())
    if not isinstance(tolerance, Mapping):
        raise InputError(f"tolerance: found {tolerance!r}, expected a Tolerance, or one by finger")
    for name, value in tolerance.items():
        if name not in fingers:
            raise InputError(
                f"tolerance.{name}: no such finger; the robot's fingers: {', '.join(fingers)}"
            )
        if not isinstance(value, Tolerance):
            raise InputError(f"tolerance.{name}: found {value!r}, expected a Tolerance")
        warn_of_wide_tolerance(value.position, value.angle, f"tolerance.{name}")
    return {name: tolerance.get(name, Tolerance()) for name in fingers}
