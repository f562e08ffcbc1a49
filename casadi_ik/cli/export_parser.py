"""What can be said behind `casadi-ik export`, `casadi-ik compile` and `casadi-ik schemas`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casadi_ik.cli.values import one_of, whole

if TYPE_CHECKING:
    from casadi_ik.cli.answer import Answer

_EXPORT = """\
examples:
  casadi-ik export kuka_lwr_barrett --out solver && make -C solver test
  casadi-ik export kuka_lwr_barrett --out solver --single && make -C solver test
  casadi-ik export kuka_lwr_barrett --out solver --follow && make -C solver test
  casadi-ik export my_robot.yaml --out page --target wasm

DIR becomes a project that needs nothing but a C compiler (--target wasm: a browser or node):
library, header, example, a test of 1,000 stored targets, a benchmark, README. It solves one target
at a time, in doubles; its answers are bit for bit those of this package. With --single, for
controllers without a unit for doubles, all of it is in single precision: an answer is one in double
precision, too, if another than here. An earlier export in DIR
is replaced; any other folder that is not empty is refused. With --scene, being solved includes
that nothing touches; where the answer does, the other ways are looked at in which the arm can hold
the hand, and then other hands.

exit codes: 0 written, 2 bad input (nothing is written)
"""

_COMPILE = """\
example:
  casadi-ik compile kuka_lwr_barrett panda+allegro_right

Makes what solving, batches and logs of a robot compile when first used, so that nothing has to be
compiled later; also for a machine without a compiler that shares CASADI_IK_CACHE.

exit codes: 0 done, 2 bad input
"""

_SCHEMAS = """\
example:
  casadi-ik schemas --out .schemas

Then an editor with a YAML language server completes and checks a file whose first line is, say,
  # yaml-language-server: $schema=.schemas/grasp.json

exit codes: 0 written, 2 bad input
"""


def add_export(commands: Any) -> None:
    """Add `export`, `compile` and `schemas` to the commands."""
    parser = commands.add_parser(
        "export",
        help="write a robot's solver as plain C or WebAssembly",
        description="Write a robot's solver as source code that needs this package no more.",
        epilog=_EXPORT,
    )
    parser.add_argument("robot", metavar="ROBOT", help="a shipped name or a YAML file")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")
    parser.add_argument(
        "--method", metavar="M", default="hand-first", help="default, and only one: hand-first"
    )
    parser.add_argument(
        "--prefix", metavar="NAME", help="what all names begin with (default: the robot's name)"
    )
    parser.add_argument(
        "--target",
        metavar="c|wasm",
        type=one_of("c", "wasm"),
        default="c",
        help="plain C (default), or a WebAssembly module for JavaScript (needs "
        "casadi-ik[compiler])",
    )
    parser.add_argument(
        "--scene",
        metavar="CAPACITY",
        type=whole(1),
        help="collisions are checked: the robot with itself, and with so many solids at most",
    )
    parser.add_argument(
        "--single",
        action="store_true",
        help="in single precision, for controllers that have no other (--target c)",
    )
    parser.add_argument(
        "--follow",
        action="store_true",
        help="with a follower of moving contacts that keeps velocities and accelerations",
    )
    parser.set_defaults(run=_export)
    parser = commands.add_parser(
        "compile",
        help="compile robots' kernels ahead of use",
        description="Compile what solving, batches and logs of robots need, ahead of use.",
        epilog=_COMPILE,
    )
    parser.add_argument(
        "robots", metavar="ROBOT", nargs="+", help="a shipped name, ARM+HAND, or a YAML file"
    )
    parser.set_defaults(run=_compile)
    parser = commands.add_parser(
        "schemas",
        help="write JSON Schemas of robot, grasp, scene and other files, for editors",
        description="Write JSON Schemas of the files that people write, with which editors "
        "complete keys.",
        epilog=_SCHEMAS,
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")
    parser.set_defaults(run=_schemas)


def _export(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.export import export

    return export(arguments)


def _compile(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.export import compile_ahead

    return compile_ahead(arguments)


def _schemas(arguments: argparse.Namespace) -> Answer:
    from casadi_ik.cli.schemas import schemas

    return schemas(arguments)
