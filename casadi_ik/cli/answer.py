"""What a command comes back with."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import RenderableType


class Exit(IntEnum):
    """Exit codes of the program."""

    DONE = 0
    """Done; for `solve` and `batch`: everything is solved."""
    NOT_SOLVED = 1
    """A valid problem that is not solved; the report says why."""
    BAD_INPUT = 2
    """One line on stderr says where, what was found and what was expected."""
    INTERRUPTED = 130
    """Ctrl-C (128 + SIGINT, as shells count)."""
    TERMINATED = 143
    """SIGTERM (128 + 15): what is finished is kept as after Ctrl-C."""
    BROKEN_PIPE = 141
    """Whoever read the report went away (128 + SIGPIPE)."""


@dataclass(frozen=True)
class Answer:
    """The end of a command; by now all files are written.

    Attributes:
        report: What to show on stdout.
        exit: The exit code.
    """

    report: RenderableType
    exit: Exit = Exit.DONE
