"""Targets of the study of misses: their parts, and the solves that count what is missed."""

from __future__ import annotations

import argparse
import time
import warnings
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from climbing import climb
from minimax import MinimaxProgram
from samplers import SAMPLERS, displaced, finger_sets, noisy, random_hands, suits

import casadi_ik as ik
from casadi_ik.errors import InputError, InputWarning
from casadi_ik.files.arrays import Array

ARTIFICIAL_ROBOTS = {path.stem: path for path in (Path(__file__).parent / "robots").glob("*.yaml")}
"""Robots that no parameter of a method was chosen for, and their arms."""

ROBOTS = (
    *("kuka_lwr_barrett", "kuka_lwr_barrett_coupled", "ar10", "baxter_ar10"),
    *("seven_axes_four_fingers", "six_axes_coupled_barrett"),
)

DISPLACED = "tolerances"
"""The sampler of contacts that are displaced within their tolerance."""

KINDS_OF_CONTACTS = {
    "palms": "palms of random hands",
    "noise": "noisy contacts of random hands",
    DISPLACED: "displaced contacts of random hands",
}
"""Targets that are palms with the posture of a hand, or contacts that no configuration has."""

ANGLES, DISTANCES, SHARES = (1, 3, 10, 30, 60), (1, 5, 20), (0.5, 0.8, 0.95)
"""Tolerances [deg] and [mm], and shares of them by which contacts are displaced."""

REFERENCE, SCALE = "kuka_lwr_barrett", 1000
"""`--ratio`: times over those of so many random targets of this robot, in the same process."""

STARTS = 20
"""Number of starts of the minimax program for a target."""


@dataclass(frozen=True)
class Part:
    """Targets that are solved in one call.

    Attributes:
        robot: Name of the robot.
        sampler: Key of `SAMPLERS` or of `KINDS_OF_CONTACTS`.
        fingers: Which have a contact, see `finger_sets`.
        tolerance: See `tolerance_of`.
        number: Of the part.
        size: Targets in it.
        seed: Of the targets.
        arm_hand: The robot itself: a worker of a cluster need not have its file.
        noise: Standard deviation of contacts [mm] and [deg], of noisy ones.
        searched_count: How many missed ones of noisy contacts are given to Ipopt.
        ratio: Whether times are set beside those of the reference.
        share: Share of the tolerance by which contacts are displaced.
    """

    robot: str
    sampler: str
    fingers: str
    tolerance: str
    number: int
    size: int
    seed: int
    arm_hand: ik.ArmHand = field(repr=False, compare=False)
    noise: tuple[float, float] = (0.0, 0.0)
    searched_count: int = 0
    ratio: bool = False
    share: float = 0.0

    @property
    def path(self) -> Path:
        """Path of its counts."""
        kind = self.sampler
        if any(self.noise):
            kind += f" {self.noise[0]:g} {self.noise[1]:g}, {self.searched_count} searched"
        if self.share:
            kind += f" {self.share:g}"
        name = f"{self.number:05d}-{self.size}-{self.seed}.json"
        return Path(self.robot) / f"{kind}, {self.fingers}" / self.tolerance / name

    @property
    def kind(self) -> str:
        """Kind of targets in words."""
        words = (
            KINDS_OF_CONTACTS[self.sampler]
            if self.sampler in KINDS_OF_CONTACTS
            else SAMPLERS[self.sampler][0]
        )
        return words if self.fingers == "all" else f"{words}; {self.fingers} fingers"


def tolerance_of(text: str) -> ik.Tolerance:
    """Read "default", one number of metres and of radians, or two, "METRES,RADIANS"."""
    if text == "default":
        return ik.Tolerance()
    try:
        position, _, angle = text.partition(",")
        return ik.Tolerance(float(position), float(angle or position))
    except ValueError as error:
        raise InputError(
            f"--tolerance: found {text!r}, expected default, NUMBER or METRES,RADIANS"
        ) from error


def tolerance_name(text: str) -> str:
    """Return a tolerance as text in convenient units."""
    tolerance = tolerance_of(text)
    if tolerance.position < 1e-4:
        return f"{tolerance.position:.2g} m, {tolerance.angle:.2g} rad".replace("e-0", "e-")
    return f"{1e3 * tolerance.position:g} mm, {np.rad2deg(tolerance.angle):.4g} deg"


@cache
def load(name: str) -> ik.ArmHand:
    """Load a built-in robot, or one of `ARTIFICIAL_ROBOTS`."""
    return ik.load_robot(ARTIFICIAL_ROBOTS.get(name, name))


SOLVERS: dict[tuple[str, str], ik.Solver] = {}
"""Solvers of this process, by robot and tolerance."""


def _solver(robot: ik.ArmHand, tolerance: str) -> ik.Solver:
    key = robot.name, tolerance
    if key not in SOLVERS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)  # wide tolerances are a part of the study
            SOLVERS[key] = ik.Solver(robot, tolerance=tolerance_of(tolerance))
    return SOLVERS[key]


@cache
def _reference(tolerance: str) -> tuple[ik.Solver, tuple[Array, Array]]:
    solver = _solver(load(REFERENCE), tolerance)
    targets = solver.robot.contacts(solver.robot.random(np.random.default_rng(0), SCALE))
    solver.solve_batch(*targets)
    return solver, targets


def _scale(part: Part) -> float:
    """Processor time of a target of the reference [s]."""
    solver, targets = _reference(part.tolerance)
    begun = time.thread_time()
    solver.solve_batch(*targets)
    return (time.thread_time() - begun) / SCALE


def solve(part: Part) -> dict[str, Any]:
    """Solve a part and count."""
    solver = _solver(part.arm_hand, part.tolerance)
    robot = solver.robot
    title_ = KINDS_OF_CONTACTS.get(part.sampler) or SAMPLERS[part.sampler][0]
    rng = np.random.default_rng([part.seed, zlib.crc32(title_.encode()), part.number])
    draw = random_hands if part.sampler in KINDS_OF_CONTACTS else SAMPLERS[part.sampler][1]
    q = draw(robot, rng, part.size)
    points, normals = robot.contacts(q)
    if part.sampler == "noise":
        metres, angle = 1e-3 * part.noise[0], float(np.radians(part.noise[1]))
        points, normals = noisy(points, normals, rng, metres, angle)
    if part.share:
        allowed = tolerance_of(part.tolerance)
        metres, angle = part.share * allowed.position, part.share * allowed.angle
        points, normals = displaced(points, normals, rng, metres, angle)
    fingers = finger_sets(robot, [part.fingers])[part.fingers]
    free = np.setdiff1d(np.arange(len(robot.fingers)), fingers)
    points[:, free] = normals[:, free] = np.nan

    def answers(count: int) -> ik.BatchSolution:
        if part.sampler == "palms":
            return solver.solve_palms(robot.palm(q[:count]), q[:count])
        return solver.solve_batch(points[:count], normals[:count])

    answers(min(part.size, 300))  # no time holds a first use
    time_before = _scale(part) if part.ratio else np.nan
    begun = time.thread_time()
    batch = answers(part.size)
    seconds = time.thread_time() - begun
    after = _scale(part) if part.ratio else np.nan
    missed_rows = np.flatnonzero(~batch.success)
    result: dict[str, Any] = {
        "count": part.size,
        "seconds": seconds,
        "ratio": 2 * seconds / part.size / (time_before + after) if part.ratio else None,
        "iterations": int(batch.iterations.sum()),
        "most iterations": int(batch.iterations.max()),
        "restarted": int((batch.restarts > 0).sum()),
        "most restarts": int(batch.restarts.max()),
        "times": [1e6 * float(np.quantile(batch.time, share)) for share in (0.5, 0.99, 1.0)],
        "missed": [
            {"row": int(row), "status": str(batch.status_names[row]), "q": q[row].tolist()}
            for row in missed_rows
        ],
    }
    if part.sampler == "noise":
        rows = missed_rows[: part.searched_count].tolist()
        possible = 0
        names = [robot.fingers[i] for i in fingers]
        ipopt = MinimaxProgram(robot, tolerance_of(part.tolerance), names) if rows else None
        for row in rows:
            assert ipopt is not None
            starts = robot.random(np.random.default_rng([part.seed, row]), STARTS)
            starts[0], starts[1] = q[row], batch.q[row]
            possible += ipopt.nearest(points[row], normals[row], starts).factor <= 1
        result |= {"looked": len(rows), "possible": possible}
    return result


def robots_of(words: Sequence[str]) -> list[str]:
    """Return names of robots.

    "pairs" is every shipped arm with every shipped hand; "tour" is each arm once. "catalogue" is
    every shipped arm, hand with motors, arm-hand, and body.
    """
    arms, hands = ik.shipped_names("arms"), ik.shipped_names("hands")
    names: list[str] = []
    for word in words:
        if word == "pairs":
            pairs = [f"{arm}+{hand}" for arm in arms for hand in hands]
            # Mixed, so that a run that is stopped has seen something of every arm and every hand.
            names += sorted(pairs, key=lambda pair: zlib.crc32(pair.encode()))
        elif word == "tour":
            names += [f"{arm}+{hands[i % len(hands)]}" for i, arm in enumerate(arms)]
        elif word == "catalogue":
            bodies = ik.shipped_names("bodies")
            bodies = [f"{body}+leap" if body == "two_ur10e" else body for body in bodies]
            moving = [hand for hand in hands if load(hand).actuators]
            names += [*ik.shipped_names("arm_hands"), *moving, *arms, *bodies]
        else:
            names.append(word)
    return list(dict.fromkeys(names))


def parts_of(options: argparse.Namespace) -> Iterator[Part]:
    """Return all parts, alternating between robots, samplers and tolerances."""
    block = min(options.block, options.count)
    robots = {name: load(name) for name in robots_of(options.robots)}
    for number in range(-(-options.count // block)):
        for name, robot in robots.items():
            for sampler in options.sampler:
                palms = sampler == "palms"
                if sampler == DISPLACED:
                    yield from displaced_parts(options, name, robot, number, block)
                if sampler in ("climb", DISPLACED) or not suits(robot, sampler):
                    continue
                if palms and not robot.description.arm_actuators:
                    continue
                noisy_ = sampler == "noise"
                for fingers in finger_sets(robot, ["all"] if palms else options.fingers):
                    for tolerance in options.tolerance:
                        yield Part(
                            *(name, sampler, fingers, tolerance, number, block),
                            seed=options.seed,
                            arm_hand=robot,
                            noise=tuple(options.noise) if noisy_ else (0.0, 0.0),
                            searched_count=options.looked if noisy_ else 0,
                            ratio=options.ratio,
                        )


def displaced_parts(
    options: argparse.Namespace, name: str, robot: ik.ArmHand, number: int, block: int
) -> Iterator[Part]:
    """Yield the parts of a block with displaced contacts: all tolerances and shares."""
    for angle in ANGLES:
        for distance in DISTANCES:
            tolerance = f"{1e-3 * distance:g},{np.radians(angle):.12g}"
            for share in SHARES:
                yield Part(
                    *(name, DISPLACED, "all", tolerance, number, block),
                    seed=options.seed,
                    arm_hand=robot,
                    share=share,
                )


@dataclass(frozen=True)
class Climb:
    """The search of one robot.

    Attributes:
        robot: Its name.
        size: How long it takes in all [s].
        options: Of the study.
    """

    robot: str
    size: float
    options: argparse.Namespace

    @property
    def path(self) -> Path:
        """Path of its results."""
        return Path("climb") / f"{self.robot}-{self.size:g}-{self.options.seed}.json"

    @property
    def state(self) -> Path:
        """Path of the state of its climbers."""
        return self.options.out / "climb" / f"{self.robot}-{self.options.seed}.state.json"


def search(climb_part: Climb) -> dict[str, Any]:
    """Climb for as long as is asked."""
    robot = load(climb_part.robot)
    solvers = {name: _solver(robot, name) for name in climb_part.options.tolerance}
    search_state = climb(solvers, climb_part.state, climb_part.size, climb_part.options.seed)
    return {"seconds": search_state["seconds"]}
