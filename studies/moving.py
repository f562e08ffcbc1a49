"""Moving targets: followed cycle by cycle, along known paths, and each solved anew.

Random smooth paths (at rest first, then at up to half the velocity limits), targets that leap, and
the same paths solved target by target from the solution before. What is done stays done: a second
run with more paths adds to them. What choosing among grasps takes: `bench.py --part choose`::

    python studies/moving.py --count 100 --report studies/results/moving
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from runner.parts import read_parts, run_parts
from runner.report import (
    Metric,
    command,
    markdown_table,
    mean_metric,
    median_metric,
    program,
    publish,
    rate_metric,
)
from samplers import grasps_of, palm_slopes, smooth_path

import casadi_ik as ik
from casadi_ik.files.arrays import Array

ROBOTS = ("kuka_lwr_barrett", "panda+allegro_right", "ur5e+shadow")
PERIOD = 1e-3
STEPS = 2000
SHARE = 0.5
"""Fraction of the velocity limits, and of the accelerations, that paths need."""

SOLVE_INTERVAL = 20
"""Interval of the targets that `solve` solves instead of a follower."""

LEAPS = 4
"""Targets that leap, each given so many cycles:"""

WAIT = 2000

TIMES = 3
"""Number of repetitions for the time of a call."""

SINGULAR = 0.05
"""Smallest singular value of an arm that counts as near singular, see `palm_slopes`."""


FASTER = ((1.0, 10.0), (3.0, 10.0))
"""Times the velocity and the acceleration limits."""

LOST_TEXT = """
The paths that are not entirely within tolerance are followed again, by the same code with faster
motors. A robot has more motors than a grasp needs, so the follower uses other configurations than
those that made the path, and these may require faster motors. *Largest difference:* of a motor of
the arm from the configuration of the path, when tolerance is lost.
"""


def measure(solver: ik.Solver, number: int) -> dict[str, Any]:
    """Figures of one path.

    Args:
        solver: On the robot.
        number: Of the path, also its seed.
    """
    robot = solver.robot
    path = smooth_path(robot, number, STEPS, PERIOD, SHARE)
    return {
        "number": number,
        **_smooth(solver, path),
        **_leaping(solver, number),
        **_anew(solver, path[::SOLVE_INTERVAL]),
    }


def _smooth(solver: ik.Solver, path: Array) -> dict[str, Any]:
    robot = solver.robot
    points, normals = robot.contacts(path)
    follower = solver.follow(path[0], PERIOD)
    q, seconds = np.empty_like(path), np.empty(len(path))
    for i, target in enumerate(zip(points, normals, strict=True)):
        begin = time.perf_counter()
        q[i] = follower(*target)
        seconds[i] = time.perf_counter() - begin
    position, angle = robot.errors(q, points, normals)
    is_within = ((position <= 5e-3) & (angle <= np.radians(3))).all(axis=1)
    first_lost = int(np.argmin(is_within)) if not is_within.all() else -1
    return {
        "median": float(np.median(seconds)),
        "met": float(is_within.mean()),
        "error": float(position.max()),
        "singular": first_lost >= 0
        and bool(
            (
                palm_slopes(robot, path[max(first_lost - 300, 0) : first_lost + 1 : 10]) < SINGULAR
            ).any()
        ),
        **_limit_use("smooth", follower, np.concatenate([path[:1], q])),
    }


def track(solver: ik.Solver, number: int) -> dict[str, Any]:
    """Track a known path, and measure each call of a follower on it.

    The same calls do the same: the least of `TIMES` runs counts, since what differs is where the
    processor was taken away and had to come back to its caches, which falls on other calls.
    """
    path = smooth_path(solver.robot, number, STEPS, PERIOD, SHARE)
    points, normals = solver.robot.contacts(path)
    calls = np.full(len(path), np.inf)
    for _ in range(TIMES):
        follower = solver.follow(path[0], PERIOD)
        for i, target in enumerate(zip(points, normals, strict=True)):
            begin = time.thread_time()
            follower(*target)
            calls[i] = min(calls[i], time.thread_time() - begin)
    grasps = grasps_of(solver.robot, points, normals)
    solver.track(grasps[:2], q0=path[0])
    begin = time.process_time()
    solution = solver.track(grasps, q0=path[0])
    seconds = time.process_time() - begin
    solved_share = float(solution.success.mean())
    return {
        "time": seconds,
        "met": solved_share,
        "jumps": len(solution.jumps),
        "calls": calls.tolist(),
    }


def _leaping(solver: ik.Solver, number: int) -> dict[str, Any]:
    """Targets that leap: limits are kept, and what can be met on the branch is met at rest."""
    robot, rng = solver.robot, np.random.default_rng([number, 1])
    start = smooth_path(robot, number, STEPS, PERIOD, SHARE)[0]
    follower, q, reached_count = solver.follow(start, PERIOD), [start], 0
    for _ in range(LEAPS):
        goal = start + 0.2 * (robot.random(rng, 1)[0] - start)
        target = robot.contacts(goal)
        q += [follower(*target) for _ in range(WAIT)]
        reached_count += follower.state.status is ik.motion.FollowStatus.FOLLOWING
    return {"leaps_met": reached_count / LEAPS, **_limit_use("leaping", follower, np.array(q))}


def _anew(solver: ik.Solver, path: Array) -> dict[str, Any]:
    """Solve every target from the previous solution; return steps and their time."""
    robot = solver.robot
    q, steps, seconds = path[0], [], []
    for points, normals in zip(*robot.contacts(path), strict=True):
        (grasp,) = grasps_of(robot, points[None], normals[None])
        begin = time.perf_counter()
        q_next = solver.solve(grasp, q0=q, diagnose=False).q
        seconds.append(time.perf_counter() - begin)
        steps.append(np.abs(q_next - q))
        q = q_next
    largest_step = np.abs(np.diff(path, axis=0)).max()
    return {
        "anew_step": float(np.max(steps)),
        "own_step": float(largest_step),
        "anew_time": float(np.median(seconds)),
    }


def _limit_use(what: str, follower: ik.motion.Follower, q: Array) -> dict[str, float]:
    """Largest velocity and acceleration as parts of their limits, and how far beyond a limit."""
    steps = np.diff(q, axis=0)
    changes = np.diff(steps, axis=0, prepend=np.zeros((1, q.shape[1])))
    return {
        f"{what}_velocity": float((np.abs(steps) / (follower.velocity * PERIOD)).max()),
        f"{what}_acceleration": float(
            (np.abs(changes) / (follower.acceleration * PERIOD**2)).max()
        ),
        f"{what}_step": float(np.abs(steps).max()),
    }


def follow_lost_path(solver: ik.Solver, number: int) -> dict[str, Any]:
    """Follow a lost path with other limits; return the shares of cycles within tolerance.

    Args:
        solver: On the robot.
        number: Of the path.
    """
    robot = solver.robot
    path = smooth_path(robot, number, STEPS, PERIOD, SHARE)
    points, normals = robot.contacts(path)
    usual = solver.follow(path[0], PERIOD)
    is_within = _within_tolerance(robot, usual, points, normals)
    shares, first = [], int(np.argmin(is_within[0])) if not is_within[0].all() else -1
    for velocity, acceleration in FASTER:
        faster_follower = solver.follow(
            path[0],
            PERIOD,
            velocity=velocity * usual.velocity,
            acceleration=acceleration * usual.acceleration,
        )
        shares.append(float(_within_tolerance(robot, faster_follower, points, normals)[0].mean()))
    arm = list(robot.description.arm_actuators)
    off = float(np.abs(is_within[1][first] - path[first])[arm].max()) if first >= 0 else 0.0
    return {
        "number": number,
        "met": float(is_within[0].mean()),
        "first": first,
        "off": off,
        "faster": shares,
    }


def _within_tolerance(
    robot: ik.ArmHand, follower: ik.motion.Follower, points: Array, normals: Array
) -> tuple[Array, Array]:
    """Return whether each cycle is within tolerance (k,), and the configurations (k, n)."""
    q = np.array([follower(*target) for target in zip(points, normals, strict=True)])
    position, angle = robot.errors(q, points, normals)
    return ((position <= 5e-3) & (angle <= np.radians(3))).all(axis=1), q


@dataclass(frozen=True)
class Part:
    """A path of a robot and what is asked of it: "path", "track" or "lost", see `solve`."""

    robot: str
    what: str
    number: int
    size: int = 1

    @property
    def path(self) -> Path:
        """Path of its results."""
        return Path(self.robot) / f"{self.what}_{self.number:04d}.json"


@cache
def _ready(robot: str) -> ik.Solver:
    """Return a solver with compiled kernels."""
    solver = ik.Solver(ik.load_robot(robot))
    measure(solver, 0)
    return solver


def solve(part: Part) -> dict[str, Any]:
    """Figures of a part."""
    return {"path": measure, "track": track, "lost": follow_lost_path}[part.what](
        _ready(part.robot), part.number
    )


def figures(robot: str, rows: dict[str, Array]) -> list[Metric]:
    """Return the metrics of a robot with their intervals."""
    is_within = rows["met"]
    return [
        rate_metric(f"{robot}/paths within tolerance", int((is_within == 1).sum()), len(is_within)),
        mean_metric(f"{robot}/cycles within tolerance", 100 * is_within, "%", "higher"),
        median_metric(f"{robot}/largest error", 1e3 * rows["error"], "mm"),
        median_metric(f"{robot}/cycle", 1e6 * rows["median"], "us"),
        mean_metric(f"{robot}/leaps met", 100 * rows["leaps_met"], "%", "higher"),
    ]


FOLLOWED_TEXT = """
Random smooth paths of {steps} cycles of {period:g} ms, from rest, at up to {share:g} % of the
velocity limits, with seeds from 0. Tolerances (5 mm, 3 deg) and accelerations (full speed in a
quarter of a second) are the defaults. Times are measured from Python on a busy machine: the
median of a cycle, and the processor time of single calls on some of the paths, the smallest of
{times} runs of each call. *Lost near a singular arm:* of the paths that are not entirely within
tolerance, those whose own configurations had a smallest singular value of the arm below
{singular} (lengths in units of 0.1 m) within the previous 300 cycles. The follower does not know
these configurations, and from others the motors would have to be faster.
"""

LEAPING = """
Largest values as parts of the limits, on the smooth paths and on {leaps} targets a path that leap
and then wait {wait} cycles.
"""

ANEW = """
Every {every}th target is solved from the previous solution (`solve(q0=previous)`): the largest
step of a motor between two of them. For the follower it is the largest step of a cycle times
{every}.
"""


def tables(robot: str, rows: dict[str, Array], tracks: list[dict[str, Any]]) -> list[list[str]]:
    """Return the rows of a robot: followed, limits, solved anew, known paths."""
    is_lost = rows["met"] < 1
    calls = (
        1e6 * np.concatenate([result["calls"] for result in tracks])
        if tracks
        else np.full(1, np.nan)
    )
    limits = [
        f"{kind}_{what}" for kind in ("smooth", "leaping") for what in ("velocity", "acceleration")
    ]
    return [
        [
            *(
                robot,
                f"{len(is_lost)}",
                f"{(~is_lost).sum()}",
                f"{100 * rows['met'].mean():.2f}",
            ),
            f"{int(rows['singular'][is_lost].sum())} of {int(is_lost.sum())}",
            f"{1e3 * np.median(rows['error']):.2f}",
            f"{1e6 * np.median(rows['median']):.0f}",
            *(f"{np.percentile(calls, part):.0f}" for part in (50, 99)),
        ],
        [
            robot,
            *(f"{rows[name].max():.6f}" for name in limits),
            f"{100 * rows['leaps_met'].mean():.0f}",
        ],
        [
            *(robot, f"{np.degrees(rows['own_step'].max()):.2f}"),
            f"{np.degrees(rows['anew_step'].max()):.1f}",
            f"{np.degrees(np.median(rows['anew_step'])):.1f}",
            f"{np.degrees(SOLVE_INTERVAL * rows['smooth_step'].max()):.2f}",
            f"{1e6 * np.median(rows['anew_time']):.0f}",
        ],
        [
            *(robot, f"{len(tracks)}", f"{np.median([result['time'] for result in tracks]):.2f}"),
            f"{100 * np.mean([result['met'] for result in tracks]):.1f}",
            f"{sum(result['jumps'] for result in tracks)}",
        ],
    ]


HEADS = (
    "robot|paths|wholly within tolerance|cycles within %|lost near a singular arm|"
    "largest error, median [mm]|cycle [us]|CPU [us]|CPU p99 [us]",
    "robot|velocity|acceleration|velocity, leaping|acceleration, leaping|leaps met %",
    "robot|the path's own step [deg]|solved anew, largest [deg]|median of paths [deg]|"
    "followed, at most [deg]|a solve [us]",
    f"robot|paths|{STEPS} grasps [s CPU]|grasps met %|jumps",
)


def lost_row(robot: str, result: dict[str, Any], singular: bool) -> list[str]:
    """Return a row of the table of lost paths."""
    first = f"{1e3 * PERIOD * result['first']:.0f}" if result["first"] >= 0 else "-"
    cells = [robot, str(result["number"]), first, f"{100 * result['met']:.1f}"]
    cells += [f"{np.degrees(result['off']):.0f}", "yes" if singular else "no"]
    return cells + [f"{100 * share:.1f}" for share in result["faster"]]


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing and write the report."""
    parser = argparse.ArgumentParser(description="Targets that move.")
    parser.add_argument("--count", type=int, default=100, help="paths of each robot")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--tracks", type=int, default=5, help="those also followed as known ones")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--folder", type=Path, default=Path("out/moving"), help="of what is done")
    parser.add_argument("--report", type=Path, default=Path("out/moving/report"), help="folder")
    options = parser.parse_args(arguments)
    rows: list[list[list[str]]] = [[], [], [], []]
    lost_rows, metrics, codes = list[list[str]](), list[Metric](), set[str]()

    def done(robot: str, what: str, numbers: list[int]) -> list[dict[str, Any]]:
        parts = [Part(robot, what, number) for number in numbers]
        run_parts(solve, parts, options.folder, jobs=options.jobs, title=f"{robot}, {what}")
        results, code = read_parts(options.folder, parts)
        codes.update([code] if code else [])
        return [result for _, result in results]

    for robot in options.robots:
        paths = done(robot, "path", list(range(options.count)))
        values = {key: np.array([row[key] for row in paths], dtype=float) for key in paths[0]}
        tracks = done(robot, "track", list(range(options.tracks)))
        for table, row in zip(rows, tables(robot, values, tracks), strict=True):
            table.append(row)
        missed = {row["number"]: row["singular"] for row in paths if row["met"] < 1}
        repeated = done(robot, "lost", list(missed))
        lost_rows += [lost_row(robot, result, missed[result["number"]]) for result in repeated]
        metrics += figures(robot, values)
    heads = ["robot", "path", "lost at [ms]", "within tolerance %", "largest difference [deg]"]
    heads += ["near a singular arm", "accelerations x10 %", "velocities x3 too %"]
    followed_table, limits, anew, known_table = (
        markdown_table(head.split("|"), table) for head, table in zip(HEADS, rows, strict=True)
    )
    times = {"steps": STEPS, "period": 1e3 * PERIOD, "share": 100 * SHARE, "times": TIMES}
    parts = [
        *(
            "## Followed cycle by cycle",
            FOLLOWED_TEXT.format(singular=SINGULAR, **times),
            followed_table,
        ),
        *("## Limits", LEAPING.format(leaps=LEAPS, wait=WAIT), limits),
        *("## Solved anew", ANEW.format(every=SOLVE_INTERVAL), anew, "## Known paths", known_table),
        *("## Paths that are lost", LOST_TEXT, markdown_table(heads, lost_rows)),
    ]
    cycles, shares = ([float(row[i]) for row in rows[0]] for i in (6, 3))
    result = (
        f"A cycle of a follower takes {min(cycles):.0f} to {max(cycles):.0f} us, and at least "
        f"{min(shares):.1f} % of the cycles of a robot are within tolerance."
    )
    run_by, code = command(__file__, arguments), {"moving": ", ".join(sorted(codes))}
    publish("Moving targets", result, parts, options.report, run_by, code, metrics)


if __name__ == "__main__":
    program(main)
