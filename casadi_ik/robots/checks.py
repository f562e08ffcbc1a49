"""The checks that descriptions go through; each failure names file, key and what was expected."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from casadi_ik.errors import DescriptionError
from casadi_ik.robots.description import Actuator, Joint

LONGEST_NAME = 100
"""Characters of a name."""


def check_couplings(joints: dict[str, Joint], actuators: list[Actuator], path: Path) -> None:
    """Whether every coupling ends at an actuator, and every actuator moves something.

    Args:
        joints: The movable joints by name.
        actuators: The actuators.
        path: The file they stand in.

    Raises:
        DescriptionError: See above; or a coupling follows something of another unit, or a slider
            leaves its triangle.
    """
    units = {joint.name: "m" if joint.type == "prismatic" else "rad" for joint in joints.values()}
    units |= {actuator.name: actuator.unit for actuator in actuators}
    followed = {joint.coupling.of for joint in joints.values() if joint.coupling is not None}
    for actuator in actuators:
        if actuator.name not in joints and actuator.name not in followed:
            raise DescriptionError(
                f"{path}: actuators.{actuator.name}: moves nothing; expected the name of a joint, "
                "or a coupling that follows it"
            )
    for joint in joints.values():
        _check_coupling(joint, joints, {actuator.name for actuator in actuators}, path)
        if (coupling := joint.coupling) is None:
            continue
        if coupling.source_unit and units[coupling.of] != coupling.source_unit:
            raise DescriptionError(
                f"{path}: joint {joint.name!r}: coupling.of: {coupling.of!r} is in "
                f"{units[coupling.of]}, expected something in {coupling.source_unit}"
            )
        motor = next((one for one in actuators if one.name == coupling.of), None)
        if motor is not None:
            where = f"{path}: joint {joint.name!r}: coupling"
            coupling.check_stroke(motor.name, motor.lower, motor.upper, where)


def _check_coupling(
    joint: Joint, by_name: dict[str, Joint], actuators: set[str], path: Path
) -> None:
    """Follow a joint's couplings down to an actuator."""
    where = f"{path}: joint {joint.name!r}"
    followed, current = [joint.name], joint
    while current.coupling is not None:
        source = current.coupling.of
        if source in followed:
            cycle = " -> ".join([*followed, source])
            raise DescriptionError(f"{where}: coupling.of: is a cycle {cycle}")
        if source in actuators:
            return
        if source not in by_name:
            raise DescriptionError(
                f"{where}: coupling.of: unknown joint or actuator {source!r}; known: "
                + ", ".join([*by_name, *sorted(actuators - set(by_name))])
            )
        followed.append(source)
        current = by_name[source]
    if current.name not in actuators:
        raise DescriptionError(
            f"{where}: coupling: missing, and there is no {current.name!r} under 'actuators'"
        )


def unique(names: Iterable[str], where: str) -> None:
    """Refuse a name that appears twice."""
    seen: set[str] = set()
    for name in names:
        usable(name, where)
        if name in seen:
            raise DescriptionError(f"{where}: {name!r} appears twice")
        seen.add(name)


def usable(name: str, where: str) -> None:
    """Refuse a name that is empty, or too long to be read in a table or a file's name."""
    if not 0 < len(name) <= LONGEST_NAME:
        raise DescriptionError(
            f"{where}: found a name of {len(name)} characters, expected 1 to {LONGEST_NAME}"
        )


def known_link(link: str, root: str, joints: list[Joint], where: str) -> str:
    """The link, if it is the root or some joint's child."""
    links = [root, *(joint.child for joint in joints)]
    if link not in links:
        raise DescriptionError(f"{where}: unknown link {link!r}; known: {', '.join(links)}")
    return link


def known_source(tags: str, sources: dict[str, str], where: str) -> None:
    """Refuse source tags (separated by blanks or commas) that are empty or not explained."""
    for tag in tags.replace(",", " ").split():
        if tag not in sources:
            raise DescriptionError(f"{where}: unknown tag {tag!r}; sources: {', '.join(sources)}")
    if not tags.strip():
        raise DescriptionError(f"{where}: is empty; every number needs its source")


def positive(value: float, where: str) -> float:
    """The value, if it is above zero."""
    if not value > 0:
        raise DescriptionError(f"{where}: found {value:.6g}, expected > 0")
    return value
