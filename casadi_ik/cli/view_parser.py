"""What can be said behind `casadi-ik view`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.shared_options import add_object_pose, add_scene, add_tolerances
from casadi_ik.cli.values import one_of, whole

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

_EXAMPLES = """\
examples:
  casadi-ik view cup --scene table          drag contacts, the cup, the table
  casadi-ik view panda+allegro_right        a robot: contacts begin where its fingers are
  casadi-ik view ranked.json                answers of `casadi-ik choose`, to be gone through
  casadi-ik view candidates.yaml --robot R  candidates, each solved when it is chosen
  casadi-ik view cup.mcap                   play a solve; a second log plays beside it
  casadi-ik view my_robot.yaml --pads       correct guessed pads by hand (see casadi-ik import)

The page stays until Ctrl-C. Only this machine can open it unless --host says otherwise; whoever
can open it can move what is on it, and all browsers see the same.

exit codes: 0 closed, 2 bad input
"""


def add_view(commands: Any) -> None:
    """Add `view` to the commands."""
    parser = commands.add_parser(
        "view",
        help="drag contacts in the browser and watch arm and hand follow; play a log",
        description="Show a grasp, a robot, answers or a solve in the browser (needs "
        "casadi-ik[view]).",
        epilog=_EXAMPLES,
    )
    parser.add_argument(
        "what",
        metavar="GRASP|ROBOT|LOG|CHOICES",
        nargs="*",
        help="a shipped name or a file (default: cup); of logs one or two",
    )
    parser.add_argument(
        "--robot", metavar="R", help="a shipped name or a YAML file (default: the file's)"
    )
    add_scene(parser, ", or what stood there beside a log")
    parser.add_argument("--method", metavar="M", help="to begin with; the page can change it")
    parser.add_argument(
        "--limits",
        metavar="enforce|ignore",
        type=one_of("enforce", "ignore"),
        default="enforce",
        help="whether being solved includes the limits (default: enforce)",
    )
    add_tolerances(parser)
    add_object_pose(parser, ", of candidates")
    parser.add_argument(
        "--solve",
        metavar="N",
        type=whole(0),
        nargs="+",
        help="which solve of each log (default: the only one)",
    )
    parser.add_argument("--pads", action="store_true", help="correct the pads of a robot's file")
    parser.add_argument(
        "--meshes", action="store_true", help="draw the meshes of the robot's files"
    )
    parser.add_argument(
        "--host",
        metavar="ADDRESS",
        default="127.0.0.1",
        help="where it is served (default: 127.0.0.1, this machine only; 0.0.0.0: everybody)",
    )
    parser.add_argument(
        "--port", metavar="N", type=whole(1), help="default: the first free one from 8080 on"
    )
    parser.set_defaults(run=_view)


def _view(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.view import view

    return view(arguments)
