"""The solves that `casadi-ik view` plays."""

from __future__ import annotations

import argparse

from casadi_ik import logs
from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.cli.question import located
from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.logs.read.one_solve import OneSolve, one_solve
from casadi_ik.logs.read.same_robot import check_robot


def the_logs(files: list[str], arguments: argparse.Namespace) -> list[tuple[OneSolve, ArmHand]]:
    """A solve of each log, and its robot.

    Raises:
        LogError: A log is missing or damaged, or was written for another robot.
        UnknownNameError: There is no such solve, or several and none is named.
        InputError: More solves are named than there are logs.
    """
    numbers = arguments.solve or []
    if len(numbers) > len(files):
        raise InputError(f"--solve: found {len(numbers)}, expected one for each log")
    found: list[tuple[OneSolve, ArmHand]] = []
    for i, file in enumerate(files):
        log = logs.open(file)
        with located(f"{file} (say --solve, --method)", (UnknownNameError,)):
            solve = one_solve(log, numbers[i] if i < len(numbers) else None, arguments.method)
        with located(f"{file}: robot (say --robot)", (UnknownNameError,)):
            robot = load_robot(arguments.robot or solve.robot)
        check_robot(robot, log.attachment("robot.urdf").decode(), file)
        found.append((solve, robot))
    return found
