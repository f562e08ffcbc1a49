"""Answers as JSON: what `casadi-ik solve` and `choose` write, and what is read back of it."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from casadi_ik.errors import DescriptionError, InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit
from casadi_ik.files.number_files import read_npz
from casadi_ik.files.writing import to_json
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.load_grasp import GraspFile, grasp_from_entry, grasp_to_dict
from casadi_ik.solve.solution import Ranking, Solution


def solution_data(solution: Solution) -> dict[str, Any]:
    """A solution as JSON holds it; null stands for what is not a finite number (a free finger)."""
    names = ["success", "status", "method", "robot", "actuators", "q", "iterations", "restarts"]
    names += ["time", "contacts", "diagnosis"]
    names += ["palm"] if solution.palm is not None else []
    names += ["clearance", "closest", "collision"] if solution.clearance is not None else []
    found = to_json({name: getattr(solution, name) for name in names}, infinite=lambda _: None)
    if solution.diagnosis is not None:
        told = ("established", "reliefs", "freed", "lines")
        more = {name: getattr(solution.diagnosis, name) for name in told}
        found["diagnosis"] |= to_json(more, infinite=lambda _: None)
    for contact in found["contacts"].values():
        del contact["tolerance"]
    return found


def ranking_data(ranking: Ranking, names: Sequence[str]) -> dict[str, Any]:
    """A ranking as JSON holds it.

    Args:
        ranking: The answers.
        names: Of the candidates.
    """
    ranked = []
    for one in ranking:
        before = one.grasp.pregrasp
        ranked.append(
            {
                "candidate": one.candidate,
                "name": names[one.candidate],
                "score": one.score,
                "grasp": grasp_to_dict(one.grasp),
                **({} if before is None else {"pregrasp": grasp_to_dict(before)}),
                "solution": solution_data(one.solution),
            }
        )
    about = {name: getattr(ranking, name) for name in ("candidates", "answered", "prefer")}
    return about | {"failures": dict(ranking.failures), "ranked": ranked}


RANKED_MEMBER = "ranked"
"""Name of the array that holds the ranked answers of an npz file, as bytes of JSON."""


class RankedSolution(msgspec.Struct, frozen=True):
    """What is needed of an answer.

    Attributes:
        robot: Whose it is.
        q: A number per actuator [rad or m].
        clearance: Smallest distance of a pair that must not touch [m]; None: not checked.
    """

    robot: str
    q: list[float]
    clearance: float | None = None


class RankedEntry(msgspec.Struct, frozen=True):
    """One of the answers of a file.

    Attributes:
        candidate: Number of its grasp among the candidates.
        score: What it was ranked by.
        solution: How to take it.
        name: Of its grasp.
        grasp: The grasp, where the object is; None in older files.
        pregrasp: The same hand before it, if the candidate said it.
        load: What it holds per newton of squeeze, of answers of ``casadi-ik grasp``.
    """

    candidate: int
    score: float
    solution: RankedSolution
    name: str = ""
    grasp: GraspFile | None = None
    pregrasp: GraspFile | None = None
    load: float | None = None

    @property
    def label(self) -> str:
        """It in a few words."""
        return f"{self.name or 'candidate'} ({self.candidate}), score {self.score:.4g}"

    def placed(self, path: Path, place: int) -> Grasp:
        """The grasp, with the hand before it if that is known.

        Args:
            path: Its file.
            place: Its place there, from 1.

        Raises:
            DescriptionError: It is missing or malformed.
        """
        where = f"ranked[{place - 1}]."
        if self.grasp is None:
            expected = "expected what `casadi-ik choose` writes now"
            raise DescriptionError(f"{path}: {where}grasp: missing, {expected}")
        grasp = grasp_from_entry(
            self.grasp, path, self.name or f"{path.stem}[{place - 1}]", f"{where}grasp."
        )
        if self.pregrasp is None:
            return grasp
        before = grasp_from_entry(self.pregrasp, path, grasp.name, f"{where}pregrasp.")
        return replace(grasp, pregrasp=before)


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


def chosen_posture(path: Path, rank: int) -> ChosenPosture:
    """One of the answers of a file.

    Args:
        path: What ``casadi-ik choose --out`` wrote.
        rank: Which, from 1.

    Raises:
        InputError: As for `read_ranked`, or there are fewer.
        DescriptionError: Its grasp is missing or malformed.
    """
    found = read_ranked(path)
    if rank > len(found):
        raise InputError(f"--rank: found {rank}, but {path} has {len(found)} answers")
    one = found[rank - 1]
    return ChosenPosture(one.placed(path, rank), np.array(one.solution.q), one.solution.robot)


def is_ranked(path: Path) -> bool:
    """Whether a file holds ranked answers: of ``casadi-ik choose``, or of ``casadi-ik grasp``."""
    if path.suffix.lower() != ".npz":
        return path.suffix.lower() == ".json"
    try:
        with zipfile.ZipFile(path) as members:
            return f"{RANKED_MEMBER}.npy" in members.namelist()
    except (OSError, zipfile.BadZipFile):
        return False  # whoever reads it says best what is wrong


def _member(path: Path) -> bytes:
    """The ranked answers that ``casadi-ik grasp`` has written beside its arrays."""
    try:
        arrays = read_npz(path, LIMITS.ranked_bytes)
    except DescriptionError as error:
        raise InputError(str(error)) from error
    if RANKED_MEMBER not in arrays:
        raise InputError(
            f"{path}: {RANKED_MEMBER}: missing, expected what `casadi-ik grasp` writes"
        )
    return arrays[RANKED_MEMBER].astype(np.uint8).tobytes()


def read_ranked(path: Path) -> list[RankedEntry]:
    """The answers of a file, best first, at least one.

    Args:
        path: What ``casadi-ik choose --out`` wrote.

    Raises:
        InputError: It cannot be read, is too large, is none of that kind, or has no answers; the
            message names file and key.
    """
    try:
        size, most = path.stat().st_size, scaled_limit(LIMITS.ranked_bytes)
        if size > most:
            raise InputError(f"{path}: found {size} bytes, expected at most {most} {RAISE_HINT}")
        held = path.read_bytes() if path.suffix.lower() != ".npz" else _member(path)
        found = msgspec.json.decode(held, type=_RankedFile).ranked
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        text = str(error).replace("`$.", "`")
        raise InputError(f"{path}: expected what `casadi-ik choose` writes: {text}") from error
    if not found:
        raise InputError(f"{path}: ranked: found none, expected at least one answer")
    return found
