"""What was said, as robots, grasps, scenes and solvers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from casadi_ik.api import METHODS, Solver
from casadi_ik.app.cli.table import Said, in_si
from casadi_ik.app.report import HUMAN, SI, Units
from casadi_ik.collision.scene import Scene, load_scene
from casadi_ik.errors import (
    CasadiIKError,
    DescriptionError,
    InputError,
    UnknownNameError,
    UnsupportedError,
    did_you_mean,
)
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.files.shipped import resolve_description, resolve_robot
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.logs import Log
from casadi_ik.logs.solve import check_robot
from casadi_ik.model.grasp import Grasp, Tolerance
from casadi_ik.model.load_grasp import load_grasp
from casadi_ik.model.targets import fixed_array


@contextlib.contextmanager
def located(
    where: str, kinds: tuple[type[CasadiIKError], ...] = (InputError, UnknownNameError)
) -> Iterator[None]:
    """Put the place in front of an error that does not know it.

    Args:
        where: A file or an option.
        kinds: Which errors.
    """
    try:
        yield
    except kinds as error:
        error.args = (f"{where}: {error}",)
        raise


def the_grasp(said: Said) -> tuple[Path, Grasp]:
    """The grasp, moved with its object, and the file it is from.

    Raises:
        UnknownNameError: No shipped grasp has that name.
        DescriptionError: The file is missing or malformed.
    """
    path, pose = resolve_description(said.grasp, "grasps"), the_object_pose(said)
    grasp = load_grasp(path)
    return path, grasp if pose is None else grasp.in_object_frame().at(pose)


def the_robot(name: str | None, path: Path | None = None, grasp: Grasp | None = None) -> ArmHand:
    """The robot that was asked for, else the grasp file's, whose path counts from that file.

    Raises:
        InputError: Neither is given.
        UnknownNameError: No shipped robot has that name.
        DescriptionError: Its file is missing or malformed.
    """
    if name is not None:
        with located("--robot"):
            return load_robot(name)
    if path is None or grasp is None or not grasp.robot:
        raise InputError(f"{path}: robot: missing, expected it in the file or --robot")
    with located(f"{path}: robot", (UnknownNameError, DescriptionError)):
        found = resolve_robot(grasp.robot, relative_to=path)
    return load_robot(grasp.robot if isinstance(found, tuple) else found)


def robot_of_log(log: Log, file: str, name: str) -> ArmHand:
    """A robot, after making sure that it is the one of a log.

    Raises:
        UnknownNameError: No shipped robot has that name.
        LogError: The log was written for another robot.
    """
    with located(f"{file}: robot (say --robot)", (UnknownNameError,)):
        robot = load_robot(name)
    check_robot(robot, log.attachment("robot.urdf").decode(), file)
    return robot


def the_method(said: Said) -> str:
    """The method.

    Raises:
        UnknownNameError: No such method.
    """
    method = said.method or METHODS[0]
    if method not in METHODS:
        raise UnknownNameError(f"--method: found {method!r}, {did_you_mean(method, METHODS)}")
    return method


def the_solver(said: Said, robot: ArmHand) -> Solver:
    """The solver for a robot; what a command has no option for is as usual.

    Raises:
        UnknownNameError: No such method, or no such scene.
        UnsupportedError: The method cannot take the robot.
        DescriptionError: The scene's file is missing or malformed.
    """
    scene = the_scene(said)
    if "method" not in said:
        return Solver(robot, tolerance=the_tolerance(said), options=_options(said), scene=scene)
    method = the_method(said)
    about = "--finger-step" if said.max_rounds is None else "--max-rounds"
    with located(f"--method {method}", (UnsupportedError,)), located(about):
        return Solver(
            robot,
            method,
            the_tolerance(said),
            said.limits,
            said.finger_step,
            options=_options(said),
            scene=scene,
        )


def _options(said: Said) -> dict[str, int]:
    """What was said of the method's own parameters."""
    rounds = getattr(said, "max_rounds", None)
    return {} if rounds is None else {"max_rounds": rounds}


def the_tolerance(said: Said) -> Tolerance:
    """When contacts count as reached."""
    usual = Tolerance()
    return Tolerance(said.tolerance_position or usual.position, said.tolerance_angle or usual.angle)


def the_scene(said: Said) -> Scene | None:
    """The scene that was asked for; None: nothing is checked.

    Raises:
        UnknownNameError: No shipped scene has that name.
        DescriptionError: The file is missing or malformed.
    """
    if said.scene is None:
        return None
    with located("--scene", (UnknownNameError, DescriptionError)):
        return load_scene(said.scene)


def the_object_pose(said: Said) -> Array | None:
    """(4, 4) where the object is in whose frame targets are; None: they are in the base frame."""
    if said.object_pose is None:
        return None
    x, y, z, roll, pitch, yaw = said.object_pose
    return frame_matrix(Frame((x, y, z), (roll, pitch, yaw)))


def the_units(said: Said) -> Units:
    """What reports are in: degrees and mm, unless radians or m were asked for."""
    return {
        "rad": (SI if said.deg is False else HUMAN)["rad"],
        "m": (SI if said.mm is False else HUMAN)["m"],
    }


def the_start(said: Said, robot: ArmHand) -> list[float] | None:
    """The start, a number per actuator; None for home.

    Raises:
        InputError: As many numbers as actuators were expected.
    """
    if said.q0 is None:
        return None
    if len(said.q0) != len(robot.actuators):
        raise InputError(
            f"--q0: found {len(said.q0)} numbers, expected {len(robot.actuators)}: "
            + ", ".join(robot.actuators)
        )
    units = (actuator.unit for actuator in robot.description.actuators)
    return [in_si(value, unit, said) for value, unit in zip(said.q0, units, strict=True)]


def the_fixed(said: Said, robot: ArmHand) -> dict[str, float]:
    """The actuators that are not to move.

    Raises:
        InputError: One is named twice, or its position is not within its limits.
        UnknownNameError: No such actuator.
    """
    units = {actuator.name: actuator.unit for actuator in robot.description.actuators}
    fixed: dict[str, float] = {}
    for name, value in said.fixed:
        if name in fixed:
            raise InputError(f"--fixed: {name} appears twice")
        fixed[name] = in_si(value, units.get(name, ""), said)
    fixed_array(fixed, robot.actuators, *robot.description.motion_limits)
    return fixed
