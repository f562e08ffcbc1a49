"""`casadi-ik import`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arms.recognise import family_in_words, is_searched
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import located
from casadi_ik.cli.report import fields, files, headline, table
from casadi_ik.cli.say import PROGRAM
from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.importing import imported
from casadi_ik.importing.capsules import worst
from casadi_ik.importing.check import largest_difference
from casadi_ik.importing.imported import Imported
from casadi_ik.importing.surfaces import Surface
from casadi_ik.robots.parts import PREFIX

SAMPLES = 20
"""Postures in which kinematics are compared."""

SEARCHED = (
    "  the arm has no known closed form: it is searched, and a solve takes several times as long"
)
"""Said of an arm whose axes are those of no family."""

SHAPELESS = "  the files have no shapes of links: a scene needs `collision:` in the description"
"""Said where there is nothing to be fitted."""

GUESSED = (
    "  pads, thumb, palm and home are guesses (delete the line of a finger that is none): see the "
    "lines marked GUESS"
)
"""Last words of the report."""

SAME = 1e-9
"""Poses that differ by no more [m, or in their axes] are the same."""


def import_robot(arguments: argparse.Namespace) -> Answer:
    """Write a description of somebody's files.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
    """
    first, hand = Path(arguments.first), arguments.hand and Path(arguments.hand)
    arm, hand = (first, hand) if hand else (None, first)
    out, picture = arguments.out, arguments.picture
    if first.suffix in (".yaml", ".yml"):
        return _drawn_again(first, arguments)
    if out is None:
        raise InputError("--out: missing, expected the name of the description to be written")
    srdf = arguments.srdf and Path(arguments.srdf)
    outputs = {"--out": out, "--picture": picture}
    check_outputs(outputs.items(), inputs=[one for one in (arm, hand, srdf) if one])
    draw = _drawing() if picture is not None else None
    found = imported.import_robot(
        arm,
        hand,
        out,
        command=_command(arguments),
        tip=arguments.tip,
        palm=arguments.palm,
        mount=_mount(arguments),
        shapes=draw is not None,
        xacro=arguments.xacro,
    )
    robots: list[ArmHand] = []
    differences: dict[str, float] = {}

    def write(part: Path) -> None:
        nonlocal found
        part.write_text(found.written.text(), encoding="utf-8")
        found = found.at_home(part)
        part.write_text(found.written.text(), encoding="utf-8")
        found = found.with_shapes(part, srdf)
        part.write_text(found.written.text(), encoding="utf-8")
        robots.append(imported.loaded(part))
        if arguments.check:
            differences.update(_differences(robots[0], found))
        if draw is not None and picture is not None:
            draw(robots[0], found.surfaces, picture)

    write_output(out, "--out", write)
    same = all(value <= SAME for value in differences.values())
    written = [("out", out)] + ([("picture", picture)] if picture is not None else [])
    report = _report(robots[0], found, differences)
    return Answer(Group(*report, *files(written)), Exit.DONE if same else Exit.NOT_SOLVED)


def _drawn_again(path: Path, arguments: argparse.Namespace) -> Answer:
    """The pads of a description as it stands now; nothing else is written."""
    picture = arguments.picture
    if arguments.hand or arguments.out is not None or picture is None:
        raise InputError(f"{path}: is a description already, expected --picture and no --out")
    check_outputs([("--picture", picture)], inputs=[path])
    draw = _drawing()
    robot = imported.loaded(path)
    draw(robot, imported.described_surfaces(path), picture)
    what = f"{robot.name}: {len(robot.fingers)} pads"
    return Answer(Group(headline(True, "DRAWN", what), *files([("picture", picture)])))


def _command(arguments: argparse.Namespace) -> str:
    words = [PROGRAM, "import", arguments.first]
    words += [arguments.hand] if arguments.hand else []
    words += ["--out", str(arguments.out)]
    for option in ("tip", "palm"):
        if getattr(arguments, option) is not None:
            words += [f"--{option}", getattr(arguments, option)]
    words += ["--xacro"] if arguments.xacro else []
    if arguments.srdf is not None:
        words += ["--srdf", arguments.srdf]
    if arguments.mount is not None:
        words += ["--mount", *(f"{value:g}" for value in _mount(arguments) or ())]
    return shlex.join(words)


def _mount(arguments: argparse.Namespace) -> list[float] | None:
    if arguments.mount is None:
        return None
    values = [value for group in arguments.mount for value in group]
    if len(values) != 6:
        raise InputError(
            f"--mount: found {len(values)} numbers, expected six: x y z [m] r p y [rad]"
        )
    return values


def _drawing() -> Callable[[ArmHand, dict[str, Surface], Path], object]:
    """The function that draws the pads, after making sure that it can."""
    with located("--picture", (MissingExtraError,)):
        from casadi_ik.views import draw_pads

    def draw(robot: ArmHand, surfaces: dict[str, Surface], path: Path) -> object:
        links = robot.description.links
        named = {PREFIX + link if PREFIX + link in links else link: link for link in surfaces}
        return draw_pads(robot, {ours: surfaces[link] for ours, link in named.items()}, path)

    return draw


def _differences(robot: ArmHand, found: Imported) -> dict[str, float]:
    """The largest difference from the file's own library, by file."""
    q = robot.random(np.random.default_rng(0), SAMPLES)
    arm, hand = found.files
    lines = found.written
    values: dict[str, float] = {}
    if arm is not None and lines.arm is not None:
        difference = largest_difference(robot, arm, q, lines.arm.locked, carried=hand)
        values[str(arm.path) if arm.path.name == hand.path.name else arm.path.name] = difference
    values[hand.path.name] = largest_difference(robot, hand, q, lines.hand.locked, arm)
    return values


def _report(robot: ArmHand, found: Imported, differences: dict[str, float]) -> list[RenderableType]:
    description, lines = robot.description, found.written
    arm = len(description.arm_actuators)
    count = len(description.actuators)
    what = (
        f"{lines.name}: {count} motors ({arm} arm, {count - arm} hand), {len(found.pads)} fingers"
    )
    pairs = {}
    if lines.arm is not None:
        pairs["tip"] = f"{lines.arm.end}: {lines.arm.how}"
        pairs["mount"] = lines.mount_how
    pairs["palm"] = f"{lines.hand.end}: {lines.hand.how}"
    if arm:
        pairs["closed form"] = family_in_words(description)
    pairs["thumb"] = f"{lines.thumb[0]}: {lines.thumb[1]}"
    for line in filter(None, (lines.arm, lines.hand)):
        if line.limits:
            pairs["limits"] = f"assumed, since {Path(line.file).name} states none: " + ", ".join(
                line.limits
            )
    if lines.hand.spinning:
        still = ", ".join(sorted(lines.hand.spinning))
        pairs["locked"] = f"{still}: turns without end, so it is no finger and stands still"
    for name, value in differences.items():
        verdict = "as its own library has it" if value <= SAME else "NOT as its own library has it"
        pairs[f"check {name}"] = f"{verdict}: poses differ by at most {value:.1e}"
    if lines.shapes:
        count = sum(map(len, lines.shapes.values()))
        pairs["shapes"] = (
            f"{count} on {len(lines.shapes)} links, at most {1e3 * worst(lines.shapes):.0f} mm "
            f"beyond their meshes; {len(lines.touching)} pairs may touch"
        )
    rows = table("finger", "pad on link", "joints", "point [mm]", "normal", right=("joints",))
    for branch, pad in zip(found.branches, found.pads, strict=True):
        # What is rounded to -0.0 is zero.
        point = " ".join(f"{round(1e3 * value, 1) + 0.0:.1f}" for value in pad.point)
        normal = " ".join(f"{round(value, 2) + 0.0:.2f}" for value in pad.normal.tolist())
        rows.add_row(branch.name, pad.link, str(len(branch.chain)), point, normal)
    notes: list[RenderableType] = [Text(f"  {note}", "yellow") for note in lines.notes]
    if is_searched(description):
        notes.append(Text(SEARCHED, "yellow"))
    if not lines.shapes:
        notes.append(Text(SHAPELESS, "yellow"))
    guessed = Text(GUESSED, "yellow")
    return [headline(True, "IMPORTED", what), fields(pairs), rows, *notes, guessed]
