"""What may be wrong about a hand's description: its numbers, each with a prior."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from casadi_ik.errors import InputError
from casadi_ik.robots.description import Joint, RobotDescription

GROUPS = ("linkage", "axes", "tips")
"""Numbers of the couplings; origins and directions of the joint axes; contact frames."""

BOUND = 3.0
"""Estimates stay within so many prior standard deviations of the description."""


@dataclass(frozen=True)
class Priors:
    """How far the description may be off: standard deviations.

    Attributes:
        length: Sides of triangles and four-bars [m].
        angle: Reference angles of the couplings [rad].
        origin: Every coordinate of a point of a joint axis [m].
        axis: Tilts of a joint axis [rad].
        tip: Every coordinate of a contact point [m].
        tip_angle: Turns of a contact frame [rad].
    """

    length: float = 0.5e-3
    angle: float = math.radians(2.0)
    origin: float = 1e-3
    axis: float = math.radians(1.0)
    tip: float = 1e-3
    tip_angle: float = math.radians(2.0)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"priors.{name}: found {value!r}, expected a number > 0")


@dataclass(frozen=True)
class Parameter:
    """One number that is estimated.

    Attributes:
        owner: The joint or finger it belongs to.
        part: "coupling", "origin", "axis", "tip" or "turn".
        key: Which number: a field of the coupling, "x", "y", "z", or the tilt "1", "2".
        nominal: What the description says; 0 for tilts and turns.
        prior: Standard deviation.
        unit: "m" or "rad".
    """

    owner: str
    part: str
    key: str
    nominal: float
    prior: float
    unit: str

    @property
    def name(self) -> str:
        """What it is called."""
        if self.part == "coupling":
            return f"{self.owner}.{self.key}"
        return f"{self.owner}.{self.part}.{self.key}"

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest value."""
        return self.nominal - BOUND * self.prior, self.nominal + BOUND * self.prior


def hand_parameters(
    robot: RobotDescription,
    fingers: Sequence[str],
    groups: Sequence[str] = GROUPS,
    priors: Priors | None = None,
) -> tuple[Parameter, ...]:
    """The numbers of some fingers, from the palm to the tips, each once.

    Args:
        robot: The description.
        fingers: Fingers that were measured.
        groups: Which kinds of numbers.
        priors: How far they may be off.

    Raises:
        UnknownNameError: There is no such finger.
        InputError: No fingers, or an unknown group.
    """
    unknown = [group for group in groups if group not in GROUPS]
    if unknown or not groups:
        wrong = repr(unknown[0]) if unknown else "nothing"
        raise InputError(f"groups: found {wrong}, expected some of {', '.join(GROUPS)}")
    if not fingers:
        raise InputError("fingers: none, expected at least one")
    spread = priors or Priors()
    found: dict[str, Parameter] = {}
    for finger in fingers:
        chain = robot.chain(robot.finger(finger).link)
        for joint in (j for j in chain if j.type != "fixed" and j.part == "hand"):
            if "linkage" in groups:
                found |= {p.name: p for p in _coupling(joint, spread)}
            if "axes" in groups:
                found |= {p.name: p for p in _axis(joint, spread)}
        if "tips" in groups:
            found |= {p.name: p for p in _tip(robot, finger, spread)}
    return tuple(found.values())


def _coupling(joint: Joint, spread: Priors) -> list[Parameter]:
    coupling = joint.coupling
    if coupling is None:
        return []
    kinds = ((coupling.lengths, spread.length, "m"), (coupling.angles, spread.angle, "rad"))
    return [
        Parameter(joint.name, "coupling", key, float(getattr(coupling, key)), prior, unit)
        for keys, prior, unit in kinds
        for key in keys
    ]


def _axis(joint: Joint, spread: Priors) -> list[Parameter]:
    origin = joint.placement[:3, 3]
    return [
        *(
            Parameter(joint.name, "origin", key, float(value), spread.origin, "m")
            for key, value in zip("xyz", origin, strict=True)
        ),
        *(Parameter(joint.name, "axis", key, 0.0, spread.axis, "rad") for key in "12"),
    ]


def _tip(robot: RobotDescription, finger: str, spread: Priors) -> list[Parameter]:
    point = robot.finger(finger).placement[:3, 3]
    return [
        *(
            Parameter(finger, "tip", key, float(value), spread.tip, "m")
            for key, value in zip("xyz", point, strict=True)
        ),
        *(Parameter(finger, "turn", key, 0.0, spread.tip_angle, "rad") for key in "xyz"),
    ]
