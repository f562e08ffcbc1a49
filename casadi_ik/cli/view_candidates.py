"""Candidates and ranked answers as questions to be gone through on a page."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.cli.question import located, the_object_pose, the_robot
from casadi_ik.cli.ranked_file import read_ranked
from casadi_ik.collision.scene import Scene
from casadi_ik.datasets import load_candidates

if TYPE_CHECKING:
    from casadi_ik.viewing.asked import Asked, Settings

    Choices = dict[str, Callable[[], tuple[Asked, Array]]]


def candidates_of(
    path: Path, arguments: argparse.Namespace, scene: Scene | None, settings: Settings
) -> tuple[ArmHand, Choices]:
    """The grasps of a file of candidates, and their robot.

    Raises:
        InputError: The file is malformed, or no robot is said.
    """
    from casadi_ik.viewing.asked import asked_of

    robot = the_robot(arguments.robot, path)
    pose = the_object_pose(arguments)
    choices: Choices = {}
    for number, grasp in enumerate(load_candidates(path, robot)):
        placed = grasp if pose is None else grasp.in_object_frame().at(pose)

        def ask(placed: Any = placed) -> tuple[Asked, Array]:
            return asked_of(robot, placed, None, scene, settings), robot.home

        choices[f"{number}: {grasp.name}" if grasp.name else str(number)] = ask
    return robot, choices


def ranked_of(
    path: Path, arguments: argparse.Namespace, scene: Scene | None, settings: Settings
) -> tuple[ArmHand, Choices]:
    """The answers of `casadi-ik choose`: the contacts that each one reaches are what is asked.

    Raises:
        InputError: The file is none of that kind, or has no answers.
    """
    from casadi_ik.viewing.asked import asked_of

    found = read_ranked(path)
    with located(f"{path}: ranked[0].solution.robot"):
        robot = the_robot(arguments.robot or found[0].solution.robot)
    choices: Choices = {}
    for place, one in enumerate(found, 1):
        with located(f"{path}: ranked[{place - 1}].solution.q"):
            q = robot.configuration(np.array([one.solution.q]))[0]

        def ask(q: Array = q) -> tuple[Asked, Array]:
            return asked_of(robot, None, q, scene, settings), q

        choices[f"{place}. {one.label}"] = ask
    return robot, choices
