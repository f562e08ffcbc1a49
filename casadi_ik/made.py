"""Objects of frozen dataclasses, made in half the time."""

from __future__ import annotations

from typing import Any, TypeVar

T = TypeVar("T")


def made(kind: type[T], **fields: Any) -> T:
    """An object of a frozen dataclass as its `__init__` makes it, from fields that are sound.

    That sets every field by a call, which for the 17 of a solution takes as long as a hand's fit.

    Args:
        kind: A dataclass without `__post_init__` and slots.
        fields: By name; those with a plain default may be left out.
    """
    found = object.__new__(kind)
    vars(found).update(fields)
    return found
