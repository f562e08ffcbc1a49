"""Several arms on a trunk solved as one: targets missed, times, following, collisions, peers.

Targets are the contacts of configurations drawn within limits, so all can be reached. What is done
is kept: a run that is stopped goes on where it was::

    python studies/one_body.py
    python studies/one_body.py --robots g1+dex3 --count 1000000 --peers 0
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from one_body_peers import by_contacts, by_wrists
from runner.figures import RESULTS
from runner.parts import read_parts, run_parts
from runner.report import (
    Metric,
    command,
    markdown_table,
    median_metric,
    program,
    provenance,
    rate_metric,
    write_metrics,
    write_page,
)

import casadi_ik as ik
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array

ROBOTS = (
    "g1+dex3",
    "g1+inspire",
    "h1_2+inspire",
    "two_pandas+allegro",
    "two_ur10e+schunk_svh",
    "mobile_kuka_lwr_barrett",
    "baxter+ar10",
    "baxter+barrett_bh8_280",
)
TOLERANCES = {
    "5 mm, 3 deg": ik.Tolerance(),
    "1e-6": ik.Tolerance(position=1e-6, angle=1e-6),
}
BLOCK = 20_000
"""Targets solved in one call."""
PART = 100_000
"""Targets kept as one result."""
ALONE = 300
"""Targets solved one by one; poses of the path that is followed."""
CYCLES = 2000
"""Of hands that are led through each other, at 1 kHz."""

INTRODUCTION = """
A target is what all fingertips of a configuration touch, so it can be reached: *random* ones are
drawn within the limits of all motors, *near limits* each motor is with probability 1/2 within 1 %
of its range of an end. Times are processor times of one thread of this machine, of a batch per
target; *one alone* is `Solver.fast`, the median.
"""


OTHERS = """
Random targets at 5 mm and 3 deg, mean processor times. Solvers of frames or residuals move all
motors of the body as those of one hand; they start at home, then at up to 400 other postures.
"""
WRISTS = """
Poses of both palms along a path, as in teleoperation: three seconds from a posture of the arms to a
random other one, 30 poses a second, each from the last answer. *Met* within 5 mm and 3 deg. The
cost of xr_teleoperate's program has terms that hold the arms back, its answers lag.
"""


@dataclass(frozen=True)
class Cell:
    """A part of the study.

    Attributes:
        robot: Name of it.
        what: A row of `TABLES`.
        count: Targets, or poses.
        seed: Of what is drawn.
        tolerance: A name of `TOLERANCES`.
        first: Number of the first target.
    """

    robot: str
    what: str
    count: int
    seed: int
    tolerance: str = "5 mm, 3 deg"
    first: int = 0

    @property
    def path(self) -> Path:
        """Where it is kept."""
        number = list(TOLERANCES).index(self.tolerance)
        name = f"{self.what}-{number}-{self.first}-{self.count}-{self.seed}.json"
        return Path(self.robot) / name.replace(" ", "_")

    @property
    def size(self) -> int:
        """How many targets."""
        return self.count


def drawn(robot: ArmHand, count: int, near: bool, seed: int) -> np.ndarray:
    """(count, n) configurations within limits."""
    rng = np.random.default_rng(seed)
    part = rng.random((count, len(robot.lower)))
    if near:
        at_end = rng.random(part.shape) < 0.5
        part = np.where(at_end, np.where(part < 0.5, 0.02 * part, 1 - 0.02 * (1 - part)), part)
    return robot.lower + part * (robot.upper - robot.lower)


def batch(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """How many targets of a part are missed, and the time [s] that it takes."""
    near = cell.what == "near limits"
    solver = ik.Solver(robot, tolerance=TOLERANCES[cell.tolerance])
    solver.solve_batch(*robot.contacts(drawn(robot, 1000, near, cell.seed + 1)))
    missed, spent = 0, 0.0
    for first in range(cell.first, cell.first + cell.count, BLOCK):
        some = min(BLOCK, cell.first + cell.count - first)
        points, normals = robot.contacts(drawn(robot, some, near, cell.seed + 2 + first))
        begun = time.process_time()
        found = solver.solve_batch(points, normals)
        spent += time.process_time() - begun
        missed += int((found.status != ik.Status.SOLVED).sum())
    return {"missed": missed, "spent": spent}


def alone(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Median time [us] of one target by itself."""
    fast, spent = ik.Solver(robot).fast(), []
    every = zip(*robot.contacts(drawn(robot, cell.count, False, cell.seed)), strict=True)
    for points, normals in every:
        begun = time.process_time()
        fast(points, normals)
        spent.append(time.process_time() - begun)
    return {"time": 1e6 * float(np.median(spent[10:]))}


def row(*cells: str) -> dict[str, Any]:
    """A result that is a row of its table as it is."""
    return {"rows": [list(cells)]}


def followed(_cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """A smooth path of all motors, followed: times [us], and error [mm]."""
    span, phase = robot.upper - robot.lower, np.arange(len(robot.lower))
    times = np.arange(3000)[:, None]
    swing = 0.1 * span * np.sin(0.001 * times + phase) * np.minimum(1.0, times / 1000)
    path = np.clip(robot.home + swing, robot.lower, robot.upper)
    points, normals = robot.contacts(path)
    follower, spent, off = ik.Solver(robot).follow(path[0]), [], []
    for goal, facing in zip(points, normals, strict=True):
        begun = time.perf_counter()
        q = follower(goal, facing)
        spent.append(1e6 * (time.perf_counter() - begun))
        off.append(np.linalg.norm(robot.contacts(q)[0] - goal, axis=1).max())
    median, most = np.median(spent), np.quantile(spent, 0.99)
    return row(robot.name, f"{median:.1f}", f"{most:.1f}", f"{1e3 * np.median(off):.2f}")


def crossed(_cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Hands led to each other's place and back, through each other, followed in a scene."""
    sides = robot.description.sides
    if len(sides) != 2 or not robot.description.shapes.capsules:
        return {"rows": []}
    solver, (points, normals) = ik.Solver(robot, scene=ik.Scene()), robot.contacts(robot.home)
    rows = [[robot.fingers.index(finger) for finger in side.fingers] for side in sides]
    way = points[rows[1]].mean(axis=0) - points[rows[0]].mean(axis=0)
    q: list[Array] = []
    spent: list[float] = []
    blocked = 0
    for _ in range(2):  # once to have all compiled and warm
        follower, q, spent, blocked = solver.follow(robot.home), [robot.home], [], 0
        for share in np.sin(np.linspace(0, np.pi, CYCLES)) ** 2:
            goal = points.copy()
            goal[rows[0]] += share * way
            goal[rows[1]] -= share * way
            begun = time.process_time()
            q.append(follower(goal, normals))
            spent.append(1e6 * (time.process_time() - begun))
            blocked += follower.state.status is ik.motion.FollowStatus.BLOCKED
    every = zip(robot.fingers, points, normals, strict=True)
    grasp = ik.Grasp(name="home", contacts={f: ik.Contact(p, n) for f, p, n in every})
    room = solver.check(np.array(q), grasp)
    assert room is not None
    median, most = np.median(spent), np.quantile(spent, 0.99)
    least = f"{1e3 * room.surplus.min():.3f}"
    return row(robot.name, f"{median:.1f}", f"{most:.1f}", f"{blocked} of {CYCLES}", least)


def free(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Targets made by configurations that touch nothing: answers that touch nothing either."""
    if not robot.description.shapes.capsules:
        return {"rows": []}
    solver, plain = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot)

    def grasp(q: np.ndarray) -> ik.Grasp:
        points, normals = robot.contacts(q)
        pairs = zip(robot.fingers, points, normals, strict=True)
        return ik.Grasp(name="free", contacts={f: ik.Contact(p, n) for f, p, n in pairs})

    about, kept, number, count = grasp(robot.home), list[np.ndarray](), 0, cell.count
    while len(kept) < count:
        some = drawn(robot, 1000, False, cell.seed + number)
        room = solver.check(some, about)
        assert room is not None
        kept += list(some[room.distance > 0])
        number += 1
        if number > 1000:
            return {"rows": []}
    points, normals = robot.contacts(np.array(kept[:count]))
    first = solver.check(plain.solve_batch(points, normals).q, about)
    assert first is not None
    solver.solve_batch(points, normals)  # all that is needed is compiled now
    begun = time.process_time()
    found = solver.solve_batch(points, normals)
    each = 1e3 * (time.process_time() - begun) / count
    solved = int((found.status == ik.Status.SOLVED).sum())
    hits = int((first.distance <= 0).sum())
    return row(robot.name, f"{hits} of {count}", f"{solved} of {count}", f"{each:.2f}")


def contacts(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Targets solved by others."""
    return {"rows": by_contacts(robot, drawn(robot, cell.count, False, cell.seed))}


def wrists(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Palms' poses solved by others."""
    return {"rows": by_wrists(robot, cell.count, cell.seed)}


@dataclass(frozen=True)
class Table:
    """What a robot is asked for, and where the report has it.

    Attributes:
        find: Works a part out.
        title: What stands before it.
        heads: Of its columns.
    """

    find: Callable[[Cell, ArmHand], dict[str, Any]]
    title: str = ""
    heads: tuple[str, ...] = ()


MISSES = ("robot", "targets", "tolerance", "missed", "a target [us]", "one alone [us]")
TABLES = {
    "random": Table(batch),
    "near limits": Table(batch),
    "alone": Table(alone),
    "followed": Table(
        followed,
        "## Followed at 1 kHz",
        ("robot", "a cycle, median [us]", "99th percent [us]", "error, median [mm]"),
    ),
    "crossed": Table(
        crossed,
        "## Hands led through each other\n\nBoth are led to the other's place and back, in "
        f"{CYCLES} cycles of 1 ms, by a follower that knows the robot's shapes. *Blocked*: "
        "cycles in which it holds back.",
        (
            *("robot", "a cycle, median [us]", "99th percent [us]"),
            *("blocked", "least clearance [mm]"),
        ),
    ),
    "free": Table(
        free,
        "## Touching nothing\n\nTargets of configurations that do not touch themselves. "
        "*First*: answers of a solver without a scene that do.",
        ("robot", "first answers that touch", "free answers", "a target [ms]"),
    ),
    "contacts": Table(
        contacts, "## Other ways\n\n" + OTHERS, ("robot", "way", "solved", "a target [us]")
    ),
    "wrists": Table(
        wrists, WRISTS, ("robot", "way", "met", "off, median [mm]", "a pose, median [us]")
    ),
}
"""All there is to ask, in the report's order."""


def work_out(cell: Cell) -> dict[str, Any]:
    """What comes of a part."""
    return TABLES[cell.what].find(cell, ik.load_robot(cell.robot))


def cells(options: argparse.Namespace) -> list[Cell]:
    """All parts."""
    every = list[Cell]()
    for robot in options.robots:
        one = partial(Cell, robot, seed=options.seed)
        for first in range(0, options.count, PART):
            some = min(PART, options.count - first)
            every += [
                one(what=what, count=some, tolerance=tolerance, first=first)
                for what in ("random", "near limits")
                for tolerance in TOLERANCES
            ]
        every += [one(what="alone", count=ALONE)] if options.count else []
        every += [one(what="followed", count=1), one(what="crossed", count=1)]
        every += [one(what="free", count=options.free)] if options.free else []
        if options.peers and robot == options.robots[0]:
            every.append(one(what="contacts", count=options.peers))
            every.append(one(what="wrists", count=2 * options.peers))
    return every


def misses(done: list[tuple[Cell, dict[str, Any]]]) -> tuple[list[list[str]], list[Metric]]:
    """Rows of targets missed, and metrics."""
    rows, metrics = list[list[str]](), list[Metric]()
    robots = dict.fromkeys(cell.robot for cell, _ in done)
    for name in robots:
        own = [(cell, found) for cell, found in done if cell.robot == name]
        single = [found["time"] for cell, found in own if cell.what == "alone"]
        metrics += [median_metric(f"one_body/{name}/alone", single, "us")] if single else []
        label = f"{name} ({len(ik.load_robot(name).actuators)} motors)"
        kinds = dict.fromkeys((cell.what, cell.tolerance) for cell, f in own if "missed" in f)
        for kind in kinds:
            some = [(c, f) for c, f in own if (c.what, c.tolerance) == kind and "missed" in f]
            count = sum(cell.count for cell, _ in some)
            missed = sum(found["missed"] for _, found in some)
            each = 1e6 * sum(found["spent"] for _, found in some) / count
            key = f"one_body/{name}/{kind[0]}/{kind[1]}"
            metrics.append(rate_metric(f"{key}/solved", count - missed, count))
            metrics.append(median_metric(f"{key}/time", [each], "us"))
            alone = f"{single[0]:.0f}" if single else ""
            rows.append([label, *kind, f"{missed} of {count}", f"{each:.1f}", alone])
    return rows, metrics


def main(arguments: list[str] | None = None) -> None:
    """Solve and write the report."""
    parser = argparse.ArgumentParser(description="Several arms on a trunk, solved as one.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--count", type=int, default=100_000, help="targets of every kind; 0: none")
    parser.add_argument("--free", type=int, default=500, help="targets without collision; 0: none")
    parser.add_argument("--peers", type=int, default=100, help="targets for other ways; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin nothing after")
    parser.add_argument("--parts", type=Path, default=Path("out/one_body"), help="results of parts")
    parser.add_argument("--out", type=Path, default=RESULTS / "one_body")
    options = parser.parse_args(arguments)
    every, until = cells(options), time.monotonic() + 60 * options.minutes
    run_parts(work_out, every, options.parts, jobs=options.jobs, until=until)
    done, codes = read_parts(options.parts, every)
    table, metrics = misses(done)
    parts = [INTRODUCTION, markdown_table(MISSES, table)] if table else []
    for what, wanted in TABLES.items():
        rows = [row for cell, found in done if cell.what == what for row in found.get("rows", [])]
        parts += [wanted.title, markdown_table(wanted.heads, rows)] if rows else []
    if len(done) < len(every):
        parts.append(f"Of {len(every):,} parts {len(done):,} are done so far.")
    made = command(__file__, arguments)
    parts += ["## Where this comes from", f"`{made}`", provenance({"one_body": codes})]
    write_page("Several arms as one", parts, options.out)
    write_metrics(metrics, options.out / "metrics.json")


if __name__ == "__main__":
    program(main)
