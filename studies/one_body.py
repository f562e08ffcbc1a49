"""Several arms on a trunk solved as one: targets missed, times, following, collisions, peers.

Targets are the contacts of configurations drawn within limits, so all can be reached::

    python studies/one_body.py
    python studies/one_body.py --robots g1+dex3 --count 1000000 --peers 0
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from one_body_peers import by_contacts, by_wrists
from rich.progress import track
from runner.figures import RESULTS
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


def drawn(robot: ArmHand, count: int, near: bool, seed: int) -> np.ndarray:
    """(count, n) configurations within limits."""
    rng = np.random.default_rng(seed)
    part = rng.random((count, len(robot.lower)))
    if near:
        at_end = rng.random(part.shape) < 0.5
        part = np.where(at_end, np.where(part < 0.5, 0.02 * part, 1 - 0.02 * (1 - part)), part)
    return robot.lower + part * (robot.upper - robot.lower)


def batches(robot: ArmHand, count: int, seed: int) -> tuple[list[list[str]], list[Metric]]:
    """Misses and times of batches."""
    rows, metrics = [], list[Metric]()
    for near in (False, True):
        for label, tolerance in TOLERANCES.items():
            solver = ik.Solver(robot, tolerance=tolerance)
            solver.solve_batch(*robot.contacts(drawn(robot, 1000, near, seed + 1)))
            missed, spent = 0, 0.0
            blocks = range(0, count, BLOCK)
            kind = "near limits" if near else "random"
            for first in track(blocks, f"{robot.name} {kind} {label}"):
                some = min(BLOCK, count - first)
                points, normals = robot.contacts(drawn(robot, some, near, seed + 2 + first))
                begun = time.process_time()
                found = solver.solve_batch(points, normals)
                spent += time.process_time() - begun
                missed += int((found.status != ik.Status.SOLVED).sum())
            name = f"one_body/{robot.name}/{kind}/{label}"
            metrics += [
                rate_metric(f"{name}/solved", count - missed, count),
                median_metric(f"{name}/time", [1e6 * spent / count], "us"),
            ]
            rows.append([kind, label, f"{missed} of {count}", f"{1e6 * spent / count:.1f}"])
    return rows, metrics


def alone(robot: ArmHand, seed: int) -> float:
    """Median time [us] of one target by itself."""
    fast, spent = ik.Solver(robot).fast(), []
    every = zip(*robot.contacts(drawn(robot, ALONE, False, seed)), strict=True)
    for points, normals in every:
        begun = time.process_time()
        fast(points, normals)
        spent.append(time.process_time() - begun)
    return 1e6 * float(np.median(spent[10:]))


def followed(robot: ArmHand) -> list[str]:
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
    return [robot.name, f"{median:.1f}", f"{most:.1f}", f"{1e3 * np.median(off):.2f}"]


def crossed(robot: ArmHand) -> list[str] | None:
    """Hands led to each other's place and back, through each other, followed in a scene."""
    sides = robot.description.sides
    if len(sides) != 2 or not robot.description.shapes.capsules:
        return None
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
    return [robot.name, f"{median:.1f}", f"{most:.1f}", f"{blocked} of {CYCLES}", least]


def free(robot: ArmHand, count: int, seed: int) -> list[str] | None:
    """Targets made by configurations that touch nothing: answers that touch nothing either."""
    if not robot.description.shapes.capsules:
        return None
    solver, plain = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot)

    def grasp(q: np.ndarray) -> ik.Grasp:
        points, normals = robot.contacts(q)
        pairs = zip(robot.fingers, points, normals, strict=True)
        return ik.Grasp(name="free", contacts={f: ik.Contact(p, n) for f, p, n in pairs})

    about, kept, number = grasp(robot.home), list[np.ndarray](), 0
    while len(kept) < count:
        some = drawn(robot, 1000, False, seed + number)
        room = solver.check(some, about)
        assert room is not None
        kept += list(some[room.distance > 0])
        number += 1
        if number > 1000:
            return None
    points, normals = robot.contacts(np.array(kept[:count]))
    first = solver.check(plain.solve_batch(points, normals).q, about)
    assert first is not None
    solver.solve_batch(points, normals)  # all that is needed is compiled now
    begun = time.process_time()
    found = solver.solve_batch(points, normals)
    each = 1e3 * (time.process_time() - begun) / count
    solved = int((found.status == ik.Status.SOLVED).sum())
    hits = int((first.distance <= 0).sum())
    return [robot.name, f"{hits} of {count}", f"{solved} of {count}", f"{each:.2f}"]


def main(arguments: list[str] | None = None) -> None:
    """Solve and write the report."""
    parser = argparse.ArgumentParser(description="Several arms on a trunk, solved as one.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--count", type=int, default=100_000, help="targets of every kind; 0: none")
    parser.add_argument("--free", type=int, default=500, help="targets without collision; 0: none")
    parser.add_argument("--peers", type=int, default=100, help="targets for other ways; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS / "one_body")
    options = parser.parse_args(arguments)
    table, metrics, paths, rooms, others, wrists = [], list[Metric](), [], [], [], []
    crossings = list[list[str]]()
    for name in options.robots:
        robot = ik.load_robot(name)
        if options.count:
            rows, some = batches(robot, options.count, options.seed)
            own = alone(robot, options.seed)
            metrics += [*some, median_metric(f"one_body/{name}/alone", [own], "us")]
            label = f"{name} ({len(robot.actuators)} motors)"
            table += [[label, *row, f"{own:.0f}"] for row in rows]
        paths.append(followed(robot))
        crossing = crossed(robot)
        crossings += [] if crossing is None else [crossing]
        room = free(robot, options.free, options.seed) if options.free else None
        rooms += [] if room is None else [room]
        if options.peers and name == options.robots[0]:
            others = by_contacts(robot, drawn(robot, options.peers, False, options.seed))
            wrists = by_wrists(robot, 2 * options.peers, options.seed)
    heads = ["robot", "targets", "tolerance", "missed", "a target [us]", "one alone [us]"]
    parts = [INTRODUCTION, markdown_table(heads, table)] if table else []
    parts.append("## Followed at 1 kHz")
    heads = ["robot", "a cycle, median [us]", "99th percent [us]", "error, median [mm]"]
    parts.append(markdown_table(heads, paths))
    if crossings:
        parts.append(
            "## Hands led through each other\n\nBoth are led to the other's place and back, in "
            f"{CYCLES} cycles of 1 ms, by a follower that knows the robot's shapes. *Blocked*: "
            "cycles in which it holds back."
        )
        heads = ["robot", "a cycle, median [us]", "99th percent [us]", "blocked"]
        parts.append(markdown_table([*heads, "least clearance [mm]"], crossings))
    if rooms:
        parts.append(
            "## Touching nothing\n\nTargets of configurations that do not touch themselves. "
            "*First*: answers of a solver without a scene that do."
        )
        heads = ["robot", "first answers that touch", "free answers", "a target [ms]"]
        parts.append(markdown_table(heads, rooms))
    if others:
        parts.append("## Other ways\n\n" + OTHERS)
        parts.append(markdown_table(["robot", "way", "solved", "a target [us]"], others))
        parts.append(WRISTS)
        heads = ["robot", "way", "met", "off, median [mm]", "a pose, median [us]"]
        parts.append(markdown_table(heads, wrists))
    made = command(__file__, arguments)
    parts += ["## Where this comes from", f"`{made}`", provenance({})]
    write_page("Several arms as one", parts, options.out)
    write_metrics(metrics, options.out / "metrics.json")


if __name__ == "__main__":
    program(main)
