"""Lines on stderr."""

from __future__ import annotations

import sys

from casadi_ik.errors import shortened

PROGRAM = "casadi-ik"
"""What the command is called."""


def say(kind: str, text: str) -> None:
    """Print one line behind the program's name.

    Args:
        kind: What it is about: "error", "warning".
        text: The rest; line breaks in it become spaces, and it is cut to a few hundred characters.
    """
    print(f"{PROGRAM}: {kind}: {shortened(' '.join(text.split()))}", file=sys.stderr)  # noqa: T201
