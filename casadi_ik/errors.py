"""The exceptions casadi_ik raises on bad input.

Not converging is never an exception: it is a `Status` of the solution. An exception means that
the question itself was malformed, and its message says in one line where, what was found and
what was expected.
"""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


def printable(text: str, most: int = 0) -> str:
    r"""A text that may come from anybody, made fit for a terminal.

    Args:
        text: The text.
        most: Characters of it that are kept, at the most; 0: all.

    Returns:
        The text with what would move the cursor, change colours or turn the direction of writing
        as visible escapes (``\x1b``); line breaks stay.
    """
    if most and len(text) > most:
        text = f"{text[:most]}... ({len(text)} characters)"
    if text.isprintable():
        return text
    return "".join(_escaped(character) for character in text)


def _escaped(character: str) -> str:
    # Cc: control characters; Cf: marks without a shape, among them those of direction; Cs: halves.
    if character == "\n" or unicodedata.category(character) not in ("Cc", "Cf", "Cs"):
        return character
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")


LONGEST = 600
"""Characters of a message; of a longer one the beginning and the end are kept."""


def shortened(text: str) -> str:
    """A text of any length as one of a few hundred characters, fit for a terminal."""
    text = printable(text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 200]} [...] {text[-180:]}"


def did_you_mean(word: str, known: Iterable[str], otherwise: str | None = None) -> str:
    """The known word that is nearest to one that is not; else `otherwise`, or all of them."""
    known = list(known)
    near = difflib.get_close_matches(word, known, 1)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"expected one of {', '.join(known)}" if otherwise is None else otherwise


class CasadiIKError(Exception):
    """Base of every error that casadi_ik raises on purpose.

    Its text is printable and short, whatever the file holds that it speaks of.

    Example:
        >>> try:
        ...     ik.load_robot("no_such_robot")
        ... except ik.CasadiIKError as error:
        ...     print(type(error).__name__)
        UnknownNameError
    """

    def __str__(self) -> str:
        return shortened(super().__str__())


@contextmanager
def os_errors(what: str, kind: type[CasadiIKError]) -> Iterator[None]:
    """Turn what the system refuses into an error of the package.

    Args:
        what: File and what was tried: "cup.yaml: cannot be read".
        kind: The error.
    """
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {error.strerror or error}") from error


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


class InvalidPoseError(InputError, DescriptionError):
    """A pose, rotation or quaternion is not rigid, by more than rounding.

    Arguments and files raise the same class: those who catch `InputError` or `DescriptionError`
    catch it, too.
    """


class InputWarning(UserWarning):
    """An input is accepted, but probably not meant: its units or the order of its keypoints.

    The message names the value, the limit and the likely mistake (millimetres given as metres,
    degrees given as radians). Silence it with ``warnings.simplefilter("ignore", InputWarning)``.
    """


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
