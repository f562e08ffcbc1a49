"""Command `casadi-ik view`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik import logs
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import (
    load_grasp_arg,
    load_robot_arg,
    load_scene_arg,
    located,
    parse_method,
    parse_object_pose,
    parse_tolerance,
    robot_of_log,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.errors import (
    InputError,
    MissingExtraError,
    UnknownNameError,
    did_you_mean,
)
from casadi_ik.files.reading import read_yaml
from casadi_ik.files.shipped import shipped_names
from casadi_ik.integrations.datasets import load_candidates
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.logs.cdr import NoMotionError, RecordedMotion, read_motion
from casadi_ik.logs.solve import SolveRecord, one_solve
from casadi_ik.solve.solution_files import is_ranked, read_ranked

if TYPE_CHECKING:
    from casadi_ik.app.viewer import Candidate, Viewer

    Choices = dict[str, Candidate]


SOLVE_NUMBERS = opt.word_list(opt.integer(1))


@command(
    Option(
        "[GRASP|ROBOT|LOG|CHOICES...]",
        "shipped name or file; one or two logs (default: cup)",
        ["cup"],
        key="what",
    ),
    opt.ROBOT,
    opt.SCENE_FILE,
    opt.METHOD,
    opt.LIMIT_MODE,
    *opt.TOLERANCES,
    opt.OBJECT_POSE,
    Option(
        "--solve N...",
        "number of the solve of each log (default: the only one)",
        parse=SOLVE_NUMBERS,
    ),
    Option("--pads", "edit the pads of a robot file"),
    opt.MESHES,
    Option(
        "--host ADDRESS",
        "server address; 0.0.0.0: all (default: 127.0.0.1)",
        "127.0.0.1",
    ),
    Option(
        "--port N",
        "port of the server (default: first free from 8080)",
        parse=opt.integer(1, 65535),
    ),
    opt.SIZE_LIMITS,
)
def view(args: Arguments) -> CommandResult:
    """Open a grasp, robot, ranking or log in the browser (needs 'casadi-ik[view]').

    Examples:
      casadi-ik view cup --scene table          drag contacts, the cup, the table
      casadi-ik view panda+allegro_right        show a robot at home
      casadi-ik view ranked.json                show solutions of `casadi-ik choose`
      casadi-ik view found.npz                  show solutions of `casadi-ik grasp`
      casadi-ik view candidates.yaml --robot R  solve each candidate on selection
      casadi-ik view cup.mcap                   play a solve (two logs: both)
      casadi-ik view way.mcap                   play a motion of `reach` or `follow`
      casadi-ik view my_robot.yaml --pads       correct guessed pads by hand

    The page is served until Ctrl-C. By default only this machine can open it; see
    --host. Everybody who can open the page can edit it, and all browsers show the
    same state.

    exit codes: 0 closed, 2 bad input
    """
    serve(open_viewer(args))
    return CommandResult("closed\n")


def serve(viewer: Viewer) -> None:
    """Print the address of a page and wait until it is closed."""
    sys.stdout.write(f"{viewer.url}   (press Ctrl-C to quit)\n")
    sys.stdout.flush()
    viewer.wait()


def open_viewer(args: Arguments) -> Viewer:
    """Start the viewer that the arguments select.

    Raises:
        CasadiIKError: The input is invalid, or the server cannot start.
    """
    with located("view", (MissingExtraError,)):
        from casadi_ik.app import viewer as viewing
    from casadi_ik.app.viewer import Settings

    server_settings: dict[str, Any] = {"host": args.host, "port": args.port}
    if all(_is_log(Path(name)) for name in args.what):
        if len(args.what) == 1 and (motion := _motion_of(args.what[0])):
            robot = load_robot_arg(args.robot or motion.robot, Path(args.what[0]))
            with located(args.what[0]):
                q = motion.ordered(robot.actuators)
            return viewing.view_motion(
                robot,
                motion.times,
                q,
                scene=load_scene_arg(args),
                label=Path(args.what[0]).stem,
                **server_settings,
            )
        with located("view"):
            scene = load_scene_arg(args)
            return viewing.view_log(*_load_solves(args), scene=scene, **server_settings)
    if len(args.what) > 1:
        raise InputError(f"view: found {len(args.what)} names, expected one (or two logs)")
    args.grasp = name = args.what[0]
    path, kind = Path(name), _kind(name)
    if args.pads:
        if kind != "robot" or not path.is_file():
            raise InputError(f"{name}: --pads: file is not a robot; expected a robot's YAML file")
        return viewing.view_pads(path, **server_settings)
    settings = Settings(parse_method(args), parse_tolerance(args), args.limits)
    scene = load_scene_arg(args)
    scene_settings = {"scene": scene, "settings": settings, **server_settings}
    if kind == "robot":
        robot = load_robot(path if path.is_file() else name)
        return viewing.view_grasp(robot, **scene_settings)
    if kind == "grasp":
        path, grasp = load_grasp_arg(args)
        robot = load_robot_arg(args.robot, path, grasp)
        with located(str(path)):
            grasp.arrays(robot.fingers)
        return viewing.view_grasp(robot, grasp, **scene_settings)
    robot, choices = (_ranked_choices if is_ranked(path) else _candidate_choices)(path, args)
    first = next(iter(choices.values()))
    return viewing.view_grasp(robot, first.grasp, q=first.q, candidates=choices, **scene_settings)


def _is_log(path: Path) -> bool:
    return path.suffix == ".mcap" or (path.is_dir() and any(path.rglob("*.mcap")))


def _motion_of(file: str) -> RecordedMotion | None:
    """Read a motion of `reach` or `follow`; return None for a log of solves."""
    if not Path(file).is_file():
        return None  # a folder of shards holds solves
    try:
        return read_motion(file)
    except NoMotionError:
        return None


def _kind(name: str) -> str:
    """Return the kind of a name or file: "grasp", "robot" or "candidates".

    Raises:
        UnknownNameError: The name is unknown.
        InputError: The file has another kind.
    """
    path = Path(name)
    if path.suffix in (".json", ".npz") or path.is_dir():
        return "candidates"
    if "/" in name or path.suffix in (".yaml", ".yml"):
        raw = read_yaml(path)
        keys = set(raw) if isinstance(raw, dict) else set()
        if "candidates" in keys:
            return "candidates"
        if "contacts" in keys:
            return "grasp"
        if keys & {"arm", "hand", "robot", "joints", "links"}:
            return "robot"
        raise InputError(
            f"{name}: kind of file is unknown; expected a grasp (key contacts), candidates (key "
            "candidates) or a robot (key hand)"
        )
    if name in shipped_names("grasps"):
        return "grasp"
    kinds = ("arm_hands", "bodies", "arms", "hands")
    if "+" in name or any(name in shipped_names(kind) for kind in kinds):
        return "robot"
    shipped = [entry for kind in ("grasps", *kinds) for entry in shipped_names(kind)]
    suggestion = did_you_mean(name, shipped, "expected a shipped name or the path of a file")
    raise UnknownNameError(
        f"{name!r} is neither a shipped grasp (casadi-ik grasps) nor a shipped robot (casadi-ik "
        f"robots); {suggestion}"
    )


def _load_solves(args: Arguments) -> list[tuple[SolveRecord, ArmHand]]:
    """Return a solve of each log with its robot.

    Raises:
        LogError: A log is missing or damaged, or was written for another robot.
        UnknownNameError: The log does not have this solve, or has several and the number is
            missing.
        InputError: There are more solve numbers than logs.
    """
    numbers = args.solve or []
    if len(numbers) > len(args.what):
        raise InputError(
            f"--solve: found {len(numbers)} numbers, expected at most {len(args.what)}, one per log"
        )
    solves: list[tuple[SolveRecord, ArmHand]] = []
    for i, file in enumerate(args.what):
        log = logs.open(file)
        with located(f"{file} (use --solve, --method)", (UnknownNameError,)):
            number = numbers[i] if i < len(numbers) else None
            solve = one_solve(log, number, args.method, counted_from=1)
        solves.append((solve, robot_of_log(log, file, args.robot or solve.robot)))
    return solves


def _candidate_choices(path: Path, args: Arguments) -> tuple[ArmHand, Choices]:
    """Return the robot and the grasps of a file of candidates by name.

    Raises:
        InputError: The file is malformed, or ``--robot`` is missing.
    """
    from casadi_ik.app.viewer import Candidate

    robot, pose = load_robot_arg(args.robot, path), parse_object_pose(args)
    choices: Choices = {}
    for number, grasp in enumerate(load_candidates(path, robot), 1):
        name = f"{number}: {grasp.name}" if grasp.name else str(number)
        choices[name] = Candidate(grasp if pose is None else grasp.in_object_frame().at(pose))
    return robot, choices


def _ranked_choices(path: Path, args: Arguments) -> tuple[ArmHand, Choices]:
    """Return the robot and the solutions of a file of `casadi-ik choose` or `grasp` by name.

    Raises:
        InputError: The file is not a ranking, or holds no solutions.
    """
    from casadi_ik.app.viewer import Candidate

    ranking = read_ranked(path)
    with located(f"{path}: ranked[0].solution.robot"):
        robot = load_robot_arg(args.robot or ranking[0].solution.robot)
    choices: Choices = {}
    for rank, entry in enumerate(ranking, 1):
        with located(f"{path}: ranked[{rank - 1}].solution.q"):
            q = robot.configuration(np.array([entry.solution.q]))[0]
        grasp = None if entry.grasp is None else entry.to_grasp(path, rank)
        choices[f"{rank}. {entry.label}"] = Candidate(
            grasp, q, entry.load, entry.solution.clearance
        )
    return robot, choices
