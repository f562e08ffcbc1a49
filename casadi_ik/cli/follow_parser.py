"""What can be said to `casadi-ik follow`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.shared_options import add_motion, add_scene, add_tolerances
from casadi_ik.cli.values import numbers, positive

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

_EXAMPLES = """\
example:
  casadi-ik follow keypoints.npz --robot panda+allegro_right --out motion.mcap

KEYPOINTS.npz holds, for k frames, either
  keypoints (k, 21, 3) of a person's hand [m], in any frame that stays the same; of those whose
            origin is in the hand (MediaPipe's world landmarks) the robot's wrist stays
or, for the f fingers in the robot's order (`casadi-ik robots`),
  points    (k, f, 3) contact points [m], robot's base frame; NaN marks a free finger
  normals   (k, f, 3) if wanted: outward pad normals; NaN marks a free one
and if wanted
  times     (k,) when the frames came [s]; without them 30 in a second
A frame with bad numbers is skipped: the motors come to rest and go on with the next.
--retarget FILE.yaml says how a hand moves the robot's (docs/motion.md):
  fingers: {thumb: 4, index: 8, middle: 12, ring: 16}
  low_pass: 0.3
MOTION.mcap holds the motion as trajectory_msgs/JointTrajectory, and as joint states for viewers;
a name that ends in .npz or .csv gives arrays or a table.

exit codes: 0 followed within tolerance all the time, 1 not all the time, 2 bad input
"""


def add_follow(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "follow",
        help="follow a moving hand, or moving contacts",
        description="Move the robot as keypoints of a hand, or contacts, move.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("frames", metavar="KEYPOINTS.npz", help="the frames, see below")
    parser.add_argument("--robot", metavar="R", help="a shipped name or a YAML file")
    add_motion(parser)
    parser.add_argument(
        "--retarget", metavar="FILE.yaml", help="how a hand moves the robot's (default: see below)"
    )
    parser.add_argument(
        "--period", metavar="S", type=positive, default=0.005, help="of a cycle (default: 0.005)"
    )
    add_scene(parser)
    add_tolerances(parser)
    parser.add_argument(
        "--q0",
        metavar="V",
        type=numbers,
        nargs="+",
        help="where the robot is: a number per actuator [rad or m], spaces or commas between; last "
        "on the line (default: home; for contacts a solution of the first)",
    )
    parser.set_defaults(run=_follow)


def _follow(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.follow import follow

    return follow(arguments)
