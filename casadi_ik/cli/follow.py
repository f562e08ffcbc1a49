"""`casadi-ik follow`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Group
from rich.text import Text

from casadi_ik.api import Solver
from casadi_ik.arrays import Array
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.frame_file import Frames, read_frames
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import located, the_robot, the_scene, the_start, the_tolerance
from casadi_ik.cli.report import fields
from casadi_ik.errors import InputError
from casadi_ik.files.limits import RAISED, limit
from casadi_ik.motion.follower import Follower
from casadi_ik.motion.following import FollowStatus
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.retarget import Retargeter, load_retarget, usual_retarget

FRAMES_AT_ONCE = 1024
"""Cycles whose targets are in memory at once."""

WORLD_LANDMARKS = "stays: the keypoints' origin is in the hand (MediaPipe's world landmarks)"

MOST_CYCLES = 4_000_000
"""Of a motion: an hour at a kilohertz."""


def follow(arguments: argparse.Namespace) -> Answer:
    """Follow the frames of a file.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
    """
    path, out = Path(arguments.frames), arguments.out
    config = None if arguments.retarget is None else load_retarget(arguments.retarget)
    name = arguments.robot or (config.robot if config else "")
    if not name:
        raise InputError("--robot: missing, expected it here or as robot in --retarget")
    robot = the_robot(name)
    frames = read_frames(path, len(robot.fingers))
    inputs = [path] + ([Path(arguments.retarget)] if arguments.retarget else [])
    check_outputs([("--out", out)], inputs)
    solver = Solver(robot, tolerance=the_tolerance(arguments), scene=the_scene(arguments))
    start = np.asarray(the_start(arguments, robot) or _start(solver, frames))
    if frames.last / arguments.period > limit(MOST_CYCLES):
        raise InputError(
            f"{path}: times: found {frames.last:g} s, expected at most "
            f"{limit(MOST_CYCLES) * arguments.period:g} s at this period {RAISED}"
        )
    follower = solver.follow(start, arguments.period)
    times = np.arange(1, int(np.ceil(frames.last / arguments.period)) + 2) * arguments.period
    q = np.empty((len(times) + 1, len(robot.actuators)))
    q[0] = follower.state.q
    status = np.full(len(q), FollowStatus.HOLDING.value, dtype="<U9")
    error = np.full((len(q), len(robot.fingers)), np.nan)
    where = "--retarget" if arguments.retarget is None else str(arguments.retarget)
    with located(where):
        retargeter = Retargeter(config or usual_retarget(robot), robot, start)
    begin = time.perf_counter()
    for i, answer in enumerate(_followed(path, follower, frames, times, retargeter), start=1):
        state = follower.state
        q[i], status[i], error[i] = answer, state.status.value, state.position_error
    seconds = (time.perf_counter() - begin) / max(len(times), 1)
    notes = {"status": status, "position_error": error}
    motion = Motion.of_cycles(robot, arguments.period, q, notes)
    write_output(out, "--out", motion.write_to)
    followed = int((status[1:] == FollowStatus.FOLLOWING.value).sum())
    stays = retargeter.in_hand and retargeter.config.travel is None
    report = _report(path, out, follower, motion, status[1:], error[1:], seconds, stays)
    return Answer(report, Exit.DONE if followed == len(times) else Exit.NOT_SOLVED)


def _start(solver: Solver, frames: Frames) -> Array:
    """Where a robot begins of which nobody says where it is."""
    home = solver.robot.home
    first = frames.points[:1], frames.normals[:1]
    if not np.isfinite(first[0]).any():
        return home
    solved = solver.solve_batch(*first)
    return solved.q[0] if solved.success[0] else home


def _followed(
    path: Path, follower: Follower, frames: Frames, times: Array, retargeter: Retargeter
) -> Iterator[Array]:
    """Where the motors are at the end of each cycle."""
    counts = retargeter.config.wrist_weight
    weight = counts, counts
    for first in range(0, len(times), FRAMES_AT_ONCE):
        now = times[first : first + FRAMES_AT_ONCE]
        if frames.keypoints is None:
            both = frames.at(now, frames.points), frames.at(now, frames.normals)
            yield from (follower(*target) for target in zip(*both, strict=True))
            continue
        for keypoints in frames.at(now, frames.keypoints):
            with located(f"{path}"):
                wanted = retargeter(keypoints, follower.period)
            palm = wanted.palm if follower.moves_palm else None
            yield follower(wanted.points, palm=palm, palm_weight=weight)


def _report(
    path: Path,
    out: Path,
    follower: Follower,
    motion: Motion,
    status: np.ndarray,
    error: Array,
    seconds: float,
    in_hand: bool,
) -> Group:
    counts = {one.value: int((status == one.value).sum()) for one in FollowStatus}
    step = np.abs(motion.velocity) / follower.velocity
    pairs = {
        "robot": motion.robot.name,
        "wrist": WORLD_LANDMARKS if in_hand else "",
        "cycles": f"{len(status)} of {1e3 * follower.period:g} ms, {1e6 * seconds:.0f} us each",
        "how they went": ", ".join(f"{name} {count}" for name, count in counts.items() if count),
        "fastest motor": f"{100 * step.max():.0f} % of its velocity limit",
        "largest error": f"{1e3 * np.nanmax(error):.2f} mm" if np.isfinite(error).any() else "",
        "written": str(out),
    }
    return Group(Text(path.name, "bold"), fields({k: v for k, v in pairs.items() if v}))
