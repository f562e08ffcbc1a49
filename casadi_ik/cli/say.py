"""Lines on stderr."""

from __future__ import annotations

import sys

from casadi_ik.errors import printable

PROGRAM = "casadi-ik"
"""What the command is called."""


def say(kind: str, text: str) -> None:
    """Print one line behind the program's name.

    Args:
        kind: What it is about: "error", "warning".
        text: The rest; line breaks in it become spaces.
    """
    print(f"{PROGRAM}: {kind}: {printable(' '.join(text.split()))}", file=sys.stderr)  # noqa: T201
