"""`casadi-ik view`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik import logs
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import (
    located,
    robot_of_log,
    the_grasp,
    the_method,
    the_object_pose,
    the_robot,
    the_scene,
    the_tolerance,
)
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.table import Answer, Said, command
from casadi_ik.errors import (
    InputError,
    LogError,
    MissingExtraError,
    UnknownNameError,
    did_you_mean,
)
from casadi_ik.files.reading import read_yaml
from casadi_ik.files.shipped import shipped_names
from casadi_ik.integrations.datasets import load_candidates
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.logs import RecordedMotion, read_motion
from casadi_ik.logs.solve import OneSolve, one_solve
from casadi_ik.solve.solution_files import is_ranked, read_ranked

if TYPE_CHECKING:
    from casadi_ik.app.viewer import Candidate, Viewer

    Choices = dict[str, Candidate]


SOLVES = opt.each(opt.whole(1))


@command(
    Option(
        "[GRASP|ROBOT|LOG|CHOICES...]",
        "a shipped name or a file; of logs one or two (default: cup)",
        ["cup"],
        key="what",
    ),
    opt.ROBOT,
    opt.SCENE,
    opt.METHOD,
    opt.LIMITS,
    *opt.TOLERANCES,
    opt.OBJECT_POSE,
    Option("--solve N...", "which solve of each log (default: the only one)", read=SOLVES),
    Option("--pads", "correct the pads of a robot's file"),
    Option(
        "--host ADDRESS",
        "where it is served; 0.0.0.0: to everybody (default: 127.0.0.1, this machine only)",
        "127.0.0.1",
    ),
    Option(
        "--port N",
        "where it is served (default: the first free from 8080)",
        read=opt.whole(1, 65535),
    ),
    opt.SIZE_LIMITS,
)
def view(said: Said) -> Answer:
    """Show a grasp, a robot, answers or a solve in the browser (needs 'casadi-ik[view]').

    Examples:
      casadi-ik view cup --scene table          drag contacts, the cup, the table
      casadi-ik view panda+allegro_right        a robot as it stands at home
      casadi-ik view ranked.json                answers of `casadi-ik choose`
      casadi-ik view found.npz                  answers of `casadi-ik grasp`
      casadi-ik view candidates.yaml --robot R  each solved when it is chosen
      casadi-ik view cup.mcap                   play a solve; of two side by side
      casadi-ik view way.mcap                   play what `reach` or `follow` wrote
      casadi-ik view my_robot.yaml --pads       correct guessed pads by hand

    The page stays until Ctrl-C. Only this machine can open it unless --host says
    otherwise; whoever can open it can move what is on it, and all browsers see the
    same.

    exit codes: 0 closed, 2 bad input
    """
    serve(opened(said))
    return Answer("closed\n")


def serve(viewer: Viewer) -> None:
    """Say where a page is, and wait until it is closed."""
    sys.stdout.write(f"{viewer.url}   (Ctrl-C ends it)\n")
    sys.stdout.flush()
    viewer.wait()


def opened(said: Said) -> Viewer:
    """The page that was asked for, running.

    Raises:
        CasadiIKError: Bad input, or nothing can be served.
    """
    with located("view", (MissingExtraError,)):
        from casadi_ik.app import viewer as viewing
    from casadi_ik.app.viewer import Settings

    served: dict[str, Any] = {"host": said.host, "port": said.port}
    if all(_is_log(Path(one)) for one in said.what):
        if len(said.what) == 1 and (motion := _motion(said.what[0])):
            robot = the_robot(said.robot or motion.robot, Path(said.what[0]))
            with located(said.what[0]):
                q = motion.ordered(robot.actuators)
            return viewing.view_motion(
                robot,
                motion.times,
                q,
                scene=the_scene(said),
                label=Path(said.what[0]).stem,
                **served,
            )
        with located("view"):
            return viewing.view_log(*_the_logs(said), scene=the_scene(said), **served)
    if len(said.what) > 1:
        raise InputError(f"view: found {len(said.what)} names, expected one (or two logs)")
    said.grasp = name = said.what[0]
    path, kind = Path(name), _kind(name)
    if said.pads:
        if kind != "robot" or not path.is_file():
            raise InputError(f"{name}: --pads: expected the YAML file of a robot")
        return viewing.view_pads(path, **served)
    settings = Settings(the_method(said), the_tolerance(said), said.limits)
    scene = the_scene(said)
    more = {"scene": scene, "settings": settings, **served}
    if kind == "robot":
        robot = load_robot(path if path.is_file() else name)
        return viewing.view_grasp(robot, **more)
    if kind == "grasp":
        path, grasp = the_grasp(said)
        robot = the_robot(said.robot, path, grasp)
        with located(str(path)):
            grasp.arrays(robot.fingers)
        return viewing.view_grasp(robot, grasp, **more)
    robot, choices = (_ranked if is_ranked(path) else _candidates)(path, said)
    first = next(iter(choices.values()))
    return viewing.view_grasp(robot, first.grasp, q=first.q, candidates=choices, **more)


def _is_log(path: Path) -> bool:
    return path.suffix == ".mcap" or (path.is_dir() and any(path.rglob("*.mcap")))


def _motion(file: str) -> RecordedMotion | None:
    """What `reach` or `follow` wrote; None: a log of solves."""
    try:
        return read_motion(file)
    except LogError as error:
        if Path(file).is_file() and "no motion: found" not in str(error):
            raise
        return None


def _kind(name: str) -> str:
    """Whether a name or file is that of a grasp, a robot or candidates.

    Raises:
        UnknownNameError: It is no name.
        InputError: A file holds none of them.
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
            f"{name}: expected a grasp (contacts:), candidates (candidates:) or a robot (hand:)"
        )
    if name in shipped_names("grasps"):
        return "grasp"
    kinds = ("arm_hands", "bodies", "arms", "hands")
    if "+" in name or any(name in shipped_names(kind) for kind in kinds):
        return "robot"
    known = [one for kind in ("grasps", *kinds) for one in shipped_names(kind)]
    meant = did_you_mean(name, known, "or give the path of a file")
    raise UnknownNameError(
        f"{name!r} is neither a shipped grasp (casadi-ik grasps) nor a shipped robot (casadi-ik "
        f"robots); {meant}"
    )


def _the_logs(said: Said) -> list[tuple[OneSolve, ArmHand]]:
    """A solve of each log, and its robot.

    Raises:
        LogError: A log is missing or damaged, or was written for another robot.
        UnknownNameError: There is no such solve, or several and none is named.
        InputError: More solves are named than there are logs.
    """
    numbers = said.solve or []
    if len(numbers) > len(said.what):
        raise InputError(f"--solve: found {len(numbers)}, expected one for each log")
    found: list[tuple[OneSolve, ArmHand]] = []
    for i, file in enumerate(said.what):
        log = logs.open(file)
        with located(f"{file} (say --solve, --method)", (UnknownNameError,)):
            number = numbers[i] if i < len(numbers) else None
            solve = one_solve(log, number, said.method, counted_from=1)
        found.append((solve, robot_of_log(log, file, said.robot or solve.robot)))
    return found


def _candidates(path: Path, said: Said) -> tuple[ArmHand, Choices]:
    """The grasps of a file of candidates, and their robot.

    Raises:
        InputError: The file is malformed, or no robot is said.
    """
    from casadi_ik.app.viewer import Candidate

    robot, pose = the_robot(said.robot, path), the_object_pose(said)
    choices: Choices = {}
    for number, grasp in enumerate(load_candidates(path, robot), 1):
        name = f"{number}: {grasp.name}" if grasp.name else str(number)
        choices[name] = Candidate(grasp if pose is None else grasp.in_object_frame().at(pose))
    return robot, choices


def _ranked(path: Path, said: Said) -> tuple[ArmHand, Choices]:
    """The answers of `casadi-ik choose` and `grasp`, each with its grasp, else what it reaches.

    Raises:
        InputError: The file is none of that kind, or has no answers.
    """
    from casadi_ik.app.viewer import Candidate

    found = read_ranked(path)
    with located(f"{path}: ranked[0].solution.robot"):
        robot = the_robot(said.robot or found[0].solution.robot)
    choices: Choices = {}
    for place, one in enumerate(found, 1):
        with located(f"{path}: ranked[{place - 1}].solution.q"):
            q = robot.configuration(np.array([one.solution.q]))[0]
        grasp = None if one.grasp is None else one.placed(path, place)
        choices[f"{place}. {one.label}"] = Candidate(grasp, q, one.load, one.solution.clearance)
    return robot, choices
