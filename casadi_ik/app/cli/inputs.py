"""Conversion of command-line arguments to robots, grasps, scenes and solvers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from casadi_ik.api import METHODS, Solver
from casadi_ik.app.cli.table import Arguments, to_si
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
from casadi_ik.files.input_checks import warn_of_angles
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
    location: str, kinds: tuple[type[CasadiIKError], ...] = (InputError, UnknownNameError)
) -> Iterator[None]:
    """Prefix the message of errors with the file or option that they concern.

    Args:
        location: File or option.
        kinds: Types of the errors.
    """
    try:
        yield
    except kinds as error:
        error.args = (f"{location}: {error}",)
        raise


def load_grasp_arg(args: Arguments) -> tuple[Path, Grasp]:
    """Return the file of the grasp, and the grasp at the given object pose.

    Raises:
        UnknownNameError: No shipped grasp has this name.
        DescriptionError: The file is missing or malformed.
    """
    path, pose = resolve_description(args.grasp, "grasps"), parse_object_pose(args)
    grasp = load_grasp(path)
    return path, grasp if pose is None else grasp.in_object_frame().at(pose)


def load_robot_arg(
    name: str | None, path: Path | None = None, grasp: Grasp | None = None
) -> ArmHand:
    """Return the robot of ``--robot``, or the robot that the grasp file names.

    Args:
        name: Value of ``--robot``, or None.
        path: File of the grasp, to which the path of a robot file is relative.
        grasp: Grasp.

    Raises:
        InputError: Neither the option nor the grasp names a robot.
        UnknownNameError: No shipped robot has this name.
        DescriptionError: The file of the robot is missing or malformed.
    """
    if name is not None:
        with located("--robot"):
            return load_robot(name)
    if path is None or grasp is None or not grasp.robot:
        raise InputError(f"{path}: robot: key is missing; expected it in the file, or --robot")
    with located(f"{path}: robot", (UnknownNameError, DescriptionError)):
        resolved = resolve_robot(grasp.robot, relative_to=path)
    return load_robot(grasp.robot if isinstance(resolved, tuple) else resolved)


def robot_of_log(log: Log, file: str, name: str) -> ArmHand:
    """Load a robot and check that it is the robot of a log.

    Raises:
        UnknownNameError: No shipped robot has this name.
        LogError: The log was written for another robot.
    """
    with located(f"{file}: robot (use --robot)", (UnknownNameError,)):
        robot = load_robot(name)
    check_robot(robot, log.attachment("robot.urdf").decode(), file)
    return robot


def parse_method(args: Arguments) -> str:
    """Return the name of the method.

    Raises:
        UnknownNameError: No method has this name.
    """
    method = args.method or METHODS[0]
    if method not in METHODS:
        raise UnknownNameError(f"--method: found {method!r}, {did_you_mean(method, METHODS)}")
    return method


def make_solver(args: Arguments, robot: ArmHand) -> Solver:
    """Return the solver of a robot; settings without an option have their default.

    Raises:
        UnknownNameError: No method or scene has this name.
        UnsupportedError: The method does not support the robot.
        DescriptionError: The file of the scene is missing or malformed.
    """
    scene = load_scene_arg(args)
    if "method" not in args:
        return Solver(robot, tolerance=parse_tolerance(args), options=_options(args), scene=scene)
    method = parse_method(args)
    option = "--finger-step" if args.max_rounds is None else "--max-rounds"
    with located(f"--method {method}", (UnsupportedError,)), located(option):
        return Solver(
            robot,
            method,
            parse_tolerance(args),
            args.limits,
            args.finger_step,
            options=_options(args),
            scene=scene,
        )


def _options(args: Arguments) -> dict[str, int]:
    """Return the parameters of the method that the command line sets."""
    max_restarts = getattr(args, "max_rounds", None)
    return {} if max_restarts is None else {"max_rounds": max_restarts}


def parse_tolerance(args: Arguments) -> Tolerance:
    """Return the tolerance of contacts."""
    default = Tolerance()
    position = args.tolerance_position or default.position
    return Tolerance(position, args.tolerance_angle or default.angle)


def load_scene_arg(args: Arguments) -> Scene | None:
    """Return the scene, or None if collisions are not checked.

    Raises:
        UnknownNameError: No shipped scene has this name.
        DescriptionError: The file is missing or malformed.
    """
    if args.scene is None:
        return None
    with located("--scene", (UnknownNameError, DescriptionError)):
        return load_scene(args.scene)


def parse_object_pose(args: Arguments) -> Array | None:
    """Return the object pose (4, 4) in the base frame, or None if it is not given."""
    if args.object_pose is None:
        return None
    x, y, z, roll, pitch, yaw = args.object_pose
    warn_of_angles((roll, pitch, yaw), "--object-pose")
    return frame_matrix(Frame((x, y, z), (roll, pitch, yaw)))


def report_units(args: Arguments) -> Units:
    """Return the units of reports: degrees and mm unless the options say otherwise."""
    return {
        "rad": (SI if args.deg is False else HUMAN)["rad"],
        "m": (SI if args.mm is False else HUMAN)["m"],
    }


def parse_q0(args: Arguments, robot: ArmHand) -> list[float] | None:
    """Return the start configuration (n,) [rad or m], or None for the home configuration.

    Raises:
        InputError: The number of values differs from the number of actuators.
    """
    if args.q0 is None:
        return None
    if len(args.q0) != len(robot.actuators):
        raise InputError(
            f"--q0: found {len(args.q0)} numbers, expected {len(robot.actuators)}: "
            + ", ".join(robot.actuators)
        )
    units = (actuator.unit for actuator in robot.description.actuators)
    return [to_si(value, unit, args) for value, unit in zip(args.q0, units, strict=True)]


def parse_fixed(args: Arguments, robot: ArmHand) -> dict[str, float]:
    """Return the positions of fixed actuators [rad or m] by name.

    Raises:
        InputError: An actuator appears twice, or its position violates its limits.
        UnknownNameError: No actuator has this name.
    """
    units = {actuator.name: actuator.unit for actuator in robot.description.actuators}
    fixed: dict[str, float] = {}
    for name, value in args.fixed:
        if name in fixed:
            raise InputError(f"--fixed: {name} appears twice")
        fixed[name] = to_si(value, units.get(name, ""), args)
    fixed_array(fixed, robot.actuators, *robot.description.motion_limits)
    return fixed
