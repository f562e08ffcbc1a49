"""The file that `casadi-ik choose` writes, read again."""

from __future__ import annotations

from pathlib import Path

import msgspec

from casadi_ik.errors import InputError
from casadi_ik.files.limits import RAISED, limit

MOST = 2**26
"""Bytes of a file: ten thousand answers take a third of it."""


class RankedSolution(msgspec.Struct, frozen=True):
    """What is needed of an answer.

    Attributes:
        robot: Whose it is.
        q: A number per actuator [rad or m].
    """

    robot: str
    q: list[float]


class RankedEntry(msgspec.Struct, frozen=True):
    """One of the answers.

    Attributes:
        candidate: Number of its grasp among the candidates.
        score: What it was ranked by.
        solution: How to take it.
        name: Of its grasp.
    """

    candidate: int
    score: float
    solution: RankedSolution
    name: str = ""

    @property
    def label(self) -> str:
        """It in a few words."""
        return f"{self.name or 'candidate'} ({self.candidate}), score {self.score:.4g}"


class _RankedFile(msgspec.Struct, frozen=True):
    ranked: list[RankedEntry]


def read_ranked(path: Path) -> list[RankedEntry]:
    """The answers of a file, best first, at least one.

    Args:
        path: What ``casadi-ik choose --out`` wrote.

    Raises:
        InputError: It cannot be read, is too large, is none of that kind, or has no answers; the
            message names file and key.
    """
    try:
        size = path.stat().st_size
        if size > limit(MOST):
            raise InputError(f"{path}: found {size} bytes, expected at most {limit(MOST)} {RAISED}")
        found = msgspec.json.decode(path.read_bytes(), type=_RankedFile).ranked
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        text = str(error).replace("`$.", "`")
        raise InputError(f"{path}: expected what `casadi-ik choose` writes: {text}") from error
    if not found:
        raise InputError(f"{path}: ranked: found none, expected at least one answer")
    return found
