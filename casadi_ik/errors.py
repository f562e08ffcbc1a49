"""Exceptions that casadi_ik raises on bad input.

Failure to converge is a `Status` of the solution, never an exception. An exception means that an
input is malformed; its message is one line: `<where>: <noun> is <problem>; expected <x>`.
"""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


def printable(text: str, most: int = 0) -> str:
    r"""Return untrusted text in a form that is safe to print on a terminal.

    Args:
        text: The text.
        most: Maximum number of characters; 0: unlimited.

    Returns:
        The text with control and direction characters as visible escapes (``\x1b``); line breaks
        stay.
    """
    if most and len(text) > most:
        text = f"{text[:most]}... ({len(text)} characters)"
    if text.isprintable():
        return text
    return "".join(_escaped(character) for character in text)


def _escaped(character: str) -> str:
    # Cc: control characters; Cf: invisible marks, such as writing direction; Cs: lone surrogates.
    if character == "\n" or unicodedata.category(character) not in ("Cc", "Cf", "Cs"):
        return character
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")


MAX_MESSAGE_LENGTH = 600
"""Maximum number of characters of a message; longer ones are shortened in the middle."""


def shortened(text: str) -> str:
    """Return text in at most `MAX_MESSAGE_LENGTH` characters, safe to print on a terminal."""
    text = printable(text)
    if len(text) <= MAX_MESSAGE_LENGTH:
        return text
    return f"{text[: MAX_MESSAGE_LENGTH - 200]} [...] {text[-180:]}"


def did_you_mean(word: str, known: Iterable[str], otherwise: str | None = None) -> str:
    """Return a hint with the most similar known word, else `otherwise` or all known words."""
    known = list(known)
    matches = difflib.get_close_matches(word, known, 1)
    if matches:
        return f"did you mean {matches[0]!r}?"
    return f"expected one of {', '.join(known)}" if otherwise is None else otherwise


class CasadiIKError(Exception):
    """Base class of all errors that casadi_ik raises.

    The message is printable and short, whatever the file contains that it quotes.

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
    """Convert errors of the operating system into an error of the package.

    Args:
        what: File and failed operation, as in "cup.yaml: cannot be read".
        kind: Class of the error.
    """
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {error.strerror or error}") from error


class DescriptionError(CasadiIKError):
    """Error of a malformed robot, object or grasp file, or of its data."""


class UnknownNameError(CasadiIKError):
    """Error of a robot, grasp, method, finger, joint or option name that does not exist."""


class InputError(CasadiIKError):
    """Error of an argument with the wrong shape, type or value (non-finite, zero normal, ...)."""


class RowError(InputError):
    """Error of a target in a batch that is malformed, or that the method does not support.

    Attributes:
        row: Number of the target, also named in the message.
    """

    def __init__(self, message: str, row: int) -> None:
        super().__init__(message)
        self.row = row


class InvalidPoseError(InputError, DescriptionError):
    """Error of a pose, rotation or quaternion that is not rigid within rounding.

    Arguments and files raise this class; handlers of `InputError` and of `DescriptionError` catch
    it.
    """


class InputWarning(UserWarning):
    """Warning of an accepted input whose units or keypoint order are probably wrong.

    The message names the value, the limit and the likely mistake (millimetres given as metres,
    degrees given as radians). Silence it with ``warnings.simplefilter("ignore", InputWarning)``.
    """


class UnsupportedError(CasadiIKError):
    """Error of a method, robot or environment that lacks a required property."""


class KernelError(CasadiIKError):
    """Error of generated code that cannot be compiled or loaded."""


class LogError(CasadiIKError):
    """Error of a log that cannot be written or read."""


class PictureError(CasadiIKError):
    """Error of a picture that cannot be written."""


class MissingExtraError(CasadiIKError, ImportError):
    """Error of an optional dependency that is not installed; the message says how to install it."""


EXTRA_OF_MODULE = {
    "collada": "meshes",
    "scipy": "meshes",
    "trimesh": "meshes",
    "mujoco": "robots",
    "xacro": "robots",
    "matplotlib": "plots",
    "pyvista": "plots",
    "vtk": "plots",
    "vtkmodules": "plots",
    "foxglove": "view",
    "viser": "view",
    "ompl": "motion",
    "toppra": "motion",
    "pinocchio": "reference",
    "proxsuite": "reference",
    "ziglang": "compiler",
}
"""Extra that installs an optional module."""

PACKAGE_OF_MODULE = {"dask": "'dask[distributed]'", "zenoh": "eclipse-zenoh"}
"""Name of the package that installs a module, where it is not the module's name."""


def install_command(module: str) -> str:
    """Return the command that installs an optional module."""
    if module in EXTRA_OF_MODULE:
        return f"pip install 'casadi-ik[{EXTRA_OF_MODULE[module]}]'"
    return f"pip install {PACKAGE_OF_MODULE.get(module, module)}"


@contextmanager
def optional_import(purpose: str) -> Iterator[None]:
    """Convert a failed import of an optional dependency into a `MissingExtraError`.

    Args:
        purpose: Function that needs the dependency, for the message ("meshes").

    Raises:
        MissingExtraError: The dependency is not installed, or cannot be loaded.
    """
    try:
        yield
    except MissingExtraError:
        raise
    except ImportError as error:
        module = (error.name or "").partition(".")[0]
        if not isinstance(error, ModuleNotFoundError) or not module:
            raise MissingExtraError(f"{purpose}: {module} cannot be loaded: {error}") from error
        raise MissingExtraError(
            f"{purpose}: {module} is not installed; {install_command(module)}"
        ) from error
