"""What can be said behind `casadi-ik calibrate`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.values import file_name, one_of, positive

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

_EXAMPLES = """\
example:
  casadi-ik calibrate poses.csv --robot ar10 --out my_ar10.yaml
  casadi-ik solve my_grasp.yaml --robot my_ar10.yaml

DATA.csv has a header and a row per measured fingertip pose, in the robot's base frame:
  finger,index_proximal_slider,index_middle_slider,x,y,z,qw,qx,qy,qz
  index,0.0485,0.0512,-0.0462,0.0896,0.1447,0.7065,0.0282,-0.7065,-0.0282
the actuators that move the finger [rad or m], the contact point [m] and, if measured, the contact
frame as a unit quaternion (its four columns may be left out, or empty in a row)

exit codes: 0 written, 1 no estimate was found, 2 bad input
"""


def add_calibrate(commands: Any) -> None:
    """Add `calibrate` to the commands."""
    parser = commands.add_parser(
        "calibrate",
        help="estimate a hand's dimensions from measured fingertip poses",
        description="Estimate linkage dimensions, joint axes and contact frames of a robot's hand.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("data", metavar="DATA.csv", help="measured poses, see below")
    parser.add_argument("--robot", metavar="R", required=True, help="a shipped name or a YAML file")
    parser.add_argument(
        "--estimate",
        metavar="GROUP",
        nargs="+",
        type=one_of("linkage", "axes", "tips"),
        default=["linkage", "axes", "tips"],
        help="which numbers: linkage, axes, tips (default: all three)",
    )
    parser.add_argument(
        "--loss",
        metavar="cauchy|huber|squares",
        type=one_of("cauchy", "huber", "squares"),
        default="cauchy",
        help="how outliers count; squares takes them in full (default: cauchy)",
    )
    parser.add_argument(
        "--noise-position",
        metavar="METRES",
        type=positive,
        default=0.5e-3,
        help="standard deviation of a measured coordinate, as long as the data are too few to show "
        "it (default: 0.0005)",
    )
    parser.add_argument(
        "--noise-angle",
        metavar="RADIANS",
        type=positive,
        default=0.0175,
        help="the same of a measured angle (default: 0.0175, 1 deg)",
    )
    parser.add_argument(
        "--out",
        metavar="CALIBRATED.yaml",
        type=file_name(".yaml"),
        required=True,
        help="write the robot with its estimated numbers",
    )
    parser.set_defaults(run=_calibrate)


def _calibrate(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.calibrate import calibrate

    return calibrate(arguments)
