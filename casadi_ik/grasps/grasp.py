"""Contacts and grasps: where each fingertip must touch and which way it must face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError
from casadi_ik.grasps.arrays import real_array, unit_vectors
from casadi_ik.grasps.tolerance import Tolerance

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Contact:
    """Where one fingertip must touch, in the robot's base frame.

    Attributes:
        point: (3,) contact point [m].
        normal: (3,) outward pad normal of the fingertip: it points out of the fingertip, into the
            object. Any length but zero, stored as a unit vector. None leaves it free.
        tolerance: When it counts as reached, or None: the solver's tolerance.

    Raises:
        InputError: A wrong shape, a number that is not finite, a zero normal, or a tolerance that
            is none.
    """

    point: Array
    normal: Array | None = None
    tolerance: Tolerance | None = None

    def __init__(
        self,
        point: ArrayLike,
        normal: ArrayLike | None = None,
        tolerance: Tolerance | None = None,
    ) -> None:
        if tolerance is not None and not isinstance(tolerance, Tolerance):
            raise InputError(f"tolerance: found {tolerance!r}, expected a Tolerance")
        object.__setattr__(self, "point", _vector(point, "point"))
        object.__setattr__(self, "tolerance", tolerance)
        if normal is None:
            return
        vector = _vector(normal, "normal")
        vector, zero = unit_vectors(vector)
        if zero:
            raise InputError("normal: found [0, 0, 0], expected a direction, not zero")
        vector.flags.writeable = False
        object.__setattr__(self, "normal", vector)


@dataclass(frozen=True, eq=False)
class Grasp:
    """A contact per finger; a finger left out is free.

    Attributes:
        contacts: Contact by finger name.
        robot: Name (or path) of the robot the grasp was made for; "" if not said.
        name: What it is called, for reports.
        object: Name of the shipped object it grasps; "" if not said.
        object_pose: (4, 4) pose of that object in the base frame, or None.
        posture: A hand posture by actuator that realises the contacts, where one is known.

    Raises:
        InputError: No contact at all.
    """

    contacts: Mapping[str, Contact]
    robot: str = ""
    name: str = ""
    object: str = ""
    object_pose: Array | None = None
    posture: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.contacts:
            raise InputError("contacts: empty, expected at least one finger")
        for finger, contact in self.contacts.items():
            if not isinstance(contact, Contact):
                raise InputError(
                    f"contacts.{finger}: found {type(contact).__name__}, expected a Contact"
                )
        object.__setattr__(self, "contacts", MappingProxyType(dict(self.contacts)))

    def __reduce__(self) -> tuple[type[Grasp], tuple[Any, ...]]:
        """Its fields; the mapping that cannot be changed is made anew."""
        held = self.robot, self.name, self.object, self.object_pose, dict(self.posture)
        return type(self), (dict(self.contacts), *held)

    def arrays(self, fingers: Sequence[str]) -> tuple[Array, Array]:
        """Points and normals in the order of the given fingers.

        Args:
            fingers: The robot's fingers.

        Returns:
            points (f, 3) [m] and normals (f, 3); NaN marks what is free.

        Raises:
            InputError: The grasp has a contact for a finger that is not among them.
        """
        for name in self.contacts:
            if name not in fingers:
                raise InputError(
                    f"contacts.{name}: no such finger; the robot's fingers: {', '.join(fingers)}"
                )
        points, normals = np.empty((len(fingers), 3)), np.empty((len(fingers), 3))
        for row, finger in enumerate(fingers):
            contact = self.contacts.get(finger)
            known = contact is not None
            points[row] = contact.point if known else np.nan
            normals[row] = contact.normal if known and contact.normal is not None else np.nan
        return points, normals


def _vector(value: Any, name: str) -> Array:
    try:
        array = real_array(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: found {value!r}, expected three numbers") from error
    if array.shape != (3,):
        raise InputError(f"{name}: found shape {array.shape}, expected (3,)")
    if not np.all(np.isfinite(array)):
        raise InputError(f"{name}: found {array.tolist()}, expected finite numbers")
    array.flags.writeable = False
    return array
