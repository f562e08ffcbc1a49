"""Contacts and grasps: target points and orientations of fingertips, or palm poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array, Bools, read_only
from casadi_ik.files.input_checks import (
    MAX_SKEW,
    checked_mapping,
    single_pose,
    warn_of_wide_tolerance,
)
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.model.pose import Free, inverse

MIN_TOLERANCE = 1e-15
"""Smallest tolerance [m or rad]: errors of configurations are rounded to about 1e-16."""


@dataclass(frozen=True)
class Tolerance:
    """Largest errors of a contact that counts as reached.

    Attributes:
        position: Distance of the contact point [m].
        angle: Angle of the pad normal [rad].

    Raises:
        InputError: A value is not a finite number of at least `MIN_TOLERANCE`.

    Example:
        >>> ik.Tolerance(position=1e-3, angle=np.deg2rad(1)).position
        0.001
    """

    position: float = 5e-3
    angle: float = math.radians(3.0)

    def __post_init__(self) -> None:
        for name, value in (("position", self.position), ("angle", self.angle)):
            is_number = isinstance(value, (int, float)) and math.isfinite(value)
            if not (is_number and value >= MIN_TOLERANCE):
                expected = (
                    f"a number >= {MIN_TOLERANCE:g}" if is_number and value > 0 else "a number > 0"
                )
                raise InputError(f"tolerance.{name}: found {value!r}, expected {expected}")


UNIT_ROUNDING = 1e-15
"""Largest difference from length 1 of a vector that is not normalised again."""

MIN_PLAIN_LENGTH, MAX_PLAIN_LENGTH = 1e-100, 1e100
"""Bounds of lengths whose squares neither underflow nor overflow."""


def real_array(value: Any) -> Array:
    """Return a new array of real numbers.

    Raises:
        ValueError: The value is text, complex (its imaginary part would be lost) or masked (its
            mask would be lost).
        TypeError: The value cannot be converted.
    """
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError("array is masked; expected NaN for free numbers")
    array = np.array(value)
    if array.dtype.kind == "c":
        raise ValueError("array is complex")
    return array if array.dtype == np.float64 else np.array(value, dtype=np.float64)


def unit_vectors(vectors: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Normalise vectors of any length, from the smallest number to the largest.

    Args:
        vectors: (..., 3); NaN gives NaN.

    Returns:
        Unit vectors, and a mask (...) of vectors that are zero, which give NaN. Vectors of unit
        length up to rounding are not changed.
    """
    with np.errstate(over="ignore", under="ignore"):
        length = _length(vectors)
    is_extreme = (length < MIN_PLAIN_LENGTH) | (length > MAX_PLAIN_LENGTH)
    if is_extreme.any():
        # Scaling by a power of two is exact. It is split because the factor may be out of range.
        power = np.where(is_extreme, -np.frexp(np.abs(vectors).max(axis=-1))[1], 0)[..., None]
        vectors = np.ldexp(np.ldexp(vectors, power // 2), power - power // 2)
        length = _length(vectors)
    length = np.where(np.abs(length - 1) < UNIT_ROUNDING, 1.0, length)
    zero = length == 0
    return vectors / np.where(zero, np.nan, length)[..., None], zero


def _length(vectors: Array) -> Array:
    """Return lengths (...); the order of summation is that of an exported solver."""
    squares = vectors * vectors
    return np.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])


EXTRA_VECTORS: Mapping[str, str] = {
    "tangent": "where the contact frame's second axis must point, orthogonal to the normal",
    "line": "the contact may be anywhere on the line through the point in this direction",
    "plane": "the contact may be anywhere on the plane through the point with this normal",
    "ball": "the pad's ball touches the point with the spot whose outward normal is this vector",
}
"""Vectors of a contact besides point and normal, by name; names of arrays add an s."""

POINT_CONSTRAINTS = ("line", "plane", "ball")
"""Vectors that relax or move the contact point; a contact has at most one of them."""


def invalid_reason(vectors: Mapping[str, Array]) -> str | None:
    """Return why the vectors of one contact are invalid; None if they are valid.

    Args:
        vectors: Vectors by name: "point" [m] and unit vectors; free ones are absent.
    """
    for name in EXTRA_VECTORS:
        if name in vectors and "point" not in vectors:
            return f"{name}: is given without a point; expected both"
    constraints = [name for name in POINT_CONSTRAINTS if name in vectors]
    if len(constraints) > 1:
        return f"{' and '.join(constraints[:2])}: found both, expected one of them"
    if "tangent" not in vectors:
        return None
    if "normal" not in vectors:
        return "tangent: is given without a normal; expected both"
    cosine = float(vectors["tangent"] @ vectors["normal"])
    if not abs(cosine) <= MAX_SKEW:
        degrees = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return (
            f"tangent: found {np.round(vectors['tangent'], 6).tolist()} at {degrees:.4g} deg to "
            "the normal, expected 90 deg"
        )
    return None


def invalid_mask(vectors: Mapping[str, Array]) -> Bools:
    """Return a mask of the contacts for which `invalid_reason` returns a reason.

    Args:
        vectors: (..., 3) arrays by name of all contacts; NaN where free.
    """
    present = {name: ~np.isnan(array[..., 0]) for name, array in vectors.items()}
    invalid = np.zeros_like(present["point"])
    for name in EXTRA_VECTORS:
        if name in present:
            invalid |= present[name] & ~present["point"]
    constraints = [present[name] for name in POINT_CONSTRAINTS if name in present]
    if constraints:
        invalid |= np.sum(constraints, axis=0) > 1
    if "tangent" in present:
        cosine = np.einsum("...i,...i->...", vectors["tangent"], vectors["normal"])
        invalid |= present["tangent"] & ~(np.abs(cosine) <= MAX_SKEW)
    return invalid


def orthogonal_tangents(tangent: Array, normal: Array) -> Array:
    """Return unit tangents (..., 3) with the component along the normals removed."""
    projected = tangent - normal * np.einsum("...i,...i->...", normal, tangent)[..., None]
    return projected / np.sqrt(np.einsum("...i,...i->...", projected, projected))[..., None]


FREE_VECTOR = np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class Contact:
    """Target contact of one fingertip, in the robot's base frame.

    Attributes:
        point: (3,) contact point [m].
        normal: (3,) outward pad normal of the fingertip: it points out of the fingertip, into the
            object. Any length but zero, stored as a unit vector. None if free.
        tolerance: Tolerance of this contact; None: the solver's tolerance.
        tangent: (3,) direction of the second axis of the contact frame (`ArmHand.contact_frames`),
            orthogonal to the normal, which fixes the pose of the fingertip. None if the rotation
            about the normal is free.
        line: (3,) direction of a line through the point on which the contact may be anywhere.
        plane: (3,) normal of a plane through the point in which the contact may be anywhere.
        ball: (3,) outward normal, into the object, of the pad's ball where it touches the point.
            The pad may roll over the point unless a normal is given; a pad without a ball in the
            robot's description touches with its contact point.

    ``Contact(direction=...)`` is a direction alone, for a fingertip that may be anywhere: its point
    is NaN and its normal is the direction.

    Raises:
        InputError: A shape or tolerance is wrong, a number is not finite, a direction is zero, or
            the tangent is not orthogonal to the normal.

    Example:
        >>> contact = ik.Contact([0.5, 0.1, 0.6], normal=[0, -2, 0])
        >>> print(contact.normal)
        [ 0. -1.  0.]
        >>> sliding = ik.Contact([0.5, 0.1, 0.6], line=[0, 0, 1])  # anywhere on a vertical line
    """

    point: Array
    normal: Array | None = None
    tolerance: Tolerance | None = None
    tangent: Array | None = None
    line: Array | None = None
    plane: Array | None = None
    ball: Array | None = None

    def __init__(
        self,
        point: ArrayLike | None = None,
        normal: ArrayLike | None = None,
        tolerance: Tolerance | None = None,
        *,
        tangent: ArrayLike | None = None,
        line: ArrayLike | None = None,
        plane: ArrayLike | None = None,
        ball: ArrayLike | None = None,
        direction: ArrayLike | None = None,
    ) -> None:
        if tolerance is not None and not isinstance(tolerance, Tolerance):
            raise InputError(f"tolerance: found {tolerance!r}, expected a Tolerance")
        if tolerance is not None:
            warn_of_wide_tolerance(tolerance.position, tolerance.angle)
        object.__setattr__(self, "tolerance", tolerance)
        inputs = {"normal": normal, "tangent": tangent, "line": line, "plane": plane, "ball": ball}
        if direction is not None:
            names = [
                name for name, value in {"point": point, **inputs}.items() if value is not None
            ]
            if names:
                raise InputError(f"direction: is given together with {names[0]}; expected it alone")
            object.__setattr__(self, "point", read_only(np.full(3, np.nan)))
            object.__setattr__(self, "normal", _unit(direction, "direction"))
            return
        if point is None:
            raise InputError("point: missing, expected three numbers (or a direction alone)")
        vectors = {"point": _vector(point, "point")}
        vectors |= {name: _unit(v, name) for name, v in inputs.items() if v is not None}
        problem = invalid_reason(vectors)
        if problem:
            raise InputError(problem)
        if "tangent" in vectors:
            vectors["tangent"] = read_only(
                orthogonal_tangents(vectors["tangent"], vectors["normal"])
            )
        for name, vector in vectors.items():
            object.__setattr__(self, name, vector)

    @classmethod
    def from_pose(cls, pose: ArrayLike) -> Contact:
        """Return a contact that constrains the whole pose of a fingertip.

        The point is the pose's origin, the normal its first axis and the tangent its second, as in
        `ArmHand.contact_frames`.

        Args:
            pose: (4, 4) pose of the contact frame.

        Raises:
            InputError: The pose is not a rigid motion.

        Example:
            >>> contact = ik.Contact.from_pose(np.eye(4))
            >>> print(contact.normal, contact.tangent)
            [1. 0. 0.] [0. 1. 0.]
        """
        motion = single_pose(pose)
        return cls(motion[:3, 3], motion[:3, 0], tangent=motion[:3, 1])

    def transformed(self, pose: ArrayLike) -> Contact:
        """Return the contact transformed from a frame into the base frame.

        Args:
            pose: (4, 4) pose of the frame in which this contact is given.

        Raises:
            InputError: The pose is not a rigid motion.

        Example:
            >>> pose = np.eye(4)
            >>> pose[:3, 3] = [1.0, 0.0, 0.0]
            >>> print(ik.Contact([0.0, 0.0, 0.5]).transformed(pose).point)
            [1.  0.  0.5]
        """
        motion = single_pose(pose)
        rotation = motion[:3, :3]
        if not np.isfinite(self.point).all():
            assert self.normal is not None
            return Contact(direction=rotation @ self.normal, tolerance=self.tolerance)
        vectors = {name: getattr(self, name) for name in ("normal", *EXTRA_VECTORS)}
        rotated = {name: rotation @ v for name, v in vectors.items() if v is not None}
        return Contact(rotation @ self.point + motion[:3, 3], tolerance=self.tolerance, **rotated)

    def at(self: Any, pose: ArrayLike | None = None) -> Contact:
        """Return `transformed(pose)`, or `from_pose(pose)` if called on the class; deprecated."""
        if pose is not None:
            warn_renamed("Contact.at", "Contact.transformed")
            return self.transformed(pose)
        warn_renamed("Contact.at", "Contact.from_pose")
        return Contact.from_pose(self)  # `self` is the pose in a call on the class


@dataclass(frozen=True, eq=False)
class Grasp:
    """A contact for each finger (omitted fingers are free), or a palm pose and a hand posture.

    Attributes:
        contacts: Contact by finger name; empty for a palm pose.
        robot: Name (or path) of the robot the grasp was made for; "" if unknown.
        name: Name of the grasp, for reports.
        object: Name of the shipped object it grasps; "" if unknown.
        object_pose: (4, 4) pose of that object in the base frame, or None. `Solver.solve`
            determines a `Free` pose; contacts are then in the object's frame.
        posture: Hand posture by actuator that realises the contacts, if known [rad or m]; with a
            palm, the posture to take, with a number for every motor that moves a finger.
        palm: (4, 4) pose of the robot's palm frame in the base frame, with which only the arm is
            solved for; for a multi-arm robot a mapping from side to pose; hands of other sides do
            not move. None: contacts determine the palm.
        pregrasp: Palm and posture before the hand closes, if known.
        squeeze: Palm and posture of the squeezing hand, if known.

    Raises:
        InputError: There is no contact, or a palm is not a rigid motion, has no posture or is given
            together with contacts.

    Example:
        >>> pinch = ik.Grasp(
        ...     {
        ...         "thumb": ik.Contact([-0.83, 0.15, 0.41], [0.48, -0.88, 0.0]),
        ...         "finger_2": ik.Contact([-0.84, 0.11, 0.435], [0.72, 0.70, 0.0]),
        ...     }
        ... )
        >>> solver.solve(pinch).success
        True
    """

    contacts: Mapping[str, Contact] = field(default_factory=dict)
    robot: str = ""
    name: str = ""
    object: str = ""
    object_pose: Array | Free | None = None
    posture: Mapping[str, float] = field(default_factory=dict)
    palm: Array | Mapping[str, Array] | None = None
    pregrasp: Grasp | None = None
    squeeze: Grasp | None = None

    def __post_init__(self) -> None:
        checked_mapping(self.contacts, "contacts", "from fingers to contacts")
        checked_mapping(self.posture, "posture", "from motors to positions")
        if self.palm is not None:
            object.__setattr__(self, "palm", _frozen_palms(self.palm))
            if self.contacts:
                raise InputError("palm: is given together with contacts; expected one of them")
            if not self.posture:
                raise InputError(
                    "posture: missing; expected one, because the grasp has a palm pose"
                )
        elif not self.contacts:
            raise InputError("contacts: found none, expected at least one finger, or a palm")
        for finger, contact in self.contacts.items():
            if not isinstance(contact, Contact):
                raise InputError(
                    f"contacts.{finger}: found {type(contact).__name__}, expected a Contact"
                )
        object.__setattr__(self, "contacts", MappingProxyType(dict(self.contacts)))

    def __reduce__(self) -> tuple[type[Grasp], tuple[Any, ...]]:
        """Return the fields; the read-only mapping is created again."""
        palm = dict(self.palm) if isinstance(self.palm, Mapping) else self.palm
        names = self.robot, self.name, self.object
        poses = self.object_pose, dict(self.posture), palm
        return type(self), (dict(self.contacts), *names, *poses, self.pregrasp, self.squeeze)

    def at(self, pose: ArrayLike) -> Grasp:
        """Return the grasp transformed by a pose, as from an object's frame into the base frame.

        ``grasp.at(a).at(b)`` is ``grasp.at(b @ a)``.

        Args:
            pose: (4, 4) pose, in the robot's base frame, of the frame in which the contacts are
                given.

        Returns:
            The grasp with contacts or palm, pregrasp, squeeze, and object pose in the base frame.

        Raises:
            InputError: The pose has another shape, a number that is not finite, or is not rigid.

        Example:
            >>> pose = np.eye(4)
            >>> pose[2, 3] = 0.01  # 1 cm higher
            >>> higher = grasp.at(pose)
            >>> print(np.round(higher.contacts["thumb"].point - grasp.contacts["thumb"].point, 6))
            [0.   0.   0.01]
        """
        motion = single_pose(pose)
        object_pose = self.object_pose
        if isinstance(object_pose, Free):
            object_pose = motion
        elif object_pose is not None:
            object_pose = motion @ object_pose
        elif self.object:
            object_pose = motion
        contacts = {
            finger: contact.transformed(motion) for finger, contact in self.contacts.items()
        }
        palm = self.palm
        if isinstance(palm, Mapping):
            palm = {side: motion @ side_pose for side, side_pose in palm.items()}
        elif palm is not None:
            palm = motion @ palm
        pregrasp, squeeze = (grasp and grasp.at(motion) for grasp in (self.pregrasp, self.squeeze))
        return replace(
            self,
            contacts=contacts,
            object_pose=object_pose,
            palm=palm,
            pregrasp=pregrasp,
            squeeze=squeeze,
        )

    @property
    def known_pose(self) -> Array | None:
        """Pose (4, 4) of the object; None if it is unknown or free."""
        return None if isinstance(self.object_pose, Free) else self.object_pose

    @property
    def single_palm(self) -> Array | None:
        """Palm pose (4, 4) of a single arm; None without a palm, or with palms by side."""
        return None if isinstance(self.palm, Mapping) else self.palm

    def in_object_frame(self) -> Grasp:
        """Return the grasp in the object's frame, the inverse of `at`.

        A grasp without an object pose is taken to be in the object's frame.

        Example:
            >>> seen = grasp.in_object_frame()
            >>> bool(np.allclose(seen.at(grasp.object_pose).contacts["thumb"].point,
            ...                  grasp.contacts["thumb"].point))
            True
        """
        return self if self.known_pose is None else self.at(inverse(self.known_pose))

    def arrays(self, fingers: Sequence[str]) -> tuple[Array, Array]:
        """Return points and normals in the order of the fingers.

        Args:
            fingers: The robot's fingers.

        Returns:
            points (f, 3) [m] and normals (f, 3); NaN marks free ones.

        Raises:
            InputError: The grasp has a contact for an unknown finger.

        Example:
            >>> points, normals = grasp.arrays(robot.fingers)
            >>> points.shape, normals.shape
            ((3, 3), (3, 3))
        """
        for name in self.contacts:
            if name not in fingers:
                raise InputError(
                    f"contacts.{name}: no such finger; the robot's fingers: {', '.join(fingers)}"
                )
        contacts = [self.contacts.get(finger) for finger in fingers]
        points = [FREE_VECTOR if contact is None else contact.point for contact in contacts]
        normals = [
            FREE_VECTOR if contact is None or contact.normal is None else contact.normal
            for contact in contacts
        ]
        return np.array(points), np.array(normals)

    def extra_vectors(self, fingers: Sequence[str]) -> dict[str, Array]:
        """Return the vectors of the contacts besides point and normal.

        Args:
            fingers: The robot's fingers.

        Returns:
            (f, 3) arrays by name ("tangents", "lines", "planes", "balls"), NaN where free; arrays
            that no contact has are omitted.

        Example:
            >>> grasp.extra_vectors(robot.fingers)  # this grasp has points and normals only
            {}
        """
        arrays: dict[str, Array] = {}
        for finger, contact in self.contacts.items():
            for name in EXTRA_VECTORS:
                vector = getattr(contact, name)
                if vector is not None:
                    rows = arrays.setdefault(f"{name}s", np.full((len(fingers), 3), np.nan))
                    rows[fingers.index(finger)] = vector
        return arrays

    def more(self, fingers: Sequence[str]) -> dict[str, Array]:
        """Return `extra_vectors(fingers)`; deprecated."""
        warn_renamed("Grasp.more", "Grasp.extra_vectors")
        return self.extra_vectors(fingers)


def _frozen_palms(palm: Any) -> Array | Mapping[str, Array]:
    """Return a palm pose, or the palm poses by side, as read-only arrays."""
    if not isinstance(palm, Mapping):
        return read_only(single_pose(palm, "palm").copy())
    if not palm:
        raise InputError("palm: found no side, expected a pose by side")
    items = palm.items()
    poses = {side: read_only(single_pose(p, f"palm.{side}").copy()) for side, p in items}
    return MappingProxyType(poses)


def _unit(value: Any, name: str) -> Array:
    """Return a vector of three numbers as a unit vector."""
    vector = _vector(value, name)
    x, y, z = vector.tolist()
    length = math.sqrt(x * x + y * y + z * z)
    # Same result as `unit_vectors`, whose arrays are slow for a single vector.
    if MIN_PLAIN_LENGTH < length < MAX_PLAIN_LENGTH:
        return vector if abs(length - 1) < UNIT_ROUNDING else read_only(vector / length)
    vector, zero = unit_vectors(vector)
    if zero:
        raise InputError(f"{name}: found [0.0, 0.0, 0.0], expected a direction, not zero")
    return read_only(vector)


def _vector(value: Any, name: str) -> Array:
    """Return three numbers as a read-only array."""
    try:
        array = real_array(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: found {value!r}, expected three numbers") from error
    if array.shape != (3,):
        raise InputError(f"{name}: found shape {array.shape}, expected (3,)")
    if not all(map(math.isfinite, array.tolist())):
        raise InputError(f"{name}: found {array.tolist()}, expected finite numbers")
    return read_only(array)
