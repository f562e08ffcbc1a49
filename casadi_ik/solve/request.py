"""How a solver's questions become problems: grasps, palms, arrays; tolerances, limits, preferences.

A palm that is given with the posture of its hand says where every fingertip is; what it leaves free
the contacts say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.poses import checked_pose
from casadi_ik.files.input_checks.units import warn_of_far_contacts, warn_of_wide_tolerance
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH, check_extra_vectors
from casadi_ik.model.grasp import Contact, Grasp, Tolerance
from casadi_ik.model.pose import Free
from casadi_ik.model.targets import DIRECTIONS_KEY, TargetBatch, fixed_array, target_arrays

CLEARANCE = "clearance"
"""The preference for what is far from everything; for solvers with a scene."""

PREFERENCES = ("limits", "manipulability", "q0", CLEARANCE)
"""What may be preferred: distance from the limits, manipulability of the arm, closeness to q0,
clearance."""

NO_PREFERENCE = "none"
"""That of methods that cannot choose: they take the solution they come to."""


def preference(prefer: str | None, started: bool) -> str:
    """The preference that was asked for.

    Args:
        prefer: One of `PREFERENCES`, or None: "q0" if a start was given, else "limits".
        started: Whether one was.

    Raises:
        InputError: No such preference.
    """
    if prefer is None:
        return "q0" if started else "limits"
    if prefer not in PREFERENCES:
        raise InputError(f"prefer: found {prefer!r}, expected one of {', '.join(PREFERENCES)}")
    return prefer


DETERMINED = 0.15
"""Contacts that move by less than this when their palm moves by 1 (turned [rad], or shifted by
`LENGTH`) do not say where it is. Those of all shipped hands with three fingers or more move by 0.17
at least."""

BEYOND = 1e-6
"""A posture may be so far beyond a limit [rad or m]; it is then at the limit."""


def hand_posture(robot: ArmHand, posture: Mapping[str, float], name: str = "posture") -> Array:
    """(n,) positions of all motors that move fingers; NaN for the others.

    Args:
        robot: The robot.
        posture: Position by actuator [rad or m].
        name: What to call it in an error.

    Raises:
        UnknownNameError: No such actuator.
        InputError: One that is missing or moves no finger, or not a number within limits.
    """
    motors = robot.description.finger_motors
    values = np.full(len(robot.actuators), np.nan)
    for key, value in posture.items():
        if key not in motors:
            error = InputError if key in robot.actuators else UnknownNameError
            found = "moves no finger" if key in robot.actuators else "no such actuator"
            raise error(f"{name}.{key}: {found}, expected {', '.join(motors)}")
        i = robot.actuators.index(key)
        low, high = robot.lower[i], robot.upper[i]
        number = isinstance(value, (int, float, np.integer, np.floating))
        if not (number and low - BEYOND <= value <= high + BEYOND):
            raise InputError(
                f"{name}.{key}: found {value!r}, expected a number from {low:g} to {high:g}"
            )
        values[i] = min(max(float(value), low), high)
    missing = [key for key in motors if key not in posture]
    if missing:
        raise InputError(f"{name}.{missing[0]}: missing, expected a number for every finger motor")
    return values


def postures_of(
    robot: ArmHand, postures: Sequence[Mapping[str, float]], name: str = "posture"
) -> Array:
    """(k, n) as `hand_posture` gives them, of many that name the same motors."""
    motors = robot.description.finger_motors
    columns = [robot.actuators.index(name) for name in motors]
    found = np.full((len(postures), len(robot.actuators)), np.nan)
    try:
        given = np.array([[posture[name] for name in motors] for posture in postures], dtype=float)
    except (KeyError, TypeError, ValueError):
        given = np.full((len(postures), len(motors)), np.nan)
    low, high = robot.lower[columns], robot.upper[columns]
    within = np.asarray(((given >= low - BEYOND) & (given <= high + BEYOND)).all(axis=1))
    found[:, columns] = np.clip(given, low, high)
    for row, posture in enumerate(postures):
        if not within[row] or len(posture) != len(motors):
            # Which says best what is wrong.
            found[row] = hand_posture(robot, posture, name.format(row))
    return found


def hand_postures(
    robot: ArmHand, postures: Mapping[str, ArrayLike] | ArrayLike, count: int
) -> Array:
    """(k, n) positions of all motors that move fingers; NaN for the others.

    Args:
        robot: The robot.
        postures: Positions (k,), or one for all, by actuator [rad or m]; or configurations (k, n)
            or (n,), of which the motors that move fingers count.
        count: k.

    Raises:
        UnknownNameError: No such actuator.
        InputError: As for `hand_posture`, or another number of positions; the message names the
            row.
    """
    if not isinstance(postures, Mapping):
        given = robot.configuration(postures, "postures")
        motors = [robot.actuators.index(name) for name in robot.description.finger_motors]
        postures = {robot.actuators[i]: given[..., i] for i in motors}
    columns: dict[str, Array] = {}
    for name, value in postures.items():
        try:
            columns[name] = np.broadcast_to(np.asarray(value, dtype=float), (count,))
        except (TypeError, ValueError) as error:
            raise InputError(f"postures.{name}: expected {count} numbers, or one") from error
    rows = range(count)
    every = [{name: float(column[row]) for name, column in columns.items()} for row in rows]
    return postures_of(robot, every, "postures: row {}")


def touched(robot: ArmHand, palms: Array, postures: Array) -> tuple[Array, Array, dict[str, Array]]:
    """Where fingertips are if hands of given postures have their palms at poses.

    Args:
        robot: The robot.
        palms: (k, 4, 4) poses of its palm frame in the base frame.
        postures: (k, n) as `hand_posture` gives them.

    Returns:
        Contact points (k, f, 3) [m] and normals (k, f, 3), base frame; and "tangents" (k, f, 3)
        where points and normals leave the palm free, as those of two opposed fingers do: NaN where
        they do not, no entry if they never do.
    """
    q = np.where(np.isnan(postures), robot.home, postures)
    points, normals = robot.contacts(q)
    here = robot.palm(q)
    turn = palms[:, :3, :3] @ np.swapaxes(here[:, :3, :3], 1, 2)
    back = np.swapaxes(turn, 1, 2)
    points = (points - here[:, None, :3, 3]) @ back + palms[:, None, :3, 3]
    normals = normals @ back
    free = _leave_free(points, normals)
    if not free.any():
        return points, normals, {}
    tangents = robot.contact_frames(q)[..., :3, 1] @ back
    return points, normals, {"tangents": np.where(free[:, None, None], tangents, np.nan)}


TURNS = np.cross(np.eye(3)[:, None], np.eye(3)[None])
"""`v @ TURNS[i]` is the cross product of axis i with v."""


def _leave_free(points: Array, facing: Array) -> NDArray[np.bool_]:
    """(k,) whether points (k, f, 3) [m] and directions (k, m, 3) leave the palm free; NaN: none."""
    placed, known = (~np.isnan(vectors[..., :1]) for vectors in (points, facing))
    count = np.maximum(placed.sum(axis=1, keepdims=True), 1)
    off = (points - np.nansum(points, axis=1, keepdims=True) / count) / LENGTH
    f = points.shape[1]
    moved = np.zeros((len(points), 6, f + facing.shape[1], 3))
    turned = np.where(np.concatenate([placed, known], axis=1), np.hstack([off, facing]), 0.0)
    for i, axis in enumerate(np.eye(3)):
        moved[:, i, :f] = axis * placed
        moved[:, 3 + i] = turned @ TURNS[i]
    rows = moved.reshape(len(points), 6, -1)
    return np.asarray(np.linalg.eigvalsh(rows @ np.swapaxes(rows, 1, 2))[:, 0] < DETERMINED**2)


def held_too(postures: Array, fixed: Array | None, actuators: Sequence[str]) -> Array:
    """(k, n) what is held by postures and by the caller.

    Raises:
        InputError: The caller holds a motor of the hand.
    """
    if fixed is None:
        return postures
    both = ~np.isnan(fixed) & ~np.isnan(postures).all(axis=0)
    if both.any():
        name = actuators[int(np.flatnonzero(both)[0])]
        raise InputError(f"fixed.{name}: the grasp's posture holds it already")
    return np.where(np.isnan(postures), fixed, postures)


@dataclass(frozen=True, eq=False)
class Request:
    """What all questions of a solver share.

    Attributes:
        robot: The robot.
        tolerances: By finger, in the robot's order.
        enforce_limits: Whether limits are part of being solved.
    """

    robot: ArmHand
    tolerances: Mapping[str, Tolerance]
    enforce_limits: bool

    def of_arrays(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        fixed: Array | None,
        first_row: int = 0,
        more: Mapping[str, ArrayLike | None] | None = None,
        prefer: str = "limits",
    ) -> TargetBatch:
        """Targets as arrays.

        Args:
            points: (k, f, 3) [m].
            normals: (k, f, 3).
            fixed: See `TargetBatch`.
            first_row: Number of the first target.
            more: (k, f, 3) what contacts have beside, see `check_extra_vectors`; and directions.
            prefer: See `TargetBatch`.

        Raises:
            InputError: See `target_arrays` and `check_extra_vectors`.
        """
        named = dict(more or {})
        directions = named.pop(DIRECTIONS_KEY, None)
        p, n = target_arrays(points, normals, len(self.robot.fingers), first_row, directions)
        warn_of_far_contacts(p, "points", self._base_travel)
        tolerances = tuple(self.tolerances.values())
        others = check_extra_vectors(named, p, n, first_row) if named else {}
        return TargetBatch(
            p, n, tolerances, self.enforce_limits, first_row, fixed, others, prefer=prefer
        )

    def of_named(
        self,
        arrays: Mapping[str, ArrayLike],
        fixed: Array | None,
        first_row: int = 0,
        prefer: str = "limits",
    ) -> TargetBatch:
        """Targets as arrays by name, see `of_arrays`: points, normals, and what else there is.

        Raises:
            InputError: See `of_arrays`.
        """
        more = dict(arrays)
        points, normals = more.pop("points"), more.pop("normals")
        return self.of_arrays(points, normals, fixed, first_row, more, prefer)

    def of_grasps(
        self,
        grasps: Sequence[Grasp],
        fixed: Mapping[str, float] | None,
        prefer: str = "limits",
        free: bool = False,
    ) -> TargetBatch:
        """Grasps, at least one, that share the tolerances of the first.

        Args:
            grasps: The grasps.
            fixed: Held actuators by name.
            prefer: See `TargetBatch`.
            free: Whether their object may have a `Free` pose.

        Raises:
            InputError: Something else than a grasp, one with a finger that the robot has not, one
                whose palms are of other sides, or see `held`.
        """
        fingers = self.robot.fingers
        for grasp in grasps:
            if not isinstance(grasp, Grasp):
                raise InputError(f"grasp: found {type(grasp).__name__}, expected a Grasp")
        if not free and any(isinstance(grasp.object_pose, Free) for grasp in grasps):
            raise InputError("object_pose: found a Free pose, which only Solver.solve looks for")
        if len(self.robot.sides) == 1:
            (side,) = self.robot.sides
            grasps = [
                grasp if grasp.one_palm is None else replace(grasp, palm={side: grasp.one_palm})
                for grasp in grasps
            ]
        if any(isinstance(grasp.palm, Mapping) for grasp in grasps):
            grasps, held = self._with_palms_met(grasps)
            targets = self.of_grasps(grasps, None, prefer, free)
            given = self.held(fixed) if fixed else None
            return replace(targets, fixed=held_too(held, given, self.robot.actuators))
        if any(grasp.palm is not None for grasp in grasps):
            return self._of_palm_grasps(grasps, fixed, prefer)
        # Contacts are checked when they are made.
        arrays = [grasp.arrays(fingers) for grasp in grasps]
        more = [grasp.more(fingers) for grasp in grasps]
        own, tolerances = grasps[0].contacts, self._usual
        if any(contact.tolerance for contact in own.values()):
            usual = self.tolerances
            tolerances = tuple(
                (own[name].tolerance if name in own else None) or usual[name] for name in fingers
            )
        # A new dimension costs nothing; one grasp is solved in the time that joining some takes.
        points, normals = (
            (arrays[0][0][None], arrays[0][1][None])
            if len(arrays) == 1
            else (np.array(both) for both in zip(*arrays, strict=True))
        )
        warn_of_far_contacts(points, grasps[0].name or "contacts", self._base_travel)
        return TargetBatch(
            points,
            normals,
            tolerances,
            self.enforce_limits,
            fixed=self.held(fixed) if fixed else None,
            more=_stacked(more, len(fingers)) if any(more) else {},
            prefer=prefer,
            object=grasps[0].object,
            object_pose=_object_poses(grasps),
        )

    def _of_palm_grasps(
        self, grasps: Sequence[Grasp], fixed: Mapping[str, float] | None, prefer: str
    ) -> TargetBatch:
        palms = [grasp.one_palm for grasp in grasps if grasp.one_palm is not None]
        if len(palms) < len(grasps):
            raise InputError("grasps: found palms and contacts, expected the same in all")
        if self.robot.description.sides:
            names = ", ".join(side.name for side in self.robot.description.sides)
            raise InputError(
                f"palm: found one pose, expected one by side (palms in a file): {names}"
            )
        postures = postures_of(self.robot, [grasp.posture for grasp in grasps])
        targets = self.of_palms(np.stack(palms), postures, fixed, prefer)
        named, poses = grasps[0].object, _object_poses(grasps)
        return replace(targets, object=named, object_pose=poses)

    def _with_palms_met(self, grasps: Sequence[Grasp]) -> tuple[list[Grasp], Array]:
        """Contacts instead of palms by side, and (k, n) what hands take, NaN for other motors."""
        robot, made = self.robot, list[Grasp]()
        held = np.full((len(grasps), len(robot.actuators)), np.nan)
        for row, grasp in enumerate(grasps):
            if not isinstance(grasp.palm, Mapping):
                raise InputError("grasps: found palms by side and others, expected the same in all")
            contacts = dict[str, Contact]()
            motors = {name: i for i, name in enumerate(robot.actuators)}
            wanted = set[str]()
            for name, pose in grasp.palm.items():
                if name not in self._sides:
                    known = ", ".join(self._sides) or "none"
                    raise InputError(f"palm.{name}: no such side; the robot's sides: {known}")
                hand = self._sides[name]
                own = {
                    motor: grasp.posture[motor]
                    for motor in hand.actuators
                    if motor in grasp.posture
                }
                posture = hand_posture(hand, own)
                points, normals, more = touched(hand, pose[None], posture[None])
                tangents = more.get("tangents", [[None] * len(hand.fingers)])[0]
                contacts |= {
                    finger: Contact(points[0, i], normals[0, i], tangent=tangents[i])
                    for i, finger in enumerate(hand.fingers)
                }
                wanted |= set(own)
                for motor, value in zip(hand.actuators, posture, strict=True):
                    held[row, motors[motor]] = value
            extra = sorted(set(grasp.posture) - wanted)
            if extra:
                raise InputError(
                    f"posture.{extra[0]}: found it, expected motors of hands with palms"
                )
            made.append(replace(grasp, palm=None, posture={}, contacts=contacts))
        return made, held

    @cached_property
    def _sides(self) -> dict[str, ArmHand]:
        body = self.robot.description
        return {side.name: ArmHand(body.side(side.name)) for side in body.sides}

    def of_palms(
        self,
        palms: ArrayLike,
        postures: Array,
        fixed: Mapping[str, float] | None,
        prefer: str = "limits",
    ) -> TargetBatch:
        """Palms that are given with the postures of their hands: only the arm is unknown.

        Args:
            palms: (k, 4, 4) poses of the robot's palm frame in the base frame.
            postures: (k, n) as `hand_posture` gives them.
            fixed: Other held actuators by name.
            prefer: See `TargetBatch`.

        Raises:
            InputError: No rigid motions, or a motor of the hand among the held ones.
        """
        poses = checked_pose(palms, "palms")
        points, normals, more = touched(self.robot, poses, postures)
        held = held_too(postures, self.held(fixed) if fixed else None, self.robot.actuators)
        return TargetBatch(
            points,
            normals,
            self._usual,
            self.enforce_limits,
            fixed=held,
            more=more,
            prefer=prefer,
            palms=poses,
        )

    @cached_property
    def _base_travel(self) -> float:
        """Distance that the robot's sliding motors go together [m]."""
        motors = self.robot.description.actuators
        ends = [max(abs(one.lower), abs(one.upper)) for one in motors if one.unit == "m"]
        return float(sum(ends))

    @cached_property
    def _usual(self) -> tuple[Tolerance, ...]:
        return tuple(self.tolerances.values())

    def held(self, fixed: Mapping[str, float] | None) -> Array | None:
        """Return held actuators as an array; see `fixed_array`."""
        robot = self.robot
        return fixed_array(fixed or {}, robot.actuators, *robot.description.stops)

    def start(self, q0: ArrayLike | None, name: str = "q0") -> Array:
        """One configuration (n,) to start from; None is the robot's home.

        Raises:
            InputError: Not one configuration; the message has its name.
        """
        start = self.robot.start(q0, name)
        if start.ndim != 1:
            raise InputError(f"{name}: found shape {start.shape}, expected ({len(start[0])},)")
        return start


def _object_poses(grasps: Sequence[Grasp]) -> Array | None:
    """(k, 4, 4) where grasps have their object; None unless all say it, of the same object."""
    if len(grasps) == 1:
        pose = grasps[0].known_pose
        return None if pose is None else pose[None]
    if len({grasp.object for grasp in grasps}) > 1:
        return None
    poses = [grasp.known_pose for grasp in grasps if grasp.known_pose is not None]
    return np.stack(poses) if poses and len(poses) == len(grasps) else None


def _stacked(parts: Sequence[Mapping[str, Array]], f: int) -> dict[str, Array]:
    """(k, f, 3) arrays of what grasps have beside points and normals; NaN where they have none."""
    none = np.full((f, 3), np.nan)
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: np.array([part.get(name, none) for part in parts]) for name in names}


def tolerances_by_finger(
    tolerance: Tolerance | Mapping[str, Tolerance] | None, fingers: Sequence[str]
) -> dict[str, Tolerance]:
    """The tolerance of every finger; what is not said is the default.

    Raises:
        InputError: No tolerance, or one for a finger that is not among them.
    """
    if tolerance is None or isinstance(tolerance, Tolerance):
        if tolerance is not None:
            warn_of_wide_tolerance(tolerance.position, tolerance.angle)
        return dict.fromkeys(fingers, tolerance or Tolerance())
    if not isinstance(tolerance, Mapping):
        raise InputError(f"tolerance: found {tolerance!r}, expected a Tolerance, or one by finger")
    for name, one in tolerance.items():
        if name not in fingers:
            raise InputError(
                f"tolerance.{name}: no such finger; the robot's fingers: {', '.join(fingers)}"
            )
        if not isinstance(one, Tolerance):
            raise InputError(f"tolerance.{name}: found {one!r}, expected a Tolerance")
        warn_of_wide_tolerance(one.position, one.angle, f"tolerance.{name}")
    return {name: tolerance.get(name, Tolerance()) for name in fingers}
