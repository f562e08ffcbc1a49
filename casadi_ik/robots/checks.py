"""The checks that descriptions go through; each failure names file, key and what was expected."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from casadi_ik.errors import DescriptionError
from casadi_ik.robots.couplings import Coupling, FourBar, LeadScrew, Linear
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
        expected = {LeadScrew: "m", FourBar: "rad"}.get(type(joint.coupling))
        if expected and joint.coupling and units[joint.coupling.of] != expected:
            raise DescriptionError(
                f"{path}: joint {joint.name!r}: coupling.of: {joint.coupling.of!r} is in "
                f"{units[joint.coupling.of]}, expected something in {expected}"
            )
        if isinstance(joint.coupling, LeadScrew):
            _check_triangle(joint, {actuator.name: actuator for actuator in actuators}, path)


def _check_triangle(joint: Joint, actuators: dict[str, Actuator], path: Path) -> None:
    """Whether a slider closes its triangle over the whole stroke."""
    coupling = joint.coupling
    if isinstance(coupling, LeadScrew) and coupling.of in actuators:
        slider = actuators[coupling.of]
        low, high = abs(coupling.b - coupling.c), coupling.b + coupling.c
        if not low <= slider.lower < slider.upper <= high:
            raise DescriptionError(
                f"{path}: joint {joint.name!r}: coupling: {slider.name!r} goes from "
                f"{slider.lower:.6g} to {slider.upper:.6g} m, expected within |b - c| = {low:.6g} "
                f"and b + c = {high:.6g} m"
            )


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


def check_numbers(coupling: Coupling | None, where: str) -> None:
    """Whether a coupling's numbers describe a mechanism."""
    if isinstance(coupling, Linear):
        if coupling.ratio == 0:
            raise DescriptionError(f"{where}.ratio: is zero, so the joint would not move")
        return
    if coupling is None:
        return
    for length in "bc" if isinstance(coupling, LeadScrew) else "pqgh":
        positive(getattr(coupling, length), f"{where}.{length}")
    if isinstance(coupling, FourBar):
        # Rod and coupler have to span the distance from the crank's pin to the rod's pivot.
        p, q, g, h = coupling.p, coupling.q, coupling.g, coupling.h
        span = math.sqrt(max(p * p + g * g - 2 * p * g * math.cos(coupling.phi_0), 0.0))
        if not abs(q - h) < span < q + h:
            raise DescriptionError(
                f"{where}.phi_0: at {coupling.phi_0:.6g} rad q and h cannot span {span:.6g} m, "
                f"expected a pose in which the linkage closes, not stretched or folded"
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
