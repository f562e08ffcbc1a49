"""The file that `casadi-ik choose` writes, read again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError, InputError
from casadi_ik.files.limits import RAISED, limit
from casadi_ik.grasps import Grasp
from casadi_ik.grasps.load import GraspFile, grasp_of

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
        grasp: The grasp, where the object is; None in older files.
        pregrasp: The same hand before it, if the candidate said it.
    """

    candidate: int
    score: float
    solution: RankedSolution
    name: str = ""
    grasp: GraspFile | None = None
    pregrasp: GraspFile | None = None

    @property
    def label(self) -> str:
        """It in a few words."""
        return f"{self.name or 'candidate'} ({self.candidate}), score {self.score:.4g}"


class _RankedFile(msgspec.Struct, frozen=True):
    ranked: list[RankedEntry]


@dataclass(frozen=True, eq=False)
class ChosenPosture:
    """One of the answers, to be reached.

    Attributes:
        grasp: The grasp, base frame.
        q: (n,) the posture [rad or m].
        robot: Name of the robot.
    """

    grasp: Grasp
    q: Array
    robot: str


def chosen_posture(path: Path, place: int) -> ChosenPosture:
    """One of the answers of a file.

    Args:
        path: What ``casadi-ik choose --out`` wrote.
        place: Which, from 1.

    Raises:
        InputError: As for `read_ranked`, or there are fewer.
        DescriptionError: Its grasp is missing or malformed.
    """
    found = read_ranked(path)
    if place > len(found):
        raise InputError(f"--rank: found {place}, but {path} has {len(found)} answers")
    one, where = found[place - 1], f"ranked[{place - 1}]."
    if one.grasp is None:
        raise DescriptionError(
            f"{path}: {where}grasp: missing, expected what `casadi-ik choose` writes now"
        )
    name = one.name or f"{path.stem}[{place - 1}]"
    grasp = grasp_of(one.grasp, path, name, f"{where}grasp.")
    if one.pregrasp is not None:
        before = grasp_of(one.pregrasp, path, name, f"{where}pregrasp.")
        grasp = replace(grasp, pregrasp=before)
    return ChosenPosture(grasp, np.array(one.solution.q), one.solution.robot)


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
