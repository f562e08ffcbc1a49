"""What can be said about a grasp that was not solved: why, by how much, and what would help."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property

from casadi_ik.files.arrays import Array
from casadi_ik.files.lazy_import import ReprMixin
from casadi_ik.model.targets import Tolerance
from casadi_ik.solve.proofs.proof import Proof
from casadi_ik.solve.verdict import ContactVerdict, PalmVerdict

Point = tuple[float, float, float]


class Reason(StrEnum):
    """Cause of an unsolved grasp: proved, or likely.

    Example:
        >>> far.diagnosis.reason is ik.solve.Reason.REACH
        True
    """

    HAND = "the contacts do not fit the hand, wherever the palm is"
    REACH = "the hand fits the contacts, but the arm does not reach there"
    LIMITS = "limits of actuators block the grasp"
    NOT_FOUND = "no solution was found, and no reason why there should be none"
    REACHABLE = "the contacts can be reached; the method did not find the way"


OF_PALMS = {
    Reason.HAND: "the hand cannot be as it is asked",
    Reason.REACH: "the arm does not reach where the palm is asked",
    Reason.REACHABLE: "the palm can be reached; the method did not find the way",
}
"""What the reasons are where a palm was asked for, not contacts; the others are the same."""


@dataclass(frozen=True)
class HandFit:
    """How well the hand alone, with its palm free to move, fits the contacts.

    Attributes:
        fits: Whether every contact is within tolerance.
        contacts: Residual errors by finger.
    """

    fits: bool
    contacts: Mapping[str, ContactVerdict]


@dataclass(frozen=True)
class ArmReach:
    """Where the wrist would have to be, against what the arm can span.

    Attributes:
        distance: Of the wrist from the shoulder [m], of the hand fit nearest to the range.
        nearest: Smallest distance within the limits of the elbow [m].
        farthest: Largest distance [m].
    """

    distance: float
    nearest: float
    farthest: float

    @property
    def excess(self) -> float:
        """By how much it is too far (> 0) or too near (< 0) [m]; 0 within the range."""
        return max(self.distance - self.farthest, 0.0) - max(self.nearest - self.distance, 0.0)


@dataclass(frozen=True)
class Relief:
    """Limits that make the grasp solvable if they alone are lifted; proved by a solution.

    Attributes:
        lifted: An actuator's name, or "arm", "hand" or "all" for all limits of these.
        beyond: By how much the solution found is beyond the limits, by actuator [rad or m];
            above the upper one if > 0, below the lower one if < 0. No more was found necessary.
        units: Unit by actuator.
        q: (n,) the solution.
    """

    lifted: str
    beyond: Mapping[str, float]
    units: Mapping[str, str]
    q: Array


@dataclass(frozen=True)
class Freed:
    """Something that makes the rest solvable if it is left free; proved by a solution.

    Attributes:
        part: "finger" or "normal".
        finger: Name of the finger; "all" for the normals of all fingers.
        q: (n,) the solution.
    """

    part: str
    finger: str
    q: Array


@dataclass(frozen=True)
class NearContact:
    """The contact a finger makes in the nearest configuration.

    Attributes:
        point: Where it touches [m], base frame.
        normal: Which way it faces, base frame.
        position_error: Distance from the contact asked for [m]; NaN if free.
        angle_error: Angle from the normal asked for [rad]; NaN if free.
    """

    point: Point
    normal: Point
    position_error: float
    angle_error: float


@dataclass(frozen=True)
class Remedies:
    """What makes a grasp solvable.

    Attributes:
        reliefs: Limits whose lifting does.
        freed: Fingers and normals whose freeing makes the rest solvable.
    """

    reliefs: tuple[Relief, ...] = ()
    freed: tuple[Freed, ...] = ()


class LazyRemedies:
    """Remedies that are looked for when first asked for; pickled as what was found."""

    def __init__(self, find: Callable[[], Remedies]) -> None:
        """Take what finds them."""
        self._find = find

    @cached_property
    def found(self) -> Remedies:
        """The remedies, looked for once."""
        return self._find()

    def __getstate__(self) -> dict[str, Remedies]:
        return {"found": self.found}


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Diagnosis(ReprMixin):
    """Cause of an unsolved grasp, with evidence.

    What would help (`reliefs`, `freed`, and `lines`, which tells of them) is looked for when first
    asked for, which takes some milliseconds; everything else is there at once.

    Attributes:
        reason: The one that is proved; without a proof the likely one, that fits what was found.
        proof: That the grasp is impossible; None where there is none, which says nothing.
        searches: Starts from which a solution was looked for.
        hand: The hand alone against the contacts; None for a hand without an arm.
        reach: The arm against the wrist's place; None unless the arm has a closed form and the
            hand fits.
        active: Actuators at a limit in the nearest configuration.
        enough: Tolerance with which the grasp would be solved.
        nearest: The contacts of the nearest configuration, by finger.
        q: (n,) that configuration; a solution if the reason is `REACHABLE`.
        time: Seconds the diagnosis took; in a batch its share. Without the search for remedies.
        lazy: Where the remedies come from.
        palm: How far the palm is off in the nearest configuration; None where contacts were asked
            for.
        sides: By side of a body its worst contact where it comes closest by itself, the trunk
            moving for it alone; of sides with contacts. {} of an arm with one hand.

    Example:
        >>> far.status.name, far.diagnosis.reason.name, far.diagnosis.hand.fits
        ('UNREACHABLE', 'REACH', True)
        >>> print(far.diagnosis.lines[0])  # doctest: +ELLIPSIS
        the hand fits the contacts, but the arm does not reach there...
    """

    reason: Reason
    proof: Proof | None = None
    searches: int = 0
    hand: HandFit | None = None
    reach: ArmReach | None = None
    active: tuple[str, ...] = ()
    enough: Tolerance
    nearest: Mapping[str, NearContact]
    q: Array
    time: float
    lazy: LazyRemedies = field(default_factory=lambda: LazyRemedies(Remedies), repr=False)
    palm: PalmVerdict | None = None
    sides: Mapping[str, ContactVerdict] = field(default_factory=dict[str, ContactVerdict])

    def __repr__(self) -> str:
        return f"<Diagnosis {self.reason.name}>"  # no search for remedies

    @property
    def established(self) -> bool:
        """Whether the reason is proved."""
        return self.proof is not None

    @property
    def reliefs(self) -> tuple[Relief, ...]:
        """Limits whose lifting makes it solvable."""
        return self.lazy.found.reliefs

    @property
    def freed(self) -> tuple[Freed, ...]:
        """Fingers and normals whose freeing makes the rest solvable."""
        return self.lazy.found.freed

    @property
    def lines(self) -> tuple[str, ...]:
        """What, by how much, and what would help: short lines in mm and degrees."""
        reason = self.reason if self.palm is None else OF_PALMS.get(self.reason, self.reason)
        if self.reason is Reason.REACHABLE:
            return (str(reason), "reachable: hand-first solves it")
        likely = "" if self.established or self.reason is Reason.NOT_FOUND else "likely: "
        lines = [f"{likely}{reason}", *self._why(), *self._grounds()]
        for relief in self._shown:
            far = ", ".join(
                f"{name} {_length(value, relief.units[name])} {_side(value)}"
                for name, value in relief.beyond.items()
            )
            lines.append(f"solvable with limits lifted: {far}")
        if self.palm is not None:
            off = _missed(self.palm.position_error, self.palm.angle_error)
            return (*lines, f"nearest: the palm is {off}")
        fingers = [item.finger for item in self.freed if item.part == "finger"]
        normals = [item.finger for item in self.freed if item.part == "normal"]
        every = normals == ["all"]
        normals = [name for name in normals if name != "all"]
        if fingers:
            lines.append(f"solvable with a finger left free: {' or '.join(fingers)}")
        if normals:
            lines.append(f"solvable with a normal left free: {' or '.join(normals)}")
        if every:
            lines.append("solvable with all normals left free")
        lines.append(
            f"solvable within {_length(self.enough.position, 'm')} "
            f"and {_length(self.enough.angle, 'rad')}"
        )
        return tuple(lines)

    def _grounds(self) -> tuple[str, ...]:
        """On what the reason rests."""
        if self.proof is not None:
            return self.proof.lines if self.palm is None else self.proof.lines_of_palm
        return (f"not proved; no solution from {self.searches} starts",)

    @property
    def _shown(self) -> list[Relief]:
        """Single limits; only where there is none, groups of them, the smallest first."""
        single = [item for item in self.reliefs if item.lifted in item.units]
        return single or list(self.reliefs[:1])

    def _why(self) -> list[str]:
        lines = [
            f"{name} by itself: nothing found closer than "
            f"{_apart(worst.position_error, worst.angle_error)}"
            for name, worst in self.sides.items()
            if not worst.ok
        ]
        if len(self.sides) > 1 and not lines:
            lines.append(f"{' and '.join(self.sides)} get there one at a time, not at once")
        if self.hand is not None and not self.hand.fits:
            off = [
                f"{name} {_missed(verdict.position_error, verdict.angle_error)}"
                for name, verdict in self.hand.contacts.items()
                if not math.isnan(verdict.position_error)
            ]
            lines.append(f"best fit of the hand alone: {', '.join(off)}")
        if self.reach is not None and self.reach.excess != 0:
            side = "too far" if self.reach.excess > 0 else "too near"
            lines.append(
                f"{side} for the arm by {_length(self.reach.excess, 'm')}: the wrist "
                f"{_length(self.reach.distance, 'm')} from the shoulder, the arm spans "
                f"{_length(self.reach.nearest, 'm')} to {_length(self.reach.farthest, 'm')}"
            )
        return lines


def _length(value: float, unit: str) -> str:
    scale, name = (math.degrees(1), "deg") if unit == "rad" else (1e3, "mm")
    size = abs(value) * scale
    return f"{size:.3g} {name}" if size < 100 else f"{size:.0f} {name}"


def _side(value: float) -> str:
    return "above" if value > 0 else "below"


def _missed(position: float, angle: float) -> str:
    return f"{_apart(position, angle)} off"


def _apart(position: float, angle: float) -> str:
    turned = "" if math.isnan(angle) else f" {_length(angle, 'rad')}"
    return f"{_length(position, 'm')}{turned}"
