"""A study: sets of targets times settings, solved block by block, resumable, in its own folder."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import casadi_ik as ik
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.logs import Keep
from runner.parts import PART, code_version, keep, solved

FIRST_USE = 8
"""Targets that a solver's first use is tried on: so many are also solved side by side."""


@dataclass(frozen=True)
class Setting:
    """A way to solve.

    Attributes:
        key: Its name in the results; also the name of a folder.
        method: One of `casadi_ik.METHODS`.
        limits: "enforce" or "ignore".
        options: Fields of the method's parameter record that differ from their defaults.
        tolerance: Position [m] and angle [rad].
        start: Start values by actuator that differ from the robot's home [rad or m].
        robot: Name or path, if it is not the study's.
    """

    key: str
    method: str
    limits: str = "enforce"
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    tolerance: tuple[float, float] = (5e-3, float(np.radians(3.0)))
    start: Mapping[str, float] = field(default_factory=dict, hash=False)
    robot: str | None = None


@dataclass(frozen=True)
class TargetSet:
    """Targets that are reachable by construction: the contacts of configurations.

    Attributes:
        key: Its name in the results; also the name of a folder.
        configurations: ``(robot, rng, count) -> (count, n)``; a function at the top of a module or
            a `functools.partial` of one, so that other processes can call it.
    """

    key: str
    configurations: Callable[[ik.ArmHand, np.random.Generator, int], Array]


@dataclass(frozen=True)
class Block:
    """The unit of work: one block of one set of targets, solved in one way.

    Attributes:
        targets: The set.
        setting: The way.
        number: Of the block in its set.
        size: Targets of it that are wanted; the last block of a set may be cut short.
    """

    targets: TargetSet
    setting: Setting
    number: int
    size: int

    @property
    def path(self) -> Path:
        """Path of its results, relative to the folder of the study."""
        return Path(self.setting.key) / self.targets.key / f"{self.number:05d}.parquet"


@dataclass(frozen=True)
class Study:
    """Sets of targets times settings.

    A block's targets depend on seed, set, number and size of the block alone: whoever solves them,
    in whatever order, and however many there are in all. A study can therefore grow: more targets,
    more sets and more settings leave what is done as it is.

    Attributes:
        name: Its name.
        robot: Name or path of the robot.
        sets: Sets of targets.
        settings: Ways to solve.
        count: Targets per set.
        seed: Of targets and methods.
        block: Targets per block.
    """

    name: str
    robot: str
    sets: tuple[TargetSet, ...]
    settings: tuple[Setting, ...]
    count: int
    seed: int = 0
    block: int = 100

    def blocks(self) -> Iterator[Block]:
        """Yield all blocks, alternating between sets and settings."""
        for number in range(-(-self.count // self.block)):
            size = min(self.block, self.count - number * self.block)
            for setting in self.settings:
                for targets in self.sets:
                    yield Block(targets, setting, number, size)

    def configurations(self, targets: TargetSet, number: int) -> Array:
        """Return the configurations (block, n) whose contacts are the targets of a block."""
        rng = np.random.default_rng([self.seed, zlib.crc32(targets.key.encode()), number])
        return targets.configurations(robot_of(self.robot), rng, self.block)

    def solver(self, setting: Setting) -> ik.Solver:
        """Return the solver of a setting, built once per process."""
        return _solver(setting.robot or self.robot, setting)

    def ready_solver(self, setting: Setting) -> ik.Solver:
        """Return the solver of a setting after a few solves as warm-up."""
        return _ready_solver(setting.robot or self.robot, setting)

    def start(self, setting: Setting) -> Array:
        """Return the start configuration (n,) of a setting."""
        robot = self.solver(setting).robot
        start = robot.home.copy()
        for actuator, value in setting.start.items():
            start[robot.actuators.index(actuator)] = value
        return start


@cache
def robot_of(name_or_path: str) -> ik.ArmHand:
    """Return a robot, loaded once per process."""
    return ik.load_robot(name_or_path)


def standing(surface: ik.Surface, turn: float, axis: int = 0) -> np.ndarray:
    """(4, 4) of an object that stands on the table.

    Args:
        surface: The object's.
        turn: Its yaw on the table [rad].
        axis: Which of its axes is up: 0 is z, 1 is y, 2 is x.
    """
    upright = np.roll(np.eye(3), -axis, axis=0)  # cyclic: z, then x, then y is up
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, :3] = pose[:3, :3] @ upright
    pose[:3, 3] = [0.5, 0.1, 0.002 - (surface.points @ upright.T)[:, 2].min()]
    return pose


@lru_cache(maxsize=8)
def _solver(robot: str, setting: Setting) -> ik.Solver:
    return ik.Solver(
        robot_of(robot),
        setting.method,
        ik.Tolerance(*setting.tolerance),
        limits=setting.limits,
        options=setting.options,
    )


@lru_cache(maxsize=8)
def _ready_solver(robot: str, setting: Setting) -> ik.Solver:
    solver = _solver(robot, setting)
    home = solver.robot.home
    solver.solve_batch(*solver.robot.contacts(np.tile(home, (FIRST_USE, 1))))
    return solver


def solve_block(study: Study, block: Block, log: Keep | None = None) -> dict[str, bytes]:
    """Solve a block: what a worker does; bytes, so that it needs no folder in common.

    Args:
        study: The study.
        block: The block.
        log: What to log; None: no log.

    Returns:
        Files by ending, the last of which is there when all are: an MCAP log if one was asked for,
        and a row per target as Parquet.
    """
    solver = study.ready_solver(block.setting)
    q = study.configurations(block.targets, block.number)[: block.size]
    points, normals = robot_of(study.robot).contacts(q)
    options: dict[str, Any] = {"seed": study.seed}
    if block.setting.start:
        # Said, it is also where the solution is to be near; else the same home is a start only.
        options["q0"] = study.start(block.setting)
    files: dict[str, bytes] = {}
    if log is None:
        batch = solver.solve_batch(points, normals, **options)
    else:
        # Solves are numbered from 0 in every log; with one seed all would keep the same numbers.
        keep_options = dataclasses.replace(log, seed=zlib.crc32(str(block.path).encode()))
        with tempfile.TemporaryDirectory(prefix="casadi_ik-study-") as place:
            path = Path(place) / "block.mcap"
            batch = solver.solve_batch(points, normals, **options, log=path, keep=keep_options)
            files[".mcap"] = path.read_bytes()
    table = io.BytesIO()
    _frame(study, block, batch, solver.robot.fingers).write_parquet(table)
    return files | {".parquet": table.getvalue()}


def _frame(
    study: Study, block: Block, batch: ik.BatchSolution, fingers: tuple[str, ...]
) -> pl.DataFrame:
    """Return a table with a row for each target."""
    count = len(batch)
    columns: dict[str, Any] = {
        "study": np.full(count, study.name),
        "setting": np.full(count, block.setting.key),
        "targets": np.full(count, block.targets.key),
        "target": block.number * study.block + np.arange(count),
        "method": np.full(count, block.setting.method),
        "limits": np.full(count, block.setting.limits),
        "success": batch.success,
        "status": batch.status_names,
        "iterations": batch.iterations,
        "restarts": batch.restarts,
        "time": batch.time,
    }
    for i, finger in enumerate(fingers):
        columns[f"position_error_{finger}"] = batch.position_error[:, i]
        columns[f"angle_error_{finger}"] = batch.angle_error[:, i]
    return pl.DataFrame(columns)


def run(
    study: Study, folder: Path, jobs: int = 1, dask: str | None = None, log: Keep | None = None
) -> None:
    """Solve what is missing.

    Args:
        study: The study.
        folder: Where its results are and go: one file per block. A run that is killed loses the
            blocks being solved and nothing else; the next one goes on.
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead; they need the installed
            package with its extra `dev`, and neither this folder nor this script.
        log: What to log, in one file per block; None: no logs.

    Raises:
        InputError: The folder holds results that were made otherwise, or the cluster cannot be
            used.
    """
    claim(study, folder)
    todo = missing(study, folder)
    for block, files in solved(partial(solve_block, study, log=log), todo, jobs, dask, study.name):
        for ending, content in files.items():
            keep((folder / block.path).with_suffix(ending), content)


STUDY_FILE = "study.json"


def fingerprint(study: Study) -> dict[str, Any]:
    """Return everything that determines a result, except the number of targets."""
    return {
        "code": code_version(),
        "robot": _digest(robot_of(study.robot).urdf()),
        "seed": study.seed,
        "block": study.block,
        "targets": {targets.key: _name(targets.configurations) for targets in study.sets},
        "settings": {
            setting.key: {
                **study.solver(setting).parameters,
                "start": study.start(setting).tolist(),
                "robot": _digest(study.solver(setting).robot.urdf()),
            }
            for setting in study.settings
        },
    }


def claim(study: Study, folder: Path) -> None:
    """Take a folder for a study, or take it up again.

    Parts that a killed run left behind are removed; new sets and settings are added.

    Raises:
        InputError: The folder holds results that were made otherwise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, expected = folder / STUDY_FILE, json.loads(json.dumps(fingerprint(study), default=str))
    if path.exists():
        stored = json.loads(path.read_text(encoding="utf-8"))
        for key, value in expected.items():
            if isinstance(value, dict):
                for name, entry in value.items():
                    _require_equal(
                        path, f"{key}.{name}", stored[key].setdefault(name, entry), entry
                    )
            else:
                _require_equal(path, key, stored[key], value)
        expected = stored
    elif any(folder.iterdir()):
        raise InputError(f"{folder}: holds files but no {STUDY_FILE}, expected an empty folder")
    keep(path, json.dumps(expected, indent=1) + "\n")
    for left in folder.rglob(f"*{PART}"):
        left.unlink(missing_ok=True)


def missing(study: Study, folder: Path) -> list[Block]:
    """Return the blocks without results, or with results of too few targets."""
    return [block for block in study.blocks() if _rows(folder / block.path) < block.size]


def _rows(path: Path) -> int:
    if not path.exists():
        return 0
    return int(pl.scan_parquet(path).select(pl.len()).collect().item())


def read_results(study: Study, folder: Path) -> pl.DataFrame:
    """Return all results of a study so far; no rows without results."""
    paths = [
        path
        for setting in study.settings
        for group in study.sets
        for path in sorted((folder / setting.key / group.key).glob("*.parquet"))
    ]
    return pl.read_parquet(paths) if paths else pl.DataFrame()


def code_of(folder: Path) -> str | None:
    """Version of the code a folder's results were made with, if there are any."""
    path = folder / STUDY_FILE
    if not path.exists():
        return None
    return json.loads(path.read_text(encoding="utf-8"))["code"]


def _require_equal(path: Path, key: str, stored_value: Any, expected: Any) -> None:
    if stored_value != expected:
        raise InputError(
            f"{path}: {key}: results made with {_brief(stored_value)} are here, this study has "
            f"{_brief(expected)}; use another folder"
        )


def _brief(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"settings {_digest(text)}"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _name(function: Any) -> str:
    if isinstance(function, partial):
        arguments = [*map(str, function.args), *(f"{k}={v}" for k, v in function.keywords.items())]
        return f"{_name(function.func)}({', '.join(arguments)})"
    return function.__qualname__
