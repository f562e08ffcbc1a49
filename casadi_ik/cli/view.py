"""`casadi-ik view`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.question import located, the_grasp, the_robot, the_scene, the_tolerance
from casadi_ik.cli.view_candidates import candidates_of, ranked_of
from casadi_ik.cli.view_log import the_logs
from casadi_ik.errors import InputError, MissingExtraError, UnknownNameError
from casadi_ik.files.reading import read_yaml
from casadi_ik.files.shipped import shipped_names
from casadi_ik.importing.surfaces import Surface
from casadi_ik.registry import METHODS

if TYPE_CHECKING:
    from casadi_ik.viewing import Viewer
    from casadi_ik.viewing.asked import Settings

SHOWN = "cup"
"""What is shown if nothing is said."""


def view(arguments: argparse.Namespace) -> Answer:
    """Serve a page until somebody interrupts.

    Raises:
        CasadiIKError: Bad input, or nothing can be served.
    """
    viewer = opened(arguments)
    sys.stdout.write(f"{viewer.url}   (Ctrl-C ends it)\n")
    sys.stdout.flush()
    viewer.wait()
    return Answer(Text("closed"))


def opened(arguments: argparse.Namespace) -> Viewer:
    """The page that was asked for, running.

    Raises:
        CasadiIKError: Bad input, or nothing can be served.
    """
    with located("view", (MissingExtraError,)):
        from casadi_ik import viewing
    what = arguments.what or [SHOWN]
    served = {"host": arguments.host, "port": arguments.port}
    if all(_is_log(Path(one)) for one in what):
        with located("view"):
            return viewing.view_log(
                *the_logs(what, arguments), scene=the_scene(arguments), **served
            )
    if len(what) > 1:
        raise InputError(f"view: found {len(what)} names, expected one (or two logs)")
    arguments.grasp = name = what[0]
    path, kind = Path(name), _kind(name)
    if arguments.pads:
        if kind != "robot" or not path.is_file():
            raise InputError(f"{name}: --pads: expected the YAML file of a robot")
        return viewing.view_pads(path, **served)
    settings, scene = _settings(arguments), the_scene(arguments)
    if kind == "robot":
        robot = load_robot(path if path.is_file() else name)
        return viewing.view_grasp(
            robot, scene=scene, settings=settings, meshes=_meshes(robot, path, arguments), **served
        )
    if kind == "grasp":
        path, grasp = the_grasp(arguments)
        robot = the_robot(arguments.robot, path, grasp)
        meshes = _meshes(robot, Path(arguments.robot or grasp.robot), arguments)
        with located(str(path)):
            grasp.arrays(robot.fingers)
        return viewing.view_grasp(
            robot, grasp, scene=scene, settings=settings, meshes=meshes, **served
        )
    ranked = path.suffix == ".json"
    robot, choices = (ranked_of if ranked else candidates_of)(path, arguments, scene, settings)
    first, q = next(iter(choices.values()))()
    more = {"scene": scene, "settings": settings, "candidates": choices, **served}
    return viewing.view_grasp(robot, first.grasp, q=q if ranked else None, **more)


def _is_log(path: Path) -> bool:
    return path.suffix == ".mcap" or (path.is_dir() and any(path.rglob("*.mcap")))


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
    kinds = ("arm_hands", "arms", "hands")
    if "+" in name or any(name in shipped_names(kind) for kind in kinds):
        return "robot"
    raise UnknownNameError(
        f"{name!r} is neither a shipped grasp (casadi-ik grasps) nor a shipped robot (casadi-ik "
        "robots); or give the path of a file"
    )


def _settings(arguments: argparse.Namespace) -> Settings:
    from casadi_ik.viewing.asked import Settings

    method = arguments.method or METHODS[0]
    if method not in METHODS:
        raise UnknownNameError(f"--method: found {method!r}, expected one of {', '.join(METHODS)}")
    return Settings(method, the_tolerance(arguments), arguments.limits)


def _meshes(robot: ArmHand, path: Path, arguments: argparse.Namespace) -> dict[str, Surface] | None:
    """What the robot's files show, if that is asked for."""
    if not arguments.meshes:
        return None
    from casadi_ik.viewing.meshes import robot_meshes

    if not path.is_file():
        raise InputError(f"--meshes: {robot.name} has no files of its own, expected a YAML file")
    return robot_meshes(robot, path)
