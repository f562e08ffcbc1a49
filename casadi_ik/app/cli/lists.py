"""Lists of what there is (`casadi-ik robots`, `methods`, ...), schemas of files, completion."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from casadi_ik.api import METHODS
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.options import PROGRAM, Option, one_of
from casadi_ik.app.cli.outputs import output, writing
from casadi_ik.app.cli.table import COMMANDS, GROUPS, Answer, Said, command, load, names
from casadi_ik.app.report import headline, robot_report, table
from casadi_ik.collision.scene import SceneFile
from casadi_ik.files.reading import convert_entry, read_yaml
from casadi_ik.files.shipped import BODIES_FOLDER, resolve_description, shipped_names
from casadi_ik.files.units import json_schema
from casadi_ik.integrations.datasets.layouts import ConventionFile
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.load_grasp import CandidatesFile, GraspFile
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.objects import ObjectFile
from casadi_ik.model.schema import (
    ArmFile,
    ArmHandFile,
    BodyFile,
    HandFile,
    ImportedBody,
    ImportedFile,
)
from casadi_ik.motion.retarget import Retarget
from casadi_ik.solve.registry import method_summary

FILES: dict[str, tuple[Any, str]] = {
    "robot": (ArmHandFile | ImportedFile, "A robot: an arm, a hand, and what joins them"),
    "arm": (ArmFile, "An arm, described in full"),
    "hand": (HandFile, "A hand, described in full"),
    "body": (BodyFile | ImportedBody, "A body: several arm-hands, or one on a trunk"),
    "grasp": (GraspFile, "A grasp: a contact per finger, or a palm and a posture"),
    "candidates": (CandidatesFile, "Grasps, of which one is to be chosen"),
    "scene": (SceneFile, "A scene: what answers must not touch"),
    "object": (ObjectFile, "An object to be grasped"),
    "retarget": (Retarget, "How a person's hand moves a robot's"),
    "dataset": (ConventionFile, "How a data set has a hand: its joints and its frame"),
}
"""By kind of file its type, and a title."""

IN_A_FILE: dict[str, Any] = {
    "anyOf": [
        {"required": ["robot"]},
        {"required": ["hand"], "properties": {"hand": {"type": "object", "required": ["file"]}}},
    ]
}
"""Of which robots the hand is in somebody's file: those that are read as `ImportedFile`."""


def schema_of(kind: str) -> dict[str, Any]:
    """The JSON Schema of a kind of `FILES`."""
    schema = json_schema(*FILES[kind])
    if kind == "robot":
        described, imported = schema.pop("anyOf")
        schema |= {"if": IN_A_FILE, "then": imported, "else": described}
    if kind == "body":
        together, imported = schema.pop("anyOf")
        schema |= {"if": {"required": ["robot"]}, "then": imported, "else": together}
    return schema


@command()
def robots(_: Said) -> Answer:
    """List the shipped robots: fingers and actuators."""
    parts: list[RenderableType] = []
    for name in shipped_names("arm_hands"):
        path = resolve_description(name, "arm_hands")
        about = convert_entry(read_yaml(path), ArmHandFile, path).description
        parts.append(robot_report(load_description(path), about))
    return Answer(Group(*parts, *_catalogue()))


def _catalogue() -> list[RenderableType]:
    """The arms and hands that are put together by their names."""
    arms = table("arm", "joints", "closed form", "what it is", right=("joints",))
    some_hand = shipped_names("hands")[0]
    for name in shipped_names("arms"):
        path = resolve_description(name, "arms")
        arm = convert_entry(read_yaml(path), ArmFile, path)
        count = sum(joint.type != "fixed" for joint in arm.joints)
        form = describe_arm(load_description(f"{name}+{some_hand}"))
        arms.add_row(name, str(count), form, _short(arm.description))
    hands = table("hand", "motors", "fingers", "what it is", right=("motors", "fingers"))
    for name in shipped_names("hands"):
        path = resolve_description(name, "hands")
        hand = convert_entry(read_yaml(path), HandFile, path)
        motors = hand.actuators or [
            joint for joint in hand.joints if joint.type != "fixed" and joint.coupling is None
        ]
        hands.add_row(name, str(len(motors)), str(len(hand.fingers)), _short(hand.description))
    example = 'any arm with any hand: load_robot("ARM+HAND"), --robot ARM+HAND, such as'
    bodies = table("body", "trunk", "motors", "sides", "what it is", right=("motors",))
    for name in shipped_names(BODIES_FOLDER):
        path = resolve_description(name, BODIES_FOLDER)
        body = convert_entry(read_yaml(path), BodyFile, path)
        whole = all(side.hand is not None for side in body.sides.values())
        motors = str(len(load_description(name).actuators)) if whole else "by its hand"
        trunk = body.trunk if isinstance(body.trunk, str) else ""
        label = name if whole else f"{name}+HAND"
        bodies.add_row(label, trunk, motors, ", ".join(body.sides), _short(body.description))
    return [Text(f"{example} panda+allegro_right", "bold"), arms, hands, bodies]


def _short(description: str) -> str:
    """The first sentence of a description."""
    return description.split(". ")[0].rstrip(".\n")


@command()
def methods(_: Said) -> Answer:
    """List the methods, the default first."""
    rows = table("method", "what it does")
    for name in METHODS:
        default = " (default)" if name == METHODS[0] else ""
        rows.add_row(name, method_summary(name) + default)
    return Answer(rows)


@command()
def grasps(_: Said) -> Answer:
    """List the shipped grasps."""
    by_robot: dict[str, Table] = {}
    for name in shipped_names("grasps"):
        path = resolve_description(name, "grasps")
        entry = convert_entry(read_yaml(path), GraspFile, path)
        rows = by_robot.setdefault(entry.robot, table("grasp", "object", "description"))
        rows.add_row(name, entry.object.name if entry.object else "", entry.description)
    parts: list[RenderableType] = []
    for robot, rows in by_robot.items():
        parts += [Text.assemble("robot ", (robot or "any", "bold")), rows]
    return Answer(Group(*parts))


@command()
def objects(_: Said) -> Answer:
    """List the shipped objects, which grasps and scenes name."""
    return Answer(_described("objects", "object", ObjectFile))


@command()
def scenes(_: Said) -> Answer:
    """List the shipped scenes: what `--scene` may be, beside a file of your own."""
    return Answer(_described("scenes", "scene", SceneFile))


def _described(kind: str, head: str, schema: type[ObjectFile | SceneFile]) -> Table:
    rows = table(head, "description")
    for name in shipped_names(kind):
        path = resolve_description(name, kind)
        rows.add_row(name, convert_entry(read_yaml(path), schema, path).description)
    return rows


@command(opt.out("DIR", "folder to write"))
def schemas(said: Said) -> Answer:
    """Write JSON Schemas of the files that people write, with which editors complete keys.

    Example:
      casadi-ik schemas --out .schemas

    Then an editor with a YAML language server completes and checks a file whose
    first line is, say,
      # yaml-language-server: $schema=.schemas/grasp.json

    exit codes: 0 written, 2 bad input
    """
    lines = []
    for kind, (_, title) in FILES.items():
        path = said.out / f"{kind}.json"
        with writing(path, "--out"):
            said.out.mkdir(parents=True, exist_ok=True)
        with output(path) as part:
            part.write_text(json.dumps(schema_of(kind), indent=1) + "\n", encoding="utf-8")
        lines.append(Text(f"  {path}  {title}"))
    return Answer(Group(headline(True, "WRITTEN", f"{len(FILES)} schemas"), *lines))


SHIPPED = {
    "GRASP": ("grasps",),
    "GRASP|ROBOT|LOG|CHOICES": ("grasps", "arm_hands"),
    "--robot": ("arm_hands",),
    "ROBOT": ("arm_hands",),
    "--scene": ("scenes",),
    "--object": ("objects",),
}
"""Kinds of shipped names that a value may be, by the option or by what stands for the value."""

BASH = """\
_casadi_ik() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} place= known=
    ((COMP_CWORD > 1)) && place=${{COMP_WORDS[1]}}
    [[ $place == log ]] && ((COMP_CWORD > 2)) && place="log ${{COMP_WORDS[2]}}"
    case "$place:$before" in
{cases}
    esac
    COMPREPLY=($(compgen -f -W "$known" -- "$word"))
}}
complete -o filenames -F _casadi_ik {program}
"""


@command(Option("SHELL", "which shell", read=one_of("bash", "zsh", "fish")))
def completion(said: Said) -> Answer:
    """Print a script by which a shell completes commands, options and shipped names with TAB.

    Examples:
      eval "$(casadi-ik completion bash)"      in ~/.bashrc
      eval "$(casadi-ik completion zsh)"       in ~/.zshrc, behind compinit
      casadi-ik completion fish > ~/.config/fish/completions/casadi-ik.fish

    exit codes: 0 printed, 2 bad input
    """
    return Answer({"bash": _bash, "zsh": _zsh, "fish": _fish}[said.shell]())


def _words(option: Option) -> list[str]:
    """What an option or an argument may be, as far as that is known."""
    if option.name == "--method":
        return list(METHODS)
    kinds = SHIPPED.get(option.name) or SHIPPED.get(option.metavar, ())
    return option.choices + [name for kind in kinds for name in shipped_names(kind)]


def _bash() -> str:
    cases = []
    for group in GROUPS:
        known = [name.rpartition(" ")[2] for name in names(group)]
        cases.append(f'"{group}:"*) known="{" ".join(known)}" ;;')
    for name in COMMANDS:
        if name in GROUPS:
            continue
        options = load(name).options
        for option in options:
            if option.dashed and option.metavar:
                cases.append(f'"{name}:{option.name}") known="{" ".join(_words(option))}" ;;')
        known = [one.name for one in options if one.dashed]
        known += [word for one in options if not one.dashed for word in _words(one)]
        cases.append(f'"{name}:"*) known="{" ".join(known)}" ;;')
    return BASH.format(cases="\n".join(f"        {case}" for case in cases), program=PROGRAM)


def _zsh() -> str:
    return f"autoload -U +X bashcompinit && bashcompinit\n{_bash()}"


def _fish() -> str:
    lines = []
    for name, (_, summary) in COMMANDS.items():
        group, _, word = name.rpartition(" ")
        seen = "__fish_seen_subcommand_from"
        outer = f"{seen} {group}" if group else "__fish_use_subcommand"
        lines.append(f"-n '{outer}' -f -a {word} -d '{summary}'")
        if name in GROUPS:
            continue
        inner = f"{seen} {word}; and {'' if group else 'not '}{seen} log"
        for option in load(name).options:
            values = f" -a '{' '.join(_words(option))}'"
            text = option.help.partition(";")[0].partition(":")[0].replace("'", "")
            shown = f" -l {option.name[2:]}" + " -r" * bool(option.metavar) if option.dashed else ""
            lines.append(f"-n '{inner}'{shown}{values if option.metavar else ''} -d '{text}'")
    return "".join(f"complete -c {PROGRAM} {line}\n" for line in lines)
