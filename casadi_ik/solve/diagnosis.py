"""Diagnosis of an unsolved grasp: cause, distance to a solution, and remedies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property

from casadi_ik.files.arrays import Array
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.files.reprs import ReprMixin
from casadi_ik.model.targets import Tolerance
from casadi_ik.solve.proofs.proof import Proof
from casadi_ik.solve.verdict import ContactVerdict, PalmVerdict

Point = tuple[float, float, float]


class Reason(StrEnum):
    """Cause of an unsolved grasp, proved or likely.

    Example:
        >>> far.diagnosis.reason is ik.solve.Reason.REACH
        True
    """

    HAND = "the contacts do not fit the hand, wherever the palm is"
    REACH = "the hand fits the contacts, but the arm does not reach there"
    LIMITS = "limits of actuators block the grasp"
    NOT_FOUND = "neither a solution nor a proof was found, and no cause is known"
    REACHABLE = "the contacts can be reached, but the method did not find a solution"


MAX_ADVICE = Tolerance(position=0.02, angle=math.radians(15.0))
"""Largest tolerance that a report recommends; a wider one makes a grasp meaningless."""

PALM_REASONS = {
    Reason.HAND: "the hand cannot take the required posture",
    Reason.REACH: "the arm does not reach the palm pose",
    Reason.REACHABLE: "the palm pose can be reached, but the method did not find a solution",
}
"""Texts of reasons for palm targets, where they differ from those for contacts."""


@dataclass(frozen=True)
class HandFit:
    """Fit of the hand alone, with a floating palm, to the contacts.

    Attributes:
        ok: True if every contact is within tolerance.
        contacts: Errors by finger.
    """

    ok: bool
    contacts: Mapping[str, ContactVerdict]

    @property
    def fits(self) -> bool:
        """Deprecated name of `ok`."""
        warn_renamed("HandFit.fits", "HandFit.ok")
        return self.ok


@dataclass(frozen=True)
class ArmReach:
    """Required distance of the wrist from the shoulder, and the range of the arm.

    Attributes:
        distance: Distance of the wrist from the shoulder [m], for the hand fit nearest to the
            range.
        nearest: Smallest distance within the limits of the elbow [m].
        farthest: Largest distance within the limits of the elbow [m].
    """

    distance: float
    nearest: float
    farthest: float

    @property
    def excess(self) -> float:
        """Distance beyond the range: too far (> 0) or too near (< 0) [m]; 0 within the range."""
        return max(self.distance - self.farthest, 0.0) - max(self.nearest - self.distance, 0.0)


@dataclass(frozen=True)
class Relief:
    """Limits whose removal makes the grasp solvable, with a solution as evidence.

    Attributes:
        lifted: Name of an actuator, or "arm", "hand" or "all" for all limits of these.
        violations: Limit violation of the solution by actuator [rad or m]: > 0 above the upper
            limit, < 0 below the lower limit. It is the smallest violation that was found.
        units: Unit by actuator.
        q: (n,) solution [rad or m].
    """

    lifted: str
    violations: Mapping[str, float]
    units: Mapping[str, str]
    q: Array

    @property
    def beyond(self) -> Mapping[str, float]:
        """Deprecated name of `violations`."""
        warn_renamed("Relief.beyond", "Relief.violations")
        return self.violations


@dataclass(frozen=True)
class ReleasedContact:
    """A contact or normal whose release makes the grasp solvable, with a solution as evidence.

    Attributes:
        part: "finger" or "normal".
        finger: Name of the finger; "all" for the normals of all fingers.
        q: (n,) solution [rad or m].
    """

    part: str
    finger: str
    q: Array


@dataclass(frozen=True)
class NearContact:
    """Contact of a finger in the nearest configuration.

    Attributes:
        point: Contact point [m], base frame.
        normal: Pad normal, base frame.
        position_error: Distance from the target point [m]; NaN if free.
        angle_error: Angle from the target normal [rad]; NaN if free.
    """

    point: Point
    normal: Point
    position_error: float
    angle_error: float


@dataclass(frozen=True)
class Remedies:
    """Changes that make a grasp solvable.

    Attributes:
        reliefs: Limits whose removal makes it solvable.
        released: Fingers and normals whose release makes it solvable.
    """

    reliefs: tuple[Relief, ...] = ()
    released: tuple[ReleasedContact, ...] = ()


class LazyRemedies:
    """Remedies that are computed on first access, and before pickling."""

    def __init__(self, find: Callable[[], Remedies]) -> None:
        """Store the function that computes the remedies."""
        self._find = find

    @cached_property
    def remedies(self) -> Remedies:
        """Remedies, computed once."""
        return self._find()

    def __getstate__(self) -> dict[str, Remedies]:
        return {"remedies": self.remedies}


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Diagnosis(ReprMixin):
    """Cause of an unsolved grasp, with evidence.

    The remedies (`reliefs`, `released`, and their part of `lines`) are computed on first access,
    which takes some milliseconds.

    Attributes:
        reason: The proved cause; without a proof the likely one.
        proof: Proof that the grasp is impossible; None if none was found.
        searches: Number of starts of the search for a solution.
        hand: Fit of the hand alone; None for a hand without an arm.
        reach: Reach of the arm; None unless the arm has a closed form and the hand fits.
        active: Actuators that are at a limit in the nearest configuration.
        enough: Tolerance within which the grasp is solvable.
        nearest: Contacts of the nearest configuration, by finger.
        q: (n,) nearest configuration [rad or m]; a solution if the reason is `REACHABLE`.
        time: Duration of the diagnosis without the remedies [s]; in a batch the share of the
            target.
        lazy: Source of the remedies.
        palm: Errors of the palm in the nearest configuration; None for targets without palm
            poses.
        sides: Worst contact of each side of a multi-arm robot with contacts, solved for this side
            and the trunk alone; empty for a single arm.

    Example:
        >>> far.status.name, far.diagnosis.reason.name, far.diagnosis.hand.ok
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
        return f"<Diagnosis {self.reason.name}>"  # does not compute the remedies

    @property
    def established(self) -> bool:
        """True if the reason is proved."""
        return self.proof is not None

    @property
    def reliefs(self) -> tuple[Relief, ...]:
        """Limits whose removal makes the grasp solvable."""
        return self.lazy.remedies.reliefs

    @property
    def released(self) -> tuple[ReleasedContact, ...]:
        """Fingers and normals whose release makes the grasp solvable."""
        return self.lazy.remedies.released

    @property
    def freed(self) -> tuple[ReleasedContact, ...]:
        """Deprecated name of `released`."""
        warn_renamed("Diagnosis.freed", "Diagnosis.released")
        return self.released

    @property
    def lines(self) -> tuple[str, ...]:
        """Cause, distance to a solution and remedies in short lines, in mm and degrees."""
        reason = self.reason if self.palm is None else PALM_REASONS.get(self.reason, self.reason)
        if self.reason is Reason.REACHABLE:
            return (str(reason), "hand-first solves the grasp")
        likely = "" if self.established or self.reason is Reason.NOT_FOUND else "likely: "
        lines = [f"{likely}{reason}", *self._evidence_lines(), *self._proof_lines()]
        for relief in self._smallest_reliefs:
            violations = ", ".join(
                f"{name} {_length(value, relief.units[name])} {_violated_side(value)}"
                for name, value in relief.violations.items()
            )
            lines.append(f"solvable with limits lifted: {violations}")
        if self.palm is not None:
            error = _format_error(self.palm.position_error, self.palm.angle_error)
            return (*lines, f"nearest: the palm is {error} off")
        fingers = [item.finger for item in self.released if item.part == "finger"]
        normals = [item.finger for item in self.released if item.part == "normal"]
        all_normals = normals == ["all"]
        normals = [name for name in normals if name != "all"]
        if fingers:
            lines.append(f"solvable with a finger left free: {' or '.join(fingers)}")
        if normals:
            lines.append(f"solvable with a normal left free: {' or '.join(normals)}")
        if all_normals:
            lines.append("solvable with all normals left free")
        if self.enough.position <= MAX_ADVICE.position and self.enough.angle <= MAX_ADVICE.angle:
            lines.append(
                f"solvable within {_length(self.enough.position, 'm')} "
                f"and {_length(self.enough.angle, 'rad')}"
            )
        return tuple(lines)

    def _proof_lines(self) -> tuple[str, ...]:
        """Return the lines of the proof, or of the search without one."""
        if self.proof is not None:
            return self.proof.lines if self.palm is None else self.proof.lines_of_palm
        return (f"not proved; no solution from {self.searches} starts",)

    @property
    def _smallest_reliefs(self) -> list[Relief]:
        """Reliefs of single actuators, else the smallest group of limits."""
        single = [item for item in self.reliefs if item.lifted in item.units]
        return single or list(self.reliefs[:1])

    def _evidence_lines(self) -> list[str]:
        lines = [
            f"{name} alone: no configuration found closer than "
            f"{_format_error(worst.position_error, worst.angle_error)}"
            for name, worst in self.sides.items()
            if not worst.ok
        ]
        if len(self.sides) > 1 and not lines:
            lines.append(f"{' and '.join(self.sides)} are solvable separately, but not together")
        if self.hand is not None and not self.hand.ok:
            errors = [
                f"{name} {_format_error(verdict.position_error, verdict.angle_error)} off"
                for name, verdict in self.hand.contacts.items()
                if not math.isnan(verdict.position_error)
            ]
            lines.append(f"best fit of the hand alone: {', '.join(errors)}")
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


def _violated_side(value: float) -> str:
    return "above" if value > 0 else "below"


def _format_error(position: float, angle: float) -> str:
    rotation = "" if math.isnan(angle) else f" {_length(angle, 'rad')}"
    return f"{_length(position, 'm')}{rotation}"
