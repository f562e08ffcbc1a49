"""Commands `casadi-ik follow` and `casadi-ik reach`."""

from __future__ import annotations

import time
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
from rich.text import Text

from casadi_ik.api import Solver
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import (
    load_grasp_arg,
    load_robot_arg,
    located,
    make_solver,
    parse_q0,
    report_units,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, output
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.report import Units, fields, files, headline
from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.files.keypoints import lost_contacts_reason
from casadi_ik.model.grasp import Grasp
from casadi_ik.motion.follower import FollowStatus
from casadi_ik.motion.frames import Frames, follow_frames, read_frames
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.reach import PARTS, Reach
from casadi_ik.motion.retarget import Retargeter, load_retarget, usual_retarget
from casadi_ik.solve.solution_files import ChosenPosture, chosen_posture

MOTION = opt.out_option(
    "MOTION.mcap", "output file (.mcap, .npz or .csv)", opt.file_name(".mcap", ".npz", ".csv")
)


@command(
    Option("KEYPOINTS.npz", "keypoints or contacts of all frames, see below", key="frames"),
    opt.ROBOT,
    MOTION,
    Option("--retarget FILE.yaml", "retargeting settings (default: general-purpose)"),
    Option("--period SECONDS", "duration of a cycle", 0.005),
    opt.SCENE_FILE,
    *opt.TOLERANCES,
    opt.Q0,
    opt.SIZE_LIMITS,
)
def follow(args: Arguments) -> CommandResult:
    """Follow the keypoints of a moving hand, or moving contacts.

    Example:
      casadi-ik follow keypoints.npz --robot panda+allegro_right --out motion.mcap

    KEYPOINTS.npz holds, for k frames, either
      keypoints (k, 21, 3) keypoints of a human hand [m] in any constant frame; if
                their origin is in the hand (MediaPipe's world landmarks), the wrist
                of the robot does not move
    or, for the f fingers in the robot's order (`casadi-ik robots`),
      points    (k, f, 3) contact points [m] in the base frame; NaN: free finger;
                without --q0 the motion starts at a solution of the first frame
      normals   (k, f, 3) outward pad normals (optional); NaN: free normal
    and optionally
      times     (k,) times of the frames [s] (default: 30 frames per second)
    Frames in which the tracker has lost the hand (NaN, zeros, -1, a jump) are
    skipped: the motors stop and continue with the next valid frame.

    --retarget FILE.yaml maps the human hand to the robot (docs/teleoperation.md):
      fingers: {thumb: 4, index: 8, middle: 12, ring: 16}
      low_pass: 0.3

    MOTION.mcap holds the motion as trajectory_msgs/JointTrajectory, and as joint
    states for viewers. With the suffix .npz or .csv the output is arrays or a table.

    exit codes: 0 within tolerance in every cycle, 1 not in every cycle, 2 bad input
    """
    path = Path(args.frames)
    config = None if args.retarget is None else load_retarget(args.retarget)
    name = args.robot or (config.robot if config else "")
    if not name:
        raise InputError("--robot: option is missing; expected it, or `robot` in --retarget")
    robot = load_robot_arg(name)
    with located("--retarget" if args.retarget is None else args.retarget):
        config = config or usual_retarget(robot)
        Retargeter(config, robot)  # checks that sides and fingers are those of the robot
    sides = [side.name for side in robot.description.sides]
    frames = read_frames(path, len(robot.fingers), sides)
    inputs = [path] + ([Path(args.retarget)] if args.retarget else [])
    check_outputs({"--out": args.out}, inputs)
    frames.cycles(args.period)  # checks the number of cycles
    solver = make_solver(args, robot)
    start = np.asarray(parse_q0(args, robot) or _start(solver, frames))
    follower = solver.follow(start, args.period)
    retargeter = Retargeter(config, robot, start)
    start_time = time.perf_counter()
    frames = frames.screened(retargeter)
    with located(str(path)):
        motion = follow_frames(robot, follower, frames, retargeter)
    count = len(motion) - 1
    cycle_time = (time.perf_counter() - start_time) / count
    with output(args.out) as part:
        motion.write_to(part)
    status, error = motion.notes["status"][1:], motion.notes["position_error"][1:]
    counts = {kind.value: int((status == kind.value).sum()) for kind in FollowStatus}
    step = np.abs(motion.velocity) / follower.velocity
    scale, unit = report_units(args)["m"]
    max_error = scale * np.nanmax(error) if np.isfinite(error).any() else None
    wrist_is_fixed = retargeter.in_hand and retargeter.config.travel is None
    pairs = {
        "robot": robot.name,
        "wrist": "fixed: the origin of the keypoints is in the hand (MediaPipe's world landmarks)"
        if wrist_is_fixed
        else "",
        "skipped frames": _lost_frames_text(frames),
        "cycles": f"{count} of {1e3 * args.period:g} ms, {1e6 * cycle_time:.0f} us each",
        "status": ", ".join(f"{name} {count}" for name, count in counts.items() if count),
        "fastest motor": f"{100 * step.max():.0f} % of its velocity limit",
        "largest error": "" if max_error is None else f"{max_error:.3g} {unit}",
        "collision": _collision_text(solver),
        "written": str(args.out),
    }
    is_followed = counts[FollowStatus.FOLLOWING.value] == count
    return CommandResult.of_parts(is_followed, Text(path.name, "bold"), fields(pairs))


def _start(solver: Solver, frames: Frames) -> Array:
    """Return the start configuration: a solution of the first contacts, or home."""
    usable = (
        i
        for i, points in enumerate(frames.points)
        if np.isfinite(points).any() and not lost_contacts_reason(points)
    )
    i = next(usable, None)
    if i is not None:
        contacts = frames.points[i : i + 1], frames.normals[i : i + 1]
        solved = solver.solve_batch(*contacts)
        if solved.success[0]:
            return solved.q[0]
    return solver.robot.home


def _lost_frames_text(frames: Frames) -> str:
    """Return the number of rejected frames and the most frequent reasons; "" if there are none."""
    if not frames.rejection_reasons:
        return ""
    counts = Counter(frames.rejection_reasons).most_common(2)
    texts = ", ".join(f"{reason} ({count})" for reason, count in counts)
    return f"{len(frames.rejection_reasons)} of {len(frames.times)}: {texts}"


def _collision_text(solver: Solver) -> str:
    return f"avoided with scene {solver.scene.name}" if solver.scene else "not checked"


@command(
    Option("GRASP", "grasp name, YAML file, or RANKED.json"),
    Option("--rank N", "rank of the solution in RANKED.json (default: 1, the best)"),
    opt.ROBOT,
    MOTION,
    opt.picture("--animation", "animation in real time"),
    opt.MESHES,
    opt.OBJECT_POSE,
    opt.SCENE_FILE,
    Option("--opening METRES", "gap between open fingertips and contacts [m]", 0.02),
    Option("--distance METRES", "length of the straight approach [m]", 0.08),
    Option(
        "--direction X...",
        "approach direction x y z, base frame (default: see below)",
        parse=partial(opt.numbers, count=3, meaning="x y z"),
    ),
    Option("--lift METRES", "height of the lift with the object [m]", 0.0),
    Option("--retreat METRES", "retreat along the reverse approach [m]", 0.0),
    Option("--period SECONDS", "time between two samples", 0.01),
    opt.RANDOM_SEED,
    *opt.TOLERANCES,
    opt.Q0,
    opt.SIZE_LIMITS,
)
def reach(args: Arguments) -> CommandResult:
    r"""Plan a timed motion from the start configuration to a grasp.

    Examples:
      casadi-ik reach cup --scene table --out motion.mcap --animation way.gif
      casadi-ik reach GRASP --robot panda+allegro_right \
          --object-pose 0.5 0 0.1 0 0 1.57 --out way.csv
      casadi-ik reach ranked.json --scene table --rank 2 --lift 0.1 --out way.mcap

    The robot moves from --q0 to a pre-grasp with open fingers, approaches the grasp
    on a straight line, and closes the fingers: from rest to rest, within the velocity
    and acceleration limits of the motors, and without collision if --scene is given.
    For a file of `casadi-ik choose` the motion ends at the chosen configuration.

    The default of --direction is from the pre-grasp palm pose of the grasp, if it has
    one, else from the palm to the contacts. If this direction is blocked, the hand
    approaches from above (0 0 -1), then tilted.

    MOTION.mcap holds the motion as trajectory_msgs/JointTrajectory, and as joint
    states for viewers. With the suffix .npz or .csv the output is arrays or a table.

    exit codes: 0 motion found, 1 no motion found (see report), 2 bad input
    """
    path, goal = _load_goal(args)
    grasp = goal if isinstance(goal, Grasp) else goal.grasp
    if isinstance(goal, Grasp):
        robot = load_robot_arg(args.robot, path, grasp)
    else:
        with located(f"{path}: solution.robot"):
            robot = load_robot_arg(args.robot or goal.robot)
    q0, outputs = parse_q0(args, robot), {"--out": args.out, "--animation": args.animation}
    if args.direction is not None and not any(args.direction):
        raise InputError("--direction: vector is zero; expected a direction")
    check_outputs(outputs, inputs=[path])
    draw, animation = None, outputs["--animation"]
    if animation is not None:
        with located("--animation", (MissingExtraError,)):
            from casadi_ik.app.pictures import draw_motion as draw
    solver = make_solver(args, robot)
    with located(str(path)):
        reach_result = solver.reach(
            goal,
            q0,
            args.opening,
            args.distance,
            period=args.period,
            seed=args.seed,
            direction=args.direction,
            lift=args.lift,
            retreat=args.retreat,
        )
    name, motion = grasp.name or str(path), reach_result.motion
    if motion is None:
        status = reach_result.status.name.replace("_", " ")
        return CommandResult.of_parts(
            False, headline(False, status, f"{name}: {reach_result.reason}")
        )
    with output(args.out) as part:
        motion.write_to(part)
    if draw is not None and animation is not None:
        draw(motion, grasp, animation, solver.scene)
    head = headline(True, "REACHED", f"{name}: {robot.name}")
    pairs = _motion_report(reach_result, motion, report_units(args))
    return CommandResult.of_parts(True, head, fields(pairs), *files(outputs))


def _load_goal(args: Arguments) -> tuple[Path, Grasp | ChosenPosture]:
    """Return the input file, and the grasp or posture to be reached.

    Raises:
        CasadiIKError: The file is invalid, or an option does not apply to it.
    """
    path = Path(args.grasp)
    if path.suffix.lower() not in (".json", ".npz"):
        if args.rank is not None:
            raise InputError(
                f"--rank: {path} is not a ranking; expected a file written by `casadi-ik choose` "
                "(.json) or `casadi-ik grasp` (.npz)"
            )
        return load_grasp_arg(args)
    if args.object_pose is not None:
        raise InputError(f"--object-pose: {path} already states its object poses")
    return path, chosen_posture(path, args.rank or 1)


def _motion_report(reach_result: Reach, motion: Motion, units: Units) -> dict[str, str]:
    """Return the report of a planned motion."""
    part, times = motion.notes["part"], motion.times
    end_times = {name: float(times[part == name][-1]) for name in PARTS if (part == name).any()}
    starts = [0.0, *end_times.values()]
    durations = [
        f"{name} {end - start:.2f} s"
        for (name, end), start in zip(end_times.items(), starts, strict=False)
    ]
    scale, unit = units["m"]
    unchecked = "collision not checked" if reach_result.clearance is None else ""
    return {
        "time": f"{times[-1]:.2f} s: {', '.join(durations)}",
        "path": reach_result.reason.removeprefix("path: "),
        "clearance": unchecked or f"{scale * (reach_result.clearance or 0.0):.3g} {unit}",
        "motors": f"up to {100 * reach_result.velocity_share:.0f} % of their velocity limits, "
        f"{100 * reach_result.acceleration_share:.0f} % of their acceleration limits (sampled)",
        "solutions tried": str(reach_result.tried),
    }
