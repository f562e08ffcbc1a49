"""The words of `solve` and `batch` as the question they ask."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene, load_scene
from casadi_ik.errors import (
    CasadiIKError,
    DescriptionError,
    InputError,
    UnknownNameError,
    UnsupportedError,
)
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.files.shipped import resolve, resolve_robot
from casadi_ik.grasps import Grasp, load_grasp
from casadi_ik.problem.problems import Tolerance, fixed_array
from casadi_ik.registry import METHODS


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


def the_grasp(arguments: argparse.Namespace) -> tuple[Path, Grasp]:
    """The grasp and the file it is from.

    Raises:
        UnknownNameError: No shipped grasp has that name.
        DescriptionError: The file is missing or malformed.
        InputError: The object's pose is none.
    """
    path, pose = resolve(arguments.grasp, "grasps"), the_object_pose(arguments)
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
        found = resolve_robot(grasp.robot, beside=path)
    return load_robot(grasp.robot if isinstance(found, tuple) else found)


def the_solver(arguments: argparse.Namespace, robot: ArmHand) -> Solver:
    """The solver for a robot.

    Raises:
        UnknownNameError: No such method.
        UnsupportedError: The method cannot take the robot.
    """
    method = METHODS[0] if arguments.method is None else arguments.method
    if method not in METHODS:
        raise UnknownNameError(f"--method: found {method!r}, expected one of {', '.join(METHODS)}")
    scene = the_scene(arguments)
    about = "--finger-step" if arguments.max_rounds is None else "--max-rounds"
    with located(f"--method {method}", (UnsupportedError,)), located(about):
        return Solver(
            robot,
            method,
            the_tolerance(arguments),
            arguments.limits,
            arguments.finger_step,
            options=the_options(arguments),
            scene=scene,
        )


def the_options(arguments: argparse.Namespace) -> dict[str, int]:
    """What was said of the method's own parameters."""
    return {} if arguments.max_rounds is None else {"max_rounds": arguments.max_rounds}


def the_tolerance(arguments: argparse.Namespace) -> Tolerance:
    """When contacts count as reached."""
    tolerance = Tolerance()
    if arguments.tolerance_position is not None:
        tolerance = replace(tolerance, position=arguments.tolerance_position)
    if arguments.tolerance_angle is not None:
        tolerance = replace(tolerance, angle=arguments.tolerance_angle)
    return tolerance


def the_scene(arguments: argparse.Namespace) -> Scene | None:
    """The scene that was asked for; None: nothing is checked.

    Raises:
        UnknownNameError: No shipped scene has that name.
        DescriptionError: The file is missing or malformed.
    """
    if arguments.scene is None:
        return None
    with located("--scene", (UnknownNameError, DescriptionError)):
        return load_scene(arguments.scene)


def the_object_pose(arguments: argparse.Namespace) -> Array | None:
    """(4, 4) where the object is in whose frame targets are; None: they are in the base frame.

    Raises:
        InputError: Other than six numbers.
    """
    if arguments.object_pose is None:
        return None
    values = [value for group in arguments.object_pose for value in group]
    if len(values) != 6:
        raise InputError(
            f"--object-pose: found {len(values)} numbers, expected six: x y z [m], "
            "roll pitch yaw [rad]"
        )
    x, y, z, roll, pitch, yaw = values
    return frame_matrix(Frame((x, y, z), (roll, pitch, yaw)))


def the_start(arguments: argparse.Namespace, robot: ArmHand) -> list[float] | None:
    """The start, a number per actuator; None for home.

    Raises:
        InputError: As many numbers as actuators were expected.
    """
    if arguments.q0 is None:
        return None
    values = [value for group in arguments.q0 for value in group]
    if len(values) != len(robot.actuators):
        raise InputError(
            f"--q0: found {len(values)} numbers, expected {len(robot.actuators)}: "
            + ", ".join(robot.actuators)
        )
    return values


def the_fixed(arguments: argparse.Namespace, robot: ArmHand) -> dict[str, float]:
    """The actuators that are not to move.

    Raises:
        InputError: One is named twice, or its position is not within its limits.
        UnknownNameError: No such actuator.
    """
    fixed: dict[str, float] = {}
    for name, value in arguments.fixed:
        if name in fixed:
            raise InputError(f"--fixed: {name} appears twice")
        fixed[name] = value
    fixed_array(fixed, robot.actuators, robot.lower, robot.upper)
    return fixed
