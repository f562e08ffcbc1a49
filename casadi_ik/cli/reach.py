"""`casadi-ik reach`."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType

from casadi_ik.api import Solver
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import (
    located,
    the_grasp,
    the_robot,
    the_scene,
    the_start,
    the_tolerance,
)
from casadi_ik.cli.ranked_file import ChosenPosture, chosen_posture
from casadi_ik.cli.report import fields, files, headline
from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.grasps import Grasp
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.reaching import PARTS, Reach


def reach(arguments: argparse.Namespace) -> Answer:
    """Find the motion to a grasp.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
    """
    path, asked = _asked(arguments)
    grasp = asked if isinstance(asked, Grasp) else asked.grasp
    if isinstance(asked, Grasp):
        robot = the_robot(arguments.robot, path, grasp)
    else:
        with located(f"{path}: solution.robot"):
            robot = the_robot(arguments.robot or asked.robot)
    q0, out, animation = the_start(arguments, robot), arguments.out, arguments.animation
    outputs: list[tuple[str, Path | None]] = [("--out", out), ("--animation", animation)]
    check_outputs(outputs, inputs=[path])
    draw = None
    if animation is not None:
        with located("--animation", (MissingExtraError,)):
            from casadi_ik.views.animation import draw_motion as draw
    solver = Solver(robot, tolerance=the_tolerance(arguments), scene=the_scene(arguments))
    with located(str(path)):
        found = solver.reach(
            asked,
            q0,
            arguments.opening,
            arguments.distance,
            period=arguments.period,
            seed=arguments.seed,
            direction=_direction(arguments),
            lift=arguments.lift,
            retreat=arguments.retreat,
        )
    name, motion = grasp.name or str(path), found.motion
    if motion is None:
        status = found.status.name.replace("_", " ")
        return Answer(Group(headline(False, status, f"{name}: {found.reason}")), Exit.NOT_SOLVED)
    write_output(out, "--out", motion.write_to)
    if draw is not None and animation is not None:
        draw(motion, grasp, animation, solver.scene)
    written = [(option.lstrip("-"), file) for option, file in outputs if file is not None]
    return Answer(Group(*_report(name, found, motion), *files(written)), Exit.DONE)


def _asked(arguments: argparse.Namespace) -> tuple[Path, Grasp | ChosenPosture]:
    """What is to be reached, and its file.

    Raises:
        CasadiIKError: See `the_grasp` and `chosen_posture`, or an option that does not fit.
    """
    path = Path(arguments.grasp)
    if path.suffix.lower() != ".json":
        if arguments.rank is not None:
            raise InputError("--rank: expected it with what `casadi-ik choose` writes (.json)")
        return the_grasp(arguments)
    if arguments.object_pose is not None:
        raise InputError(f"--object-pose: {path} says where its objects are")
    return path, chosen_posture(path, arguments.rank or 1)


def _direction(arguments: argparse.Namespace) -> list[float] | None:
    if arguments.direction is None:
        return None
    values = [value for group in arguments.direction for value in group]
    if len(values) != 3 or not any(values):
        raise InputError(f"--direction: found {values}, expected three numbers, not all zero")
    return values


def _report(name: str, found: Reach, motion: Motion) -> list[RenderableType]:
    part, times = motion.notes["part"], motion.times
    ends = [float(times[np.flatnonzero(part == one)[-1]]) for one in PARTS if (part == one).any()]
    spent = [end - begin for begin, end in zip([0.0, *ends], ends, strict=False)]
    named = [one for one in PARTS if (part == one).any()]
    room = "not checked" if found.clearance is None else f"{1e3 * found.clearance:.1f} mm"
    pairs = {
        "time": f"{times[-1]:.2f} s: "
        + ", ".join(f"{one} {length:.2f} s" for one, length in zip(named, spent, strict=True)),
        "way there": found.reason.removeprefix("way there: "),
        "clearance": room,
        "motors": f"up to {100 * found.velocity_share:.0f} % of their velocity limits, "
        f"{100 * found.acceleration_share:.0f} % of their acceleration limits (by the samples)",
        "solutions tried": str(found.tried),
    }
    return [headline(True, "REACHED", f"{name}: {motion.robot.name}"), fields(pairs)]
