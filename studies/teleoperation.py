"""How well, how smoothly and how fast is a hand led by fingertip positions alone?

A robot moves as random smooth postures do; a follower is given nothing but where the fingertips are
in every frame, arm and hand together, and in a second run the palm's pose too, softly. Beside it,
if it is installed, dex-retargeting leads a hand alone, and so does the follower::

    pip install dex-retargeting torch six trimesh  # the last three it imports and does not name
    python studies/teleoperation.py --report out/teleoperation
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from peer_retargeting import beside
from rich.console import Console
from runner import markdown_table, write_page
from samplers import smooth_path

import casadi_ik as ik
from casadi_ik.arrays import Array

ROBOTS = ("panda+allegro_right", "kuka_lwr_barrett", "ur5e+shadow")
PERIOD = 0.01
"""Of a frame [s]."""

SHARE = 0.4
"""Most of any motor's velocity on a path."""

WRIST = (0.05, 0.05)
"""How much the palm's place and facing count, a fingertip counting 1."""

INTRODUCTION = f"""
Paths of random smooth postures at up to {100 * SHARE:.0f} % of the velocity limits, frames of
{1e3 * PERIOD:g} ms, seeds 0 on. The follower is given fingertip positions only (no normals) and
keeps to limits of position, velocity and acceleration. *Error:* of fingertips, in frames after the
first second. *Roughness:* largest change of a motor's velocity from frame to frame, as a part of
what its acceleration limit permits; *path:* the same of the postures that made the targets. *Time:*
of a call from Python, median and 99th percentile; other work ran on the machine.
"""


@dataclass(frozen=True)
class Run:
    """Figures of one path."""

    error: Array
    rough: float
    own: float
    seconds: Array
    palm: float


def run(robot: ik.ArmHand, seed: int, count: int, wrist: bool) -> Run:
    """Follow one path."""
    solver = ik.Solver(robot)
    path = smooth_path(robot, seed, count, PERIOD, SHARE)
    tips, palms = robot.contacts(path)[0], robot.palm(path)
    follower = solver.follow(path[0], PERIOD)
    most = PERIOD * follower.velocity / 0.25
    q, seconds = np.empty_like(path), np.empty(count)
    for i in range(count):
        begin = time.perf_counter()
        if wrist:
            q[i] = follower(tips[i], palm=palms[i], palm_weight=WRIST)
        else:
            q[i] = follower(tips[i])
        seconds[i] = time.perf_counter() - begin
    settled = slice(round(1.0 / PERIOD), None)
    error = np.linalg.norm(robot.contacts(q)[0] - tips, axis=2)[settled]
    off = robot.palm(q)[settled, :3, 3] - palms[settled, :3, 3]

    def rough(moved: Array) -> float:
        return float((np.abs(np.diff(moved, 2, axis=0)) / PERIOD / most).max())

    away = float(np.median(np.linalg.norm(off, axis=1)))
    return Run(error.ravel(), rough(q), rough(path), seconds[10:], away)


def main(arguments: list[str] | None = None) -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description="Fingertip positions alone as targets.")
    parser.add_argument("--paths", type=int, default=10)
    parser.add_argument("--count", type=int, default=1000, help="frames of a path")
    parser.add_argument("--peer-paths", type=int, default=2, help="those of dex-retargeting")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--report", type=Path, default=Path("out/teleoperation"), help="folder")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.robots:
        robot = ik.load_robot(name)
        for wrist in (False, True):
            runs = [run(robot, seed, options.count, wrist) for seed in range(options.paths)]
            error = 1e3 * np.concatenate([one.error for one in runs])
            seconds = 1e6 * np.concatenate([one.seconds for one in runs])
            row = [name, "yes" if wrist else "no", f"{np.median(error):.2f}"]
            row += [f"{np.quantile(error, 0.99):.1f}", f"{100 * np.mean(error < 5):.1f}"]
            row += [f"{1e3 * np.median([one.palm for one in runs]):.0f}"]
            row += [f"{max(one.rough for one in runs):.2f}", f"{max(one.own for one in runs):.2f}"]
            row += [f"{np.median(seconds):.0f}", f"{np.quantile(seconds, 0.99):.0f}"]
            rows.append(row)
            Console().print(row)
    heads = ["robot", "palm too", "error, median [mm]", "99th percentile", "below 5 mm %"]
    heads += ["palm off, median [mm]", "roughness", "path's own", "time [us]", "p99 [us]"]
    peer = beside(options.peer_paths, options.count, PERIOD, SHARE)
    parts = [INTRODUCTION, markdown_table(heads, rows), "## Beside dex-retargeting", *peer]
    write_page("Fingertip positions as targets", parts, options.report)


if __name__ == "__main__":
    main()
