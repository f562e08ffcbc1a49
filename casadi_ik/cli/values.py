"""Words of the command line as values; an error says what was found and what was expected."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path


def numbers(text: str) -> list[float]:
    """Finite numbers, separated by commas or spaces."""
    found: list[float] = []
    for word in text.replace(",", " ").split():
        try:
            value = float(word)
        except ValueError:
            raise ArgumentTypeError(f"found {word!r}, expected a number") from None
        if not math.isfinite(value):
            raise ArgumentTypeError(f"found {word!r}, expected a finite number")
        found.append(value)
    return found


def positive(text: str) -> float:
    """A positive finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise ArgumentTypeError(f"found {text!r}, expected a number > 0")
    return value


def whole(least: int) -> Callable[[str], int]:
    """A whole number from `least` to what 64 bits hold."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value < 2**63:
            raise ArgumentTypeError(f"found {text!r}, expected a whole number >= {least}")
        return value

    return parse


def one_of(*names: str) -> Callable[[str], str]:
    """One of some words."""

    def parse(text: str) -> str:
        if text not in names:
            raise ArgumentTypeError(f"found {text!r}, expected one of {', '.join(names)}")
        return text

    return parse


def file_name(*suffixes: str) -> Callable[[str], Path]:
    """A file to be written, with one of the suffixes if any are given."""

    def parse(text: str) -> Path:
        if not text:
            raise ArgumentTypeError("found '', expected the name of a file")
        path = Path(text)
        if suffixes and path.suffix.lower() not in suffixes:
            raise ArgumentTypeError(
                f"found {text!r}, expected a name ending in {', '.join(suffixes)}"
            )
        return path

    return parse


def npz_or_folder(text: str) -> Path:
    """An npz file to be written, or a folder: one that is there, or a name without suffix."""
    path = file_name()(text)
    if path.suffix.lower() not in ("", ".npz") and not path.is_dir():
        raise ArgumentTypeError(f"found {text!r}, expected OUT.npz or a folder without suffix")
    return path


def assignment(text: str) -> tuple[str, float]:
    """A name and its number, ``NAME=V``.

    Raises:
        ArgumentTypeError: Something else.
    """
    name, equals, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (name and equals and math.isfinite(number)):
        raise ArgumentTypeError(f"found {text!r}, expected NAME=NUMBER")
    return name, number
