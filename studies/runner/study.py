"""What a study is: sets of targets, and the ways in which each target is solved."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import casadi_ik as ik
from casadi_ik.arrays import Array

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
        """Where its results are, relative to the study's folder."""
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
        """All blocks, so that what is done so far is as many of every set and setting."""
        for number in range(-(-self.count // self.block)):
            size = min(self.block, self.count - number * self.block)
            for setting in self.settings:
                for targets in self.sets:
                    yield Block(targets, setting, number, size)

    def configurations(self, targets: TargetSet, number: int) -> Array:
        """Configurations (block, n) whose contacts are the targets of a whole block."""
        rng = np.random.default_rng([self.seed, zlib.crc32(targets.key.encode()), number])
        return targets.configurations(robot_of(self.robot), rng, self.block)

    def solver(self, setting: Setting) -> ik.Solver:
        """The solver of a setting, built once per process."""
        return _solver(setting.robot or self.robot, setting)

    def ready_solver(self, setting: Setting) -> ik.Solver:
        """The same, once it has solved a few targets: no result's time holds its first use."""
        return _used(setting.robot or self.robot, setting)

    def start(self, setting: Setting) -> Array:
        """The configuration (n,) a setting starts from."""
        robot = self.solver(setting).robot
        start = robot.home.copy()
        for actuator, value in setting.start.items():
            start[robot.actuators.index(actuator)] = value
        return start


@cache
def robot_of(name_or_path: str) -> ik.ArmHand:
    """A robot, loaded once per process."""
    return ik.load_robot(name_or_path)


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
def _used(robot: str, setting: Setting) -> ik.Solver:
    solver = _solver(robot, setting)
    home = solver.robot.home
    solver.solve_batch(*solver.robot.contacts(np.tile(home, (FIRST_USE, 1))))
    return solver
