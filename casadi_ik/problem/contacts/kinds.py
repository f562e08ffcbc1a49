"""The kind of every contact: which conditions it has; and which kinds a target's data ask for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

from casadi_ik.problem.contacts.conditions import CONDITIONS, FACING, PLACE, Condition


class ContactKind(NamedTuple):
    """A contact's conditions, by name; a weight of zero frees either.

    Point and normal is the usual kind. With weights it is a point alone, or a direction alone.
    """

    place: str = "point"
    facing: str = "normal"

    @property
    def conditions(self) -> tuple[Condition, Condition]:
        """The two of them."""
        return CONDITIONS[self.place], CONDITIONS[self.facing]

    @property
    def data(self) -> tuple[str, ...]:
        """Names of the target's vectors."""
        return tuple(dict.fromkeys(name for row in self.conditions for name in row.data))


USUAL = ContactKind()
"""Point and normal."""

Kinds: TypeAlias = tuple[ContactKind, ...]
"""A kind per finger: what a kernel is built for."""


def usual(f: int) -> Kinds:
    """Point and normal for all of f fingers."""
    return (USUAL,) * f


def suffix(kinds: Kinds) -> str:
    """What the name of a graph for these kinds ends with; nothing for the usual ones."""
    if set(kinds) <= {USUAL}:
        return ""
    return "_" + "_".join(f"{kind.place}{kind.facing}" for kind in kinds)


def kind_of(data: Iterable[str]) -> ContactKind:
    """The kind of a contact that has these vectors beside point and normal."""
    known, asked = set(data), {PLACE: USUAL.place, FACING: USUAL.facing}
    for condition in CONDITIONS.values():
        if not known.isdisjoint(condition.data[1:]):
            asked[condition.aspect] = condition.name
    return ContactKind(asked[PLACE], asked[FACING])
