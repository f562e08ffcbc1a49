"""Contacts and grasps: where each fingertip must touch and which way it must face."""

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
from casadi_ik.files.input_checks.poses import MAX_SKEW, single_pose
from casadi_ik.files.input_checks.units import warn_of_wide_tolerance
from casadi_ik.model.pose import Free, inverse


@dataclass(frozen=True)
class Tolerance:
    """Largest errors at which a contact is reached.

    Attributes:
        position: Distance of the contact point [m].
        angle: Angle of the pad normal [rad].

    Raises:
        InputError: Not a positive finite number.

    Example:
        >>> ik.Tolerance(position=1e-3, angle=np.deg2rad(1)).position
        0.001
    """

    position: float = 5e-3
    angle: float = math.radians(3.0)

    def __post_init__(self) -> None:
        for name, value in (("position", self.position), ("angle", self.angle)):
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0):
                raise InputError(f"tolerance.{name}: found {value!r}, expected a number > 0")


UNIT_ROUNDING = 1e-15
"""A vector whose length is so near to 1 has been normalised before."""

MIN_PLAIN_LENGTH, MAX_PLAIN_LENGTH = 1e-100, 1e100
"""Between these the squares of a length are neither rounded to zero nor infinite."""


def real_array(value: Any) -> Array:
    """A new array of real numbers.

    Raises:
        ValueError: Something else: text, complex numbers (whose imaginary part would be lost), or
            masked ones (whose mask would).
        TypeError: The same.
    """
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError("a masked array, expected plain numbers (NaN marks what is free)")
    array = np.array(value)
    if array.dtype.kind == "c":
        raise ValueError("complex numbers, expected real ones")
    return array if array.dtype == np.float64 else np.array(value, dtype=np.float64)


def unit_vectors(vectors: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Directions of any length, from the smallest number to the largest.

    Args:
        vectors: (..., 3); NaN gives NaN.

    Returns:
        Unit vectors, and (...) which of the vectors are zero (these give NaN). What is of unit
        length to the last digits stays as it is.
    """
    with np.errstate(over="ignore", under="ignore"):
        length = _length(vectors)
    odd = (length < MIN_PLAIN_LENGTH) | (length > MAX_PLAIN_LENGTH)
    if odd.any():
        # By powers of two, which change no digit; in two halves, as one may be out of range.
        power = np.where(odd, -np.frexp(np.abs(vectors).max(axis=-1))[1], 0)[..., None]
        vectors = np.ldexp(np.ldexp(vectors, power // 2), power - power // 2)
        length = _length(vectors)
    length = np.where(np.abs(length - 1) < UNIT_ROUNDING, 1.0, length)
    zero = length == 0
    return vectors / np.where(zero, np.nan, length)[..., None], zero


def _length(vectors: Array) -> Array:
    """(...), summed in order: the same bits in an exported solver."""
    squares = vectors * vectors
    return np.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])


EXTRA_VECTORS: Mapping[str, str] = {
    "tangent": "where the contact frame's second axis must point, across the normal",
    "line": "the contact may be anywhere on the line through the point in this direction",
    "plane": "the contact may be anywhere on the plane through the point with this normal",
    "ball": "the pad's ball touches the point where its outward normal is this one",
}
"""What a contact may have beside point and normal, by name; arrays have an s at the end."""

POINT_CONSTRAINTS = ("line", "plane", "ball")
"""Those that say where the point is touched: a contact has one at most."""


def invalid_reason(vectors: Mapping[str, Array]) -> str | None:
    """What is wrong with the vectors of one contact: the first line of it, or None.

    Args:
        vectors: By name; "point" [m] and unit vectors, absent if free.
    """
    for name in EXTRA_VECTORS:
        if name in vectors and "point" not in vectors:
            return f"{name}: found one without a point, expected both"
    places = [name for name in POINT_CONSTRAINTS if name in vectors]
    if len(places) > 1:
        return f"{' and '.join(places[:2])}: found both, expected one of them"
    if "tangent" not in vectors:
        return None
    if "normal" not in vectors:
        return "tangent: found one without a normal, expected both"
    cosine = float(vectors["tangent"] @ vectors["normal"])
    if not abs(cosine) <= MAX_SKEW:
        degrees = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return (
            f"tangent: found {np.round(vectors['tangent'], 6).tolist()} at {degrees:.4g} deg to "
            "the normal, expected 90 deg"
        )
    return None


def invalid_mask(vectors: Mapping[str, Array]) -> Bools:
    """Which contacts `invalid_reason` has something to say about, all at once.

    Args:
        vectors: (..., 3) by name, as there, of all contacts; NaN where free.
    """
    given = {name: ~np.isnan(array[..., 0]) for name, array in vectors.items()}
    bad = np.zeros_like(given["point"])
    for name in EXTRA_VECTORS:
        if name in given:
            bad |= given[name] & ~given["point"]
    places = [given[name] for name in POINT_CONSTRAINTS if name in given]
    if places:
        bad |= np.sum(places, axis=0) > 1
    if "tangent" in given:
        cosine = np.einsum("...i,...i->...", vectors["tangent"], vectors["normal"])
        bad |= given["tangent"] & ~(np.abs(cosine) <= MAX_SKEW)
    return bad


def orthogonal_tangents(tangent: Array, normal: Array) -> Array:
    """Tangents (..., 3) without what rounding left of them along the normals, unit."""
    across = tangent - normal * np.einsum("...i,...i->...", normal, tangent)[..., None]
    return across / np.sqrt(np.einsum("...i,...i->...", across, across))[..., None]


FREE_VECTOR = np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class Contact:
    """Desired contact of one fingertip, in the robot's base frame.

    Attributes:
        point: (3,) contact point [m].
        normal: (3,) outward pad normal of the fingertip: it points out of the fingertip, into the
            object. Any length but zero, stored as a unit vector. None leaves it free.
        tolerance: When it counts as reached, or None: the solver's tolerance.
        tangent: (3,) where the second axis of the contact frame must point
            (`ArmHand.contact_frames`), orthogonal to the normal: with it, the whole pose of the
            fingertip is given. None leaves the turn about the normal free.
        line: (3,) direction of a line through the point on which the contact may be anywhere.
        plane: (3,) normal of a plane through the point in which the contact may be anywhere.
        ball: (3,) outward normal, into the object, that the pad's ball has where it touches the
            point. The pad may roll over the point unless a normal says which way it faces; where
            the robot's description has no ball for the pad, it touches with its point.

    A contact with a direction alone, wherever the fingertip is, is ``Contact(direction=...)``: its
    point is NaN and its normal that direction.

    Raises:
        InputError: A wrong shape, a number that is not finite, a zero direction, a tangent that is
            not orthogonal to the normal, or a tolerance that is none.

    Example:
        >>> contact = ik.Contact([0.5, 0.1, 0.6], normal=[0, -2, 0])
        >>> print(contact.normal)
        [ 0. -1.  0.]
        >>> sliding = ik.Contact([0.5, 0.1, 0.6], line=[0, 0, 1])  # anywhere on an upright line
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
        given = {"normal": normal, "tangent": tangent, "line": line, "plane": plane, "ball": ball}
        if direction is not None:
            others = [
                name for name, value in {"point": point, **given}.items() if value is not None
            ]
            if others:
                raise InputError(f"direction: found it beside {others[0]}, expected it alone")
            object.__setattr__(self, "point", read_only(np.full(3, np.nan)))
            object.__setattr__(self, "normal", _unit(direction, "direction"))
            return
        if point is None:
            raise InputError("point: missing, expected three numbers (or a direction alone)")
        vectors = {"point": _vector(point, "point")}
        vectors |= {name: _unit(v, name) for name, v in given.items() if v is not None}
        problem = invalid_reason(vectors)
        if problem:
            raise InputError(problem)
        if "tangent" in vectors:
            vectors["tangent"] = read_only(
                orthogonal_tangents(vectors["tangent"], vectors["normal"])
            )
        for name, vector in vectors.items():
            object.__setattr__(self, name, vector)

    def at(self: Any, pose: ArrayLike | None = None) -> Contact:
        """The contact that moves with a frame into the base frame.

        Of the class, ``Contact.at(pose)`` asks for a fingertip's whole pose: the point is the
        pose's origin, the normal its first axis, the tangent its second, as
        `ArmHand.contact_frames` gives them.

        Args:
            pose: (4, 4) where the frame is in which this one is given.

        Raises:
            InputError: No rigid motion.

        Example:
            >>> pose = np.eye(4)
            >>> pose[:3, 3] = [1.0, 0.0, 0.0]
            >>> print(ik.Contact([0.0, 0.0, 0.5]).at(pose).point)
            [1.  0.  0.5]
            >>> print(ik.Contact.at(pose).normal, ik.Contact.at(pose).tangent)
            [1. 0. 0.] [0. 1. 0.]
        """
        if pose is None or not isinstance(self, Contact):
            return Contact(np.zeros(3), [1, 0, 0], tangent=[0, 1, 0]).at(single_pose(self))
        motion = single_pose(pose)
        turn = motion[:3, :3]
        if not np.isfinite(self.point).all():
            assert self.normal is not None
            return Contact(direction=turn @ self.normal, tolerance=self.tolerance)
        vectors = {name: getattr(self, name) for name in ("normal", *EXTRA_VECTORS)}
        turned = {name: turn @ vector for name, vector in vectors.items() if vector is not None}
        return Contact(turn @ self.point + motion[:3, 3], tolerance=self.tolerance, **turned)


@dataclass(frozen=True, eq=False)
class Grasp:
    """A contact for each finger (omitted fingers are free), or a palm pose and a hand posture.

    Attributes:
        contacts: Contact by finger name; none where a palm is given.
        robot: Name (or path) of the robot the grasp was made for; "" if not said.
        name: What it is called, for reports.
        object: Name of the shipped object it grasps; "" if not said.
        object_pose: (4, 4) pose of that object in the base frame, or None. A `Free` pose is looked
            for by `Solver.solve`: the contacts are then in the object's frame.
        posture: A hand posture by actuator that realises the contacts, where one is known; with a
            palm the posture to take, a number for every motor that moves a finger [rad or m].
        palm: (4, 4) pose of the robot's palm frame in the base frame: then the hand is as the
            posture has it, and only the arm is looked for. Of a body with several sides the poses
            by side: hands of those that are left out stay. None: the contacts say all.
        pregrasp: The same hand before it closes, if it is known: a palm and a posture.
        squeeze: The same hand as it squeezes, if it is known: a palm and a posture.

    Raises:
        InputError: No contact at all, a palm that is no rigid motion, has no posture or has
            contacts beside it.

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
        if self.palm is not None:
            object.__setattr__(self, "palm", _frozen_palms(self.palm))
            if self.contacts:
                raise InputError("palm: found it beside contacts, expected one of them")
            if not self.posture:
                raise InputError("posture: missing, expected one for the hand of the palm")
        elif not self.contacts:
            raise InputError("contacts: found none, expected at least one finger, or a palm")
        for finger, contact in self.contacts.items():
            if not isinstance(contact, Contact):
                raise InputError(
                    f"contacts.{finger}: found {type(contact).__name__}, expected a Contact"
                )
        object.__setattr__(self, "contacts", MappingProxyType(dict(self.contacts)))

    def __reduce__(self) -> tuple[type[Grasp], tuple[Any, ...]]:
        """Its fields; the mapping that cannot be changed is made anew."""
        palm = dict(self.palm) if isinstance(self.palm, Mapping) else self.palm
        held = self.robot, self.name, self.object, self.object_pose, dict(self.posture), palm
        return type(self), (dict(self.contacts), *held, self.pregrasp, self.squeeze)

    def at(self, pose: ArrayLike) -> Grasp:
        """The grasp moved as a whole: given in an object's frame, it is placed with the object.

        ``grasp.at(a).at(b)`` is ``grasp.at(b @ a)``.

        Args:
            pose: (4, 4) where the frame is, in the robot's base frame, in which the contacts are
                given.

        Returns:
            The contacts or the palm, what comes before and after, and the object where there is
            one, in the base frame.

        Raises:
            InputError: Another shape, a number that is not finite, or no rigid motion.

        Example:
            >>> pose = np.eye(4)
            >>> pose[2, 3] = 0.01  # 1 cm higher
            >>> higher = grasp.at(pose)
            >>> print(np.round(higher.contacts["thumb"].point - grasp.contacts["thumb"].point, 6))
            [0.   0.   0.01]
        """
        motion = single_pose(pose)
        place = self.object_pose
        if isinstance(place, Free):
            place = motion
        elif place is not None:
            place = motion @ place
        elif self.object:
            place = motion
        contacts = {finger: contact.at(motion) for finger, contact in self.contacts.items()}
        palm = self.palm
        if isinstance(palm, Mapping):
            palm = {side: motion @ one for side, one in palm.items()}
        elif palm is not None:
            palm = motion @ palm
        before, after = (one and one.at(motion) for one in (self.pregrasp, self.squeeze))
        return replace(
            self,
            contacts=contacts,
            object_pose=place,
            palm=palm,
            pregrasp=before,
            squeeze=after,
        )

    @property
    def known_pose(self) -> Array | None:
        """(4, 4) where the object is; None: not said, or it is looked for."""
        return None if isinstance(self.object_pose, Free) else self.object_pose

    @property
    def one_palm(self) -> Array | None:
        """(4, 4) where the palm of a single arm has to be; None: not said, or said by side."""
        return None if isinstance(self.palm, Mapping) else self.palm

    def in_object_frame(self) -> Grasp:
        """The contacts as the object sees them, to be placed by `at`.

        A grasp that does not say where its object is counts as given in the object's frame.

        Example:
            >>> seen = grasp.in_object_frame()
            >>> bool(np.allclose(seen.at(grasp.object_pose).contacts["thumb"].point,
            ...                  grasp.contacts["thumb"].point))
            True
        """
        return self if self.known_pose is None else self.at(inverse(self.known_pose))

    def arrays(self, fingers: Sequence[str]) -> tuple[Array, Array]:
        """Points and normals in the order of the given fingers.

        Args:
            fingers: The robot's fingers.

        Returns:
            points (f, 3) [m] and normals (f, 3); NaN marks what is free.

        Raises:
            InputError: The grasp has a contact for a finger that is not among them.

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

    def more(self, fingers: Sequence[str]) -> dict[str, Array]:
        """What the contacts have beside point and normal.

        Args:
            fingers: The robot's fingers.

        Returns:
            (f, 3) by name ("tangents", "lines", "planes", "balls"), NaN where free; only what any
            has.

        Example:
            >>> grasp.more(robot.fingers)  # points and normals are all that it asks for
            {}
        """
        found: dict[str, Array] = {}
        for finger, contact in self.contacts.items():
            for name in EXTRA_VECTORS:
                vector = getattr(contact, name)
                if vector is not None:
                    rows = found.setdefault(f"{name}s", np.full((len(fingers), 3), np.nan))
                    rows[fingers.index(finger)] = vector
        return found


def _frozen_palms(palm: Any) -> Array | Mapping[str, Array]:
    if not isinstance(palm, Mapping):
        return read_only(single_pose(palm, "palm").copy())
    if not palm:
        raise InputError("palm: found no side, expected a pose by side")
    poses = {side: read_only(single_pose(one, f"palm.{side}").copy()) for side, one in palm.items()}
    return MappingProxyType(poses)


def _unit(value: Any, name: str) -> Array:
    vector = _vector(value, name)
    x, y, z = vector.tolist()
    length = math.sqrt(x * x + y * y + z * z)
    if (
        MIN_PLAIN_LENGTH < length < MAX_PLAIN_LENGTH
    ):  # `unit_vectors`, whose arrays take long for a single one
        return vector if abs(length - 1) < UNIT_ROUNDING else read_only(vector / length)
    vector, zero = unit_vectors(vector)
    if zero:
        raise InputError(f"{name}: found [0.0, 0.0, 0.0], expected a direction, not zero")
    return read_only(vector)


def _vector(value: Any, name: str) -> Array:
    try:
        array = real_array(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: found {value!r}, expected three numbers") from error
    if array.shape != (3,):
        raise InputError(f"{name}: found shape {array.shape}, expected (3,)")
    if not all(map(math.isfinite, array.tolist())):
        raise InputError(f"{name}: found {array.tolist()}, expected finite numbers")
    return read_only(array)
