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
from runner.parts import add_part_options, complete_parts
from runner.report import (
    Metric,
    command,
    markdown_table,
    median_metric,
    program,
    publish,
    rate_metric,
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
SINGLE_TARGETS = 300
"""Targets solved one by one; poses of the path that is followed."""
CYCLES = 2000
"""Number of cycles of crossing hands, at 1 kHz."""
EXCESSES = (1e-3, 5e-3, 20e-3, 50e-3)
"""Distances beyond the reach [m]."""
SEARCH = 20_000
"""Answers that a random search looks at for one that touches nothing."""
SEARCH_BATCH = 1000
"""Number of solutions of the random search in one call."""

INTRODUCTION = """
Targets are the contacts of configurations and therefore reachable. *Random* configurations are
drawn within the limits of all motors; *near limits*, each motor is with probability 1/2 within 1
% of its range from a limit. Times are processor times of one thread, per target of a batch; *one
alone* is the median of `Solver.fast`.
"""


OTHER_METHODS = """
Random targets at 5 mm and 3 deg, mean processor times. Solvers of frames or residuals treat all
motors of the robot as those of one hand; they start at home, then at up to 400 other
configurations.
"""
WRISTS = """
Poses of both palms along a path, as in teleoperation: three seconds from one random configuration
of the arms to another, 30 poses per second, each solved from the previous solution. *Met* within
5 mm and 3 deg. The cost of the program of xr_teleoperate has damping terms, so its solutions lag.
"""


@dataclass(frozen=True)
class Cell:
    """A part of the study.

    Attributes:
        robot: Name of it.
        task: A row of `TABLES`.
        count: Targets, or poses.
        seed: Of what is drawn.
        tolerance: A name of `TOLERANCES`.
        first: Number of the first target.
    """

    robot: str
    task: str
    count: int
    seed: int
    tolerance: str = "5 mm, 3 deg"
    first: int = 0

    @property
    def path(self) -> Path:
        """Path of its result."""
        number = list(TOLERANCES).index(self.tolerance)
        name = f"{self.task}-{number}-{self.first}-{self.count}-{self.seed}.json"
        return Path(self.robot) / name.replace(" ", "_")

    @property
    def size(self) -> int:
        """Number of targets."""
        return self.count


def draw_configurations(robot: ArmHand, count: int, is_near_limits: bool, seed: int) -> np.ndarray:
    """Draw (count, n) configurations within limits."""
    rng = np.random.default_rng(seed)
    part = rng.random((count, len(robot.lower)))
    if is_near_limits:
        at_end = rng.random(part.shape) < 0.5
        part = np.where(at_end, np.where(part < 0.5, 0.02 * part, 1 - 0.02 * (1 - part)), part)
    return robot.lower + part * (robot.upper - robot.lower)


def batch(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Count the missed targets of a part, and measure the time [s]."""
    near_limits = cell.task == "near limits"
    solver = ik.Solver(robot, tolerance=TOLERANCES[cell.tolerance])
    solver.solve_batch(
        *robot.contacts(draw_configurations(robot, 1000, near_limits, cell.seed + 1))
    )
    missed, seconds = 0, 0.0
    for first in range(cell.first, cell.first + cell.count, BLOCK):
        size = min(BLOCK, cell.first + cell.count - first)
        points, normals = robot.contacts(
            draw_configurations(robot, size, near_limits, cell.seed + 2 + first)
        )
        start = time.process_time()
        solution = solver.solve_batch(points, normals)
        seconds += time.process_time() - start
        missed += int((solution.status != ik.Status.SOLVED).sum())
    return {"missed": missed, "spent": seconds}


def solve_singly(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Return the median time of a single target [us]."""
    fast, seconds = ik.Solver(robot).fast(), []
    targets = zip(
        *robot.contacts(draw_configurations(robot, cell.count, False, cell.seed)), strict=True
    )
    for points, normals in targets:
        start = time.process_time()
        fast(points, normals)
        seconds.append(time.process_time() - start)
    return {"time": 1e6 * float(np.median(seconds[10:]))}


def row(*cells: str) -> dict[str, Any]:
    """Return a result with a single row."""
    return {"rows": [list(cells)]}


def follow_path(_cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Follow a smooth path of all motors; return times [us] and error [mm]."""
    span, phase = robot.upper - robot.lower, np.arange(len(robot.lower))
    times = np.arange(3000)[:, None]
    swing = 0.1 * span * np.sin(0.001 * times + phase) * np.minimum(1.0, times / 1000)
    path = np.clip(robot.home + swing, robot.lower, robot.upper)
    points, normals = robot.contacts(path)
    follower, times, errors = ik.Solver(robot).follow(path[0]), [], []
    for goal, normal in zip(points, normals, strict=True):
        start = time.perf_counter()
        q = follower(goal, normal)
        times.append(1e6 * (time.perf_counter() - start))
        errors.append(np.linalg.norm(robot.contacts(q)[0] - goal, axis=1).max())
    median, percentile = np.median(times), np.quantile(times, 0.99)
    return row(robot.name, f"{median:.1f}", f"{percentile:.1f}", f"{1e3 * np.median(errors):.2f}")


def cross_hands(_cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Move each hand to the position of the other and back, in a scene."""
    sides = robot.description.sides
    if len(sides) != 2 or not robot.description.shapes.capsules:
        return {"rows": []}
    solver, (points, normals) = ik.Solver(robot, scene=ik.Scene()), robot.contacts(robot.home)
    rows = [[robot.fingers.index(finger) for finger in side.fingers] for side in sides]
    offset = points[rows[1]].mean(axis=0) - points[rows[0]].mean(axis=0)
    q: list[Array] = []
    times: list[float] = []
    blocked = 0
    for _ in range(2):  # once to have all compiled and warm
        follower, q, times, blocked = solver.follow(robot.home), [robot.home], [], 0
        for share in np.sin(np.linspace(0, np.pi, CYCLES)) ** 2:
            goal = points.copy()
            goal[rows[0]] += share * offset
            goal[rows[1]] -= share * offset
            start = time.process_time()
            q.append(follower(goal, normals))
            times.append(1e6 * (time.process_time() - start))
            blocked += follower.state.status is ik.motion.FollowStatus.BLOCKED
    median, percentile = np.median(times), np.quantile(times, 0.99)
    clearance = f"{1e3 * clearance_of(solver, np.array(q)).min():.3f}"
    return row(
        robot.name, f"{median:.1f}", f"{percentile:.1f}", f"{blocked} of {CYCLES}", clearance
    )


def grasp(robot: ArmHand, points: Array, normals: Array) -> ik.Grasp:
    """Return a grasp with contacts (f, 3) of all fingers."""
    contacts = zip(robot.fingers, points, normals, strict=True)
    return ik.Grasp(name="target", contacts={f: ik.Contact(p, n) for f, p, n in contacts})


def clearance_of(solver: ik.Solver, q: Array) -> Array:
    """Return the clearances of configurations (k,) [m]; negative in collision."""
    clearance = solver.check(q, grasp(solver.robot, *solver.robot.contacts(solver.robot.home)))
    assert clearance is not None
    return clearance.surplus


def untouched(solver: ik.Solver, count: int, seed: int) -> Array:
    """Return (count, n) random collision-free configurations; none if they are too rare."""
    configurations = np.zeros((0, len(solver.robot.lower)))
    for number in range(1000):
        samples = draw_configurations(solver.robot, 1000, False, seed + number)
        configurations = np.concatenate(
            [configurations, samples[clearance_of(solver, samples) > 0]]
        )
        if len(configurations) >= count:
            return configurations[:count]
    return configurations[:0]


def solve_collision_free(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Solve targets of collision-free configurations without collision."""
    if not robot.description.shapes.capsules:
        return {"rows": []}
    solver, plain, count = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot), cell.count
    configurations = untouched(solver, count, cell.seed)
    if not len(configurations):
        return {"rows": []}
    points, normals = robot.contacts(configurations)
    hits = int((clearance_of(solver, plain.solve_batch(points, normals).q) <= 0).sum())
    solver.solve_batch(points, normals)  # all that is needed is compiled now
    start = time.process_time()
    solution = solver.solve_batch(points, normals)
    time_each = 1e3 * (time.process_time() - start) / count
    solved = int((solution.status == ik.Status.SOLVED).sum())
    return row(robot.name, f"{hits} of {count}", f"{solved} of {count}", f"{time_each:.2f}")


def solve_out_of_reach(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Solve targets that are moved away from the base until just out of reach."""
    solver, sides = ik.Solver(robot), robot.description.sides
    points, normals = robot.contacts(draw_configurations(robot, cell.count, False, cell.seed))
    directions = np.zeros_like(points)
    for index, side in enumerate(sides):
        fingers = [robot.fingers.index(finger) for finger in side.fingers]
        centre = points[:, fingers].mean(axis=1)
        is_moved = np.isin(np.arange(cell.count) % (len(sides) + 1), (index, len(sides)))
        directions[:, fingers] = (
            is_moved[:, None] * centre / np.linalg.norm(centre, axis=1)[:, None]
        )[:, None]
    distance, step = np.zeros(cell.count), np.full(cell.count, 0.1)
    for _ in range(18):
        targets = points + (distance + step)[:, None, None] * directions
        is_solved = solver.solve_batch(targets, normals).success
        distance[is_solved] += step[is_solved]
        step = np.where(is_solved, step, step / 2)
    rows = []
    for excess in EXCESSES:
        targets, fast, times = (
            points + (distance + excess)[:, None, None] * directions,
            solver.fast(),
            [],
        )
        for goal, normal in zip(targets, normals, strict=True):
            start = time.process_time()
            fast(goal, normal)
            times.append(1e3 * (time.process_time() - start))
        is_solved = solver.solve_batch(targets, normals).success.sum()
        statuses = solver.solve_batch(targets, normals, diagnose=True).status
        times = [f"{time:.0f}" for time in (np.mean(times), np.quantile(times, 0.99), max(times))]
        proved = str((statuses == ik.Status.UNREACHABLE).sum())
        rows.append(
            [robot.name, f"{1e3 * excess:.0f}", str(cell.count), *times, str(is_solved), proved]
        )
    return {"rows": rows}


def around(
    points: Array, normals: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw (count, f, 3) contacts and normals uniformly within the tolerance."""
    tolerance = ik.Tolerance()
    shift, tangent = rng.standard_normal((2, count, *points.shape))
    shift /= np.linalg.norm(shift, axis=2, keepdims=True)
    tangent -= (tangent * normals).sum(axis=2, keepdims=True) * normals
    tangent /= np.linalg.norm(tangent, axis=2, keepdims=True)
    uniform = rng.random((2, count, len(points), 1))
    angle = tolerance.angle * np.sqrt(uniform[1])
    displaced = points + tolerance.position * np.cbrt(uniform[0]) * shift
    return displaced, np.cos(angle) * normals + np.sin(angle) * tangent


def random_search(
    solver: ik.Solver, plain: ik.Solver, points: Array, normals: Array, seed: int
) -> bool:
    """Return whether one of `SEARCH` solutions from random starts is collision-free.

    By turns the target itself is solved, which finds other trunks and arms, and targets within its
    tolerances, which finds other hands.
    """
    robot, rng, tolerance = solver.robot, np.random.default_rng(seed), ik.Tolerance()
    for block in range(0, SEARCH, SEARCH_BATCH):
        targets = np.tile(points, (SEARCH_BATCH, 1, 1)), np.tile(normals, (SEARCH_BATCH, 1, 1))
        if block % (2 * SEARCH_BATCH):
            targets = around(points, normals, SEARCH_BATCH, rng)
        solutions = plain.solve_batch(*targets, q0=robot.random(rng, SEARCH_BATCH), prefer="q0")
        actual_points, actual_normals = robot.contacts(solutions.q)
        distances = np.linalg.norm(actual_points - points, axis=2).max(axis=1)
        angles = np.arccos(np.clip((actual_normals * normals).sum(axis=2), -1, 1)).max(axis=1)
        is_within = (
            solutions.success & (distances <= tolerance.position) & (angles <= tolerance.angle)
        )
        if (clearance_of(solver, solutions.q[is_within]) >= 0).any():
            return True
    return False


def compare_with_search(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Compare the solved targets with those of a random search."""
    if not robot.description.shapes.capsules:
        return {"rows": []}
    solver, plain = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot)
    hands = list(robot.description.hand_actuators)
    q = draw_configurations(robot, cell.count, False, cell.seed + 10**6)
    with_free = q.copy()
    collision_free = untouched(solver, cell.count, cell.seed + 2 * 10**6)
    with_free[: len(collision_free), hands] = collision_free[:, hands]
    rows = []
    for kind, configurations in {"any": q, "free": with_free[: len(collision_free)]}.items():
        points, normals = robot.contacts(configurations)
        unsolved = np.flatnonzero(~solver.solve_batch(points, normals).success)
        missed = [
            int(i) for i in unsolved if random_search(solver, plain, points[i], normals[i], int(i))
        ]
        solved, search_only = len(configurations) - len(unsolved), len(missed)
        percentage = f"{100 * solved / max(solved + search_only, 1):.2f} %"
        numbers = str(solved), str(search_only), str(len(unsolved) - search_only), percentage
        rows.append([robot.name, kind, *numbers])
    return {"rows": rows}


def contacts(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Solve targets with other solvers."""
    return {"rows": by_contacts(robot, draw_configurations(robot, cell.count, False, cell.seed))}


def wrists(cell: Cell, robot: ArmHand) -> dict[str, Any]:
    """Solve palm poses with other solvers."""
    return {"rows": by_wrists(robot, cell.count, cell.seed)}


@dataclass(frozen=True)
class Table:
    """A measurement and its table in the report.

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
    "alone": Table(solve_singly),
    "followed": Table(
        follow_path,
        "## Followed at 1 kHz",
        ("robot", "a cycle, median [us]", "99th percent [us]", "error, median [mm]"),
    ),
    "crossed": Table(
        cross_hands,
        "## Hands led through each other\n\nBoth are led to the other's place and back, in "
        f"{CYCLES} cycles of 1 ms, by a follower that knows the robot's shapes. *Blocked*: "
        "cycles in which it holds back.",
        (
            *("robot", "a cycle, median [us]", "99th percent [us]"),
            *("blocked", "least clearance [mm]"),
        ),
    ),
    "beyond": Table(
        solve_out_of_reach,
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
        solve_collision_free,
        "## Touching nothing\n\nTargets of configurations that do not touch themselves. "
        "*First*: answers of a solver without a scene that do.",
        ("robot", "first answers that touch", "free answers", "a target [ms]"),
    ),
    "searched": Table(
        compare_with_search,
        f"Beside a search: where no free answer is found, {SEARCH:,} answers from random postures "
        "are looked at, half of them to the target and half to targets within its tolerances. "
        "Trunk and arms that make the targets are random, touching or not; *hands* are random too "
        "(any), or those of configurations that touch nothing (free). *Share* is of the targets "
        "for which either finds one.",
        ("robot", "hands", "free answers", "the search alone", "neither", "share"),
    ),
    "contacts": Table(
        contacts, "## Other ways\n\n" + OTHER_METHODS, ("robot", "way", "solved", "a target [us]")
    ),
    "wrists": Table(
        wrists, WRISTS, ("robot", "way", "met", "off, median [mm]", "a pose, median [us]")
    ),
}
"""Tables in the order of the report."""


def work_out(cell: Cell) -> dict[str, Any]:
    """Return the result of a part."""
    return TABLES[cell.task].find(cell, ik.load_robot(cell.robot))


def cells(options: argparse.Namespace) -> list[Cell]:
    """Return all parts of the study."""
    parts = list[Cell]()
    for robot in options.robots:
        new_cell = partial(Cell, robot, seed=options.seed)
        for first in range(0, options.count, PART):
            size = min(PART, options.count - first)
            parts += [
                new_cell(task=task, count=size, tolerance=tolerance, first=first)
                for task in ("random", "near limits")
                for tolerance in TOLERANCES
            ]
        parts += [new_cell(task="alone", count=SINGLE_TARGETS)] if options.count else []
        parts += [new_cell(task="followed", count=1), new_cell(task="crossed", count=1)]
        for task in ("beyond", "free", "searched"):
            count = getattr(options, task)
            parts += [new_cell(task=task, count=count)] if count else []
        if options.peers and robot == options.robots[0]:
            parts.append(new_cell(task="contacts", count=options.peers))
            parts.append(new_cell(task="wrists", count=2 * options.peers))
    return parts


def misses(done: list[tuple[Cell, dict[str, Any]]]) -> tuple[list[list[str]], list[Metric]]:
    """Rows of targets missed, and metrics."""
    rows, metrics = list[list[str]](), list[Metric]()
    robots = dict.fromkeys(cell.robot for cell, _ in done)
    for name in robots:
        results = [(cell, result) for cell, result in done if cell.robot == name]
        single = [result["time"] for cell, result in results if cell.task == "alone"]
        metrics += [median_metric(f"one_body/{name}/alone", single, "us")] if single else []
        label = f"{name} ({len(ik.load_robot(name).actuators)} motors)"
        kinds = dict.fromkeys((cell.task, cell.tolerance) for cell, f in results if "missed" in f)
        for kind in kinds:
            parts = [(c, f) for c, f in results if (c.task, c.tolerance) == kind and "missed" in f]
            count = sum(cell.count for cell, _ in parts)
            missed = sum(result["missed"] for _, result in parts)
            time_each = 1e6 * sum(result["spent"] for _, result in parts) / count
            key = f"one_body/{name}/{kind[0]}/{kind[1]}"
            metrics.append(rate_metric(f"{key}/solved", count - missed, count))
            metrics.append(median_metric(f"{key}/time", [time_each], "us"))
            single_time = f"{single[0]:.0f}" if single else ""
            rows.append([label, *kind, f"{missed} of {count}", f"{time_each:.1f}", single_time])
    return rows, metrics


def main_result(done: list[tuple[Cell, dict[str, Any]]]) -> str:
    """Return the sentence on the targets that are missed, by tolerance."""
    counts: dict[str, tuple[int, int]] = {}
    for cell, figures in done:
        if "missed" in figures:
            missed, count = counts.get(cell.tolerance, (0, 0))
            counts[cell.tolerance] = missed + figures["missed"], count + cell.count
    robots = len({cell.robot for cell, _ in done})
    clauses = [f"{missed:,} of {n:,} at {name}" for name, (missed, n) in counts.items()]
    return f"Reachable targets of {robots} multi-arm robots that are missed: {', '.join(clauses)}."


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
    add_part_options(parser, "one_body", RESULTS / "one_body")
    options = parser.parse_args(arguments)
    results = complete_parts(work_out, cells(options), options, "parts")
    done = results.done
    table, metrics = misses(done)
    parts = [INTRODUCTION, markdown_table(MISSES, table)] if table else []
    for task, table in TABLES.items():
        rows = [row for cell, result in done if cell.task == task for row in result.get("rows", [])]
        parts += [table.title, markdown_table(table.heads, rows)] if rows else []
    parts += results.note
    run_by, code = command(__file__, arguments), {"one_body": results.codes}
    result = main_result(done)
    publish("Several arms as one", result, parts, options.out, run_by, code, metrics)


if __name__ == "__main__":
    program(main)
