"""What can be said behind `casadi-ik import`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.values import file_name, numbers

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

_EXAMPLES = """\
examples:
  casadi-ik import arm.urdf hand.urdf --out my_robot.yaml --picture my_robot.png
  casadi-ik import arm.urdf hand.xml --mount 0 0 0.05 0 0 1.57 --out my_robot.yaml
  casadi-ik import whole_robot.urdf --palm left_palm --out my_robot.yaml
  casadi-ik import my_robot.yaml --picture my_robot.png     after a guess was corrected
  casadi-ik solve my_grasp.yaml --robot my_robot.yaml

Files are URDF, xacro (needs casadi-ik[xacro]) or MJCF (needs casadi-ik[mujoco]). What no file says
(fingertips, where a pad is and which way it faces, the thumb, palm, home) is guessed; each guess is
marked in the description, and --picture shows them. The description points to the files.

exit codes: 0 written, 1 --check found a difference, 2 bad input (nothing is written)
"""


def add_import(commands: Any) -> None:
    """Add `import` to the commands."""
    parser = commands.add_parser(
        "import",
        help="make a description of your robot from its URDF or MJCF files",
        description="Make a description from the files of an arm and a hand, or of both in one.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("first", metavar="ARM|ROBOT", help="file of the arm, or of everything")
    parser.add_argument("hand", metavar="HAND", nargs="?", help="file of the hand")
    parser.add_argument(
        "--out",
        metavar="ROBOT.yaml",
        type=file_name(".yaml", ".yml"),
        help="write the description (needed unless one is given to be drawn again)",
    )
    parser.add_argument("--tip", metavar="LINK", help="link of the arm that carries the hand")
    parser.add_argument("--palm", metavar="LINK", help="link that the fingers hang on")
    parser.add_argument(
        "--mount",
        metavar="V",
        type=numbers,
        nargs="+",
        help="the hand's base on the tip: x y z [m] roll pitch yaw [rad] (default: on it)",
    )
    parser.add_argument(
        "--srdf", metavar="FILE.srdf", help="links that may touch, beside those that are found to"
    )
    parser.add_argument(
        "--xacro",
        action="store_true",
        help="expand the macros of files that are not called .xacro",
    )
    parser.add_argument(
        "--picture",
        metavar="FILE.png",
        type=file_name(".png"),
        help="draw the hand and the guessed pads (needs casadi-ik[plots])",
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="compare the kinematics with pinocchio's (MuJoCo's) reading of the files",
    )
    parser.set_defaults(run=_import)


def _import(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.import_robot import import_robot

    return import_robot(arguments)
