"""XML of a robot as elements, checked before a parser that would crash, hang or print sees it."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import RAISED, limit

LARGEST = 1e6
"""No length or angle of a robot is larger [m or rad]."""

FURTHEST = 1e3
"""A limit beyond it [rad or m] is none: some programs write 1e16 for a joint without."""

LARGEST_FILE = 16 * 2**20
"""Bytes of a file."""

DEEPEST = 200
"""Elements inside one another."""

MOST_LINKS = 1000
"""Of a file."""

MOST_JOINTS = 200
"""Of a file, that move."""

Element = ElementTree.Element


class _ForbiddenError(ValueError):
    pass


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        DescriptionError: It cannot be read, or is larger than any robot.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(limit(LARGEST_FILE) + 1)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise DescriptionError(f"{path}: cannot be read: {reason}") from error
    if len(data) > limit(LARGEST_FILE):
        most = f"{limit(LARGEST_FILE) / 2**20:.3g} MiB"
        raise DescriptionError(f"{path}: cannot be read: is larger than {most} {RAISED}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{path}: cannot be read: not UTF-8 text") from error


def parse_xml(text: str, path: Path) -> Element:
    """Parse XML that declares no entities: a few lines of them can grow without end.

    Args:
        text: The text.
        path: The file it is from.

    Raises:
        DescriptionError: Not XML, a document type, or nested without end.
    """
    try:
        _look_through(text)
        return ElementTree.fromstring(text)
    except _ForbiddenError as error:
        raise DescriptionError(f"{path}: {error}") from error
    except (ElementTree.ParseError, expat.ExpatError) as error:
        raise DescriptionError(f"{path}: not valid XML: {error}") from error


def _look_through(text: str) -> None:
    """One event at a time, before anything is built."""
    parser = expat.ParserCreate("utf-8")  # what the text is, whatever it says of itself
    depth = 0

    def start(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise _ForbiddenError(f"elements nested more than {DEEPEST} deep")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_: object) -> None:
        raise _ForbiddenError("has a document type (<!DOCTYPE ...>), expected plain elements")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(text.encode("utf-8"), True)


def attribute(element: Element | None, name: str, where: str) -> str:
    """An attribute of an element.

    Raises:
        DescriptionError: There is none.
    """
    value = None if element is None else element.get(name)
    if not value:
        raise DescriptionError(f"{where}: {name}: missing")
    return value


def check_size(links: int, moving: int, path: Path) -> None:
    """Refuse what is larger than any robot, before anything is looked for in it.

    Raises:
        DescriptionError: It has too many links or joints that move.
    """
    for noun, count, most in (("links", links, MOST_LINKS), ("moving joints", moving, MOST_JOINTS)):
        if count > limit(most):
            raise DescriptionError(
                f"{path}: found {count} {noun}, expected at most {limit(most)} {RAISED}"
            )


def number(element: Element | None, name: str, where: str, most: float = LARGEST) -> float | None:
    """A number of an element; None if it is not there.

    Raises:
        DescriptionError: Something that is no number, or a larger one than `most`.
    """
    text = None if element is None else element.get(name)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and abs(value) <= most):
        raise DescriptionError(
            f"{where}: {name}: found {text!r}, expected a finite number{_to(most)}"
        )
    return value


def _to(most: float) -> str:
    return f" up to {most:g}" if math.isfinite(most) else ""


def check_vector(element: Element | None, name: str, where: str) -> None:
    """Refuse an attribute that is not three finite numbers, if it is there.

    Raises:
        DescriptionError: It is not.
    """
    text = None if element is None else element.get(name)
    if text is None:
        return
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(abs(one) <= LARGEST for one in values):
        raise DescriptionError(
            f"{where}: {name}: found {text!r}, expected three finite numbers{_to(LARGEST)}"
        )
