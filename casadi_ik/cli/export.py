"""`casadi-ik export` and `casadi-ik compile`."""

from __future__ import annotations

import time

from rich.console import Group
from rich.text import Text

from casadi_ik.answers.report import counted, fields, headline
from casadi_ik.arm_hand import load_robot
from casadi_ik.cli import options as opt
from casadi_ik.cli.options import Option
from casadi_ik.cli.outputs import say
from casadi_ik.cli.table import Answer, Said, command
from casadi_ik.errors import UnsupportedError
from casadi_ik.exporting.ahead import uses
from casadi_ik.exporting.project import (
    c_project,
    check_folder,
    check_method,
    checked_prefix,
    wasm_project,
    write_folder,
)
from casadi_ik.kernels import cache_directory
from casadi_ik.kernels.compiler import find_compiler


@command(
    Option("ROBOT", "a shipped name or a YAML file"),
    opt.out("DIR", "folder to write"),
    Option("--method M", "hand-first is the only one that can be", "hand-first"),
    Option("--prefix NAME", "what all names begin with (default: the robot's name)"),
    Option(
        "--target c|wasm",
        "plain C, or a WebAssembly module for JavaScript (needs 'casadi-ik[compiler]')",
        "c",
    ),
    Option(
        "--scene CAPACITY",
        "collisions are checked: the robot with itself, and with so many solids at most",
        read=opt.whole(1),
    ),
    Option("--single", "in single precision, for controllers that have no other (--target c)"),
    Option(
        "--follow", "with a follower of moving contacts that keeps velocities and accelerations"
    ),
)
def export(said: Said) -> Answer:
    """Write a robot's solver as source code that needs this package no more.

    Examples:
      casadi-ik export kuka_lwr_barrett --out solver && make -C solver test
      casadi-ik export kuka_lwr_barrett --out solver --single && make -C solver test
      casadi-ik export kuka_lwr_barrett --out solver --follow && make -C solver test
      casadi-ik export my_robot.yaml --out page --target wasm

    DIR becomes a project that needs nothing but a C compiler (--target wasm: a
    browser or node): library, header, example, a test of 1,000 stored targets, a
    benchmark, README. It solves one target at a time, in doubles; its answers are
    bit for bit those of this package. With --single, for controllers without a unit
    for doubles, all of it is in single precision: an answer is one in double
    precision, too, if another than here. An earlier export in DIR is replaced; any
    other folder that is not empty is refused. With --scene, being solved includes
    that nothing touches; where the answer does, the other ways are looked at in
    which the arm can hold the hand, and then other hands.

    exit codes: 0 written, 2 bad input (nothing is written)
    """
    check_method(said.method)
    check_folder(said.out)
    if said.single and said.target == "wasm":
        raise UnsupportedError(
            "--single: WebAssembly computes as fast in double precision; expected --target c"
        )
    robot = load_robot(said.robot)
    prefix = checked_prefix(said.prefix, robot.name)
    if said.target == "wasm":
        found = wasm_project(robot, prefix, said.scene, said.follow)
    else:
        found = c_project(robot, prefix, said.scene, said.single, said.follow)
    write_folder(said.out, found)
    pairs = {
        "names": f"{prefix}_...",
        "files": f"{len(found)}, {sum(map(len, found.values())) / 1e6:.1f} MB",
        "next": f"see {said.out / 'README.md'}",
    }
    return Answer(Group(headline(True, "EXPORTED", f"{robot.name} to {said.out}"), fields(pairs)))


@command(
    Option("ROBOT...", "a shipped name, ARM+HAND, or a YAML file", key="robots"),
    Option("--all", "also scenes, choices, motions, logs and diagnoses"),
)
def compile_ahead(said: Said) -> Answer:
    """Compile what robots need, ahead of use.

    Examples:
      casadi-ik compile kuka_lwr_barrett panda+allegro_right
      casadi-ik compile --all kuka_lwr_barrett

    Compiles what single solves and batches of a robot need, with --all everything
    that it can be used for, so that nothing has to be compiled later.

    exit codes: 0 done, 2 bad input
    """
    robots = [load_robot(name) for name in said.robots]
    if find_compiler() is None:
        raise UnsupportedError(
            "compile: there is no C compiler; pip install 'casadi-ik[compiler]' brings one"
        )
    lines = []
    for robot in robots:
        whole_time, parts = time.perf_counter(), list(uses(robot, said.all))
        for i, (what, use) in enumerate(parts, start=1):
            began = time.perf_counter()
            use()
            spent = time.perf_counter() - began
            say("compiled", f"{robot.name} {i}/{len(parts)}: {what} ({spent:.1f} s)")
        lines.append(Text(f"  {robot.name}: {time.perf_counter() - whole_time:.1f} s"))
    what = f"{counted(len(robots), 'robot')} in {cache_directory()}"
    return Answer(Group(headline(True, "COMPILED", what), *lines))
