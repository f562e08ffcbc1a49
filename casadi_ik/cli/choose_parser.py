"""What can be said behind `casadi-ik choose`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.shared_options import add_effort, add_object_pose, add_scene, add_tolerances
from casadi_ik.cli.values import file_name, numbers, one_of, positive, whole
from casadi_ik.problem.preference import PREFERENCES

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

LAYOUT_NAMES = (
    "getagrip",
    "dexgraspnet",
    "bodex",
    "dexgraspbench",
    "dexonomy",
    "multidex",
    "table",
)
"""Said here again: the parser does not wait for the package that reads them."""

_EXAMPLES = """\
examples:
  casadi-ik choose candidates.yaml --robot panda+allegro_right --scene table --out ranked.json
  casadi-ik choose grasps/ --robot R --object-pose 0.5 0 0.1 0 0 1.57 --prefer q0 --out ranked.json

CANDIDATES is one of
  a YAML file with a list of grasps, each as a grasp file has it:
    candidates:
      - contacts: {thumb: {point: [0.02, 0.10, 0.05], normal: [0.0, -0.94, 0.34]}, ...}
      - contacts: ...
  a folder of grasp files
  an npz file with points and normals (k, f, 3), as for `casadi-ik batch`
  an npy file of getagrip, dexgraspnet, bodex, dexgraspbench or dexonomy: palms and hands are as
    they are there, only the arm is looked for (--take contacts: only the fingertips are)
  a pt file of multidex, the same; --of says of which of its objects
  a table (.csv, .npz, .parquet) with columns x y z, qw qx qy qz or roll pitch yaw (where the
    robot's palm frame is to be) and the hand's joints by name
Nothing in a file is run. docs/choosing.md says what is in them.

RANKED.json holds the answers, best first, each with the number of its candidate and its score, and
how many candidates have none, by reason.

exit codes: 0 at least one found, 1 none (the report counts the reasons), 2 bad input
"""


def add_choose(commands: Any) -> None:
    """Add `choose` to the commands."""
    parser = commands.add_parser(
        "choose",
        help="find the best of many grasps of one object",
        description="Of many grasps find those that are best to take, and how.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("candidates", metavar="CANDIDATES", help="the grasps, see below")
    parser.add_argument("--robot", metavar="R", required=True, help="a shipped name or a YAML file")
    add_object_pose(parser, "; candidates that do not say where theirs is are in its frame")
    parser.add_argument(
        "--layout",
        metavar="L",
        type=one_of(*LAYOUT_NAMES),
        help=f"of the file: {', '.join(LAYOUT_NAMES)} (default: told from it)",
    )
    parser.add_argument(
        "--hand",
        metavar="FILE",
        help="what the file calls the hand's joints and where it has the hand's frame: a shipped "
        "name or a YAML file (default: the shipped one that fits the robot)",
    )
    parser.add_argument(
        "--take",
        metavar="palm|contacts",
        type=one_of("palm", "contacts"),
        default="palm",
        help="what a palm and a posture of a data set or table are taken for (default: palm)",
    )
    parser.add_argument(
        "--object",
        metavar="NAME",
        help="what a data set or table grasps: a shipped name, a YAML file or a mesh (in convex "
        "pieces; as large as the data say); of --take contacts only the pads that touch it count",
    )
    parser.add_argument(
        "--of",
        metavar="NAME",
        help="of which object's grasps, by the file's own name, where it has those of several",
    )
    parser.add_argument(
        "--scale",
        metavar="S",
        type=positive,
        help="of which size of the object, by the file's own scale, where it has several",
    )
    parser.add_argument(
        "--invalid",
        metavar="error|drop|clip",
        type=one_of("error", "drop", "clip"),
        default="error",
        help="what becomes of rows of a data set or table with joints beyond their limits or with "
        "no grasp in them: the file is refused, they are left out, or joints are put at their "
        "limits (default: error)",
    )
    add_scene(parser)
    parser.add_argument(
        "--prefer",
        metavar="|".join(PREFERENCES),
        type=one_of(*PREFERENCES),
        help="what comes first: far from limits, with a manipulable arm, near the start, or with "
        "--scene far from what may be hit (default: q0 if it is given, else limits)",
    )
    parser.add_argument(
        "--q0",
        metavar="V",
        type=numbers,
        nargs="+",
        help="where the robot is: a number per actuator [rad or m] (default: home)",
    )
    parser.add_argument(
        "--limit", metavar="N", type=whole(1), default=10, help="answers at most (default: 10)"
    )
    parser.add_argument(
        "--per-candidate",
        metavar="N",
        type=whole(1),
        default=1,
        help="answers of one candidate at most (default: 1)",
    )
    parser.add_argument(
        "--seed", metavar="N", type=whole(0), default=0, help="of all random numbers (default: 0)"
    )
    add_tolerances(parser)
    add_effort(parser)
    parser.add_argument(
        "--out", metavar="RANKED.json", type=file_name(), required=True, help="write the answers"
    )
    parser.set_defaults(run=_choose)


def _choose(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.choose import choose

    return choose(arguments)
