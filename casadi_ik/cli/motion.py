"""`casadi-ik follow` and `casadi-ik reach`: motions, timed, as files."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Group
from rich.text import Text

from casadi_ik.api import Solver
from casadi_ik.arrays import Array
from casadi_ik.cli import options as opt
from casadi_ik.cli.choose import ChosenPosture, chosen_posture
from casadi_ik.cli.inputs import located, the_grasp, the_robot, the_solver, the_start
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.report import fields, files, headline
from casadi_ik.cli.table import Answer, Exit, Said, command
from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.files.limits import LIMITS, RAISED, limit
from casadi_ik.files.npz import read_npz
from casadi_ik.grasps import Grasp
from casadi_ik.motion.follower import Follower, FollowStatus
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.reach import PARTS, Reach
from casadi_ik.motion.retarget import KEYPOINTS, Retargeter, load_retarget, usual_retarget

MOTION = opt.out("MOTION.mcap", "write the motion", opt.file_name(".mcap", ".npz", ".csv"))


@command(
    opt.Option("KEYPOINTS.npz", "the frames, see below", key="frames"),
    opt.ROBOT,
    MOTION,
    opt.Option(
        "--retarget FILE.yaml", "how a hand moves the robot's", otherwise="as suits most hands"
    ),
    opt.Option("--period S", "of a cycle", opt.positive, default=0.005),
    opt.SCENE,
    *opt.TOLERANCES,
    opt.Q0,
    opt.SIZE_LIMITS,
)
def follow(said: Said) -> Answer:
    """Move the robot as keypoints of a hand, or contacts, move.

    Example:
      casadi-ik follow keypoints.npz --robot panda+allegro_right --out motion.mcap

    KEYPOINTS.npz holds, for k frames, either
      keypoints (k, 21, 3) of a person's hand [m], in any frame that stays the same;
                of those whose origin is in the hand (MediaPipe's world landmarks)
                the robot's wrist stays
    or, for the f fingers in the robot's order (`casadi-ik robots`),
      points    (k, f, 3) contact points [m], robot's base frame; NaN: a free
                finger; without --q0 the motion begins at a solution of the first
      normals   (k, f, 3) if wanted: outward pad normals; NaN: a free one
    and if wanted
      times     (k,) when the frames came [s]; without them 30 in a second
    A frame with bad numbers is skipped: the motors come to rest and go on with the
    next.

    --retarget FILE.yaml says how a hand moves the robot's (docs/motion.md):
      fingers: {thumb: 4, index: 8, middle: 12, ring: 16}
      low_pass: 0.3

    MOTION.mcap holds the motion as trajectory_msgs/JointTrajectory, and as joint
    states for viewers; a name that ends in .npz or .csv gives arrays or a table.

    exit codes: 0 followed within tolerance all the time, 1 not all the time,
    2 bad input
    """
    path = Path(said.frames)
    config = None if said.retarget is None else load_retarget(said.retarget)
    name = said.robot or (config.robot if config else "")
    if not name:
        raise InputError("--robot: missing, expected it here or as robot in --retarget")
    robot = the_robot(name)
    frames = _read_frames(path, len(robot.fingers))
    inputs = [path] + ([Path(said.retarget)] if said.retarget else [])
    check_outputs({"--out": said.out}, inputs)
    solver = the_solver(said, robot)
    start = np.asarray(the_start(said, robot) or _start(solver, frames))
    seconds = float(frames.times[-1])
    if seconds > limit(LIMITS.stream_cycles) * said.period:
        raise InputError(
            f"{path}: times: found {seconds:g} s, expected at most "
            f"{limit(LIMITS.stream_cycles) * said.period:g} s at this period {RAISED}"
        )
    follower = solver.follow(start, said.period)
    times = np.arange(1, int(np.ceil(seconds / said.period)) + 2) * said.period
    q = np.empty((len(times) + 1, len(robot.actuators)))
    q[0] = follower.state.q
    status = np.full(len(q), FollowStatus.HOLDING.value, dtype="<U9")
    error = np.full((len(q), len(robot.fingers)), np.nan)
    with located("--retarget" if said.retarget is None else said.retarget):
        retargeter = Retargeter(config or usual_retarget(robot), robot, start)
    began = time.perf_counter()
    for i, reached in enumerate(_followed(path, follower, frames, times, retargeter), start=1):
        state = follower.state
        q[i], status[i], error[i] = reached, state.status.value, state.position_error
    spent = (time.perf_counter() - began) / len(times)
    notes = {"status": status, "position_error": error}
    motion = Motion.of_cycles(robot, said.period, q, notes)
    write_output(said.out, "--out", motion.write_to)
    counts = {one.value: int((status[1:] == one.value).sum()) for one in FollowStatus}
    step, far = np.abs(motion.velocity) / follower.velocity, error[1:][np.isfinite(error[1:])]
    stays = retargeter.in_hand and retargeter.config.travel is None
    pairs = {
        "robot": robot.name,
        "wrist": "stays: the keypoints' origin is in the hand (MediaPipe's world landmarks)"
        if stays
        else "",
        "cycles": f"{len(times)} of {1e3 * said.period:g} ms, {1e6 * spent:.0f} us each",
        "how they went": ", ".join(f"{name} {count}" for name, count in counts.items() if count),
        "fastest motor": f"{100 * step.max():.0f} % of its velocity limit",
        "largest error": f"{1e3 * far.max():.2f} mm" if len(far) else "",
        "written": str(said.out),
    }
    followed = counts[FollowStatus.FOLLOWING.value] == len(times)
    return Answer.solved(followed, Group(Text(path.name, "bold"), fields(pairs)))


@dataclass(frozen=True, eq=False)
class _Frames:
    """Frames of a stream.

    Attributes:
        times: (k,) [s], the first 0.
        keypoints: (k, 21, 3) of a person's hand [m]; None: contacts are given.
        points: (k, f, 3) contact points [m], base frame; nothing where keypoints are given.
        normals: (k, f, 3) outward pad normals; NaN where free.
    """

    times: Array
    keypoints: Array | None
    points: Array
    normals: Array

    def at(self, times: Array, values: Array) -> Array:
        """Values of frames between the frames, linearly; NaN beside a frame that has NaN."""
        after = np.clip(np.searchsorted(self.times, times), 1, max(len(self.times) - 1, 1))
        if len(self.times) == 1:
            return np.repeat(values, len(times), axis=0)
        start, end = self.times[after - 1], self.times[after]
        share = np.clip((times - start) / (end - start), 0.0, 1.0)[:, None, None]
        before, behind = values[after - 1], values[after]
        with np.errstate(invalid="ignore"):  # a frame that is none gives none
            between = before + share * (behind - before)
        return np.where(share <= 0, before, np.where(share >= 1, behind, between))


def _read_frames(path: Path, fingers: int) -> _Frames:
    """Read what `follow` reads, for a robot of so many fingers.

    Raises:
        DescriptionError: Missing, damaged or too large; the message names the file.
        InputError: Other arrays than expected; the message names file and key.
    """
    arrays = read_npz(path, LIMITS.stream_bytes)
    known = ["keypoints", "normals", "points", "times"]
    if ("keypoints" in arrays) == ("points" in arrays):
        raise InputError(
            f"{path}: expected keypoints (k, {KEYPOINTS}, 3) or points (k, {fingers}, 3); "
            f"found {', '.join(arrays) or 'nothing'}"
        )
    for name in sorted(set(arrays).difference(known)):
        raise InputError(f"{path}: {name}: unknown, expected {', '.join(known)}")
    key = "keypoints" if "keypoints" in arrays else "points"
    count = KEYPOINTS if key == "keypoints" else fingers
    frames = arrays[key]
    if frames.ndim != 3 or frames.shape[1:] != (count, 3) or not len(frames):
        raise InputError(
            f"{path}: {key}: found shape {frames.shape}, expected (k, {count}, 3), k >= 1"
        )
    # One bad frame is no error of a stream; most of them too large are in other units.
    middle = frames.mean(axis=1, keepdims=True) if key == "keypoints" else 0.0
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(frames - middle, axis=2)
    away = away[np.isfinite(away)]
    if len(away) and np.median(away) > LIMITS.stream_reach:
        of = "middle of the hand" if key == "keypoints" else "base"
        raise InputError(
            f"{path}: {key}: found {np.median(away):.4g} m from the {of}, expected at most "
            f"{LIMITS.stream_reach:g} m (numbers in mm?)"
        )
    normals = arrays.get("normals")
    if normals is not None and (key == "keypoints" or normals.shape != frames.shape):
        expected = "points beside them" if key == "keypoints" else f"{frames.shape}"
        raise InputError(f"{path}: normals: found shape {normals.shape}, expected {expected}")
    times = arrays.get("times", np.arange(len(frames)) / 30.0)
    steady = times.shape == (len(frames),) and np.isfinite(times).all()
    if not (steady and (np.diff(times) > 0).all()):
        raise InputError(
            f"{path}: times: expected {len(frames)} growing numbers of seconds, one per frame"
        )
    if key == "keypoints":
        nothing = np.zeros((len(frames), 0, 3))
        return _Frames(times - times[0], frames, nothing, nothing)
    free = np.full(frames.shape, np.nan) if normals is None else normals
    return _Frames(times - times[0], None, frames, free)


def _start(solver: Solver, frames: _Frames) -> Array:
    """Where a robot begins of which nobody says where it is."""
    first = frames.points[:1], frames.normals[:1]
    if np.isfinite(first[0]).any():
        solved = solver.solve_batch(*first)
        if solved.success[0]:
            return solved.q[0]
    return solver.robot.home


def _followed(
    path: Path, follower: Follower, frames: _Frames, times: Array, retargeter: Retargeter
) -> Iterator[Array]:
    """Where the motors are at the end of each cycle."""
    weight = retargeter.config.wrist_weight, retargeter.config.wrist_weight
    at_once = 1024  # whose targets are in memory
    for first in range(0, len(times), at_once):
        now = times[first : first + at_once]
        if frames.keypoints is None:
            both = frames.at(now, frames.points), frames.at(now, frames.normals)
            yield from (follower(*target) for target in zip(*both, strict=True))
            continue
        for keypoints in frames.at(now, frames.keypoints):
            with located(str(path)):
                wanted = retargeter(keypoints, follower.period)
            palm = wanted.palm if follower.moves_palm else None
            yield follower(wanted.points, palm=palm, palm_weight=weight)


@command(
    opt.Option("GRASP", f"{opt.GRASP.help}, or RANKED.json"),
    opt.Option(
        "--rank N", "which of the answers of RANKED.json", opt.whole(1), otherwise="1, the best"
    ),
    opt.ROBOT,
    MOTION,
    opt.picture("--animation", "draw the motion in real time"),
    opt.OBJECT_POSE,
    opt.SCENE,
    opt.Option(
        "--opening M",
        "how far fingertips are from their contacts before they close",
        opt.positive,
        default=0.02,
    ),
    opt.Option("--distance M", "how far the hand comes straight", opt.positive, default=0.08),
    opt.Option(
        "--direction X...",
        "the way the hand comes: x y z in the base frame, 0 0 -1 from above",
        opt.vector(3, "x y z"),
        otherwise="from where the grasp has its palm before it, if it says, else from the palm to "
        "the contacts",
    ),
    opt.Option(
        "--lift M", "how far the hand then goes up, with what it holds", opt.positive, default=0.0
    ),
    opt.Option(
        "--retreat M",
        "how far it goes back after that, against the way it came",
        opt.positive,
        default=0.0,
    ),
    opt.Option("--period S", "between two samples", opt.positive, default=0.01),
    opt.SEED,
    *opt.TOLERANCES,
    opt.Q0,
    opt.SIZE_LIMITS,
)
def reach(said: Said) -> Answer:
    r"""Find the timed motion from where the robot is to a grasp.

    Examples:
      casadi-ik reach cup --scene table --out motion.mcap --animation way.gif
      casadi-ik reach GRASP --robot panda+allegro_right \
          --object-pose 0.5 0 0.1 0 0 1.57 --out way.csv
      casadi-ik reach ranked.json --scene table --rank 2 --lift 0.1 --out way.mcap

    The robot goes from --q0 to a pre-grasp with open fingers, comes straight on, and
    closes: from rest to rest, within the motors' velocities and accelerations; with
    --scene all of it is free. Of what `casadi-ik choose` wrote it goes to the very
    posture that was chosen. MOTION.mcap holds it as trajectory_msgs/JointTrajectory,
    and as joint states for viewers; a name that ends in .npz or .csv gives arrays or
    a table.

    exit codes: 0 there is a way, 1 there is none (the report says why), 2 bad input
    """
    path, asked = _asked(said)
    grasp = asked if isinstance(asked, Grasp) else asked.grasp
    if isinstance(asked, Grasp):
        robot = the_robot(said.robot, path, grasp)
    else:
        with located(f"{path}: solution.robot"):
            robot = the_robot(said.robot or asked.robot)
    q0, outputs = the_start(said, robot), {"--out": said.out, "--animation": said.animation}
    if said.direction is not None and not any(said.direction):
        raise InputError("--direction: found three zeros, expected a direction")
    check_outputs(outputs, inputs=[path])
    draw, animation = None, outputs["--animation"]
    if animation is not None:
        with located("--animation", (MissingExtraError,)):
            from casadi_ik.views import draw_motion as draw
    solver = the_solver(said, robot)
    with located(str(path)):
        found = solver.reach(
            asked,
            q0,
            said.opening,
            said.distance,
            period=said.period,
            seed=said.seed,
            direction=said.direction,
            lift=said.lift,
            retreat=said.retreat,
        )
    name, motion = grasp.name or str(path), found.motion
    if motion is None:
        status = found.status.name.replace("_", " ")
        return Answer(headline(False, status, f"{name}: {found.reason}"), Exit.NOT_SOLVED)
    write_output(said.out, "--out", motion.write_to)
    if draw is not None and animation is not None:
        draw(motion, grasp, animation, solver.scene)
    head = headline(True, "REACHED", f"{name}: {robot.name}")
    return Answer(Group(head, fields(_reached(found, motion)), *files(outputs)))


def _asked(said: Said) -> tuple[Path, Grasp | ChosenPosture]:
    """What is to be reached, and its file.

    Raises:
        CasadiIKError: See `the_grasp` and `chosen_posture`, or an option that does not fit.
    """
    path = Path(said.grasp)
    if path.suffix.lower() != ".json":
        if said.rank is not None:
            raise InputError("--rank: expected it with what `casadi-ik choose` writes (.json)")
        return the_grasp(said)
    if said.object_pose is not None:
        raise InputError(f"--object-pose: {path} says where its objects are")
    return path, chosen_posture(path, said.rank or 1)


def _reached(found: Reach, motion: Motion) -> dict[str, str]:
    part, times = motion.notes["part"], motion.times
    ends = {one: float(times[part == one][-1]) for one in PARTS if (part == one).any()}
    begins = [0.0, *ends.values()]
    spent = [f"{one} {end - a:.2f} s" for (one, end), a in zip(ends.items(), begins, strict=False)]
    room = "not checked" if found.clearance is None else f"{1e3 * found.clearance:.1f} mm"
    return {
        "time": f"{times[-1]:.2f} s: {', '.join(spent)}",
        "way there": found.reason.removeprefix("way there: "),
        "clearance": room,
        "motors": f"up to {100 * found.velocity_share:.0f} % of their velocity limits, "
        f"{100 * found.acceleration_share:.0f} % of their acceleration limits (by the samples)",
        "solutions tried": str(found.tried),
    }
