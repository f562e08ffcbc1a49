"""What can be said to `casadi-ik reach`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.shared_options import add_motion, add_object_pose, add_scene, add_tolerances
from casadi_ik.cli.values import file_name, numbers, positive, whole

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

_EXAMPLES = """\
examples:
  casadi-ik reach cup --scene table --out motion.mcap --animation way.gif
  casadi-ik reach GRASP --robot panda+allegro_right --object-pose 0.5 0 0.1 0 0 1.57 --out way.csv
  casadi-ik reach ranked.json --scene table --rank 2 --lift 0.1 --out motion.mcap

The robot goes from --q0 to a pre-grasp with open fingers, comes straight on, and closes: from rest
to rest, within the motors' velocities and accelerations; with --scene all of it is free. Of
what `casadi-ik choose` wrote it goes to the very posture that was chosen.
MOTION.mcap holds it as trajectory_msgs/JointTrajectory, and as joint states for viewers; a name
that ends in .npz or .csv gives arrays or a table.

exit codes: 0 there is a way, 1 there is none (the report says why), 2 bad input
"""


def add_reach(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "reach",
        help="the timed motion from where the robot is to a grasp",
        description="Go from where the robot is to a grasp.",
        epilog=_EXAMPLES,
    )
    parser.add_argument(
        "grasp", metavar="GRASP", help="a shipped name, a YAML file, or RANKED.json"
    )
    parser.add_argument(
        "--rank",
        metavar="N",
        type=whole(1),
        help="which of the answers of RANKED.json (default: 1, the best)",
    )
    parser.add_argument("--robot", metavar="R", help="a shipped name or a YAML file")
    add_motion(parser)
    parser.add_argument(
        "--animation",
        metavar="FILE.gif",
        type=file_name(".gif"),
        help="draw the motion in real time",
    )
    add_object_pose(parser)
    add_scene(parser)
    parser.add_argument(
        "--opening",
        metavar="M",
        type=positive,
        default=0.02,
        help="how far fingertips are from their contacts before they close (default: 0.02)",
    )
    parser.add_argument(
        "--distance",
        metavar="M",
        type=positive,
        default=0.08,
        help="how far the hand comes straight (default: 0.08)",
    )
    parser.add_argument(
        "--direction",
        metavar="X",
        type=numbers,
        nargs="+",
        help="the way the hand comes: x y z in the base frame, 0 0 -1 from above (default: from "
        "where the grasp has its palm before it, if it says, else from the palm to the contacts)",
    )
    parser.add_argument(
        "--lift",
        metavar="M",
        type=positive,
        default=0.0,
        help="how far the hand then goes up, with what it holds (default: 0)",
    )
    parser.add_argument(
        "--retreat",
        metavar="M",
        type=positive,
        default=0.0,
        help="how far it goes back after that, against the way it came (default: 0)",
    )
    parser.add_argument(
        "--period",
        metavar="S",
        type=positive,
        default=0.01,
        help="between two samples (default: 0.01)",
    )
    parser.add_argument(
        "--seed", metavar="N", type=whole(0), default=0, help="of all random numbers (default: 0)"
    )
    add_tolerances(parser)
    parser.add_argument(
        "--q0",
        metavar="V",
        type=numbers,
        nargs="+",
        help="where the robot is: a number per actuator [rad or m] (default: home)",
    )
    parser.set_defaults(run=_reach)


def _reach(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.reach import reach

    return reach(arguments)
