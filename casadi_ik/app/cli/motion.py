"""`casadi-ik follow` and `casadi-ik reach`: motions, timed, as files."""

from __future__ import annotations

import time
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
from rich.text import Text

from casadi_ik.api import Solver
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import located, the_grasp, the_robot, the_solver, the_start, the_units
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, output
from casadi_ik.app.cli.table import Answer, Said, command
from casadi_ik.app.report import Units, fields, files, headline
from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.keypoints import lost_contacts_reason
from casadi_ik.model.grasp import Grasp
from casadi_ik.motion.follower import FollowStatus
from casadi_ik.motion.frames import Frames, follow_frames, read_frames
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.reach import PARTS, Reach
from casadi_ik.motion.retarget import Retargeter, load_retarget, usual_retarget
from casadi_ik.solve.solution_files import ChosenPosture, chosen_posture

MOTION = opt.out("MOTION.mcap", "write the motion", opt.file_name(".mcap", ".npz", ".csv"))


@command(
    Option("KEYPOINTS.npz", "the frames, see below", key="frames"),
    opt.ROBOT,
    MOTION,
    Option("--retarget FILE.yaml", "how a hand moves the robot's (default: as suits most hands)"),
    Option("--period SECONDS", "of a cycle", 0.005),
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
    A frame of a tracker that has lost the hand (NaN, zeros, -1, a jump) is skipped:
    the motors come to rest and go on with the next.

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
    with located("--retarget" if said.retarget is None else said.retarget):
        config = config or usual_retarget(robot)
        Retargeter(config, robot)  # is of the robot's sides and fingers
    sides = [side.name for side in robot.description.sides]
    frames = read_frames(path, len(robot.fingers), sides)
    inputs = [path] + ([Path(said.retarget)] if said.retarget else [])
    check_outputs({"--out": said.out}, inputs)
    frames.cycles(said.period)  # are not too many
    solver = the_solver(said, robot)
    start = np.asarray(the_start(said, robot) or _start(solver, frames))
    follower = solver.follow(start, said.period)
    retargeter = Retargeter(config, robot, start)
    began = time.perf_counter()
    frames = frames.screened(retargeter)
    with located(str(path)):
        motion = follow_frames(robot, follower, frames, retargeter)
    count = len(motion) - 1
    spent = (time.perf_counter() - began) / count
    with output(said.out) as part:
        motion.write_to(part)
    status, error = motion.notes["status"][1:], motion.notes["position_error"][1:]
    counts = {one.value: int((status == one.value).sum()) for one in FollowStatus}
    step = np.abs(motion.velocity) / follower.velocity
    scale, unit = the_units(said)["m"]
    far = scale * np.nanmax(error) if np.isfinite(error).any() else None
    stays = retargeter.in_hand and retargeter.config.travel is None
    pairs = {
        "robot": robot.name,
        "wrist": "stays: the keypoints' origin is in the hand (MediaPipe's world landmarks)"
        if stays
        else "",
        "frames of a lost hand": _lost(frames),
        "cycles": f"{count} of {1e3 * said.period:g} ms, {1e6 * spent:.0f} us each",
        "how they went": ", ".join(f"{name} {count}" for name, count in counts.items() if count),
        "fastest motor": f"{100 * step.max():.0f} % of its velocity limit",
        "largest error": "" if far is None else f"{far:.3g} {unit}",
        "collision": _checked(solver),
        "written": str(said.out),
    }
    followed = counts[FollowStatus.FOLLOWING.value] == count
    return Answer.solved(followed, Text(path.name, "bold"), fields(pairs))


def _start(solver: Solver, frames: Frames) -> Array:
    """Return where the robot begins: at a solution of the first contacts, or at home."""
    usable = (
        i
        for i, points in enumerate(frames.points)
        if np.isfinite(points).any() and not lost_contacts_reason(points)
    )
    i = next(usable, None)
    if i is not None:
        first = frames.points[i : i + 1], frames.normals[i : i + 1]
        solved = solver.solve_batch(*first)
        if solved.success[0]:
            return solved.q[0]
    return solver.robot.home


def _lost(frames: Frames) -> str:
    """Return how many frames were rejected and the most frequent reasons, "" if none was."""
    if not frames.lost:
        return ""
    counts = Counter(frames.lost).most_common(2)
    texts = ", ".join(f"{reason} ({count})" for reason, count in counts)
    return f"{len(frames.lost)} of {len(frames.times)} held: {texts}"


def _checked(solver: Solver) -> str:
    return f"kept clear of scene {solver.scene.name}" if solver.scene else "not checked"


@command(
    Option("GRASP", f"{opt.GRASP.help}, or RANKED.json"),
    Option("--rank N", "which of the answers of RANKED.json (default: 1, the best)"),
    opt.ROBOT,
    MOTION,
    opt.picture("--animation", "draw the motion in real time"),
    opt.OBJECT_POSE,
    opt.SCENE,
    Option(
        "--opening METRES", "how far fingertips are from their contacts before they close [m]", 0.02
    ),
    Option("--distance METRES", "that the hand comes straight [m]", 0.08),
    Option(
        "--direction X...",
        "the way the hand comes: x y z in the base frame, 0 0 -1 from above (default: from where "
        "the grasp has its palm before it, if it says, else from the palm to the contacts; where "
        "that cannot be gone, from above or leaning)",
        read=partial(opt.numbers, count=3, meaning="x y z"),
    ),
    Option("--lift METRES", "how far the hand then goes up, with what it holds [m]", 0.0),
    Option("--retreat METRES", "how far it goes back after that, against the way it came [m]", 0.0),
    Option("--period SECONDS", "between two samples", 0.01),
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
            from casadi_ik.app.pictures import draw_motion as draw
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
        return Answer.solved(False, headline(False, status, f"{name}: {found.reason}"))
    with output(said.out) as part:
        motion.write_to(part)
    if draw is not None and animation is not None:
        draw(motion, grasp, animation, solver.scene)
    head = headline(True, "REACHED", f"{name}: {robot.name}")
    pairs = _reached(found, motion, the_units(said))
    return Answer.solved(True, head, fields(pairs), *files(outputs))


def _asked(said: Said) -> tuple[Path, Grasp | ChosenPosture]:
    """What is to be reached, and its file.

    Raises:
        CasadiIKError: See `the_grasp` and `chosen_posture`, or an option that does not fit.
    """
    path = Path(said.grasp)
    if path.suffix.lower() not in (".json", ".npz"):
        if said.rank is not None:
            raise InputError(
                "--rank: expected it with what `casadi-ik choose` (.json) or `grasp` (.npz) writes"
            )
        return the_grasp(said)
    if said.object_pose is not None:
        raise InputError(f"--object-pose: {path} says where its objects are")
    return path, chosen_posture(path, said.rank or 1)


def _reached(found: Reach, motion: Motion, units: Units) -> dict[str, str]:
    part, times = motion.notes["part"], motion.times
    ends = {one: float(times[part == one][-1]) for one in PARTS if (part == one).any()}
    begins = [0.0, *ends.values()]
    spent = [f"{one} {end - a:.2f} s" for (one, end), a in zip(ends.items(), begins, strict=False)]
    scale, unit = units["m"]
    room = "collision not checked" if found.clearance is None else ""
    return {
        "time": f"{times[-1]:.2f} s: {', '.join(spent)}",
        "path": found.reason.removeprefix("path: "),
        "clearance": room or f"{scale * (found.clearance or 0.0):.3g} {unit}",
        "motors": f"up to {100 * found.velocity_share:.0f} % of their velocity limits, "
        f"{100 * found.acceleration_share:.0f} % of their acceleration limits (by the samples)",
        "solutions tried": str(found.tried),
    }
