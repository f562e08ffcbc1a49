"""Your robot: described (`casadi-ik import`), calibrated, exported as C, compiled ahead."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import located, the_robot, the_units
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, output, say
from casadi_ik.app.cli.table import Answer, Said, command
from casadi_ik.app.report import Units, count_text, fields, files, headline, table
from casadi_ik.compile import cache_directory
from casadi_ik.compile.compiler import find_compiler
from casadi_ik.errors import InputError, MissingExtraError, UnsupportedError
from casadi_ik.export.project import (
    c_project,
    check_folder,
    check_method,
    checked_prefix,
    uses,
    wasm_project,
    write_folder,
)
from casadi_ik.integrations.importing import imported
from casadi_ik.integrations.importing.capsules import largest_excess
from casadi_ik.integrations.importing.imported import Imported, largest_difference, no_palm
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.kinematics.arms.recognise import describe_arm, is_searched
from casadi_ik.papers.chandra import calibration

LEAST_ARM = 4
"""Least number of motors that move a palm and are called an arm."""

SAME = 1e-9
"""Poses that differ by no more [m, or in their axes] are the same."""


@command(
    Option("ARM|ROBOT", "file of the arm, or of everything", key="first"),
    Option("[HAND]", "file of the hand"),
    Option(
        "--out ROBOT.yaml",
        "write the description (needed unless one is given to be drawn again)",
        read=opt.file_name(".yaml", ".yml"),
    ),
    Option("--tip LINK", "link of the arm that carries the hand"),
    Option("--palm LINK...", "link that the fingers hang on; of a body one for each hand"),
    Option(
        "--mount POSE...",
        "the hand's base on the tip: x y z [m] roll pitch yaw [rad] (default: on it)",
    ),
    Option("--srdf FILE.srdf", "links that may touch, beside those that are found to"),
    Option("--xacro", "expand the macros of files that are not called .xacro"),
    Option("--xacro-args NAME:=VALUE...", "values of the arguments of a file with macros"),
    opt.picture("--picture", "draw the hand and the guessed pads"),
    Option("--check", "compare the kinematics with pinocchio's (MuJoCo's) of the files"),
    opt.SIZE_LIMITS,
)
def import_robot(said: Said) -> Answer:
    """Describe your robot from the files of an arm and a hand, or of all in one.

    Examples:
      casadi-ik import arm.urdf hand.urdf --out my_robot.yaml --picture my_robot.png
      casadi-ik import arm.urdf hand.xml --mount 0 0 0.05 0 0 1.57 --out mine.yaml
      casadi-ik import whole_robot.urdf --palm left_palm --out my_robot.yaml
      casadi-ik import humanoid.urdf --out my_humanoid.yaml    both hands, one body
      casadi-ik import my_robot.yaml --picture my_robot.png    a guess was corrected
      casadi-ik solve my_grasp.yaml --robot my_robot.yaml

    Files are URDF, xacro (needs casadi-ik[xacro]) or MJCF (needs casadi-ik[mujoco]); names
    such as panda_description are looked up by casadi-ik[robot-descriptions].
    What no file says (fingertips, where a pad is and which way it faces, the thumb,
    palm, home) is guessed; each guess is marked in the description, and --picture
    shows them. The description points to the files. Of a file with several arms
    with hands becomes one body: the trunk carries them all, what moves none of them
    (legs, head) stands still.

    exit codes: 0 written, 1 --check found a difference, 2 bad input (nothing is
    written)
    """
    first = imported.file_of(said.first)
    hand = said.hand and imported.file_of(said.hand, "HAND")
    arm, hand = (first, hand) if hand else (None, first)
    if first.suffix in (".yaml", ".yml"):
        return _drawn_again(first, said)
    if said.out is None:
        raise InputError("--out: missing, expected the name of the description to be written")
    srdf = said.srdf and Path(said.srdf)
    outputs = {"--out": said.out, "--picture": said.picture}
    check_outputs(outputs, inputs=[one for one in (arm, hand, srdf) if one])
    draw = _drawing() if said.picture is not None else None
    found = imported.import_robot(
        arm,
        hand,
        said.out,
        command=_command(said),
        tip=said.tip,
        palm=said.palm or (),
        mount=said.mount,
        xacro=said.xacro_args or bool(said.xacro),
    )
    with output(said.out) as part:
        part.write_text(found.written.text(), encoding="utf-8")
        found = found.at_home(part)
        part.write_text(found.written.text(), encoding="utf-8")
        found = found.with_shapes(part, srdf, discard=True)
        part.write_text(found.written.text(), encoding="utf-8")
        robot = imported.loaded(part)
        differences = _differences(robot, found) if said.check else {}
        if draw is not None and said.picture is not None:
            draw(robot, said.picture)
    same = all(value <= SAME for value in differences.values())
    report = _import_report(robot, found, differences)
    return Answer.solved(same, *report, *files(outputs))


def _drawn_again(path: Path, said: Said) -> Answer:
    """The pads of a description as it stands now; nothing else is written."""
    if said.hand or said.out is not None or said.picture is None:
        raise InputError(f"{path}: is a description already, expected --picture and no --out")
    outputs = {"--picture": said.picture}
    check_outputs(outputs, inputs=[path])
    draw, robot = _drawing(), imported.loaded(path)
    draw(robot, said.picture)
    what = f"{robot.name}: {len(robot.fingers)} pads"
    return Answer.solved(True, headline(True, "DRAWN", what), *files(outputs))


def _command(said: Said) -> str:
    """The command line, as it stands in the description."""
    words = [opt.PROGRAM, "import", said.first, *filter(None, [said.hand]), "--out", str(said.out)]
    for option in ("tip", "palm", "srdf"):
        if (value := getattr(said, option)) is not None:
            words += [f"--{option}", *([value] if isinstance(value, str) else value)]
    words += ["--xacro"] if said.xacro else []
    words += ["--xacro-args", *said.xacro_args] if said.xacro_args else []
    words += ["--mount", *(f"{value:g}" for value in said.mount)] if said.mount else []
    return shlex.join(words)


def _drawing() -> Callable[[ArmHand, Path], object]:
    """The function that draws the pads, after making sure that it can."""
    with located("--picture", (MissingExtraError,)):
        from casadi_ik.app.pictures import draw_pads
    return draw_pads


def _differences(robot: ArmHand, found: Imported) -> dict[str, float]:
    """The largest difference from the file's own library, by file."""
    q = robot.random(np.random.default_rng(0), 20)
    arm, hand = found.files
    lines = found.written
    values: dict[str, float] = {}
    if arm is not None and lines.arm is not None:
        difference = largest_difference(robot, arm, q, lines.arm.locked, carried=hand)
        values[str(arm.path) if arm.path.name == hand.path.name else arm.path.name] = difference
    values[hand.path.name] = largest_difference(robot, hand, q, lines.hand.locked, arm)
    return values


def _import_report(
    robot: ArmHand, found: Imported, differences: dict[str, float]
) -> list[RenderableType]:
    description, lines = robot.description, found.written
    arm = len(description.arm_actuators)
    count = len(description.actuators)
    # Few motors that move the palm of a hand alone are its wrist.
    noun = "wrist" if lines.arm is None and 0 < arm < LEAST_ARM else "arm"
    motors = f"{arm} {noun}, {count - arm} hand"
    if description.sides:
        whose = [f"{len(description.trunk)} trunk"]
        whose += [f"{s.name} {len(s.arm)} arm, {len(s.hand)} hand" for s in description.sides]
        motors = "; ".join(whose)
    fingers = len(description.fingers)
    what = f"{lines.name}: {count} motors ({motors}), {fingers} fingers"
    pairs = {}
    if lines.arm is not None:
        pairs["tip"] = f"{lines.arm.end}: {lines.arm.how}"
        pairs["mount"] = lines.mount_how
    if description.sides:
        pairs["trunk"] = f"{description.trunk_link}: the last link that carries all palms"
    arms = [description.side(hand.side) if hand.side else description for hand in lines.hands]
    for hand, one in zip(lines.hands, arms, strict=True):
        side = f"{hand.side} " if hand.side else ""
        pairs[f"{side}palm"] = f"{hand.link}: {hand.how}"
        pairs[f"{side}closed form"] = describe_arm(one) if one.arm_actuators else ""
        if hand.thumb is not None:
            pairs[f"{side}thumb"] = f"{hand.thumb[0]}: {hand.thumb[1]}"
    for line in filter(None, (lines.arm, lines.hand)):
        if line.limits:
            pairs["limits"] = f"assumed, since {Path(line.file).name} states none: " + ", ".join(
                line.limits
            )
    for reason in dict.fromkeys(lines.hand.why.values()):
        still = ", ".join(name for name, why in lines.hand.why.items() if why == reason)
        pairs["locked" if "locked" not in pairs else "locked too"] = f"{still}: {reason}"
    pairs["check"] = "\n".join(
        f"{name}: {'' if value <= SAME else 'NOT '}as its own library has it: poses differ by at "
        f"most {value:.1e}"
        for name, value in differences.items()
    )
    if lines.shapes:
        shapes = sum(map(len, lines.shapes.values()))
        pairs["shapes"] = (
            f"{shapes} on {len(lines.shapes)} links, "
            f"at most {1e3 * largest_excess(lines.shapes):.0f} mm beyond their meshes; "
            f"{len(lines.touching)} pairs may touch"
        )
    rows = table("finger", "pad on link", "joints", "point [mm]", "normal", right=("joints",))
    fingers = [(h.side, *finger) for h in lines.hands for finger in h.fingers.items()]
    for branch, (side, name, pad) in zip(found.branches, fingers, strict=True):
        # What is rounded to -0.0 is zero.
        point = " ".join(f"{round(1e3 * value, 1) + 0.0:.1f}" for value in pad.point)
        normal = " ".join(f"{round(value, 2) + 0.0:.2f}" for value in pad.normal.tolist())
        called = f"{side}_{name}" if side else name
        rows.add_row(called, pad.link, str(len(branch.chain)), point, normal)
    asked = [hand.link for hand in lines.hands if hand.how == "--palm"]
    notes = [f"--palm: {why}" for link in asked if (why := no_palm(found.files[1], link))]
    notes += lines.notes
    if any(map(is_searched, arms)):
        notes.append(
            "the arm has no known closed form: it is searched, and a solve takes several times "
            "as long"
        )
    if not lines.shapes:
        notes.append(
            "the files have no shapes of links: a scene needs `collision:` in the description"
        )
    notes.append(
        "pads, thumb, palm and home are guesses (delete the line of a finger that is none): see "
        "the lines marked GUESS"
    )
    yellow = [Text(f"  {note}", "yellow") for note in notes]
    return [headline(True, "IMPORTED", what), fields(pairs), rows, *yellow]


@command(
    Option("DATA.csv", "measured poses, see below", key="data"),
    opt.THE_ROBOT,
    Option(
        "--estimate GROUP...",
        "which numbers: linkage, axes, tips (default: all three)",
        ("linkage", "axes", "tips"),
        opt.each(opt.one_of("linkage", "axes", "tips")),
    ),
    Option(
        "--loss cauchy|huber|squares",
        "how outliers count; squares takes them in full",
        "cauchy",
    ),
    Option(
        "--noise-position METRES",
        "standard deviation of a measured coordinate, as long as the data are too few to show it",
        0.5e-3,
    ),
    Option(
        "--noise-angle RADIANS",
        "the same of a measured angle (default: 0.0175, 1 deg)",
        math.radians(1.0),
    ),
    opt.out("CALIBRATED.yaml", "write the robot with its estimated numbers"),
)
def calibrate(said: Said) -> Answer:
    """Estimate linkage dimensions, joint axes and contact frames of a robot's hand.

    Example:
      casadi-ik calibrate poses.csv --robot ar10 --out my_ar10.yaml
      casadi-ik solve my_grasp.yaml --robot my_ar10.yaml

    DATA.csv has a header and a row per measured fingertip pose, in the robot's base
    frame:
      finger,index_proximal_slider,index_middle_slider,x,y,z,qw,qx,qy,qz
      index,0.0485,0.0512,-0.0462,0.0896,0.1447,0.7065,0.0282,-0.7065,-0.0282
    the actuators that move the finger [rad or m], the contact point [m] and, if
    measured, the contact frame as a unit quaternion (its four columns may be left
    out, or empty in a row)

    exit codes: 0 written, 1 no estimate was found, 2 bad input
    """
    data, outputs = Path(said.data), {"--out": said.out}
    robot = the_robot(said.robot).description
    measurements = calibration.read_measurements(data, robot)
    check_outputs(outputs, inputs=[data])
    parameters = calibration.hand_parameters(robot, measurements.measured_fingers, said.estimate)
    found = calibration.calibrate(
        calibration.HandModel(robot, parameters),
        measurements,
        loss=said.loss,
        sigma_position=said.noise_position,
        sigma_angle=said.noise_angle,
    )
    if found.converged:
        with output(said.out) as part:
            calibration.write_description(found, said.robot, part, data.name)
    written = files(outputs) if found.converged else []
    return Answer.solved(found.converged, *_calibration_report(found, the_units(said)), *written)


def _calibration_report(found: calibration.Calibration, units: Units) -> list[RenderableType]:
    count = f"{len(found.parameters)} numbers from {len(found.weights)} poses"
    status = "ESTIMATED" if found.converged else "NOT CONVERGED"
    noise = f"{1e3 * found.noise[0]:.3f} mm"
    if math.isfinite(found.noise[1]):
        noise += f", {math.degrees(found.noise[1]):.3f} deg"
    weak = found.unidentified()
    lines = {
        "tip misses, median": f"{1e3 * np.median(found.before[:, 0]):.3f} mm described, "
        f"{1e3 * np.median(found.after[:, 0]):.3f} mm estimated",
        "noise found" if found.noise_estimated else "noise assumed": noise,
        "outliers": f"{len(found.outliers)} poses count less than a quarter",
        "directions": f"{len(found.parameters)}, of which the data say less than the priors about "
        f"{len(weak)}, and nothing about {found.unknown_directions}",
    }
    right = ("described", "estimated", "±95%", "learned")
    rows = table("number", "described", "estimated", "±95%", "unit", "learned", right=right)
    numbers = np.stack([found.values, found.interval, found.learned], axis=1).tolist()
    for parameter, (value, interval, learned) in zip(found.parameters, numbers, strict=True):
        scale, unit = units[parameter.unit]
        shown = (f"{scale * one:.3f}" for one in (parameter.nominal, value, interval))
        rows.add_row(parameter.name, *shown, unit, f"{100 * learned:.0f} %")
    parts: list[RenderableType] = [headline(found.converged, status, count), fields(lines), rows]
    if weak:
        parts.append(Text("  what the data cannot tell apart, the weakest first:"))
    for value, names in weak[:5]:
        together = ", ".join(f"{part:+.2f} {name}" for name, part in list(names.items())[:4])
        parts.append(Text(f"  {value:8.1e}  {together}"))
    return parts


@command(
    Option("ROBOT", "a shipped name or a YAML file"),
    opt.out("DIR", "folder to write"),
    Option("--method M", "method to export; only hand-first is supported", "hand-first"),
    Option("--prefix NAME", "prefix of all names (default: the robot's name)"),
    Option(
        "--target c|wasm",
        "plain C, or a WebAssembly module for JavaScript (needs 'casadi-ik[compiler]')",
        "c",
    ),
    Option(
        "--scene CAPACITY",
        "check collisions with the robot itself and up to CAPACITY solids",
        read=opt.whole(1),
    ),
    Option("--single", "compute in single precision (--target c)"),
    Option("--follow", "add a follower of moving contacts"),
)
def export(said: Said) -> Answer:
    """Write a robot's solver as standalone source code.

    Examples:
      casadi-ik export kuka_lwr_barrett --out solver && make -C solver test
      casadi-ik export kuka_lwr_barrett --out solver --single && make -C solver test
      casadi-ik export kuka_lwr_barrett --out solver --follow && make -C solver test
      casadi-ik export my_robot.yaml --out page --target wasm

    DIR becomes a project with library, header, example, README, benchmark and a test
    of 1,000 targets. It needs only a C compiler (--target wasm: a browser or node),
    and its answers are bit for bit those of this package. An earlier export in DIR
    is replaced; any other folder that is not empty is refused.

    With --single nothing is computed in double precision. Answers also pass the
    double-precision check but may differ from those computed here; the test of the
    project allows one missed target in a thousand. Robots with several arms cannot
    combine it with --scene.

    With --scene a target is solved only if the robot does not collide. If an answer
    collides, other arm configurations and then other hand poses are examined.

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
    what = f"{count_text(len(robots), 'robot')} in {cache_directory()}"
    return Answer(Group(headline(True, "COMPILED", what), *lines))
