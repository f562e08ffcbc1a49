"""A word on a terminal about work that takes long and happens once."""

from __future__ import annotations

import sys

RATE = 50_000
"""Characters of C that a compiler takes in a second, about: 25,000 to 115,000 were measured."""

LONG = 2.0
"""Seconds from which a compilation is worth a word."""


def announce(name: str, size: int) -> None:
    """Say on stderr, if it is a terminal, what is compiled and about how long that takes.

    Args:
        name: Of the kernel.
        size: Characters of its text.
    """
    stream, seconds = sys.stderr, size / RATE
    if stream is not None and seconds >= LONG and stream.isatty():
        stream.write(f"compiling {name} (about {seconds:.0f} s, once per machine)\n")
        stream.flush()
