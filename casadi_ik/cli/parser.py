"""What can be said on the command line. The commands themselves are imported when called."""

from __future__ import annotations

import argparse
import re
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NoReturn

from casadi_ik.cli.calibrate_parser import add_calibrate
from casadi_ik.cli.choose_parser import add_choose
from casadi_ik.cli.export_parser import add_export
from casadi_ik.cli.follow_parser import add_follow
from casadi_ik.cli.import_parser import add_import
from casadi_ik.cli.log_parser import add_log
from casadi_ik.cli.reach_parser import add_reach
from casadi_ik.cli.say import PROGRAM
from casadi_ik.cli.shared_options import (
    add_effort,
    add_object_pose,
    add_scene,
    add_size_limits,
    add_tolerances,
)
from casadi_ik.cli.values import assignment, file_name, npz_or_folder, numbers, one_of, whole
from casadi_ik.cli.view_parser import add_view
from casadi_ik.errors import InputError
from casadi_ik.problem.preference import PREFERENCES

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer


_READERS = ("solve", "batch", "follow", "reach", "choose", "import", "view")
"""Commands that read what is somebody else's."""

_DESCRIPTION = """\
Where must every motor of an arm and its hand stand, so that each fingertip touches a given point
and faces a given way?
"""

_EXAMPLES = """\
examples:
  casadi-ik grasps                                   what is there to be grasped
  casadi-ik solve cup                                solve a shipped grasp
  casadi-ik solve my_grasp.yaml --log my_grasp.mcap  your own, with a log of every iteration
  casadi-ik log info my_grasp.mcap                   what the log holds

exit codes: 0 solved (or done), 1 a valid problem not solved, 2 bad input
"""

_SOLVE_EXAMPLES = """\
examples:
  casadi-ik solve cup
  casadi-ik solve cup --method enhanced-dls --out cup.json --log cup.mcap --picture cup.png
  casadi-ik solve my_grasp.yaml --robot my_robot.yaml --tolerance-position 0.002

a grasp file:
  robot: kuka_lwr_barrett
  contacts:      # point [m] and outward pad normal, in the robot's base frame
    thumb:    {point: [0.52, 0.10, 0.60], normal: [0.0, -0.94, 0.34]}
    finger_2: {point: [0.55, 0.02, 0.60], normal: [0.0, 0.94, 0.34]}
    finger_3: {point: [0.49, 0.02, 0.60], normal: [0.0, 0.94, 0.34]}

exit codes: 0 solved, 1 not solved (the report says why), 2 bad input
"""

_BATCH_EXAMPLES = """\
example:
  casadi-ik batch targets.npz --robot kuka_lwr_barrett --jobs 4 --out solved.npz

TARGETS.npz holds, for k targets and the f fingers in the robot's order (`casadi-ik robots`):
  points   (k, f, 3) contact points [m], robot's base frame; NaN marks a free finger
  normals  (k, f, 3) outward pad normals; NaN marks a free normal
and if wanted, NaN where not:
  tangents (k, f, 3) second axes of the contact frames, orthogonal to the normals: whole poses
  lines    (k, f, 3) a contact may be anywhere on the line through its point in this direction
  planes   (k, f, 3) a contact may be anywhere in the plane through its point with this normal
  directions (k, f, 3) a fingertip faces this way wherever it is; it has no point then
OUT.npz then holds:
  q (k, n), success (k,), status (k,), position_error (k, f) [m], angle_error (k, f) [rad],
  iterations, restarts (k,), time (k,) [s]
and with --scene:
  clearance (k,) [m]: of the pair of shapes nearest to being too near; negative: penetration
and with --diagnose, where a target is not solved (else "" and NaN):
  reason (k,), nearest_q (k, n) closest to the contacts, enough_position (k,) [m] and
  enough_angle (k,) [rad]: the tolerances with which it would be solved
A Parquet file has a row per target: columns FINGER_x, _y, _z, _nx, _ny, _nz for every finger.
In parts (--dask, --resume, --part-size, or files that are no npz) the finished ones stand in OUT,
or beside OUT.npz until all are there; a kill costs those being solved, --resume does the rest.
A row that is no target (partly NaN, infinite, a zero normal) gets the status INVALID and NaN; it
is named on stderr and does not stop the rest.

exit codes: 0 all solved, 1 not all solved, 2 bad input
"""

_INVALID_CHOICE = re.compile(r"invalid choice: (.*) \(choose from (.*)\)")


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line like all others."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **options)
        # So that `--q0 -1e-3,0.2` reads as numbers and not as an option.
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        """Refuse the command line.

        Raises:
            InputError: Always.
        """
        message = message.removeprefix("argument ")
        message = _INVALID_CHOICE.sub(r"found \1, expected one of \2", message)
        raise InputError(f"{message} (see {self.prog} --help)")


def build_parser() -> Parser:
    """The parser; the namespace it gives has the command's function as `run`."""
    parser = Parser(prog=PROGRAM, description=_DESCRIPTION, epilog=_EXAMPLES)
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {version('casadi-ik')}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, title="commands")
    _add_solve(commands)
    _add_batch(commands)
    add_follow(commands)
    add_reach(commands)
    add_choose(commands)
    add_import(commands)
    add_export(commands)
    add_calibrate(commands)
    for name, run, text in (
        ("robots", _robots, "list the shipped robots: fingers and actuators"),
        ("methods", _methods, "list the methods"),
        ("grasps", _grasps, "list the shipped grasps"),
    ):
        commands.add_parser(name, help=text, description=text.capitalize() + ".").set_defaults(
            run=run
        )
    add_log(commands)
    add_view(commands)
    for name in _READERS:
        add_size_limits(commands.choices[name])
    return parser


def _add_solve(commands: Any) -> None:
    parser = commands.add_parser(
        "solve",
        help="solve one grasp",
        description="Find the position of every motor for one grasp.",
        epilog=_SOLVE_EXAMPLES,
    )
    parser.add_argument(
        "grasp", metavar="GRASP", help="a shipped name (`casadi-ik grasps`) or a YAML file"
    )
    parser.add_argument(
        "--robot", metavar="R", help="a shipped name or a YAML file (default: the grasp file's)"
    )
    _add_solver_options(parser)
    parser.add_argument(
        "--out", metavar="FILE.json", type=file_name(), help="write the solution as JSON"
    )
    parser.add_argument(
        "--picture",
        metavar="FILE.png",
        type=file_name(".png"),
        help="draw the grasp (needs casadi-ik[plots])",
    )
    parser.add_argument(
        "--picture-dark",
        metavar="FILE.png",
        type=file_name(".png"),
        help="the same for a dark page",
    )
    _add_diagnose(parser, default=True)
    parser.set_defaults(run=_solve)


def _add_batch(commands: Any) -> None:
    parser = commands.add_parser(
        "batch",
        help="solve many targets of one robot",
        description="Find the position of every motor for many targets.",
        epilog=_BATCH_EXAMPLES,
    )
    parser.add_argument(
        "targets",
        metavar="TARGETS",
        help="points and normals in an npz or Parquet file, or a folder of such files, see below",
    )
    parser.add_argument("--robot", metavar="R", required=True, help="a shipped name or a YAML file")
    _add_solver_options(parser)
    parser.add_argument(
        "--jobs",
        metavar="N",
        type=whole(1),
        default=1,
        help="threads, or in parts processes (default: 1)",
    )
    parser.add_argument(
        "--out",
        metavar="OUT",
        type=npz_or_folder,
        required=True,
        help="write the solutions: to OUT.npz, or in parts into a folder (a name without suffix)",
    )
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="solve in parts on a Dask cluster: what `dask scheduler` prints, tcp://HOST:8786 "
        "(needs casadi-ik[cluster])",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="solve in parts that survive a kill, and go on with those that are there",
    )
    parser.add_argument(
        "--part-size", metavar="N", type=whole(1), help="targets of a part (default: 20000)"
    )
    _add_diagnose(parser, default=False)
    parser.set_defaults(run=_batch)


def _add_solver_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--method", metavar="M", help="default: the first that `casadi-ik methods` lists"
    )
    parser.add_argument(
        "--q0",
        metavar="V",
        type=numbers,
        nargs="+",
        help="start: a number per actuator [rad or m], spaces or commas between; last on the line "
        "(default: home)",
    )
    parser.add_argument(
        "--prefer",
        metavar="|".join(PREFERENCES),
        type=one_of(*PREFERENCES),
        help="which of several solutions: far from its limits, with a manipulable arm, near the "
        "start, or with --scene far from what may be hit (default: q0 if it is given, else limits)",
    )
    add_scene(parser)
    add_object_pose(
        parser,
        "; contacts move with it, and those of a file that does not say where its object is are in "
        "its frame",
    )
    parser.add_argument(
        "--seed", metavar="N", type=whole(0), default=0, help="of all random numbers (default: 0)"
    )
    add_tolerances(parser)
    add_effort(parser)
    parser.add_argument(
        "--limits",
        metavar="enforce|ignore",
        type=one_of("enforce", "ignore"),
        default="enforce",
        help="whether being solved includes the limits (default: enforce); ignore: the paper's way",
    )
    parser.add_argument(
        "--finger-step",
        metavar="ipopt|closed-form",
        type=one_of("ipopt", "closed-form"),
        help="solver of the fingers' own step in the paper's methods (default: ipopt); "
        "closed-form gives the same answer much faster",
    )
    parser.add_argument(
        "--fixed",
        metavar="NAME=V",
        type=assignment,
        nargs="+",
        default=[],
        help="actuators that are not to move, and where they stand [rad or m]",
    )
    parser.add_argument(
        "--log",
        metavar="FILE.mcap",
        type=file_name(),
        help="write every iteration to a log; a batch in parts: into a folder, read as one log",
    )


def _add_diagnose(parser: argparse.ArgumentParser, default: bool) -> None:
    parser.add_argument(
        "--diagnose",
        action=argparse.BooleanOptionalAction,
        default=default,
        help=f"find out why what is not solved is not (default: {'yes' if default else 'no'})",
    )


def _solve(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.solve import solve

    return solve(arguments)


def _batch(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.batch import batch

    return batch(arguments)


def _robots(_: argparse.Namespace) -> Answer:
    from casadi_ik.cli.lists import robots

    return robots()


def _methods(_: argparse.Namespace) -> Answer:
    from casadi_ik.cli.lists import methods

    return methods()


def _grasps(_: argparse.Namespace) -> Answer:
    from casadi_ik.cli.lists import grasps

    return grasps()
