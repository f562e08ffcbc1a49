"""The exceptions casadi_ik raises on bad input.

Not converging is never an exception: it is a `Status` of the solution. An exception means that
the question itself was malformed, and its message says in one line where, what was found and
what was expected.
"""

from __future__ import annotations

LONGEST = 600
"""Characters of a message; of a longer one the beginning and the end are kept."""


def printable(text: str) -> str:
    """Text without what a terminal would take for a command; line breaks stay."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else f"\\x{ord(c):02x}" for c in text)


def shortened(text: str) -> str:
    """A text of any length as one of a few hundred printable characters."""
    if len(text) > LONGEST:
        text = f"{text[: LONGEST - 200]} [...] {text[-180:]}"
    return printable(text)


class CasadiIKError(Exception):
    """Base of every error that casadi_ik raises on purpose.

    Its text is printable and short, whatever the file holds that it speaks of.
    """

    def __str__(self) -> str:
        return shortened(super().__str__())


class DescriptionError(CasadiIKError):
    """A robot, object or grasp file (or the data in it) is malformed."""


class UnknownNameError(CasadiIKError):
    """A robot, grasp, method, finger, joint or option of that name does not exist."""


class InputError(CasadiIKError):
    """An argument has the wrong shape, type or value (non-finite, zero normal, ...)."""


class RowError(InputError):
    """One target of many is malformed or not for the method; the message says which.

    Attributes:
        row: Number of the target.
    """

    def __init__(self, message: str, row: int) -> None:
        super().__init__(message)
        self.row = row


class UnsupportedError(CasadiIKError):
    """The method cannot be used with this robot; the message says which property is missing."""


class KernelError(CasadiIKError):
    """Generated code could not be compiled or loaded."""


class LogError(CasadiIKError):
    """A log cannot be written or read."""


class PictureError(CasadiIKError):
    """A picture cannot be written."""


class MissingExtraError(CasadiIKError, ImportError):
    """An optional part of the package is not installed; the message says how to install it."""
