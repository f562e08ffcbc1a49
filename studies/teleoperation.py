"""How well, how smoothly and how fast is a hand led by fingertip positions alone?

A robot moves as random smooth postures do; a follower is given nothing but where the fingertips are
in every frame, arm and hand together, and in a second run the palm's pose too, softly. Beside it,
if it is installed, dex-retargeting (Qin et al. 2023, AnyTeleop) leads a hand alone by NLopt, and so
does the follower, both with the kinematics of our URDF. Its own configuration sets it up: `vector`
from the palm to every tip, `position` of the tips, `DexPilot` with the vectors between the tips too
(those of a thumb nearer than 30 mm to a finger are closed by it on purpose)::

    pip install dex-retargeting torch six trimesh  # the last three it imports and does not name
    python studies/teleoperation.py --report out/teleoperation
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from runner.report import command, markdown_table, publish
from samplers import smooth_path

import casadi_ik as ik
from casadi_ik.files.arrays import Array

ROBOTS = ("panda+allegro_right", "kuka_lwr_barrett", "ur5e+shadow")
PERIOD = 0.01
"""Period of a frame [s]."""

SHARE = 0.4
"""Largest fraction of a velocity limit on a path."""

WRIST = (0.05, 0.05)
"""Weights of position and orientation of the palm, relative to a fingertip."""

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
    path_roughness: float
    seconds: Array
    palm: float


def run(robot: ik.ArmHand, seed: int, count: int, wrist: bool) -> Run:
    """Follow one path."""
    solver = ik.Solver(robot)
    path = smooth_path(robot, seed, count, PERIOD, SHARE)
    tips, palms = robot.contacts(path)[0], robot.palm(path)
    follower = solver.follow(path[0], PERIOD)
    max_step = PERIOD * follower.velocity / 0.25
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

    def rough(displacements: Array) -> float:
        return float((np.abs(np.diff(displacements, 2, axis=0)) / PERIOD / max_step).max())

    offset = float(np.median(np.linalg.norm(off, axis=1)))
    return Run(error.ravel(), rough(q), rough(path), seconds[10:], offset)


NEEDED = ("dex_retargeting", "torch", "nlopt")
"""Packages that the peer imports; it does not declare torch."""

KINDS = ("vector", "position", "dexpilot")

SMOOTHED = 0.2
"""Share of a new frame in dex-retargeting's own configurations for teleoperation."""

NOISE = 1e-3
"""Standard deviation of what is added to keypoints, as a camera does [m]."""

HAND = "name: allegro_right\ndescription: The hand alone.\nhand: allegro_right\nthumb: thumb\n"
HAND += "fingers: [thumb, index, middle, ring]\n"

Lead = Callable[[Array], Array]
"""Fingertips (f, 3) to motors (n,)."""

HEADS = ["keypoints", "who", "error, median [mm]", "99th percentile", "roughness"]
HEADS += ["beyond velocity %", "time [us]", "p99 [us]", "CPU [us]"]

EXPLAINED = """
The same motion of an Allegro hand's fingertips in the palm's frame, {count} frames of {frame:g} ms,
seeds 0 to {last}; once as it is, once with noise of {noise:g} mm on every keypoint. *Error:* of
fingertips against those without noise, in frames after the first second. *Roughness:* largest
change of a motor's velocity from frame to frame, as a part of what its acceleration limit permits.
*Beyond velocity:* frames in which a motor is faster than its limit. *Time:* of a call from Python,
all in one thread of one run, by turns; other work ran on the machine, so the processor's time
stands beside. dex-retargeting {version}; *smoothed:* with the low-pass filter of its own
configurations ({smoothed:g} of every new frame).
"""

KNOWN_TEXT = """
Figures published for it with the Allegro hand, on another machine and another motion: 770 to 980 us
a frame, 95th percentile 5 ms.
"""

MISSING = """
Not run: {missing} not installed (`pip install dex-retargeting torch six trimesh`, the last three of
which it imports and does not name).
"""


def retarget_with(robot: ik.ArmHand, kind: str, share: float, start: Array, folder: Path) -> Lead:
    """dex-retargeting for a hand.

    Args:
        robot: The hand.
        kind: One of `KINDS`.
        share: Of a new frame in what comes out; 1: nothing is smoothed.
        start: (n,) where the hand is.
        folder: Where its URDF goes.
    """
    path, tips = folder / "hand.urdf", [f"{name}_contact" for name in robot.fingers]
    path.write_text(robot.urdf())
    palm, count = robot.description.palm_link, len(tips)
    config: dict[str, Any] = {"type": kind, "urdf_path": str(path), "low_pass_alpha": share}
    if kind == "vector":
        numbers = [[0] * count, list(range(1, count + 1))]
        config |= {"target_origin_link_names": [palm] * count, "target_task_link_names": tips}
        config |= {"target_link_human_indices": numbers}
    elif kind == "position":
        config |= {"target_link_names": tips, "target_link_human_indices": list(range(count))}
    else:
        config |= {"wrist_link_name": palm, "finger_tip_link_names": tips}
    import_module("torch").set_num_threads(1)
    module: Any = import_module("dex_retargeting.retargeting_config")
    peer = module.RetargetingConfig.from_dict(config).build()
    names = peer.optimizer.robot.dof_joint_names
    ours = [names.index(name) for name in robot.actuators]
    theirs = [robot.actuators.index(name) for name in names]
    peer.set_qpos(start[theirs])
    indices = peer.optimizer.target_link_human_indices
    wrist = robot.links(start)[palm][:3, 3]

    def lead(points: Array) -> Array:
        if kind == "position":
            return peer.retarget(points)[ours]
        keys = np.vstack([wrist, points])
        # DexPilot's numbers are those of 21 keypoints, four to a finger.
        origin, task = np.array(indices) // (1 if kind == "vector" else 4)
        return peer.retarget(keys[task] - keys[origin])[ours]

    return lead


@dataclass(frozen=True)
class Tracking:
    """Errors [m], roughness, fraction of frames beyond velocity limits, and times [s]."""

    error: Array
    rough: float
    beyond_velocity: float
    seconds: Array
    cpu: float


def measure(
    robot: ik.ArmHand, lead: Lead, tips: Array, target: Array, period: float, velocity: Array
) -> Tracking:
    """Lead a hand through fingertips (k, f, 3) that are asked for."""
    q, seconds = np.empty((len(tips), len(robot.actuators))), np.empty(len(tips))
    start_time = time.process_time()
    for i, points in enumerate(tips):
        begin = time.perf_counter()
        q[i] = lead(points)
        seconds[i] = time.perf_counter() - begin
    cpu = (time.process_time() - start_time) / len(tips)
    settled = slice(round(1.0 / period), None)
    error = np.linalg.norm(robot.contacts(q)[0] - target, axis=2)[settled]
    rates = np.diff(q, axis=0) / period
    max_step = period * velocity / 0.25
    rough = float((np.abs(np.diff(rates, axis=0)) / max_step)[settled].max())
    beyond_velocity = float((np.abs(rates) > 1.001 * velocity)[settled].any(axis=1).mean())
    return Tracking(error.ravel(), rough, beyond_velocity, seconds[10:], cpu)


def leaders(
    robot: ik.ArmHand, start: Array, period: float, folder: Path
) -> Iterator[tuple[str, Lead]]:
    """Name and leader of everybody; each begins anew."""
    follower = ik.Solver(robot).follow(start, period)
    yield "casadi_ik, hand alone", lambda points: follower(points)
    for kind in KINDS:
        yield f"dex-retargeting {kind}", retarget_with(robot, kind, 1.0, start, folder)
    smoothed = retarget_with(robot, "vector", SMOOTHED, start, folder)
    yield "dex-retargeting vector, smoothed", smoothed


def comparison_section(paths: int, count: int, period: float, share: float) -> list[str]:
    """Return a section with the comparison, or with the reason why there is none."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        return [MISSING.format(missing=" and ".join(missing)), KNOWN_TEXT]
    runs_by_peer: dict[tuple[str, str], list[Tracking]] = {}
    with TemporaryDirectory() as named:
        folder = Path(named)
        (folder / "hand.yaml").write_text(HAND)
        robot = ik.load_robot(folder / "hand.yaml")
        velocity = ik.Solver(robot).follow(robot.home, period).velocity
        for seed in range(paths):
            path = smooth_path(robot, seed, count, period, share)
            tips = robot.contacts(path)[0]
            noise = np.random.default_rng(seed).normal(0.0, NOISE, tips.shape)
            for keypoints, measured in (("exact", tips), ("noisy", tips + noise)):
                for who, lead in leaders(robot, path[0], period, folder):
                    led = measure(robot, lead, measured, tips, period, velocity)
                    runs_by_peer.setdefault((keypoints, who), []).append(led)
    rows = []
    for (keypoints, who), runs in runs_by_peer.items():
        error = 1e3 * np.concatenate([run.error for run in runs])
        seconds = 1e6 * np.concatenate([run.seconds for run in runs])
        row = [keypoints, who, f"{np.median(error):.2f}", f"{np.quantile(error, 0.99):.1f}"]
        row += [f"{max(run.rough for run in runs):.2f}"]
        row += [f"{100 * np.mean([run.beyond_velocity for run in runs]):.1f}"]
        row += [f"{np.median(seconds):.0f}", f"{np.quantile(seconds, 0.99):.0f}"]
        rows.append([*row, f"{1e6 * np.mean([run.cpu for run in runs]):.0f}"])
    text = EXPLAINED.format(
        count=count,
        frame=1e3 * period,
        last=paths - 1,
        noise=1e3 * NOISE,
        version=version("dex_retargeting"),
        smoothed=SMOOTHED,
    )
    return [text, markdown_table(HEADS, rows), KNOWN_TEXT]


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
            error = 1e3 * np.concatenate([run.error for run in runs])
            seconds = 1e6 * np.concatenate([run.seconds for run in runs])
            row = [name, "yes" if wrist else "no", f"{np.median(error):.2f}"]
            row += [f"{np.quantile(error, 0.99):.1f}", f"{100 * np.mean(error < 5):.1f}"]
            row += [f"{1e3 * np.median([run.palm for run in runs]):.0f}"]
            row += [
                f"{max(run.rough for run in runs):.2f}",
                f"{max(run.path_roughness for run in runs):.2f}",
            ]
            row += [f"{np.median(seconds):.0f}", f"{np.quantile(seconds, 0.99):.0f}"]
            rows.append(row)
            Console().print(row)
    heads = ["robot", "palm too", "error, median [mm]", "99th percentile", "below 5 mm %"]
    heads += ["palm off, median [mm]", "roughness", "path's own", "time [us]", "p99 [us]"]
    peer = comparison_section(options.peer_paths, options.count, PERIOD, SHARE)
    parts = [INTRODUCTION, markdown_table(heads, rows), "## Beside dex-retargeting", *peer]
    medians, shares = ([float(row[i]) for row in rows] for i in (2, 4))
    result = (
        f"Fingertips follow with a median error of at most {max(medians):.2f} mm and are within "
        f"5 mm in at least {min(shares):.1f} % of the frames."
    )
    run_by = command(__file__, arguments)
    publish("Teleoperation accuracy", result, parts, options.report, run_by)


if __name__ == "__main__":
    main()
