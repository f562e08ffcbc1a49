"""`casadi-ik export` and `casadi-ik compile`."""

from __future__ import annotations

import argparse
import time

from rich.console import Group
from rich.text import Text

from casadi_ik.arm_hand import load_robot
from casadi_ik.cli.answer import Answer
from casadi_ik.cli.report import fields, headline
from casadi_ik.cli.say import say
from casadi_ik.errors import UnsupportedError
from casadi_ik.exporting.ahead import uses
from casadi_ik.exporting.project import (
    c_project,
    check_folder,
    check_method,
    checked_prefix,
    write_folder,
)
from casadi_ik.exporting.wasm import wasm_project
from casadi_ik.kernels import cache_directory
from casadi_ik.kernels.compiler import find_compiler


def export(arguments: argparse.Namespace) -> Answer:
    """Write a solver as source code.

    Raises:
        CasadiIKError: Bad input, or a folder that cannot be written.
    """
    check_method(arguments.method)
    check_folder(arguments.out)
    if arguments.single and arguments.target == "wasm":
        raise UnsupportedError(
            "--single: WebAssembly computes as fast in double precision; expected --target c"
        )
    robot = load_robot(arguments.robot)
    prefix = checked_prefix(arguments.prefix, robot.name)
    if arguments.target == "wasm":
        files = wasm_project(robot, prefix, arguments.scene, arguments.follow)
    else:
        files = c_project(robot, prefix, arguments.scene, arguments.single, arguments.follow)
    write_folder(arguments.out, files)
    size = sum(len(content) for content in files.values())
    pairs = {
        "names": f"{prefix}_...",
        "files": f"{len(files)}, {size / 1e6:.1f} MB",
        "next": f"see {arguments.out / 'README.md'}",
    }
    return Answer(
        Group(headline(True, "EXPORTED", f"{robot.name} to {arguments.out}"), fields(pairs))
    )


def compile_ahead(arguments: argparse.Namespace) -> Answer:
    """Compile what solving, batches and logs of robots need.

    Raises:
        CasadiIKError: Bad input, or a compiler that refuses.
    """
    robots = [load_robot(name) for name in arguments.robots]
    if find_compiler() is None:
        raise UnsupportedError(
            "compile: there is no C compiler; pip install 'casadi-ik[compiler]' brings one"
        )
    lines = []
    for robot in robots:
        whole, parts = time.perf_counter(), list(uses(robot))
        for i, (what, use) in enumerate(parts, start=1):
            begun = time.perf_counter()
            use()
            spent = time.perf_counter() - begun
            say("compiled", f"{robot.name} {i}/{len(parts)}: {what} ({spent:.1f} s)")
        lines.append(Text(f"  {robot.name}: {time.perf_counter() - whole:.1f} s"))
    what = f"{len(robots)} robot{'s' * (len(robots) > 1)} in {cache_directory()}"
    return Answer(Group(headline(True, "COMPILED", what), *lines))
