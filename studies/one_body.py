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
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

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
BEYOND = (1e-3, 5e-3, 20e-3, 50e-3)
"""How far out of reach targets are [m]."""
SEARCH = 20_000
"""Answers that a random search looks at for one that touches nothing."""
SEARCHED = 1000
"""Of them, in one call."""

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
    median, most = np.median(spent), np.quantile(spent, 0.99)
    least = f"{1e3 * room_of(solver, np.array(q)).min():.3f}"
    return row(robot.name, f"{median:.1f}", f"{most:.1f}", f"{blocked} of {CYCLES}", least)


def grasp(robot: ArmHand, points: Array, normals: Array) -> ik.Grasp:
    """Contacts (f, 3) of all fingers."""
    every = zip(robot.fingers, points, normals, strict=True)
    return ik.Grasp(name="target", contacts={f: ik.Contact(p, n) for f, p, n in every})


def room_of(solver: ik.Solver, q: Array) -> Array:
    """(k,) how far configurations are from touching anything [m]; < 0: they do."""
    room = solver.check(q, grasp(solver.robot, *solver.robot.contacts(solver.robot.home)))
    assert room is not None
    return room.surplus


def untouched(solver: ik.Solver, count: int, seed: int) -> Array:
    """(count, n) random configurations that touch nothing; none where they are too rare."""
    kept = np.zeros((0, len(solver.robot.lower)))
    for number in range(1000):
        some = drawn(solver.robot, 1000, False, seed + number)
        kept = np.concatenate([kept, some[room_of(solver, some) > 0]])
        if len(kept) >= count:
            return kept[:count]
    return kept[:0]


def free(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Targets made by configurations that touch nothing: answers that touch nothing either."""
    if not robot.description.shapes.capsules:
        return {"rows": []}
    solver, plain, count = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot), cell.count
    kept = untouched(solver, count, cell.seed)
    if not len(kept):
        return {"rows": []}
    points, normals = robot.contacts(kept)
    hits = int((room_of(solver, plain.solve_batch(points, normals).q) <= 0).sum())
    solver.solve_batch(points, normals)  # all that is needed is compiled now
    begun = time.process_time()
    found = solver.solve_batch(points, normals)
    each = 1e3 * (time.process_time() - begun) / count
    solved = int((found.status == ik.Status.SOLVED).sum())
    return row(robot.name, f"{hits} of {count}", f"{solved} of {count}", f"{each:.2f}")


def beyond(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Targets moved away from the base until they are just out of reach."""
    solver, sides = ik.Solver(robot), robot.description.sides
    points, normals = robot.contacts(drawn(robot, cell.count, False, cell.seed))
    way = np.zeros_like(points)
    for place, side in enumerate(sides):
        own = [robot.fingers.index(finger) for finger in side.fingers]
        middle = points[:, own].mean(axis=1)
        moved = np.isin(np.arange(cell.count) % (len(sides) + 1), (place, len(sides)))
        way[:, own] = (moved[:, None] * middle / np.linalg.norm(middle, axis=1)[:, None])[:, None]
    reached, step = np.zeros(cell.count), np.full(cell.count, 0.1)
    for _ in range(18):
        there = points + (reached + step)[:, None, None] * way
        met = solver.solve_batch(there, normals).success
        reached[met] += step[met]
        step = np.where(met, step, step / 2)
    rows = []
    for far in BEYOND:
        there, fast, spent = points + (reached + far)[:, None, None] * way, solver.fast(), []
        for goal, facing in zip(there, normals, strict=True):
            begun = time.process_time()
            fast(goal, facing)
            spent.append(1e3 * (time.process_time() - begun))
        met = solver.solve_batch(there, normals).success.sum()
        why = solver.solve_batch(there, normals, diagnose=True).status
        times = [f"{time:.0f}" for time in (np.mean(spent), np.quantile(spent, 0.99), max(spent))]
        proved = str((why == ik.Status.UNREACHABLE).sum())
        rows.append([robot.name, f"{1e3 * far:.0f}", str(cell.count), *times, str(met), proved])
    return {"rows": rows}


def around(
    points: Array, normals: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(count, f, 3) contacts and normals, evenly spread over what the tolerance allows."""
    tolerance = ik.Tolerance()
    shift, turn = rng.standard_normal((2, count, *points.shape))
    shift /= np.linalg.norm(shift, axis=2, keepdims=True)
    turn -= (turn * normals).sum(axis=2, keepdims=True) * normals
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    part = rng.random((2, count, len(points), 1))
    angle = tolerance.angle * np.sqrt(part[1])
    moved = points + tolerance.position * np.cbrt(part[0]) * shift
    return moved, np.cos(angle) * normals + np.sin(angle) * turn


def random_search(
    solver: ik.Solver, plain: ik.Solver, points: Array, normals: Array, seed: int
) -> bool:
    """Whether one of `SEARCH` answers to a target from random postures touches nothing.

    By turns the target itself is solved, which finds other trunks and arms, and targets within its
    tolerances, which finds other hands.
    """
    robot, rng, tolerance = solver.robot, np.random.default_rng(seed), ik.Tolerance()
    for block in range(0, SEARCH, SEARCHED):
        asked = np.tile(points, (SEARCHED, 1, 1)), np.tile(normals, (SEARCHED, 1, 1))
        if block % (2 * SEARCHED):
            asked = around(points, normals, SEARCHED, rng)
        found = plain.solve_batch(*asked, q0=robot.random(rng, SEARCHED), prefer="q0")
        at, facing = robot.contacts(found.q)
        off = np.linalg.norm(at - points, axis=2).max(axis=1)
        turned = np.arccos(np.clip((facing * normals).sum(axis=2), -1, 1)).max(axis=1)
        met = found.success & (off <= tolerance.position) & (turned <= tolerance.angle)
        if (room_of(solver, found.q[met]) >= 0).any():
            return True
    return False


def searched(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Targets of which nobody knows whether they have a free answer, beside a random search."""
    if not robot.description.shapes.capsules:
        return {"rows": []}
    solver, plain = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot)
    hands = list(robot.description.hand_actuators)
    q = drawn(robot, cell.count, False, cell.seed + 10**6)
    with_free = q.copy()
    apart = untouched(solver, cell.count, cell.seed + 2 * 10**6)
    with_free[: len(apart), hands] = apart[:, hands]
    rows = []
    for kind, some in {"any": q, "free": with_free[: len(apart)]}.items():
        points, normals = robot.contacts(some)
        left = np.flatnonzero(~solver.solve_batch(points, normals).success)
        missed = [
            int(i) for i in left if random_search(solver, plain, points[i], normals[i], int(i))
        ]
        ours, alone = len(some) - len(left), len(missed)
        share = f"{100 * ours / max(ours + alone, 1):.2f} %"
        numbers = str(ours), str(alone), str(len(left) - alone), share
        rows.append([robot.name, kind, *numbers])
    return {"rows": rows}


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
    "beyond": Table(
        beyond,
        "## Just out of reach\n\nContacts of random configurations, those of one side or of all "
        "moved away from the base until no answer is found, and so much farther. One by one; "
        "*solved* are those that a batch finds an answer for after all, *proved* are verdicts "
        "UNREACHABLE of a diagnosis.",
        (
            *("robot", "beyond [mm]", "targets", "a target, mean [ms]", "99th percent [ms]"),
            *("longest [ms]", "solved", "proved"),
        ),
    ),
    "free": Table(
        free,
        "## Touching nothing\n\nTargets of configurations that do not touch themselves. "
        "*First*: answers of a solver without a scene that do.",
        ("robot", "first answers that touch", "free answers", "a target [ms]"),
    ),
    "searched": Table(
        searched,
        f"Beside a search: where no free answer is found, {SEARCH:,} answers from random postures "
        "are looked at, half of them to the target and half to targets within its tolerances. "
        "Trunk and arms that make the targets are random, touching or not; *hands* are random too "
        "(any), or those of configurations that touch nothing (free). *Share* is of the targets "
        "for which either finds one.",
        ("robot", "hands", "free answers", "the search alone", "neither", "share"),
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
        for what in ("beyond", "free", "searched"):
            count = getattr(options, what)
            every += [one(what=what, count=count)] if count else []
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
    parser.add_argument("--beyond", type=int, default=60, help="targets out of reach; 0: none")
    parser.add_argument("--free", type=int, default=500, help="targets without collision; 0: none")
    parser.add_argument(
        "--searched", type=int, default=200, help="targets beside a random search; 0: none"
    )
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
