"""Commands for robots of users: `import`, `calibrate`, `export` and `compile`."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import load_robot_arg, located, report_units
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, output, print_message
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.report import Units, count_text, fields, files, headline, table
from casadi_ik.compile import cache_directory
from casadi_ik.compile.compiler import find_compiler
from casadi_ik.errors import InputError, MissingExtraError, UnsupportedError
from casadi_ik.export.project import (
    c_project,
    check_folder,
    check_method,
    export_prefix,
    kernel_uses,
    wasm_project,
    write_folder,
)
from casadi_ik.integrations.importing import robot_import
from casadi_ik.integrations.importing.capsules import largest_excess
from casadi_ik.integrations.importing.limbs import palm_warning
from casadi_ik.integrations.importing.reference_kinematics import largest_difference
from casadi_ik.integrations.importing.robot_import import ImportResult
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.kinematics.arms.recognise import describe_arm, is_searched
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.load_robot import load_description
from casadi_ik.papers.chandra import calibration

MIN_ARM_MOTORS = 4
"""Minimum number of motors of an arm; the report calls fewer motors a wrist."""

POSE_TOLERANCE = 1e-9
"""Largest difference of poses [m, or of axis components] that counts as equal."""


@command(
    Option("ARM|ROBOT", "file of the arm, or of the complete robot", key="first"),
    Option("[HAND]", "file of the hand"),
    Option(
        "--out ROBOT.yaml",
        "output file; required unless ROBOT is a description",
        parse=opt.file_name(".yaml", ".yml"),
    ),
    Option("--tip LINK", "link of the arm that carries the hand"),
    Option("--palm LINK...", "palm link (one per hand of a multi-arm robot)"),
    Option(
        "--mount POSE...",
        "hand on the tip: x y z [m] roll pitch yaw [rad] (default: 0)",
    ),
    Option("--srdf FILE.srdf", "extra allowed contacts, in addition to those detected"),
    Option("--xacro", "expand macros in files without the suffix .xacro"),
    Option("--xacro-args NAME:=VALUE...", "arguments of a xacro file"),
    opt.picture("--picture", "picture of the guessed pads"),
    opt.MESHES,
    Option("--check", "compare the kinematics with pinocchio (MJCF: MuJoCo)"),
    opt.SIZE_LIMITS,
)
def import_robot(args: Arguments) -> CommandResult:
    """Describe a robot by the files of an arm and a hand, or by one file.

    Examples:
      casadi-ik import arm.urdf hand.urdf --out my_robot.yaml --picture my_robot.png
      casadi-ik import arm.urdf hand.xml --mount 0 0 0.05 0 0 1.57 --out mine.yaml
      casadi-ik import whole_robot.urdf --palm left_palm --out my_robot.yaml
      casadi-ik import humanoid.urdf --out my_humanoid.yaml    two arms, one trunk
      casadi-ik import my_robot.yaml --picture my_robot.png    after a correction
      casadi-ik solve my_grasp.yaml --robot my_robot.yaml

    Files are URDF, xacro (needs casadi-ik[robots]) or MJCF (needs casadi-ik[robots]).
    Names such as panda_description are looked up by robot_descriptions.

    The files do not state fingertips, position and normal of pads, thumb, palm and
    home configuration: these are guessed. Each guess is marked in the description,
    and --picture shows them. The description refers to the files. A file with several
    arm-hands becomes a multi-arm robot with a trunk; motors that move no palm (legs,
    head) are locked.

    exit codes: 0 written, 1 --check found a difference, 2 bad input (no file is
    written)
    """
    first = robot_import.find_robot_file(args.first)
    hand = args.hand and robot_import.find_robot_file(args.hand, "HAND")
    arm, hand = (first, hand) if hand else (None, first)
    if first.suffix in (".yaml", ".yml"):
        return _draw_description(first, args)
    if args.out is None:
        raise InputError("--out: option is missing; expected the name of the description")
    srdf = args.srdf and Path(args.srdf)
    outputs = {"--out": args.out, "--picture": args.picture}
    check_outputs(outputs, inputs=[path for path in (arm, hand, srdf) if path])
    draw = _drawing() if args.picture is not None else None
    import_result = robot_import.import_robot(
        arm,
        hand,
        args.out,
        command=_command_line(args),
        tip=args.tip,
        palm=args.palm or (),
        mount=args.mount,
        xacro=args.xacro_args or bool(args.xacro),
    )
    with output(args.out) as part:
        part.write_text(import_result.description.to_yaml(), encoding="utf-8")
        import_result = import_result.with_home(part)
        part.write_text(import_result.description.to_yaml(), encoding="utf-8")
        import_result = import_result.with_shapes(part, srdf, discard=True)
        part.write_text(import_result.description.to_yaml(), encoding="utf-8")
        robot = ArmHand(load_description(part))
        differences = _differences(robot, import_result) if args.check else {}
        if draw is not None and args.picture is not None:
            draw(robot, args.picture)
    is_same = all(value <= POSE_TOLERANCE for value in differences.values())
    report = _import_report(robot, import_result, differences)
    return CommandResult.of_parts(is_same, *report, *files(outputs))


def _draw_description(path: Path, args: Arguments) -> CommandResult:
    """Draw the pads of an existing description."""
    if args.hand or args.out is not None or args.picture is None:
        raise InputError(f"{path}: file is a description; expected --picture without --out")
    outputs = {"--picture": args.picture}
    check_outputs(outputs, inputs=[path])
    draw, robot = _drawing(), ArmHand(load_description(path))
    draw(robot, args.picture)
    summary = f"{robot.name}: {len(robot.fingers)} pads"
    return CommandResult.of_parts(True, headline(True, "DRAWN", summary), *files(outputs))


def _command_line(args: Arguments) -> str:
    """Return the command line to be recorded in the description."""
    words = [opt.PROGRAM, "import", args.first, *filter(None, [args.hand]), "--out", str(args.out)]
    for option in ("tip", "palm", "srdf"):
        if (value := getattr(args, option)) is not None:
            words += [f"--{option}", *([value] if isinstance(value, str) else value)]
    words += ["--xacro"] if args.xacro else []
    words += ["--xacro-args", *args.xacro_args] if args.xacro_args else []
    words += ["--mount", *(f"{value:g}" for value in args.mount)] if args.mount else []
    return shlex.join(words)


def _drawing() -> Callable[[ArmHand, Path], object]:
    """Return the function that draws pads after checking that matplotlib is installed."""
    with located("--picture", (MissingExtraError,)):
        from casadi_ik.app.pictures import draw_pads
    return draw_pads


def _differences(robot: ArmHand, import_result: ImportResult) -> dict[str, float]:
    """Return the largest pose difference from pinocchio or MuJoCo by file."""
    q = robot.random(np.random.default_rng(0), 20)
    arm, hand = import_result.files
    written = import_result.description
    values: dict[str, float] = {}
    if arm is not None and written.arm is not None:
        difference = largest_difference(robot, arm, q, written.arm.locked, hand_tree=hand)
        values[str(arm.path) if arm.path.name == hand.path.name else arm.path.name] = difference
    values[hand.path.name] = largest_difference(robot, hand, q, written.hand.locked, arm)
    return values


def _import_report(
    robot: ArmHand, import_result: ImportResult, differences: dict[str, float]
) -> list[RenderableType]:
    """Return the report of an import: choices, fingers and notes."""
    description, imported = robot.description, import_result.description
    arm = len(description.arm_actuators)
    count = len(description.actuators)
    arm_noun = "wrist" if imported.arm is None and 0 < arm < MIN_ARM_MOTORS else "arm"
    motors = f"{arm} {arm_noun}, {count - arm} hand"
    if description.sides:
        groups = [f"{len(description.trunk)} trunk"]
        groups += [f"{s.name} {len(s.arm)} arm, {len(s.hand)} hand" for s in description.sides]
        motors = "; ".join(groups)
    fingers = len(description.fingers)
    summary = f"{imported.name}: {count} motors ({motors}), {fingers} fingers"
    pairs = {}
    if imported.arm is not None:
        pairs["tip"] = f"{imported.arm.end_link}: {imported.arm.reason}"
        pairs["mount"] = imported.mount_reason
    if description.sides:
        pairs["trunk"] = f"{description.trunk_link}: last link that carries all palms"
    arms = [description.side(hand.side) if hand.side else description for hand in imported.hands]
    for hand, kinematics in zip(imported.hands, arms, strict=True):
        side = f"{hand.side} " if hand.side else ""
        pairs[f"{side}palm"] = f"{hand.palm_link}: {hand.reason}"
        pairs[f"{side}closed form"] = describe_arm(kinematics) if kinematics.arm_actuators else ""
        if hand.thumb is not None:
            pairs[f"{side}thumb"] = f"{hand.thumb[0]}: {hand.thumb[1]}"
    for file_part in filter(None, (imported.arm, imported.hand)):
        if file_part.limits:
            source = Path(file_part.file).name
            limits = ", ".join(file_part.limits)
            pairs["limits"] = f"assumed, because {source} states none: {limits}"
    for reason in dict.fromkeys(imported.hand.lock_reasons.values()):
        joint_names = ", ".join(
            name
            for name, lock_reason in imported.hand.lock_reasons.items()
            if lock_reason == reason
        )
        pairs["locked" if "locked" not in pairs else "locked too"] = f"{joint_names}: {reason}"
    pairs["check"] = "\n".join(
        f"{name}: {'equal' if value <= POSE_TOLERANCE else 'NOT EQUAL'} to the reference library: "
        f"poses differ by at most {value:.1e}"
        for name, value in differences.items()
    )
    if imported.shapes:
        shapes = sum(map(len, imported.shapes.values()))
        pairs["shapes"] = (
            f"{shapes} on {len(imported.shapes)} links, "
            f"at most {1e3 * largest_excess(imported.shapes):.0f} mm beyond their meshes; "
            f"{len(imported.touching)} pairs may touch"
        )
    notes = [Text(f"  {note}", "yellow") for note in _import_notes(import_result, arms)]
    return [headline(True, "IMPORTED", summary), fields(pairs), _pad_table(import_result), *notes]


def _pad_table(import_result: ImportResult) -> Table:
    """Return the table of the fingers of an imported robot and their pads."""
    hands = import_result.description.hands
    rows = table("finger", "pad on link", "joints", "point [mm]", "normal", right=("joints",))
    fingers = [(h.side, *finger) for h in hands for finger in h.pads.items()]
    for finger_chain, (side, name, pad) in zip(import_result.fingers, fingers, strict=True):
        # Adding 0.0 turns -0.0 into 0.0.
        point = " ".join(f"{round(1e3 * value, 1) + 0.0:.1f}" for value in pad.point)
        normal = " ".join(f"{round(value, 2) + 0.0:.2f}" for value in pad.normal.tolist())
        finger_name = f"{side}_{name}" if side else name
        rows.add_row(finger_name, pad.link, str(len(finger_chain.joints)), point, normal)
    return rows


def _import_notes(import_result: ImportResult, arms: Sequence[RobotDescription]) -> list[str]:
    """Return the warnings of an import, and what its user has to check.

    Args:
        import_result: The imported robot.
        arms: The robot as one arm-hand for each hand.
    """
    imported = import_result.description
    chosen_links = [hand.palm_link for hand in imported.hands if hand.reason == "--palm"]
    notes = [
        f"--palm: {warning}"
        for link in chosen_links
        if (warning := palm_warning(import_result.files[1], link))
    ]
    notes += imported.notes
    if any(map(is_searched, arms)):
        notes.append(
            "the arm has no known closed form: it is solved numerically, which takes several times "
            "as long"
        )
    if not imported.shapes:
        notes.append(
            "the files have no collision shapes: a scene needs `collision:` in the description"
        )
    notes.append(
        "pads, thumb, palm and home are guesses: check the lines marked GUESS, and delete the "
        "lines of links that are not fingers"
    )
    return notes


@command(
    Option("DATA.csv", "measured fingertip poses, see below", key="data"),
    opt.REQUIRED_ROBOT,
    Option(
        "--estimate GROUP...",
        "groups to estimate: linkage, axes, tips (default: all)",
        ("linkage", "axes", "tips"),
        opt.word_list(opt.choice("linkage", "axes", "tips")),
    ),
    Option(
        "--loss cauchy|huber|squares",
        "loss function; squares keeps outliers",
        "cauchy",
    ),
    Option(
        "--noise-position METRES",
        "prior noise of measured coordinates",
        0.5e-3,
    ),
    Option(
        "--noise-angle RADIANS",
        "prior noise of measured angles (default: 0.0175, 1 deg)",
        math.radians(1.0),
    ),
    opt.out_option("CALIBRATED.yaml", "output file of the calibrated robot"),
)
def calibrate(args: Arguments) -> CommandResult:
    """Estimate linkage dimensions, joint axes and contact frames of a robot's hand.

    Example:
      casadi-ik calibrate poses.csv --robot ar10 --out my_ar10.yaml
      casadi-ik solve my_grasp.yaml --robot my_ar10.yaml

    DATA.csv has a header and a row per measured fingertip pose, in the robot's base
    frame:
      finger,index_proximal_slider,index_middle_slider,x,y,z,qw,qx,qy,qz
      index,0.0485,0.0512,-0.0462,0.0896,0.1447,0.7065,0.0282,-0.7065,-0.0282
    The columns are the actuators that move the finger [rad or m], the contact
    point [m] and, if measured, the contact frame as a unit quaternion (its four
    columns may be absent, or empty in a row). The noise is estimated from the data
    if they suffice; --noise-position and --noise-angle are used otherwise.

    exit codes: 0 written, 1 no estimate was found, 2 bad input
    """
    data, outputs = Path(args.data), {"--out": args.out}
    robot = load_robot_arg(args.robot).description
    measurements = calibration.read_measurements(data, robot)
    check_outputs(outputs, inputs=[data])
    parameters = calibration.hand_parameters(robot, measurements.measured_fingers, args.estimate)
    estimate = calibration.calibrate(
        calibration.HandModel(robot, parameters),
        measurements,
        loss=args.loss,
        sigma_position=args.noise_position,
        sigma_angle=args.noise_angle,
    )
    if estimate.converged:
        with output(args.out) as part:
            calibration.write_description(estimate, args.robot, part, data.name)
    output_lines = files(outputs) if estimate.converged else []
    return CommandResult.of_parts(
        estimate.converged, *_calibration_report(estimate, report_units(args)), *output_lines
    )


def _calibration_report(estimate: calibration.Calibration, units: Units) -> list[RenderableType]:
    """Return the report of a calibration: errors, numbers and weak directions."""
    count = f"{len(estimate.parameters)} numbers from {len(estimate.weights)} poses"
    status = "ESTIMATED" if estimate.converged else "NOT CONVERGED"
    noise = f"{1e3 * estimate.noise[0]:.3f} mm"
    if math.isfinite(estimate.noise[1]):
        noise += f", {math.degrees(estimate.noise[1]):.3f} deg"
    weak_directions = estimate.unidentified()
    lines = {
        "median tip error": f"{1e3 * np.median(estimate.before[:, 0]):.3f} mm described, "
        f"{1e3 * np.median(estimate.after[:, 0]):.3f} mm estimated",
        "noise estimated" if estimate.noise_estimated else "noise assumed": noise,
        "outliers": f"{len(estimate.outliers)} poses with a weight below 1/4",
        "directions": f"{len(estimate.parameters)}; {len(weak_directions)} are determined less by "
        f"the data than by the priors, {estimate.unknown_directions} not at all by the data",
    }
    right = ("described", "estimated", "±95%", "learned")
    rows = table("number", "described", "estimated", "±95%", "unit", "learned", right=right)
    numbers = np.stack([estimate.values, estimate.interval, estimate.learned], axis=1).tolist()
    for parameter, (value, interval, learned) in zip(estimate.parameters, numbers, strict=True):
        scale, unit = units[parameter.unit]
        values = (f"{scale * number:.3f}" for number in (parameter.nominal, value, interval))
        rows.add_row(parameter.name, *values, unit, f"{100 * learned:.0f} %")
    parts: list[RenderableType] = [headline(estimate.converged, status, count), fields(lines), rows]
    if weak_directions:
        parts.append(Text("  directions that the data do not determine, weakest first:"))
    for value, names in weak_directions[:5]:
        combination = ", ".join(f"{part:+.2f} {name}" for name, part in list(names.items())[:4])
        parts.append(Text(f"  {value:8.1e}  {combination}"))
    return parts


@command(
    Option("ROBOT", "name listed by `casadi-ik robots`, or YAML file"),
    opt.out_option("DIR", "output folder"),
    Option("--method M", "method; only hand-first is possible", "hand-first"),
    Option("--prefix NAME", "prefix of all names (default: the robot's name)"),
    Option(
        "--target c|wasm",
        "plain C or WebAssembly ('casadi-ik[compiler]')",
        "c",
    ),
    Option(
        "--scene CAPACITY",
        "check self-collision and collisions with CAPACITY solids",
        parse=opt.integer(1),
    ),
    Option("--single", "compute in single precision (--target c)"),
    Option("--follow", "add a follower of moving contacts"),
)
def export(args: Arguments) -> CommandResult:
    """Write a robot's solver as standalone source code.

    Examples:
      casadi-ik export kuka_lwr_barrett --out solver && make -C solver test
      casadi-ik export kuka_lwr_barrett --out solver --single && make -C solver test
      casadi-ik export kuka_lwr_barrett --out solver --follow && make -C solver test
      casadi-ik export my_robot.yaml --out page --target wasm

    DIR becomes a project with library, header, example, README, benchmark and a test
    of 1,000 targets. It needs only a C compiler (--target wasm: a browser or node),
    and its solutions are bit for bit equal to those of this package. An earlier
    export in DIR is replaced; any other folder that is not empty is refused.

    --single computes in single precision only. Solutions also pass the
    double-precision check but may differ from those of this package; the test of the
    project allows one missed target in a thousand.

    With --scene a target is solved only if the robot does not collide. If a solution
    collides, other arm configurations and then other hand poses are examined.

    exit codes: 0 written, 2 bad input (nothing is written)
    """
    check_method(args.method)
    check_folder(args.out)
    if args.single and args.target == "wasm":
        raise UnsupportedError(
            "--single: WebAssembly computes as fast in double precision; expected --target c"
        )
    robot = load_robot(args.robot)
    prefix = export_prefix(args.prefix, robot.name)
    if args.target == "wasm":
        project_files = wasm_project(robot, prefix, args.scene, args.follow)
    else:
        project_files = c_project(robot, prefix, args.scene, args.single, args.follow)
    write_folder(args.out, project_files)
    pairs = {
        "names": f"{prefix}_...",
        "files": f"{len(project_files)}, {sum(map(len, project_files.values())) / 1e6:.1f} MB",
        "next": f"see {args.out / 'README.md'}",
    }
    return CommandResult(
        Group(headline(True, "EXPORTED", f"{robot.name} to {args.out}"), fields(pairs))
    )


@command(
    Option("ROBOT...", "shipped names, ARM+HAND, or YAML files", key="robots"),
    Option("--all", "compile kernels of all features, not only of solves"),
)
def compile_ahead(args: Arguments) -> CommandResult:
    """Compile the kernels of robots ahead of use.

    Examples:
      casadi-ik compile kuka_lwr_barrett panda+allegro_right
      casadi-ik compile --all kuka_lwr_barrett

    The command compiles the kernels of single solves and batches. With --all it also
    compiles those of scenes, rankings, motions, logs and diagnoses, so that later
    commands compile nothing.

    exit codes: 0 done, 2 bad input
    """
    robots = [load_robot(name) for name in args.robots]
    if find_compiler() is None:
        raise UnsupportedError(
            "compile: no C compiler is installed; expected one (pip install 'casadi-ik[compiler]')"
        )
    lines = []
    for robot in robots:
        robot_start, graphs = time.perf_counter(), list(kernel_uses(robot, args.all))
        for i, (graph_name, compile_graph) in enumerate(graphs, start=1):
            start = time.perf_counter()
            compile_graph()
            elapsed = time.perf_counter() - start
            print_message(
                "compiled", f"{robot.name} {i}/{len(graphs)}: {graph_name} ({elapsed:.1f} s)"
            )
        lines.append(Text(f"  {robot.name}: {time.perf_counter() - robot_start:.1f} s"))
    summary = f"{count_text(len(robots), 'robot')} in {cache_directory()}"
    return CommandResult(Group(headline(True, "COMPILED", summary), *lines))
