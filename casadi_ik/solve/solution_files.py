"""Solutions and rankings as JSON, as `casadi-ik solve` and `choose` write them."""

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
    """Return a solution as JSON data, with null for non-finite numbers (a free finger)."""
    names = ["success", "status", "method", "robot", "actuators", "q", "iterations", "restarts"]
    names += ["time", "contacts", "diagnosis"]
    names += ["palm"] if solution.palm is not None else []
    names += ["clearance", "closest", "collision"] if solution.clearance is not None else []
    data = to_json({name: getattr(solution, name) for name in names}, infinite=lambda _: None)
    if solution.diagnosis is not None:
        properties = ("established", "reliefs", "released", "lines")
        evidence = {name: getattr(solution.diagnosis, name) for name in properties}
        data["diagnosis"] |= to_json(evidence, infinite=lambda _: None)
        data["diagnosis"]["freed"] = data["diagnosis"]["released"]  # deprecated key
    for contact in data["contacts"].values():
        del contact["tolerance"]
    return data


def ranking_data(ranking: Ranking, names: Sequence[str]) -> dict[str, Any]:
    """Return a ranking as JSON data.

    Args:
        ranking: The ranking.
        names: Names of the candidates.
    """
    ranked = []
    for entry in ranking:
        pregrasp = entry.grasp.pregrasp
        ranked.append(
            {
                "candidate": entry.candidate,
                "name": names[entry.candidate],
                "score": entry.score,
                "grasp": grasp_to_dict(entry.grasp),
                **({} if pregrasp is None else {"pregrasp": grasp_to_dict(pregrasp)}),
                "solution": solution_data(entry.solution),
            }
        )
    summary = {name: getattr(ranking, name) for name in ("candidates", "answered", "prefer")}
    return summary | {"failures": dict(ranking.failures), "ranked": ranked}


RANKED_MEMBER = "ranked"
"""Name of the array of an npz file that contains the ranking as bytes of JSON."""


class RankedSolution(msgspec.Struct, frozen=True):
    """Solution of a ranked entry; only the fields that are read.

    Attributes:
        robot: Name of the robot.
        q: Actuator positions [rad or m].
        clearance: Clearance [m]; None: not checked.
    """

    robot: str
    q: list[float]
    clearance: float | None = None


class RankedEntry(msgspec.Struct, frozen=True):
    """Entry of a ranking in a file.

    Attributes:
        candidate: Index of the grasp among the candidates.
        score: Score of the ranking.
        solution: Solution of the grasp.
        name: Name of the grasp.
        grasp: Grasp in the base frame; None in older files.
        pregrasp: Pregrasp of the candidate, if it has one.
        load: Load per newton of squeeze, for files of ``casadi-ik grasp``.
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
        """Short description of the entry."""
        return f"{self.name or 'candidate'} ({self.candidate}), score {self.score:.4g}"

    def to_grasp(self, path: Path, rank: int) -> Grasp:
        """Return the grasp with its pregrasp.

        Args:
            path: File of the entry.
            rank: Rank of the entry, from 1.

        Raises:
            DescriptionError: The grasp is missing or malformed.
        """
        prefix = f"ranked[{rank - 1}]."
        if self.grasp is None:
            expected = "expected the format of `casadi-ik choose`"
            raise DescriptionError(f"{path}: {prefix}grasp: missing, {expected}")
        grasp = grasp_from_entry(
            self.grasp, path, self.name or f"{path.stem}[{rank - 1}]", f"{prefix}grasp."
        )
        if self.pregrasp is None:
            return grasp
        pregrasp = grasp_from_entry(self.pregrasp, path, grasp.name, f"{prefix}pregrasp.")
        return replace(grasp, pregrasp=pregrasp)


class _RankedFile(msgspec.Struct, frozen=True):
    ranked: list[RankedEntry]


@dataclass(frozen=True, eq=False)
class ChosenPosture:
    """Configuration of a ranked entry, as the goal of `Solver.reach`.

    Attributes:
        grasp: Grasp in the base frame.
        q: (n,) configuration [rad or m].
        robot: Name of the robot.
    """

    grasp: Grasp
    q: Array
    robot: str


def chosen_posture(path: Path, rank: int) -> ChosenPosture:
    """Return the configuration of an entry of a file.

    Args:
        path: File that ``casadi-ik choose --out`` wrote.
        rank: Rank of the entry, from 1.

    Raises:
        InputError: See `read_ranked`, or there are fewer entries.
        DescriptionError: The grasp of the entry is missing or malformed.
    """
    entries = read_ranked(path)
    if rank > len(entries):
        raise InputError(
            f"--rank: found {rank}, expected at most {len(entries)}, the entries of {path}"
        )
    entry = entries[rank - 1]
    q = np.array(entry.solution.q)
    return ChosenPosture(entry.to_grasp(path, rank), q, entry.solution.robot)


def is_ranked(path: Path) -> bool:
    """Return True for a file with a ranking of ``casadi-ik choose`` or ``casadi-ik grasp``."""
    if path.suffix.lower() != ".npz":
        return path.suffix.lower() == ".json"
    try:
        with zipfile.ZipFile(path) as members:
            return f"{RANKED_MEMBER}.npy" in members.namelist()
    except (OSError, zipfile.BadZipFile):
        return False  # the reader reports the error


def _member(path: Path) -> bytes:
    """Return the ranking that ``casadi-ik grasp`` stores with its arrays."""
    try:
        arrays = read_npz(path, LIMITS.ranked_bytes)
    except DescriptionError as error:
        raise InputError(str(error)) from error
    if RANKED_MEMBER not in arrays:
        raise InputError(
            f"{path}: {RANKED_MEMBER}: missing, expected the format of `casadi-ik grasp`"
        )
    return arrays[RANKED_MEMBER].astype(np.uint8).tobytes()


def read_ranked(path: Path) -> list[RankedEntry]:
    """Return the entries of a file, at least one, best first.

    Args:
        path: File that ``casadi-ik choose --out`` wrote.

    Raises:
        InputError: The file cannot be read, is too large, is not a ranking, or has no entries;
            the message names file and key.
    """
    try:
        size, max_size = path.stat().st_size, scaled_limit(LIMITS.ranked_bytes)
        if size > max_size:
            raise InputError(
                f"{path}: found {size} bytes, expected at most {max_size} {RAISE_HINT}"
            )
        content = path.read_bytes() if path.suffix.lower() != ".npz" else _member(path)
        entries = msgspec.json.decode(content, type=_RankedFile).ranked
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        text = str(error).replace("`$.", "`")
        raise InputError(f"{path}: expected the format of `casadi-ik choose`: {text}") from error
    if not entries:
        raise InputError(f"{path}: ranked: found none, expected at least one entry")
    return entries
