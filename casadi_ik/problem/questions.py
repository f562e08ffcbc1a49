"""How a solver's questions become problems: grasps or arrays, tolerances, limits, what is held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.grasps import Grasp, Tolerance
from casadi_ik.grasps.pose import checked_pose
from casadi_ik.problem.contacts.arrays import more_arrays
from casadi_ik.problem.palm_targets import held_too, postures_of, touched
from casadi_ik.problem.problems import DIRECTIONS, Problems, fixed_array, target_arrays


@dataclass(frozen=True, eq=False)
class Questions:
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
    ) -> Problems:
        """Targets as arrays.

        Args:
            points: (k, f, 3) [m].
            normals: (k, f, 3).
            fixed: See `Problems`.
            first_row: Number of the first target.
            more: (k, f, 3) what contacts have beside, see `more_arrays`; and directions.
            prefer: See `Problems`.

        Raises:
            InputError: See `target_arrays` and `more_arrays`.
        """
        named = dict(more or {})
        directions = named.pop(DIRECTIONS, None)
        p, n = target_arrays(points, normals, len(self.robot.fingers), first_row, directions)
        tolerances = tuple(self.tolerances.values())
        others = more_arrays(named, p, n, first_row) if named else {}
        return Problems(
            p, n, tolerances, self.enforce_limits, first_row, fixed, others, prefer=prefer
        )

    def of_named(
        self,
        arrays: Mapping[str, ArrayLike],
        fixed: Array | None,
        first_row: int = 0,
        prefer: str = "limits",
    ) -> Problems:
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
    ) -> Problems:
        """Grasps, at least one, that share the tolerances of the first.

        Args:
            grasps: The grasps.
            fixed: Held actuators by name.
            prefer: See `Problems`.

        Raises:
            InputError: Something else than a grasp, one with a finger that the robot has not, or
                see `held`.
        """
        fingers = self.robot.fingers
        for grasp in grasps:
            if not isinstance(grasp, Grasp):
                raise InputError(f"grasp: found {type(grasp).__name__}, expected a Grasp")
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
        return Problems(
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
    ) -> Problems:
        palms = [grasp.palm for grasp in grasps if grasp.palm is not None]
        if len(palms) < len(grasps):
            raise InputError("grasps: found palms and contacts, expected the same in all")
        postures = postures_of(self.robot, [grasp.posture for grasp in grasps])
        problems = self.of_palms(np.stack(palms), postures, fixed, prefer)
        named, poses = grasps[0].object, _object_poses(grasps)
        return replace(problems, object=named, object_pose=poses)

    def of_palms(
        self,
        palms: ArrayLike,
        postures: Array,
        fixed: Mapping[str, float] | None,
        prefer: str = "limits",
    ) -> Problems:
        """Palms that are given with the postures of their hands: only the arm is unknown.

        Args:
            palms: (k, 4, 4) poses of the robot's palm frame in the base frame.
            postures: (k, n) as `hand_posture` gives them.
            fixed: Other held actuators by name.
            prefer: See `Problems`.

        Raises:
            InputError: No rigid motions, or a motor of the hand among the held ones.
        """
        poses = checked_pose(palms, "palms")
        points, normals, more = touched(self.robot, poses, postures)
        held = held_too(postures, self.held(fixed) if fixed else None, self.robot.actuators)
        return Problems(
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
    def _usual(self) -> tuple[Tolerance, ...]:
        return tuple(self.tolerances.values())

    def held(self, fixed: Mapping[str, float] | None) -> Array | None:
        """Held actuators as an array; see `fixed_array`."""
        robot = self.robot
        return fixed_array(fixed or {}, robot.actuators, robot.lower, robot.upper)

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
        pose = grasps[0].object_pose
        return None if pose is None else pose[None]
    if len({grasp.object for grasp in grasps}) > 1:
        return None
    poses = [grasp.object_pose for grasp in grasps if grasp.object_pose is not None]
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
    return {name: tolerance.get(name, Tolerance()) for name in fingers}
